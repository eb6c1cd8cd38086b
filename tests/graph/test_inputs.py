"""Placeholders: values, sizes, and shapes that the file does not say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from export_model.converters.compiler.passes.inputs import batch_size_rank, complete_shapes, set_values, settle_inputs
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import FLOAT32
from export_model.signatures.errors import UsageError
from export_model.signatures.roles import Role
from tests.graph.making import const, graph, node, placeholder
from tests.graph.running import value
from tests.graph.samples import f32, floats

pytestmark = pytest.mark.xdist_group("graph-passes")


def sized(shape: Sequence[int | None] | None, *, vector: bool) -> Graph:
    """``y = x + zeros([batch_size, 2])`` with batch_size as a number or a vector of one."""
    dims = (
        [const("axis", 0), const("width", [2]), node("dims", "ConcatV2", "batch_size", "width", "axis")]
        if vector
        else [const("width", 2), node("dims", "Pack", "batch_size", "width")]
    )
    return graph(
        placeholder("x", (None, 2)),
        placeholder("batch_size", shape, np.int32),
        *dims,
        const("zero", f32(0).reshape(())),
        node("zeros", "Fill", "dims", "zero"),
        node("y", "Add", "x", "zeros"),
    )


ROLES = {"x": Role.VECTOR, "batch_size": Role.BATCH_SIZE}


@pytest.mark.parametrize(
    ("shape", "vector"),
    [((), False), (None, False), ((None,), True), ((1,), True), (None, True)],
)
def test_the_batch_size_is_taken_from_an_observation(shape: Sequence[int | None] | None, vector: bool) -> None:
    made = sized(shape, vector=vector)
    assert batch_size_rank(made, made["batch_size"]) == vector
    after = settle_inputs(made, ROLES)
    assert "batch_size" not in {n.name for n in after.prune(["y"]).nodes}
    for batch in (1, 3):
        x = floats(batch, 2)
        size = np.array([batch] if vector else batch, np.int32)
        np.testing.assert_array_equal(
            value(after, {"x": x}, "y"), value(made, {"x": x, "batch_size": size}, "y"), strict=True
        )
    assert infer_types(after)["y"].shape == ("batch", 2)


def test_the_sequence_length_is_one() -> None:
    made = graph(
        placeholder("x", (None, 2)),
        placeholder("sequence_length", (), np.int32),
        placeholder("steps", (None,), np.int32),
        node("both", "Add", "sequence_length", "steps"),
    )
    roles = {"x": Role.VECTOR, "sequence_length": Role.SEQUENCE_LENGTH, "steps": Role.SEQUENCE_LENGTH}
    after = settle_inputs(made, roles)
    assert {n.name for n in after.nodes if n.op == "Placeholder"} == {"x"}
    assert after["steps"].origin == "steps:0"
    np.testing.assert_array_equal(value(after, {}, "both"), np.array([2], np.int32), strict=True)


def test_a_default_that_has_a_role_is_an_input() -> None:
    attrs = {"dtype": FLOAT32, "shape": TensorShape((None, 2))}
    made = graph(
        placeholder("x", (None, 2)),
        const("default", f32(1, 2)),
        Node("epsilon", "PlaceholderWithDefault", ("default",), attrs, origin="epsilon:0"),
        Node("other", "PlaceholderWithDefault", ("default",), attrs),
    )
    after = settle_inputs(made, {"x": Role.VECTOR, "epsilon": Role.NOISE})
    assert after["epsilon"] == Node("epsilon", "Placeholder", (), attrs, origin="epsilon:0")
    assert after["other"].op == "PlaceholderWithDefault"


def test_values_from_the_command_line_become_constants() -> None:
    made = graph(
        placeholder("gain", (None, 2)),
        placeholder("flag", (), np.bool_),
        placeholder("count", None, np.int32),
        node("y", "Neg", "gain"),
    )
    after = set_values(made, {"gain": 1.5, "flag": 1, "count": 3})
    assert {n.op for n in after.nodes} == {"Const", "Neg"}
    np.testing.assert_array_equal(after["gain"].value, f32(1.5, 1.5).reshape(1, 2), strict=True)
    np.testing.assert_array_equal(after["flag"].value, np.array(True), strict=True)
    np.testing.assert_array_equal(after["count"].value, np.array(3, np.int32), strict=True)
    assert after["gain"].origin == "gain:0"


@pytest.mark.parametrize(
    ("name", "said"), [("absent", "'absent', which is not in the graph"), ("y", "'y', which is a Neg")]
)
def test_values_for_anything_else_are_refused(name: str, said: str) -> None:
    made = graph(placeholder("x", (None, 2)), node("y", "Neg", "x"))
    with pytest.raises(UsageError, match=said):
        set_values(made, {name: 1.0})


def camera(side: int, *, shape: Sequence[int | None] | None, pool: str | None = None) -> Graph:
    """Two convolutions (and a pool) over an image of ``side`` x ``side`` x 3, flattened into a dense layer."""
    layers = [
        placeholder("x", shape),
        const("k1", floats(4, 4, 3, 5)),
        node("c1", "Conv2D", "x", "k1", strides=(1, 2, 2, 1), padding="VALID"),
        node("a1", "Elu", "c1"),
        const("k2", floats(3, 3, 5, 6)),
        node("c2", "Conv2D", "a1", "k2", strides=(1, 2, 2, 1), padding="VALID"),
    ]
    last, length = "c2", side
    for window in (4, 3):
        length = (length - window) // 2 + 1
    if pool:
        layers.append(node("p", pool, "c2", strides=(1, 2, 2, 1), ksize=(1, 3, 3, 1), padding="SAME"))
        last, length = "p", -(-length // 2)
    width = length * length * 6
    return graph(
        *layers,
        const("to", [-1, width]),
        node("flat", "Reshape", last, "to"),
        const("weights", floats(width, 2)),
        node("y", "MatMul", "flat", "weights"),
    )


@pytest.mark.parametrize("shape", [None, (None, None, None, 3), (None, None, None, None), (None, 20, None, 3)])
@pytest.mark.parametrize("pool", [None, "MaxPool", "AvgPool"])
def test_the_sides_of_an_image_are_found_from_the_dense_layer(
    shape: Sequence[int | None] | None, pool: str | None
) -> None:
    after = complete_shapes(camera(20, shape=shape, pool=pool), {"x": Role.VISUAL})
    dims = after["x"].attrs["shape"].dims
    assert dims is not None
    assert (dims[0], dims[3]) == (None, 3)
    # several sides lead to as many features; the smallest that does
    smallest = next(s for s in range(8, 21) if _features(s, pool=pool) == _features(20, pool=pool))
    assert dims[1:3] == ((20, smallest) if shape == (None, 20, None, 3) else (smallest, smallest))
    rows = floats(2, *dims[1:])  # type: ignore[arg-type]
    assert value(after, {"x": rows}, "y").shape == (2, 2)


def _features(side: int, *, pool: str | None) -> int:
    weights = camera(side, shape=None, pool=pool).constant("weights")
    assert weights is not None
    return len(weights)


def test_a_known_image_stays() -> None:
    made = camera(20, shape=(None, 20, 20, 3))
    assert complete_shapes(made, {"x": Role.VISUAL}) is made


def test_the_length_of_a_vector_is_found_from_the_dense_layer() -> None:
    """Behind the normaliser of ML-Agents, and not behind the first that reads the input."""
    made = graph(
        placeholder("x", None),
        node("size", "Shape", "x"),
        node("unread", "Abs", "x"),
        const("mean", f32(1, 2, 3, 4)),
        const("bound", f32(5)),
        node("centred", "Sub", "x", "mean"),
        node("scaled", "RealDiv", "centred", "mean"),
        node("below", "Minimum", "scaled", "bound"),
        const("weights", floats(2, 4)),
        node("y", "MatMul", "below", "weights", transpose_b=True),
        placeholder("unknown", None),
    )
    after = complete_shapes(made, {"x": Role.VECTOR, "unknown": Role.PARAMETER})
    assert after["x"].attrs["shape"] == TensorShape((None, 4))
    assert after["unknown"].attrs["shape"] == TensorShape(None)
