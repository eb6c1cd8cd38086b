"""Graphs without an axis for any number of agents get one, and each row is as the source's."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.compiler.passes.vmap_trial import check_rows
from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nodes import NameScope, Node, TensorShape
from export_model.converters.graph.run import run_graph
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import SignatureError
from export_model.signatures.roles import Role
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


def drawn(*before: NodeDef, mean: str = "y", shape: str = "shape") -> tuple[NodeDef, ...]:
    """``mean`` with noise as the action; ``shape`` is computed from the input's, ``two`` is that of one row."""
    tenth, two = constant("tenth", 0.1, F), constant("two", [1, 2], np.int32)
    return (
        *before, tenth, two, node("shape", "Shape", mean, T=F, out_type=np.int32),
        node("noise", "RandomStandardNormal", shape, T=np.int32, dtype=F), node("some", "Mul", "noise", "tenth", T=F),
        node("action", "Add", mean, "some", T=F),
    )  # fmt: skip


def test_rows_that_change_one_another_are_seen_behind_a_draw(tmp_path: Path) -> None:
    axes, most = constant("axes", [0, 1], np.int32), node("most", "Max", "y", "axes", T=F, Tidx=np.int32)
    source = tmp_path / "drawn.bytes"
    source.write_bytes(product((1, 3), *drawn(axes, most, node("share", "RealDiv", "y", "most", T=F), mean="share")))
    (policy,) = read_source(source).policies()
    observed = np.abs(np.random.default_rng(1).standard_normal((2, 3))).astype(np.float32)
    feeds = {"state": observed, "epsilon": np.zeros((2, 2), np.float32)}
    y = observed @ WEIGHTS
    answer = run_graph(policy.graph, feeds, ["action"])["action"]
    np.testing.assert_allclose(answer, y / y.max(axis=1, keepdims=True), 1e-5, 1e-6)


def test_several_rows_that_change_one_another_behind_a_draw_are_refused(tmp_path: Path) -> None:
    axis, mean = constant("axis", 0, np.int32), node("m", "Mean", "y", "axis", T=F, Tidx=np.int32)
    source = tmp_path / "together.bytes"
    source.write_bytes(product((4, 3), *drawn(axis, mean, node("centred", "Sub", "y", "m", T=F), mean="centred")))
    with pytest.raises(SignatureError, match="no axis for any number of agents"):
        read_source(source).policies()


@pytest.mark.parametrize("noise", ["lift", "keep"])
def test_each_agent_has_a_draw_of_its_own(noise: Literal["lift", "keep"], tmp_path: Path) -> None:
    source = tmp_path / "drawn.bytes"
    source.write_bytes(product((1, 3), *drawn(shape="two")))
    (policy,) = read_source(source).policies(CompileOptions(noise=noise))
    if noise == "lift":
        assert {s.name: s.shape for s in policy.signature.inputs} == {"state": (None, 3), "epsilon": (None, 2)}
    else:
        answer = run_graph(policy.graph, {"state": np.ones((2, 3), np.float32)}, ["action"])["action"]
        assert not np.allclose(answer[0], answer[1])


@pytest.mark.parametrize("turned", [False, True])
def test_the_odds_of_a_draw_are_those_of_the_row(turned: bool) -> None:
    """Multinomial of logits that rows share, whose draws are the same whatever the odds were."""
    b = Builder(NameScope(()))
    x = b.append(Node("x", "Placeholder", (), {"dtype": np.dtype(F), "shape": TensorShape((None, 3))}))
    logits = b.add("Sub", [x, b.add("Mean", [x, b.ints([0])], keep_dims=True)]) if turned else x
    b.add("Multinomial", [logits, b.ints(1)], "action", output_dtype=np.dtype(np.int64))
    if turned:
        with pytest.raises(SignatureError, match="draws from"):
            check_rows(b.graph(), ["action"])
    else:
        check_rows(b.graph(), ["action"])


def test_a_vector_without_rows_gets_an_axis_in_front(tmp_path: Path) -> None:
    """Beside an input of one row, whose first axis is the agents'."""
    source = tmp_path / "beside.bytes"
    bias = placeholder("vector_bias", (2,))
    source.write_bytes(product((1, 3), bias, node("action", "Add", "y", "vector_bias", T=F)))
    options = CompileOptions(inputs={"vector_bias": Role.VECTOR, "vector_observation": Role.VECTOR})
    (policy,) = read_source(source).policies(options)
    assert sorted(s.shape for s in policy.signature.inputs) == [(None, 2), (None, 3)]


def test_draws_agree_with_the_source_row_by_row(tmp_path: Path, pool: RuntimePool) -> None:
    source = tmp_path / "drawn.bytes"
    source.write_bytes(product((1, 3), *drawn(shape="two")))
    (result,) = export([source], ExportOptions(tmp_path / "out", verify="tensorflow,onnxruntime"), pool=pool)
    assert result.report is not None
    assert result.report.passed is True
    assert result.report.reference == "source/tensorflow"


def test_it_agrees_with_the_source_row_by_row(tmp_path: Path, pool: RuntimePool) -> None:
    source = tmp_path / "one.bytes"
    shape, after = GRAPHS["no rows in the action"]
    source.write_bytes(product(shape, *after))
    (result,) = export([source], ExportOptions(tmp_path / "out", verify="tensorflow,onnxruntime"), pool=pool)
    assert result.report is not None
    assert result.report.passed is True
    assert result.report.reference == "source/tensorflow"
