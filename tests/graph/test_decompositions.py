"""What a Barracuda lacks, in ops that it has: the same numbers as the op itself, and nothing left that is lacking."""

from __future__ import annotations

import numpy as np
import pytest

from converters.compiler.passes.lowering import lower_for_importers, lower_for_nn
from converters.consumers.profiles import PROFILES
from converters.graph.nodes import Graph
from converters.graph.ops.table import TABLE
from converters.graph.run import run_graph
from tests.graph.samples import SAMPLES, Sample

DECOMPOSED = {name: op.barracuda for name, op in TABLE.items() if op.barracuda is not None}
CASES = [s for s in SAMPLES if s.op in DECOMPOSED]
#: Exp and log near their zeros and erf's formula are right to this much, as in Unity.
ABSOLUTE = 3e-7


def agree(sample: Sample, lowered: Graph) -> None:
    wanted, given = (run_graph(g, sample.feeds, sample.fetches) for g in (sample.graph, lowered))
    for name in sample.fetches:
        assert given[name].dtype == wanted[name].dtype
        np.testing.assert_allclose(given[name], wanted[name], rtol=1e-6, atol=ABSOLUTE, err_msg=sample.title)


def ops(graph: Graph) -> set[str]:
    return {n.op for n in graph.nodes}


@pytest.mark.parametrize("sample", CASES, ids=lambda s: s.title)
def test_a_decomposed_op_gives_the_same_numbers_in_a_nn(sample: Sample) -> None:
    lowered = lower_for_nn(sample.graph)
    agree(sample, lowered)
    assert not ops(lowered) & {name for name, how in DECOMPOSED.items() if how.nn}


@pytest.mark.parametrize("sample", CASES, ids=lambda s: s.title)
@pytest.mark.parametrize("misread", [{how.onnx for how in DECOMPOSED.values() if how.onnx}])
def test_a_decomposed_op_gives_the_same_numbers_in_onnx(sample: Sample, misread: set[str]) -> None:
    agree(sample, lower_for_importers(sample.graph, misread))


def test_who_lacks_what_is_asked_of_the_table_of_importers() -> None:
    """Erf came with Barracuda 2.3.1; 1.1.2 swaps a constant first operand of Sub and Div."""
    lacking = {p.name: p.write_options("{}").misread for p in PROFILES}
    assert {name for name, misread in lacking.items() if "Erf" in misread} == {"barracuda-1.4", "barracuda-1.0"}
    assert {name for name, misread in lacking.items() if {"Sub", "Div"} & misread} == {"barracuda-1.0"}
    assert not lacking["unity6"] & {how.onnx for how in DECOMPOSED.values()}
