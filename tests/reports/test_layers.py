"""A graph as layers: what is called what, no circles, nothing lost; and where the boxes go."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops.samplers import SAMPLERS
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.layers import Block, blocks_of
from export_model.exporter.reports.layout import layout
from fixtures import FIXTURES
from fixtures import path as fixture


def blocks(path: Path) -> list[list[Block]]:
    found = []
    for policy in read_source(path).policies(CompileOptions()):
        outputs = [s.name for s in policy.signature.outputs]
        made = blocks_of(policy.graph, outputs)
        needed = policy.graph.ancestors(outputs)
        drawn = sorted(n.name for b in made for n in b.nodes)
        assert drawn == sorted(n.name for n in policy.graph.nodes if n.name in needed and n.value is None)
        assert sorted(b.title for b in made if b.kind == "output") == sorted(outputs)
        found.append(made)
    return found


@pytest.mark.parametrize("name", FIXTURES)
def test_every_node_is_in_a_box_and_every_box_comes_after_what_it_reads(name: str) -> None:
    for made in blocks(fixture(name)):
        assert all(place < i for i, block in enumerate(made) for place in block.before)
        assert all(block.title for block in made)


@pytest.mark.parametrize(
    ("name", "titles"),
    [
        ("continuous", {"normalise, clip", "dense 64, swish", "dense 2, clip", "dense 1"}),
        ("recurrent", {"dense 32, swish", "LSTM 16", "one-hot, join", "dense 3", "dense 2", "softmax"}),
        ("visual", {"conv 4×4 → 16 /2, elu", "conv 3×3 → 32 /2, elu, max pool", "dense 24, elu", "dense 2, tanh"}),
    ],
)
def test_layers_have_the_names_that_people_use(name: str, titles: set[str]) -> None:
    assert titles <= {b.title for b in blocks(fixture(name))[0]}


@pytest.mark.parametrize("op", sorted(SAMPLERS))
def test_every_sampler_is_a_draw(op: str) -> None:
    graph = Graph((Node("in", "Placeholder"), Node("out", op, ("in",))))
    assert [b.title for b in blocks_of(graph, ["out"])] == ["in", "draw", "out"]


@st.composite
def graphs(draw: st.DrawFn) -> Graph:
    nodes = [
        Node("in0", "Placeholder"),
        Node("in1", "Placeholder"),
        Node("w", "Const", value=np.zeros((3, 3), np.float32)),
    ]
    for i in range(draw(st.integers(1, 25))):
        op = draw(
            st.sampled_from(["MatMul", "Add", "Mul", "ConcatV2", "Sigmoid", "Reshape", "StridedSlice", "Multinomial"])
        )
        known = [n.name for n in nodes if n.value is None]
        sources = draw(st.lists(st.sampled_from(known), min_size=1, max_size=3))
        nodes.append(Node(f"n{i}", op, (*sources, "w") if op == "MatMul" else tuple(sources)))
    return Graph(tuple(nodes))


@given(graphs())
def test_no_graph_gives_a_circle(graph: Graph) -> None:
    last = graph.nodes[-1].name
    made = blocks_of(graph, [last])
    assert all(place < i for i, block in enumerate(made) for place in block.before)
    assert {n.name for b in made for n in b.nodes} == {n for n in graph.ancestors([last]) if n != "w"}


@st.composite
def boxes(draw: st.DrawFn) -> list[set[int]]:
    count = draw(st.integers(1, 20))
    return [draw(st.sets(st.integers(0, i - 1), max_size=3)) if i else set() for i in range(count)]


@given(boxes(), st.data())
def test_boxes_do_not_overlap_and_stand_below_what_they_read(before: list[set[int]], data: st.DataObject) -> None:
    widths = [data.draw(st.floats(20, 300)) for _ in before]
    placed = layout(before, widths)
    for i, sources in enumerate(before):
        assert all(placed.places[s].row < placed.places[i].row for s in sources)
    for row in range(placed.rows):
        here = sorted((p for p in placed.places if p.row == row), key=lambda p: p.x)
        for a, b in itertools.pairwise(here):
            assert a.x + a.width / 2 <= b.x - b.width / 2 + 1e-6
    assert all(p.x - p.width / 2 >= 0 and p.x + p.width / 2 <= placed.width for p in placed.places)
    assert len(placed.edges) == sum(len(s) for s in before)
