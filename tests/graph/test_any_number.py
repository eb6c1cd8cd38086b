"""Graphs without an axis for any number of agents get one, and each row is as the source's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from converters.graph.run import run_graph
from converters.runtimes.pool import RuntimePool
from exporter.export.pipeline import ExportOptions, export
from exporter.export.sources import read_source
from signatures.errors import SignatureError
from tests.handmade import NodeDef, constant, graph_bytes, node, placeholder

WEIGHTS = np.random.default_rng(0).standard_normal((3, 2)).astype(np.float32)
F = np.float32


def product(shape: tuple[int, ...], *after: NodeDef) -> bytes:
    """``x`` · WEIGHTS as ``y``, then what is given."""
    nodes = [placeholder("vector_observation", shape), constant("w", WEIGHTS), constant("row", [1, 3], np.int32)]
    nodes += [node("x", "Reshape", "vector_observation", "row", T=F, Tshape=np.int32)] if len(shape) == 1 else []
    nodes += [node("y", "MatMul", "x" if len(shape) == 1 else "vector_observation", "w", T=F)]
    return graph_bytes([*nodes, *(after or [node("action", "Tanh", "y", T=F)])])


#: What the source takes → the axes, what is behind ``y``.
GRAPHS = {
    "one row": ((1, 3), ()),
    "four rows": ((4, 3), ()),
    "no rows": ((3,), ()),
    "no rows in the action": (
        (3,),
        (constant("two", [2], np.int32), node("r", "Reshape", "y", "two", T=F, Tshape=np.int32),
         node("action", "Tanh", "r", T=F)),
    ),
    "one row kept inside": (
        (1, 3),
        (constant("two", [1, 2], np.int32), node("r", "Reshape", "y", "two", T=F, Tshape=np.int32),
         node("action", "Tanh", "r", T=F)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", GRAPHS)
def test_an_axis_for_the_agents_is_added_and_said(kind: str, tmp_path: Path) -> None:
    shape, after = GRAPHS[kind]
    source = tmp_path / "one.bytes"
    source.write_bytes(product(shape, *after))
    (policy,) = read_source(source).policies()
    assert [s.shape for s in (*policy.signature.inputs, policy.signature.outputs[0])] == [(None, 3), (None, 2)]
    observed = np.random.default_rng(1).standard_normal((5, 3)).astype(np.float32)
    answer = run_graph(policy.graph, {"state": observed}, ["action"])["action"]
    np.testing.assert_allclose(answer, np.tanh(observed @ WEIGHTS), 1e-5, 1e-6)
    agents = "4 agents" if shape[0] == 4 else "one agent"
    assert any(f"decides for {agents} at a time" in n for n in policy.signature.notes)
    assert policy.source.rows == (4 if shape[0] == 4 else 1)


def test_rows_that_change_one_another_are_no_rows_of_their_own(tmp_path: Path) -> None:
    axis, mean = constant("axis", 0, np.int32), node("mean", "Mean", "y", "axis", T=F, Tidx=np.int32)
    source = tmp_path / "together.bytes"
    source.write_bytes(product((4, 3), axis, mean, node("action", "Sub", "y", "mean", T=F)))
    with pytest.raises(SignatureError, match=r"no axis for any number of agents: vector_observation .*\n.*\n.*None"):
        read_source(source).policies()


def test_it_agrees_with_the_source_row_by_row(tmp_path: Path, pool: RuntimePool) -> None:
    source = tmp_path / "one.bytes"
    shape, after = GRAPHS["no rows in the action"]
    source.write_bytes(product(shape, *after))
    (result,) = export([source], ExportOptions(tmp_path / "out", verify="tensorflow,onnxruntime"), pool=pool)
    assert result.report is not None
    assert result.report.passed is True
    assert result.report.reference == "source/tensorflow"
