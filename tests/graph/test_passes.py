"""The passes between unrolling and the writers, each on graphs made by hand.

``test_normalise`` and ``test_straighten`` hold the ones before.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from converters.frozen_graph.reader import read_graph
from converters.graph.compile import compile_graph
from converters.graph.nodes import Graph, Node, TensorShape
from converters.graph.ops.table import TABLE
from converters.graph.passes.fold import fold
from converters.graph.passes.fuse import fuse
from converters.graph.passes.inputs import batch_size_rank, complete_shapes, set_values, settle_inputs
from converters.graph.passes.naming import name_tensors
from converters.graph.passes.noise import lift_noise, samplers, without_noise
from converters.graph.passes.simplify import collapse_views, drop_identities
from converters.graph.run import run_graph
from converters.graph.shapes import infer_types
from converters.graph.types import FLOAT32, INT32, INT64
from converters.understand.action import ActionMeaning
from converters.understand.brains import Head
from converters.understand.derived_outputs import LOG_PROBS, add_companions
from converters.understand.memories import memory_layout
from converters.understand.normaliser import normaliser
from fixtures import path
from signatures.errors import GraphError, UnsupportedOpError, UsageError
from signatures.roles import Role
from tests.graph.harness import Array, Runtimes, difference
from tests.graph.making import const, graph, node, ops, placeholder
from tests.graph.samples import f32, floats, ints

IDENTITIES = sorted(op.name for op in TABLE.values() if op.moves == "same")
pytestmark = pytest.mark.xdist_group("graph-passes")


def values(made: Graph, feeds: Mapping[str, Array], *names: str) -> list[Array]:
    results = run_graph(made, feeds, names)
    return [results[n] for n in names]


def value(made: Graph, feeds: Mapping[str, Array], name: str) -> Array:
    return values(made, feeds, name)[0]


def same_values(before: Graph, after: Graph, feeds: Mapping[str, Array], moved: Mapping[str, str]) -> None:
    """Fetches of the new graph have the values that they had in the old one, dtypes and shapes too."""
    for old, new in moved.items():
        np.testing.assert_array_equal(value(after, feeds, new), value(before, feeds, old), strict=True)


# ------------------------------------------------------------------ fold


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
    made = fold(before).pruned(["y"])
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


# ------------------------------------------------------------------ simplify


def test_identities_are_dropped() -> None:
    kept = graph(
        placeholder("x", (None, 2)),
        *(node(f"i{k}", op, "x" if k == 0 else f"i{k - 1}") for k, op in enumerate(IDENTITIES)),
        node("y", "Neg", f"i{len(IDENTITIES) - 1}"),
        node("out", "Identity", "y"),
        node("unread", "Exp", "x"),
    )
    made, fetches = drop_identities(kept, {"a": "out", "b": "i0"})
    assert fetches == {"a": "y", "b": "x"}
    assert [n.name for n in made.nodes] == ["x", "y"]
    assert made["y"].inputs == ("x",)


def test_identities_of_further_outputs_are_dropped() -> None:
    before = graph(
        const("axis", 1),
        placeholder("x", (None, 4)),
        node("split", "Split", "axis", "x", num_split=2),
        node("second", "Identity", "split:1"),
        node("y", "Neg", "second"),
    )
    made, fetches = drop_identities(before, {"a": "y", "b": "second"})
    assert fetches == {"a": "y", "b": "split:1"}
    same_values(before, made, {"x": floats(3, 4)}, {"y": "y", "second": "split:1"})


def collapsed(nodes: Sequence[Node], feeds: Mapping[str, Array]) -> Graph:
    """The graph with its views collapsed, after its "y" has been held against what it was."""
    before = graph(*nodes)
    made, fetches = collapse_views(before, {"y": "y"})
    same_values(before, made, feeds, {"y": fetches["y"]})
    return made


def test_a_chain_of_views_becomes_one() -> None:
    nodes = [
        placeholder("x", (None, 6)),
        const("to", [-1, 1, 6]),
        const("turn", [1, 0, 2]),
        const("last", -1),
        node("a", "Reshape", "x", "to"),
        node("b", "Transpose", "a", "turn"),
        node("c", "Squeeze", "b", squeeze_dims=(0,)),
        node("d", "ExpandDims", "c", "last"),
        node("e", "Neg", "d"),
        node("y", "Squeeze", "e", squeeze_dims=(2,)),
    ]
    made = collapsed(nodes, {"x": floats(3, 6)})
    assert ops(made) == ["Reshape", "Neg", "Reshape"]


def bounds(*operands: Sequence[int]) -> list[Node]:
    """Begin, end and strides of a slice, called "b", "e" and "s"."""
    return [const(name, operand) for name, operand in zip("bes", operands, strict=True)]


def test_views_that_lead_back_vanish() -> None:
    nodes = [
        placeholder("x", (None, 6)),
        const("to", [-1, 2, 3]),
        const("back", [-1, 6]),
        node("a", "Reshape", "x", "to"),
        node("b", "Reshape", "a", "back"),
        node("y", "Neg", "b"),
    ]
    assert ops(collapsed(nodes, {"x": floats(3, 6)})) == ["Neg"]


@pytest.mark.parametrize(
    "nodes",
    [
        [const("turn", [1, 0, 2]), node("y", "Transpose", "x", "turn")],
        [*bounds([1], [2], [1]), node("y", "StridedSlice", "x", *"bes")],
        [*bounds([0, 1], [0, 2], [1, 1]), node("y", "StridedSlice", "x", *"bes", begin_mask=1, end_mask=1)],
        [*bounds([1], [2], [1]), node("y", "StridedSlice", "x", *"bes", shrink_axis_mask=1)],
        [*bounds([0], [0], [-1]), node("y", "StridedSlice", "x", *"bes", begin_mask=1, end_mask=1)],
        [const("axis", 0), node("y", "ConcatV2", "x", "x", "axis")],
        [node("y", "Pack", "x", "x", axis=1)],
    ],
)
def test_what_moves_elements_is_no_view(nodes: Sequence[Node]) -> None:
    assert ops(collapsed([placeholder("x", (None, 2, 3)), *nodes], {"x": floats(4, 2, 3)})) == [nodes[-1].op]


@pytest.mark.parametrize(
    "nodes",
    [
        [node("y", "Pack", "x", axis=1)],
        [const("axis", 0), node("y", "ConcatV2", "x", "axis")],
        [
            *bounds([0, 0], [0, 1], [1, 1]),
            node("y", "StridedSlice", "x", *"bes", begin_mask=1, end_mask=1, shrink_axis_mask=2),
        ],
        [*bounds([0, 5], [9, -9], [1, -1]), node("y", "StridedSlice", "x", *"bes", begin_mask=1, end_mask=1)],
        [const("turn", [1, 0, 2]), node("y", "Transpose", "x", "turn")],
    ],
)
def test_what_only_renames_axes_of_one_is_a_view(nodes: Sequence[Node]) -> None:
    made = collapsed([placeholder("x", (None, 1, 3)), *nodes], {"x": floats(4, 1, 3)})
    assert set(ops(made)) <= {"Reshape"}


@st.composite
def chains(draw: st.DrawFn) -> tuple[Graph, Array]:
    """Views and what looks like them, in a row behind x, which has axes of length 1."""
    shape = [draw(st.integers(1, 3)), *draw(st.permutations([1, 2, 1, 3]))[: draw(st.integers(1, 4))]]
    free = draw(st.booleans())
    nodes = [placeholder("x", (None if free else shape[0], *shape[1:]))]
    fed = floats(*shape)
    current, dims = "x", [None if free else shape[0], *shape[1:]]

    def add(op: str, *operands: Any, **attrs: Any) -> None:
        nonlocal current
        name = f"n{len(nodes)}"
        inputs = []
        for k, operand in enumerate(operands):
            nodes.append(const(f"{name}_{k}", operand))
            inputs.append(f"{name}_{k}")
        nodes.append(node(name, op, current, *inputs, **attrs))
        current = name

    for _ in range(draw(st.integers(1, 6))):
        step = draw(st.sampled_from(["flat", "turn", "squeeze", "expand", "slice", "pack", "neg"]))
        ones = [i for i, d in enumerate(dims) if d == 1]
        if step == "flat" and dims.count(None) <= 1 and len(dims) > 1:
            at = draw(st.integers(0, len(dims) - 2))
            pair = dims[at : at + 2]
            joined = None if None in pair else pair[0] * pair[1]
            dims = [*dims[:at], joined, *dims[at + 2 :]]
            add("Reshape", [-1 if d is None else d for d in dims])
        elif step == "turn" and dims:
            order = draw(st.permutations(range(len(dims))))
            dims = [dims[i] for i in order]
            add("Transpose", order)
        elif step == "squeeze" and ones:
            axis = draw(st.sampled_from(ones))
            dims = [*dims[:axis], *dims[axis + 1 :]]
            add("Squeeze", squeeze_dims=(axis,))
        elif step == "expand":
            axis = draw(st.integers(0, len(dims)))
            dims = [*dims[:axis], 1, *dims[axis:]]
            add("ExpandDims", axis)
        elif step == "slice" and dims:
            axis = draw(st.integers(0, len(dims) - 1))
            step_by = draw(st.sampled_from([1, -1]))
            bits = (1 << axis + 1) - 1
            shrink = draw(st.booleans()) and dims[axis] == 1
            operands = [0] * (axis + 1), [1] * (axis + 1), [1] * axis + [1 if shrink else step_by]
            masks = {"begin_mask": bits, "end_mask": bits, "shrink_axis_mask": shrink << axis}
            dims = [*dims[:axis], *dims[axis + 1 :]] if shrink else dims
            add("StridedSlice", *operands, **masks)
        elif step == "pack":
            axis = draw(st.integers(0, len(dims)))
            dims = [*dims[:axis], 1, *dims[axis:]]
            add("Pack", axis=axis)
        elif step == "neg":
            add("Neg")
    nodes.append(node("y", "Identity", current))
    return graph(*nodes), fed


@settings(deadline=None, derandomize=True, max_examples=300)
@given(chains())
def test_collapsing_views_changes_no_value(case: tuple[Graph, Array]) -> None:
    before, x = case
    made, fetches = collapse_views(before, {"y": "y"})
    same_values(before, made, {"x": x}, {"y": fetches["y"]})
    # never more work than before, and no chain of views left
    assert len(ops(made)) <= len(ops(before))
    for each in made.nodes:
        if each.op == "Reshape":
            assert made.producer(each.inputs[0]).op not in ("Reshape", "Squeeze", "ExpandDims")


# ------------------------------------------------------------------ noise


def gaussian(*, in_graph: bool, scale: Node | None = None, tail: str = "Tanh") -> Graph:
    """``action = tanh(x·W + σ·ε)`` with ε fed or drawn in the graph."""
    source = (
        [
            node("rows", "Shape", "mu", out_type=INT32),
            node("epsilon", "RandomStandardNormal", "rows", dtype=FLOAT32, seed=3),
        ]
        if in_graph
        else [placeholder("epsilon", (None, 2))]
    )
    return graph(
        placeholder("x", (None, 3)),
        const("weights", floats(3, 2)),
        node("mu", "MatMul", "x", "weights"),
        scale or const("sigma", f32(0.5, 2)),
        *source,
        node("noise", "Mul", "epsilon", "sigma"),
        node("sample", "Add", "mu", "noise"),
        node("action", tail, "sample"),
    )


def mean(x: Array) -> Array:
    return np.tanh(x.astype(np.float64) @ floats(3, 2)).astype(np.float32)


def test_lifted_noise_is_an_input_of_the_sampler_s_name() -> None:
    before = gaussian(in_graph=True)
    assert [n.name for n in samplers(before)] == ["epsilon"]
    made = lift_noise(before, "lift")
    assert samplers(made) == []
    assert made["epsilon"] == Node(
        "epsilon", "Placeholder", (), {"dtype": FLOAT32, "shape": TensorShape((None, 2))}, origin="epsilon:0"
    )
    feeds = {"x": floats(4, 3, seed=1), "epsilon": floats(4, 2, seed=2)}
    same_values(before, made, feeds, {"action": "action"})


def test_kept_noise_stays_in_the_graph() -> None:
    before = gaussian(in_graph=True)
    assert lift_noise(before, "keep") is before
    fed = gaussian(in_graph=False)
    assert lift_noise(fed, "lift") is fed


def test_zero_noise_leaves_the_mean_in_any_batch() -> None:
    made = lift_noise(gaussian(in_graph=True), "zero")
    assert made["epsilon"].op == "Const"
    for batch in (1, 4):
        x = floats(batch, 3)
        np.testing.assert_allclose(value(made, {"x": x}, "action"), mean(x), rtol=1e-6)


def test_noise_of_unknown_rank_is_not_lifted() -> None:
    made = graph(placeholder("shape", (None,), np.int32), node("draw", "RandomStandardNormal", "shape", dtype=FLOAT32))
    with pytest.raises(UnsupportedOpError, match="'draw'") as caught:
        lift_noise(made, "lift")
    assert caught.value.issues == (("draw", "RandomStandardNormal"),)


@pytest.mark.parametrize("in_graph", [True, False])
def test_an_action_without_noise_stands_beside_the_noisy_one(in_graph: bool) -> None:
    before = gaussian(in_graph=in_graph)
    made, still = without_noise(before, "action", {"epsilon": (None, 2)}, "quiet")
    x, epsilon = floats(4, 3), floats(4, 2, seed=2)
    np.testing.assert_allclose(value(made, {"x": x}, still), mean(x), rtol=1e-6)
    same_values(before, made, {"x": x, "epsilon": epsilon}, {"action": "action"})
    # the mean itself: neither a product with zero nor a sum with it
    assert ops(made.pruned([still])) == ["MatMul", "Tanh"]


def test_an_overflowing_deviation_does_not_reach_the_quiet_action() -> None:
    endless = node("sigma", "Exp", "far")
    before = graph(const("far", f32(1e4).reshape(())), *gaussian(in_graph=False, scale=endless).nodes)
    made, still = without_noise(before, "action", {"epsilon": (None, 2)}, "quiet")
    assert np.isfinite(value(made, {"x": floats(4, 3)}, still)).all()


def test_noise_subtracted_or_added_to_a_row_is_taken_out() -> None:
    before = graph(
        placeholder("x", (None, 2)),
        placeholder("epsilon", (None, 2)),
        const("row", f32(3, 4)),
        node("less", "Sub", "x", "epsilon"),
        node("shifted", "Add", "row", "epsilon"),  # broadcast: the row alone has another shape
        node("y", "Add", "less", "shifted"),
    )
    made, still = without_noise(before, "y", {"epsilon": (None, 2)}, "quiet")
    x = floats(3, 2)
    np.testing.assert_array_equal(value(made, {"x": x}, still), x + f32(3, 4))
    made, still = without_noise(before, "shifted", {"epsilon": (None, 2)}, "quiet")
    np.testing.assert_array_equal(value(made, {"x": x}, still), f32(3, 4).reshape(1, 2), strict=True)


def test_without_noise_nothing_is_copied() -> None:
    made = graph(placeholder("x", (None, 2)), placeholder("epsilon", (None, 2)), node("action", "Tanh", "x"))
    assert without_noise(made, "action", {"epsilon": (None, 2)}, "quiet") == (made, "action")


# ------------------------------------------------------------------ companions

ACTION = Head("action", "action")


def companions(made: Graph, role: Role, branches: Sequence[str] = (), **more: str) -> tuple[Graph, dict[str, str]]:
    meaning = ActionMeaning(role, tuple(branches))
    return add_companions(made, {"action": "action", **more}, ACTION, meaning, {"epsilon": (None, 2)})


def test_continuous_with_noise_gets_its_mean() -> None:
    made, fetches = companions(gaussian(in_graph=True), Role.CONTINUOUS)
    assert fetches.keys() == {"action", "deterministic_action"}
    x = floats(4, 3)
    np.testing.assert_allclose(value(made, {"x": x}, fetches["deterministic_action"]), mean(x), rtol=1e-6)


def test_continuous_without_noise_is_its_own_companion() -> None:
    made = graph(placeholder("x", (None, 2)), node("action", "Tanh", "x"))
    after, fetches = companions(made, Role.CONTINUOUS)
    assert after is made
    assert fetches == {"action": "action", "deterministic_action": "action"}


SIZES = (3, 2)


def branches(kind: str) -> tuple[Graph, list[str]]:
    """A policy of two branches: its "action", and the tensor of each branch."""
    logits = [placeholder("x", (None, 5)), const("axis", 1), const("sizes", list(SIZES))]
    logits.append(node("logits", "SplitV", "x", "sizes", "axis", num_split=2))
    parts = ["logits", "logits:1"]
    if kind == "sampled":
        inner = [node(f"draw_{i}", "Multinomial", p, "one", output_dtype=INT64) for i, p in enumerate(parts)]
        inner = [const("one", 1), *inner]
        made, found = ["draw_0", "draw_1"], parts
    else:
        op = {"log_probs": "LogSoftmax", "probs": "Softmax"}[kind]
        inner = [node(f"branch_{i}", op, p) for i, p in enumerate(parts)]
        made = found = ["branch_0", "branch_1"]
    return graph(*logits, *inner, node("action", "ConcatV2", *made, "axis")), found


def log_softmax(x: Array) -> Array:
    return x - np.log(np.exp(x.astype(np.float64)).sum(axis=1, keepdims=True))


@pytest.mark.parametrize("kind", ["sampled", "log_probs", "probs"])
def test_discrete_actions_get_the_best_of_each_branch(kind: str) -> None:
    before, found = branches(kind)
    made, fetches = companions(before, Role[kind.upper()], found)
    x = floats(6, 5)
    best = value(made, {"x": x}, fetches["deterministic_action"])
    expected = np.stack([x[:, :3].argmax(1), x[:, 3:].argmax(1)], axis=1)
    np.testing.assert_array_equal(best, expected, strict=True)
    assert infer_types(made)[fetches["deterministic_action"]].dtype == INT64
    if kind == "sampled":
        expected = np.concatenate([log_softmax(x[:, :3]), log_softmax(x[:, 3:])], axis=1)
        np.testing.assert_allclose(value(made, {"x": x}, fetches[LOG_PROBS]), expected, atol=1e-6)
    else:
        assert LOG_PROBS not in fetches


def test_one_branch_is_not_joined() -> None:
    before = graph(
        placeholder("x", (None, 3)), const("one", 1), node("action", "Multinomial", "x", "one", output_dtype=INT64)
    )
    made, fetches = companions(before, Role.SAMPLED, ["x"])
    assert "ConcatV2" not in ops(made)
    x = floats(4, 3)
    np.testing.assert_allclose(value(made, {"x": x}, fetches[LOG_PROBS]), log_softmax(x), atol=1e-6)
    np.testing.assert_array_equal(
        value(made, {"x": x}, fetches["deterministic_action"]), x.argmax(1)[:, None], strict=True
    )


@pytest.mark.parametrize(
    ("shape", "dtype"), [((3,), np.int32), ((3,), np.int64), ((3, 2), np.int32), ((3, 2), np.int64)]
)
def test_an_integer_action_is_its_own_companion_in_columns(shape: tuple[int, ...], dtype: Any) -> None:
    before = graph(placeholder("x", (None, *shape[1:]), dtype), node("action", "Abs", "x"))
    made, fetches = companions(before, Role.DETERMINISTIC)
    x = ints(*shape, dtype=dtype)
    expected = np.abs(x).astype(np.int64).reshape(3, -1)
    np.testing.assert_array_equal(value(made, {"x": x}, fetches["deterministic_action"]), expected, strict=True)


def test_companions_that_the_source_has_stay() -> None:
    before, found = branches("sampled")
    own = {"deterministic_action": "logits", LOG_PROBS: "logits:1"}
    made, fetches = companions(before, Role.SAMPLED, found, **own)
    assert fetches == {"action": "action", **own}
    assert [n.name for n in made.nodes] == [n.name for n in before.nodes]
    before = gaussian(in_graph=True)
    made, fetches = companions(before, Role.CONTINUOUS, deterministic_action="mu")
    assert made is before
    assert fetches["deterministic_action"] == "mu"


def test_a_hybrid_s_second_action_has_names_of_its_own() -> None:
    before, found = branches("sampled")
    head = Head("discrete_actions", "discrete_actions")
    meaning = ActionMeaning(Role.SAMPLED, tuple(found))
    made, fetches = add_companions(before, {"discrete_actions": "action"}, head, meaning, {})
    assert fetches.keys() == {"discrete_actions", "deterministic_discrete_actions", LOG_PROBS}
    x = floats(6, 5)
    best = value(made, {"x": x}, fetches["deterministic_discrete_actions"])
    np.testing.assert_array_equal(best[:, 1], x[:, 3:].argmax(1))


# ------------------------------------------------------------------ naming


def named(made: Graph, feeds: Mapping[str, str], fetches: Mapping[str, str], *reserved: str) -> Graph:
    """The renamed graph, after its outputs have been held against what they were."""
    after = name_tensors(made, feeds, fetches, reserved)
    arrays = {n.name: floats(3, 4, seed=len(n.name)) for n in made.nodes if n.op == "Placeholder"}
    moved = {new: arrays[old] for new, old in feeds.items()}
    for name, reference in fetches.items():
        np.testing.assert_array_equal(value(after, moved, name), value(made, arrays, reference), strict=True)
    assert {n.name for n in after.nodes if n.op == "Placeholder"} == feeds.keys()
    return after


def test_the_node_that_makes_an_output_takes_its_name() -> None:
    made = graph(placeholder("obs", (None, 4)), node("inner/Tanh", "Tanh", "obs"), node("y", "Neg", "inner/Tanh"))
    after = named(made, {"state": "obs"}, {"action": "y", "value_estimate": "inner/Tanh"})
    assert [(n.name, n.op, n.inputs, n.origin) for n in after.nodes] == [
        ("state", "Placeholder", (), "obs:0"),
        ("value_estimate", "Tanh", ("state",), "inner/Tanh:0"),
        ("action", "Neg", ("value_estimate",), "y:0"),
    ]


def test_inner_nodes_give_way() -> None:
    made = graph(
        placeholder("x", (None, 4)),
        node("action", "Neg", "x"),
        node("state", "Exp", "action"),
        node("action/inner", "Tanh", "state"),
        node("contract", "Abs", "action/inner"),
        node("y", "Neg", "contract"),
    )
    after = named(made, {"state": "x"}, {"action": "y"}, "contract")
    assert [n.name for n in after.nodes] == [
        "state", "action/inner_1", "state/inner", "action/inner", "contract/inner", "action",
    ]  # fmt: skip
    assert after["action/inner_1"].origin == "action:0"


def test_inputs_may_swap_names() -> None:
    made = graph(placeholder("a", (None, 4)), placeholder("b", (None, 4)), node("y", "Sub", "a", "b"))
    after = named(made, {"a": "b", "b": "a"}, {"y": "y"})
    assert after["y"].inputs == ("b", "a")


def test_one_tensor_may_be_two_outputs() -> None:
    made = graph(placeholder("x", (None, 4)), node("y", "Neg", "x"))
    after = named(made, {"x": "x"}, {"action": "y", "deterministic_action": "y"})
    assert [(n.name, n.op, n.inputs, n.origin) for n in after.nodes[1:]] == [
        ("action", "Neg", ("x",), "y:0"),
        ("deterministic_action", "Identity", ("action",), "y:0"),
    ]


def test_an_output_may_be_an_input_or_a_constant() -> None:
    made = graph(placeholder("x", (None, 4)), const("c", floats(3, 4)))
    after = named(made, {"state": "x"}, {"action": "x", "value_estimate": "c"})
    assert [(n.name, n.op, n.inputs) for n in after.nodes] == [
        ("state", "Placeholder", ()),
        ("c", "Const", ()),
        ("action", "Identity", ("state",)),
        ("value_estimate", "Identity", ("c",)),
    ]


def test_outputs_of_a_node_with_several_get_nodes_of_their_own() -> None:
    made = graph(
        const("axis", 1),
        placeholder("x", (None, 4)),
        node("action", "Split", "axis", "x", num_split=2),
        node("z", "Neg", "action"),
    )
    after = named(made, {"x": "x"}, {"action": "action:1", "other": "action", "z": "z"})
    assert after["action"] == Node("action", "Identity", ("action/inner:1",))
    # what is output 0 alone is named itself, unless another output of the node is one too
    assert after["other"].op == "Identity"
    assert after["z"].inputs == ("action/inner",)


# ------------------------------------------------------------------ inputs


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
    assert "batch_size" not in {n.name for n in after.pruned(["y"]).nodes}
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
    made = graph(
        placeholder("x", None),
        const("mean", f32(1, 2, 3, 4)),
        node("centred", "Sub", "x", "mean"),
        const("weights", floats(2, 4)),
        node("y", "MatMul", "centred", "weights", transpose_b=True),
        placeholder("unknown", None),
    )
    after = complete_shapes(made, {"x": Role.VECTOR, "unknown": Role.PARAMETER})
    assert after["x"].attrs["shape"] == TensorShape((None, 4))
    assert after["unknown"].attrs["shape"] == TensorShape(None)


# ------------------------------------------------------------------ fuse


def layer(product: str, *tail: str, **attrs: Any) -> Graph:
    """A product with bias and what follows it; the last node is "y"."""
    x, weights = ((None, 3), (3, 4)) if product == "MatMul" else ((None, 5, 5, 3), (2, 2, 3, 4))
    names = ["product", "biased", *(f"t{i}" for i in range(len(tail)))]
    names[-1] = "y"
    return graph(
        placeholder("x", x),
        const("weights", floats(*weights)),
        const("bias", floats(4, seed=1)),
        node(names[0], product, "x", "weights", **attrs),
        node(names[1], "BiasAdd", names[0], "bias"),
        *(node(names[2 + i], op, names[1 + i]) for i, op in enumerate(tail)),
    )


CONV = {"strides": (1, 1, 1, 1), "padding": "SAME"}


@pytest.mark.parametrize(
    ("before", "expected"),
    [
        (layer("MatMul"), ["_FusedMatMul"]),
        (layer("MatMul", "Relu"), ["_FusedMatMul"]),
        (layer("MatMul", "Elu", "Relu"), ["_FusedMatMul", "Relu"]),
        (layer("MatMul", "Tanh"), ["_FusedMatMul", "Tanh"]),
        (layer("Conv2D", **CONV), ["_FusedConv2D"]),
        (layer("Conv2D", "Elu", **CONV), ["_FusedConv2D"]),
    ],
)
def test_a_product_its_bias_and_activation_are_one_op(before: Graph, expected: list[str]) -> None:
    made = fuse(before, ["y"], activations=True)
    assert ops(made) == expected
    x = floats(3, *before["x"].attrs["shape"].dims[1:])
    np.testing.assert_allclose(value(made, {"x": x}, "y"), value(before, {"x": x}, "y"), rtol=1e-6, atol=1e-6)
    assert made["y"].origin == "y:0"


def test_activations_are_fused_where_they_are_asked_for() -> None:
    made = fuse(layer("MatMul", "Relu"), ["y"], activations=False)
    assert ops(made) == ["_FusedMatMul", "Relu"]
    assert made["biased"].attrs["fused_ops"] == ("BiasAdd",)


@pytest.mark.parametrize(
    ("before", "roots"),
    [
        (graph(*layer("MatMul").nodes, node("z", "Neg", "product")), ["y", "z"]),
        (layer("MatMul"), ["product", "y"]),
        (layer("MatMul", transpose_a=True), ["y"]),
        (layer("MatMul", transpose_b=True), ["y"]),
        (
            graph(
                placeholder("x", (None, 3)),
                placeholder("bias", (4,)),
                const("weights", floats(3, 4)),
                node("product", "MatMul", "x", "weights"),
                node("y", "BiasAdd", "product", "bias"),
            ),
            ["y"],
        ),
    ],
    ids=["read twice", "an output", "transposed a", "transposed b", "bias not constant"],
)
def test_what_cannot_be_fused_stays(before: Graph, roots: list[str]) -> None:
    assert fuse(before, roots, activations=True) is before


def test_a_bias_that_is_an_output_is_not_swallowed() -> None:
    made = fuse(layer("MatMul", "Relu"), ["biased", "y"], activations=True)
    assert ops(made) == ["_FusedMatMul", "Relu"]


# ------------------------------------------------------------------ stats


def test_the_normaliser_is_read_off_the_graph() -> None:
    made = graph(
        placeholder("x", (None, 3)),
        const("mean", f32(1, 2, 3)),
        const("std", f32(0.5, 1, 4)),
        node("centred", "Sub", "x", "mean"),
        node("scaled", "RealDiv", "centred", "std"),
    )
    assert normaliser(made, "x") == {"kind": "normal", "mean": [1, 2, 3], "std": [0.5, 1, 4], "clip": 5.0}


def test_without_statistics_there_is_no_normaliser() -> None:
    mean, std = const("mean", f32(1, 2, 3)), const("std", f32(0.5, math.inf, 4))
    centred, scaled = node("centred", "Sub", "x", "mean"), node("scaled", "RealDiv", "centred", "std")
    assert normaliser(graph(placeholder("x", (None, 3)), mean, centred), "x") is None
    assert normaliser(graph(placeholder("x", (None, 3)), mean, std, centred, scaled), "x") is None


def cell(name: str, memory: str, first: int, units: int, gate: str = "gate") -> list[Node]:
    """c and h cut out of a memory, used as a BasicLSTMCell uses them."""

    def part(label: str, begin: int, end: int) -> list[Node]:
        bounds = [const(f"{name}/{label}/{k}", v) for k, v in (("b", [0, begin]), ("e", [0, end]), ("s", [1, 1]))]
        attrs = {"begin_mask": 1, "end_mask": 1}
        return [*bounds, node(f"{name}/{label}", "StridedSlice", memory, *(n.name for n in bounds), **attrs)]

    return [
        *part("c", first, first + units),
        *part("h", first + units, first + 2 * units),
        node(f"{name}/forget", "Mul", f"{name}/c", gate),
        node(f"{name}/joined", "ConcatV2", "x", f"{name}/h", "axis"),
    ]


def memory(*nodes: Node, size: int = 8) -> Graph:
    return graph(
        placeholder("x", (None, 3)),
        placeholder("memory", (None, size)),
        placeholder("gate", (None, 2)),
        placeholder("gates", (None, 4)),
        const("axis", 1),
        *nodes,
    )


def test_one_lstm_has_a_cell_and_a_hidden_state() -> None:
    assert memory_layout(memory(*cell("a", "memory", 0, 4, gate="gates")), "memory") == ("c", "h")


def test_two_lstms_have_theirs_in_turn() -> None:
    side_by_side = memory(*cell("a", "memory", 0, 2), *cell("b", "memory", 4, 2))
    assert memory_layout(side_by_side, "memory") == ("c", "h", "c", "h")


def test_slices_of_slices_are_followed() -> None:
    halves = [const("sizes", [4, 4]), node("halves", "SplitV", "memory", "sizes", "axis", num_split=2)]
    nested = memory(*halves, *cell("value", "halves:1", 0, 2), *cell("policy", "halves", 0, 2))
    assert memory_layout(nested, "memory") == ("c", "h", "c", "h")


def test_repeated_memories_are_followed() -> None:
    """SAC of ML-Agents 0.10 to 0.14 repeats the policy's memory to the size of all its networks'."""
    wide = [
        const("times", [1, 3]),
        node("tile", "Tile", "memory", "times"),
        node("wide", "ConcatV2", "tile", "memory", "axis"),
    ]
    assert memory_layout(memory(*wide, *cell("a", "wide", 24, 4, gate="gates")), "memory") == ("c", "h")


def test_a_state_that_is_joined_and_gated_is_hidden() -> None:
    """A GRU multiplies its one state by gates as well."""
    joined = node("joined", "ConcatV2", "x", "memory", "axis")
    made = memory(node("reset", "Mul", "memory", "gates"), joined, node("keep", "Mul", "gates", "memory"), size=4)
    assert memory_layout(made, "memory") == ("h",)


@pytest.mark.parametrize(
    "made",
    [
        memory(*cell("a", "memory", 0, 2)),
        memory(*cell("a", "memory", 2, 2), *cell("b", "memory", 0, 2)),
        memory(node("y", "Neg", "memory")),
        memory(),
        graph(placeholder("memory", None), placeholder("gates", (None, 4)), node("y", "Mul", "memory", "gates")),
    ],
    ids=["half of it", "overlapping", "no cell", "unread", "unknown shape"],
)
def test_an_unknown_layout_is_empty(made: Graph) -> None:
    assert memory_layout(made, "memory") == ()


GENUINE = Path(__file__).resolve().parents[3] / "shared" / "genuine"


@pytest.mark.corpus
@pytest.mark.parametrize(
    ("case", "layout"),
    [
        ("0.3.0-ppo-continuous-recurrent", ("c", "h", "c", "h")),
        ("0.6.0-ppo-continuous-recurrent", ("c", "h", "c", "h")),
        ("0.6.0-ppo-discrete-recurrent", ("c", "h")),
        ("0.10.1-ppo-continuous-recurrent", ("c", "h", "c", "h")),
        ("0.10.1-sac-continuous-recurrent", ("c", "h")),
        ("0.22.0-ppo-continuous-recurrent", ("c", "h")),
    ],
)
def test_layouts_of_genuine_policies(case: str, layout: tuple[str, ...]) -> None:
    folder = GENUINE / case
    if not folder.is_dir():
        pytest.skip("../shared (genuine graphs) is not beside this checkout")
    file = json.loads((folder / "case.json").read_text())["frozen"]["file"]
    (policy,) = compile_graph(read_graph((folder / file).read_bytes()), case)
    assert policy.signature.memory is not None
    assert policy.signature.memory.layout == layout


# ------------------------------------------------------------------ all of them


def test_all_passes_together_keep_what_tensorflow_computes(runtimes: Runtimes) -> None:
    """The visual fixture flattens by shape arithmetic, draws noise and has two heads."""
    source = read_graph(path("visual").read_bytes())
    (policy,) = compile_graph(source, "visual")
    feeds = {
        "observation_0": floats(3, 20, 20, 3, low=0, high=1),
        "state": floats(3, 4),
        "epsilon": floats(3, 2, seed=2),
    }
    mine = values(policy.graph, feeds, "action", "value_estimate")
    for expected, actual in zip(
        runtimes.tensorflow(policy.graph, feeds, ["action", "value_estimate"]), mine, strict=True
    ):
        assert difference(expected, actual) is None
    assert not {n.op for n in policy.graph.nodes} & {"Shape", "Prod", "Slice", "Pack", *IDENTITIES} - {"Identity"}


def test_an_input_that_is_not_fed_is_named() -> None:
    made = graph(placeholder("x", (None, 2)), node("y", "Neg", "x"))
    with pytest.raises(GraphError, match="the input 'x' is not fed"):
        run_graph(made, {}, ["y"])
