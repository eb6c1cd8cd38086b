"""The normaliser's statistics and the parts of a memory, read off a graph."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from export_model.converters.compiler.compile import compile_graph
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.policy.memories import memory_layout
from export_model.converters.policy.observations import normaliser
from tests.graph.making import const, graph, node, placeholder
from tests.graph.samples import f32

pytestmark = pytest.mark.xdist_group("graph-passes")


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
