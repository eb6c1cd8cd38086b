"""What does not depend on an input becomes a constant."""

from __future__ import annotations

import numpy as np
import pytest

from export_model.converters.compiler.passes.fold import fold
from export_model.converters.graph.nodes import Graph
from export_model.converters.graph.types import FLOAT32, INT32
from tests.graph.making import const, graph, node, ops, placeholder
from tests.graph.running import same_values
from tests.graph.samples import f32, floats

pytestmark = pytest.mark.xdist_group("graph-passes")


def test_fold_leaves_matrix_products_to_the_runtime() -> None:
    image, kernel = const("image", floats(1, 3, 3, 2)), const("kernel", floats(2, 2, 2, 2))
    made = fold(
        graph(
            const("a", floats(2, 3)),
            const("b", floats(3, 2, seed=1)),
            node("product", "MatMul", "a", "b"),
            node("twice", "Add", "product", "product"),
            image,
            kernel,
            node("convolved", "Conv2D", "image", "kernel", strides=(1, 1, 1, 1), padding="VALID"),
            node("sum", "Add", "a", "a"),
        )
    )
    assert ops(made) == ["MatMul", "Add", "Conv2D"]
    assert made["sum"].op == "Const"
    np.testing.assert_array_equal(made["sum"].value, 2 * floats(2, 3))


def test_fold_leaves_samplers() -> None:
    made = fold(graph(const("shape", [2, 3]), node("draw", "RandomStandardNormal", "shape", dtype=FLOAT32)))
    assert ops(made) == ["RandomStandardNormal"]


def test_fold_does_not_unpack_large_constants() -> None:
    made = fold(
        graph(const("shape", [2048, 1024]), const("one", f32(1).reshape(())), node("ones", "Fill", "shape", "one"))
    )
    assert ops(made) == ["Fill"]


def test_fold_keeps_name_and_origin() -> None:
    made = fold(graph(const("a", 3), const("b", 4), node("sum", "Add", "a", "b")))
    assert (made["sum"].op, made["sum"].origin) == ("Const", "sum:0")
    assert made.constant("sum") == 7


def test_fold_makes_a_constant_of_every_output() -> None:
    before = graph(
        const("axis", 1),
        const("whole", floats(2, 6)),
        node("split", "Split", "axis", "whole", num_split=3),
        placeholder("x", (None, 2)),
        node("y", "Add", "x", "split:1"),
        node("z", "Add", "y", "split:2"),
        # a name that the second output would like
        node("split/1", "Neg", "x"),
    )
    made = fold(before)
    assert ops(made) == ["Add", "Add", "Neg"]
    same_values(before, made, {"x": floats(2, 2)}, {"z": "z", "split": "split", "split/1": "split/1"})


def flattening(*, joined: bool) -> Graph:
    """[batch, 2, 3, 4] as rows, by shape arithmetic as tf.layers.flatten and tf.contrib wrote it."""
    shape = [
        placeholder("x", (None, 2, 3, 4)),
        node("shape", "Shape", "x", out_type=INT32),
        const("zero", 0),
        const("begin", [0]),
        const("one", [1]),
        const("size", [3]),
        const("axis", [0]),
        node("inner", "Slice", "shape", "one", "size"),
        node("width", "Prod", "inner", "axis"),
    ]
    if joined:
        target = [
            node("rows", "Slice", "shape", "begin", "one"),
            node("column", "ExpandDims", "width", "zero"),
            node("to", "ConcatV2", "rows", "column", "zero"),
        ]
    else:
        rows = node("rows", "StridedSlice", "shape", "begin", "one", "one", shrink_axis_mask=1)
        target = [rows, node("to", "Pack", "rows", "width")]
    return graph(*shape, *target, node("flat", "Reshape", "x", "to"), node("y", "Neg", "flat"))


@pytest.mark.parametrize("joined", [True, False])
def test_fold_gives_a_reshape_its_open_axis(joined: bool) -> None:
    before = flattening(joined=joined)
    made = fold(before).prune(["y"])
    assert ops(made) == ["Reshape", "Neg"]
    target = made.constant(made["flat"].inputs[1])
    assert target is not None
    assert target.tolist() == [-1, 24]
    for batch in (1, 3):
        same_values(before, made, {"x": floats(batch, 2, 3, 4)}, {"y": "y"})


def test_fold_keeps_a_reshape_with_two_open_axes() -> None:
    before = graph(
        placeholder("x", (None, None, 4)),
        node("shape", "Shape", "x", out_type=INT32),
        node("y", "Reshape", "x", "shape"),
    )
    made = fold(before)
    assert ops(made) == ["Shape", "Reshape"]
    same_values(before, made, {"x": floats(2, 3, 4)}, {"y": "y"})


def test_folding_again_changes_nothing() -> None:
    made = fold(flattening(joined=True))
    assert [(n.name, n.op, n.inputs) for n in fold(made).nodes] == [(n.name, n.op, n.inputs) for n in made.nodes]
