"""What a Barracuda lacks, in ops that it has: the same numbers as the op itself, and nothing left that is lacking."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from export_model.converters.compiler.passes.lowering import lower_for_importers, lower_for_nn
from export_model.converters.consumers.profiles import PROFILES
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops.table import TABLE
from export_model.converters.graph.run import run_graph
from tests.graph.samples import SAMPLES, Sample

DECOMPOSED = {name: op.barracuda for name, op in TABLE.items() if op.barracuda is not None}
CASES = [s for s in SAMPLES if s.op in DECOMPOSED]
#: Exp and log near their zeros and erf's formula are right to this much, as in Unity.
ABSOLUTE = 3e-7
#: What stands behind a decomposition, too: a cast of a number without a fraction.
STAYS = {"Cast"}
#: Forms without one: a table that is computed, classes on another axis, indices of no agent.
KEPT = {
    ("Gather", "int64 matrix of indices"),
    *(("GatherV2", title) for title in ("columns", "one column", "negative axis")),
    *(("OneHot", title) for title in ("axis 0", "axis 1 of 3")),
}
#: NaN times 0 is no 0.
DIFFERS = {("ZerosLike", "float32")}


def ended(sample: Sample) -> tuple[Graph, list[str]]:
    """The sample with a node behind each result, as a policy's outputs have: those keep their names."""
    names = [f"result{index}" for index in range(len(sample.fetches))]
    ends = (Node(n, "Identity", (reference,)) for n, reference in zip(names, sample.fetches, strict=True))
    return Graph((*sample.graph.nodes, *ends)), names


def agree(sample: Sample, lower: Callable[[Graph], Graph]) -> Graph:
    graph, names = ended(sample)
    lowered = lower(graph)
    wanted, given = (run_graph(g, sample.feeds, names) for g in (graph, lowered))
    for name in names:
        assert given[name].dtype == wanted[name].dtype
        same = np.isclose(given[name], wanted[name], rtol=1e-6, atol=ABSOLUTE, equal_nan=True)
        same |= np.isnan(wanted[name]) | (np.isnan(given[name]) if (sample.op, sample.title) in DIFFERS else False)
        assert same.all(), f"{sample.title}: {given[name]} for {wanted[name]}"
    return lowered


def ops(graph: Graph) -> set[str]:
    return {n.op for n in graph.nodes}


@pytest.mark.parametrize("sample", CASES, ids=lambda s: s.title)
def test_a_decomposed_op_gives_the_same_numbers_in_a_nn(sample: Sample) -> None:
    lowered = agree(sample, lower_for_nn)
    left = ops(lowered) & {name for name, how in DECOMPOSED.items() if how.nn}
    assert left - STAYS == ({sample.op} if (sample.op, sample.title) in KEPT else set())


@pytest.mark.parametrize("sample", CASES, ids=lambda s: s.title)
@pytest.mark.parametrize("misread", [{how.onnx for how in DECOMPOSED.values() if how.onnx}])
def test_a_decomposed_op_gives_the_same_numbers_in_onnx(sample: Sample, misread: set[str]) -> None:
    agree(sample, lambda graph: lower_for_importers(graph, misread))


def test_who_lacks_what_is_asked_of_the_table_of_importers() -> None:
    """Erf came with Barracuda 2.3.1; 1.1.2 swaps a constant first operand of Sub and Div."""
    lacking = {p.name: p.write_options("{}").misread for p in PROFILES}
    assert {name for name, misread in lacking.items() if "Erf" in misread} == {"barracuda-1.4", "barracuda-1.0"}
    assert {name for name, misread in lacking.items() if {"Sub", "Div"} & misread} == {"barracuda-1.0"}
    assert lacking["unity6"] & {how.onnx for how in DECOMPOSED.values()} == {"Cast"}
