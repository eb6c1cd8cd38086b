"""What is folded has an end for all of a graph together, and it is the same whatever was inferred before."""

from __future__ import annotations

import tracemalloc
from collections.abc import Sequence

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.converters.compiler.compile import compile_graph
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.graph.nodes import Graph
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.size_limits import MAX_MADE
from tests.handmade import NodeDef, constant, graph_bytes, node, placeholder

X = "vector_observation"
#: As many elements as one node may be folded to.
LARGEST = 1 << 20
#: Twice what may be folded, in float32, and what the compiler has beside it.
LIMIT = (3 * MAX_MADE * 4) + (32 << 20)


def summed(names: Sequence[str]) -> list[NodeDef]:
    """``action`` = the observation plus the largest element of each."""
    axis = constant("axis", np.array([0], np.int32))
    made, total = [axis], X
    for name in names:
        made += [
            node(f"{name}/largest", "Max", name, "axis", keep_dims=False),
            node(f"{name}/added", "Add", total, f"{name}/largest"),
        ]
        total = f"{name}/added"
    return [*made, node("action", "Tanh", total)]


def fills(count: int) -> list[NodeDef]:
    """Constants that a few bytes each ask for."""
    made = [constant("dims", np.array([LARGEST], np.int32)), placeholder(X)]
    for i in range(count):
        made += [constant(f"value{i}", i / 1024), node(f"fill{i}", "Fill", "dims", f"value{i}")]
    return [*made, *summed([f"fill{i}" for i in range(count)])]


def sums(count: int) -> list[NodeDef]:
    """One large constant, and many that are as large as it: none is larger than its operand."""
    made = [constant("dims", np.array([LARGEST], np.int32)), constant("half", 0.5), node("one", "Fill", "dims", "half")]
    made.append(placeholder(X))
    for i in range(count):
        made += [constant(f"value{i}", i / 1024), node(f"sum{i}", "Add", "one", f"value{i}")]
    return [*made, *summed([f"sum{i}" for i in range(count)])]


@pytest.mark.parametrize("made", [fills, sums])
def test_constants_together_take_no_more_than_a_policy(made: object) -> None:
    assert callable(made)
    graph = read_graph(graph_bytes(made(150)))
    tracemalloc.start()
    try:
        compile_graph(graph, "policy")
        assert tracemalloc.get_traced_memory()[1] < LIMIT < 150 * LARGEST * 4
    finally:
        tracemalloc.stop()


def folded(graph: Graph) -> list[str]:
    return [name for name, kind in infer_types(graph).items() if kind.constant is not None and kind.constant.size > 256]


def test_what_is_folded_does_not_depend_on_what_was_inferred_before() -> None:
    """Types are kept on nodes, which graphs share: what they hold is counted again."""
    nodes = [n for n in read_graph(graph_bytes(fills(20))).nodes if n.name != "action"]
    expected = folded(Graph(tuple(nodes)))
    assert expected == [f"fill{i}" for i in range(MAX_MADE // LARGEST)]
    assert folded(Graph(tuple(nodes))) == expected
    fewer = Graph(tuple(n for n in nodes if "fill1" not in n.name and "added" not in n.name))
    assert folded(fewer) == [f"fill{i}" for i in range(20) if not str(i).startswith("1")]
    assert folded(Graph(tuple(nodes))) == expected
    assert folded(Graph(tuple(replace(n) for n in nodes))) == expected


def test_shapes_are_folded_however_much_was_before() -> None:
    made = [*fills(20)[:-1], constant("three", np.array([3], np.int32)), constant("two", np.array([2], np.int32))]
    graph = read_graph(graph_bytes([*made, node("six", "Mul", "three", "two"), node("action", "Tanh", X)]))
    six = infer_types(graph)["six"].constant
    assert six is not None
    assert six.tolist() == [6]
