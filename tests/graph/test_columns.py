"""Slices of a concatenation that are its parts; pairs of ONNX nodes that are one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from export_model.converters.compiler.passes.slice_of_concat import parts_for_slices
from export_model.converters.formats.onnx import messages
from export_model.converters.formats.onnx.peephole import pooled_first, simplify_nodes
from export_model.converters.graph.nodes import Graph
from tests.graph.making import const, graph, node, ops, placeholder
from tests.graph.running import value
from tests.graph.samples import floats

pytestmark = pytest.mark.xdist_group("graph-passes")


def joined(first: Sequence[int], last: Sequence[int], **masks: int) -> Graph:
    """A slice of [a, b], of 3 and 2 columns, doubled."""
    bits = {f"{k}_mask": masks.get(k, 0) for k in ("begin", "end", "ellipsis", "new_axis", "shrink_axis")}
    return graph(
        placeholder("a", (None, 3)),
        placeholder("b", (None, 2)),
        const("axis", np.array(1, np.int32)),
        node("both", "ConcatV2", "a", "b", "axis", N=2),
        *(const(n, np.array(v, np.int32)) for n, v in (("begin", first), ("end", last), ("strides", [1] * len(first)))),
        node("taken", "StridedSlice", "both", "begin", "end", "strides", **bits),
        node("y", "Add", "taken", "taken"),
    )


@pytest.mark.parametrize(
    ("before", "source"),
    [
        (joined([0, 0], [0, 3], begin=1, end=1), "a"),
        (joined([0, 3], [0, 5], begin=1, end=1), "b"),
        (joined([0, 3], [0, 0], begin=1, end=3), "b"),
        (joined([0, 2], [0, 5], begin=1, end=1), "taken"),  # a column of the other part, too
        (joined([0, 0], [0, 2], begin=1, end=1), "taken"),  # not the whole part
        (joined([0, 0], [1, 3]), "taken"),  # one row
        (joined([0, 0], [0, 3], begin=1, end=1, shrink_axis=2), "taken"),  # one column
    ],
)
def test_a_slice_that_is_a_part_is_the_part(before: Graph, source: str) -> None:
    made = parts_for_slices(before, ["y"])
    assert made["y"].inputs == (source, source)
    feeds = {"a": floats(4, 3), "b": floats(4, 2, seed=1)}
    np.testing.assert_array_equal(value(made, feeds, "y"), value(before, feeds, "y"))


def test_a_slice_that_is_an_output_stays() -> None:
    assert "StridedSlice" in ops(parts_for_slices(joined([0, 0], [0, 3], begin=1, end=1), ["taken", "y"]))


LOW, HALF, HIGH, ROW = np.float32(-1), np.float32(0.5), np.float32(2), np.ones(3, np.float32)
COLUMN = np.array([-1, 1])


@pytest.mark.parametrize(
    ("pair", "constants", "expected"),
    [
        ((("Min", "x", "p", {}), ("Max", "q", "m", {})), {"p": HIGH, "q": LOW}, ["Clip"]),
        ((("Mul", "x", "p", {}), ("Max", "x", "m", {})), {"p": HALF}, ["LeakyRelu"]),
        ((("Mul", "p", "x", {}), ("Max", "m", "x", {})), {"p": HIGH}, ["Mul", "Max"]),
        ((("Mul", "x", "p", {}), ("Max", "m", "z", {})), {"p": HALF}, ["Mul", "Max"]),
        ((("Min", "p", "x", {}), ("Max", "m", "q", {})), {"p": HIGH, "q": LOW}, ["Clip"]),
        ((("Min", "x", "p", {}), ("Max", "m", "q", {})), {"p": LOW, "q": HIGH}, ["Min", "Max"]),
        ((("Min", "x", "p", {}), ("Max", "m", "q", {})), {"p": ROW, "q": LOW}, ["Min", "Max"]),
        ((("ArgMax", "x", "", {"axis": 1, "keepdims": 0}), ("Reshape", "m", "p", {})), {"p": COLUMN}, ["ArgMax"]),
        (
            (("ArgMax", "x", "", {"axis": 0, "keepdims": 0}), ("Reshape", "m", "p", {})),
            {"p": COLUMN},
            ["ArgMax", "Reshape"],
        ),
    ],
)
def test_two_nodes_are_one_where_onnx_has_it(
    pair: Sequence[tuple[str, str, str, dict[str, Any]]], constants: dict[str, Any], expected: list[str]
) -> None:
    values = {name: np.asarray(v) for name, v in constants.items()}
    nodes = [
        messages.node(kind, [name for name in (one, other) if name], [made], made, **attributes)
        for (kind, one, other, attributes), made in zip(pair, "my", strict=True)
    ]
    made = simplify_nodes(nodes, values, {"m": 1}, ["y"])
    assert [n.op_type for n in made] == expected
    assert list(made[-1].output) == ["y"]
    if expected == ["Clip"]:
        assert list(made[0].input) == ["x", "q", "p"]
    if expected == ["LeakyRelu"]:
        assert (list(made[0].input), made[0].attribute[0].f) == (["x"], 0.5)
    if expected == ["ArgMax"]:
        assert {a.name: a.i for a in made[0].attribute} == {"axis": 1, "keepdims": 1}
        assert len(simplify_nodes(nodes, values, {"m": 2}, ["y"])) == 2
    assert len(simplify_nodes(nodes, values, {"m": 1}, ["m", "y"])) == 2
    assert len(simplify_nodes([*nodes, messages.node("Neg", ["m"], ["z"])], values, {"m": 1}, ["y", "z"])) == 3


def test_an_elu_comes_behind_the_pool_that_alone_reads_it() -> None:
    def pair(op: str) -> list[Any]:
        return [messages.node(op, ["x"], ["a"]), messages.node("MaxPool", ["a"], ["y"], kernel_shape=[2, 2])]

    found = [(n.op_type, list(n.input), list(n.output)) for n in pooled_first(pair("Elu"), ["y"], lambda wish: wish)]
    assert found == [("MaxPool", ["x"], ["y/before"]), ("Elu", ["y/before"], ["y"])]
    for nodes, outputs in ((pair("Neg"), ["y"]), (pair("Elu"), ["y", "a"])):
        assert [n.op_type for n in pooled_first(nodes, outputs, str)] == [nodes[0].op_type, "MaxPool"]
    read = [*pair("Elu"), messages.node("Neg", ["a"], ["z"])]
    assert [n.op_type for n in pooled_first(read, ["y", "z"], str)] == ["Elu", "MaxPool", "Neg"]
