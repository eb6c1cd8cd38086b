"""Inputs that ``--set`` gives one value: a row for each agent where they are joined to what the agents are fed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from export_model.converters.compiler.compile import compile_graph
from export_model.converters.compiler.options import CompileOptions
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.exporter.demo import FOLDER
from export_model.exporter.export.sources import read_source
from tests.commands import export_model
from tests.handmade import constant, dense, graph_bytes, node, placeholder

HALLWAY = FOLDER / "Hallway.bytes"
ROWS = 5


def compiled(**values: float) -> Policy:
    (policy,) = read_source(HALLWAY).policies(CompileOptions(values=values))
    return policy


@pytest.mark.parametrize("before", [0, 2])
def test_it_gives_what_the_policy_gives_that_is_fed_the_value(before: int) -> None:
    free, fixed = compiled(), compiled(prev_action=before)
    assert [s.name for s in fixed.signature.inputs] == ["state", "action_masks", "recurrent_in"]
    random = np.random.default_rng(0)
    feeds = {
        "state": random.standard_normal((ROWS, 4)).astype(np.float32),
        "action_masks": np.ones((ROWS, 3), np.float32),
        "recurrent_in": random.standard_normal((ROWS, 32)).astype(np.float32),
    }
    outputs = [s.name for s in fixed.signature.outputs]
    wanted = run_graph(free.graph, {**feeds, "prev_action": np.full((ROWS, 1), before, np.int32)}, outputs)
    given = run_graph(fixed.graph, feeds, outputs)
    for name in outputs:
        np.testing.assert_allclose(given[name], wanted[name], atol=1e-6, err_msg=name)


def test_each_brain_of_a_file_takes_the_rows_of_its_own_observation() -> None:
    nodes = []
    for scope in ("First", "Second"):
        nodes += [
            placeholder(f"{scope}/vector_observation", (None, 2)),
            placeholder(f"{scope}/before", (None, 1)),
            constant(f"{scope}/axis", np.int32(1)),
            node(f"{scope}/both", "ConcatV2", f"{scope}/vector_observation", f"{scope}/before", f"{scope}/axis"),
            *dense(f"{scope}/action", f"{scope}/both", 3, 2),
        ]
    values = {"First/before": 0.5, "Second/before": 0.5}
    policies = compile_graph(read_graph(graph_bytes(nodes)), "policy", CompileOptions(values=values))
    inputs = [[(s.name, s.source) for s in p.signature.inputs] for p in policies]
    assert inputs == [[("state", "First/vector_observation:0")], [("state", "Second/vector_observation:0")]]


@pytest.mark.runtimes
def test_tensorflow_runs_the_source_with_a_row_for_each_agent(tmp_path: Path) -> None:
    out = tmp_path / "out"
    ran = export_model(HALLWAY, "--set", "prev_action=1", "-o", out, "--to", "bytes,onnx", "--verify", "tensorflow")
    assert ran.status == 0 and "PASSED" in ran.out, ran.err
    again = export_model("verify", out / "Hallway", "--runtimes", "tensorflow", "--source", HALLWAY)
    assert again.status == 0, again.err
