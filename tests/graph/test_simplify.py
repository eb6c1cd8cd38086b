"""Identities and chains of reshapes go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from export_model.converters.compiler.passes.simplify import collapse_views, drop_identities
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops.table import TABLE
from tests.graph.harness import Array
from tests.graph.making import const, graph, node, ops, placeholder
from tests.graph.running import same_values
from tests.graph.samples import floats

IDENTITIES = sorted(op.name for op in TABLE.values() if op.moves == "same")
pytestmark = pytest.mark.xdist_group("graph-passes")


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
