"""``--step``: which checkpoint of a run's folder is inspected, exported and, afterwards, verified against."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.graph.run import run_graph
from export_model.converters.runtimes.pool import RuntimePool
from export_model.signatures.errors import BundleError, UsageError
from tests.checkpoint.writing import TrainingGraph, bundle, expected, policy
from tests.commands import export_model, is_refused
from tests.exporting import export_model as exported
from tests.exporting import inspect_model, verify_bundle

OBSERVATION = np.linspace(-1, 1, 12, dtype=np.float32).reshape(4, 3)
STEPS = (10, 200, 30)
BEHAVIORS = ("Walker", "Crawler")


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """results/<run> with two behaviors, a checkpoint per step in each, every one another policy."""
    folder = tmp_path / "run"
    for seed, behavior in enumerate(BEHAVIORS):
        for step in STEPS:
            graph = policy(1000 * seed + step)
            bundle(folder / behavior / f"model-{step}.ckpt", graph.variables)
        _runnable(policy(0)).write(folder / behavior / "raw_graph_def.pb")
    return folder


def _runnable(graph: TrainingGraph) -> TrainingGraph:
    """Without what training did, whose nodes are made for readers and lack what TensorFlow asks of them."""
    kept = [n for n in graph.message.node if n.op in ("Placeholder", "VariableV2", "MatMul", "BiasAdd", "Tanh")]
    reads = [n for n in graph.message.node if n.name.endswith("/read")]
    for node in reads:
        node.attr["T"].type = 3 if node.name.startswith(("version", "global")) else 1
    nodes = [schema.NodeDef.FromString(n.SerializeToString()) for n in (*kept, *reads)]
    del graph.message.node[:]
    graph.message.node.extend(nodes)
    return graph


def seed_of(behavior: str, step: int) -> int:
    return 1000 * BEHAVIORS.index(behavior) + step


@pytest.mark.parametrize("step", [None, *STEPS])
def test_inspect_shows_the_policies_of_the_step(run: Path, step: int | None) -> None:
    found = inspect_model(run, step=step)
    assert [p.policy.name for p in found.policies] == sorted(BEHAVIORS)
    for inspected in found.policies:
        graph = policy(seed_of(inspected.policy.name, 200 if step is None else step))
        action = run_graph(inspected.policy.graph, {"state": OBSERVATION}, ["action"])["action"]
        np.testing.assert_allclose(action, expected(graph, OBSERVATION), rtol=1e-5)


def test_inspect_by_the_command_line(run: Path) -> None:
    default, chosen = (export_model("inspect", run, *more) for more in ((), ("--step", 10)))
    assert (default.status, chosen.status) == (0, 0)
    assert f"next: export-model {run} --step 10 -o exported" in chosen.out
    first, second = (export_model("inspect", run, *more, "--json").json for more in ((), ("--step", 10)))
    assert first["sha256"] != second["sha256"]
    is_refused(export_model("inspect", run, "--step", 11), "--step 11", "the steps are 10, 30, 200")


def test_a_step_is_said_in_the_contract_and_used_again(run: Path, tmp_path: Path, runtimes: RuntimePool) -> None:
    """Every behavior's bundle is compared with its own checkpoint of that step, in TensorFlow."""
    results = exported(run, tmp_path / "out", step=30, to="bytes", verify="none")
    assert [r.policy.name for r in results] == sorted(BEHAVIORS)
    for result in results:
        content = json.loads((result.folder / "policy.json").read_text())
        assert content["source"]["step"] == 30
        report = verify_bundle(result.folder, source=run, runtimes="tensorflow")
        assert report.passed is True
        assert report.reference == "source/tensorflow"
        assert verify_bundle(result.folder, source=run, step=30, runtimes="tensorflow").passed is True


def test_another_step_is_another_source(run: Path, tmp_path: Path) -> None:
    (first, _) = exported(run, tmp_path / "out", step=30, to="bytes", verify="none")
    with pytest.raises(BundleError, match="is not the source of this bundle"):
        verify_bundle(first.folder, source=run, step=10)
    with pytest.raises(UsageError, match="the steps are 10, 30, 200"):
        verify_bundle(first.folder, source=run, step=31)
    is_refused(export_model("verify", first.folder, "--source", run, "--step", 10), "is not the source", "--step")
    is_refused(export_model("verify", first.folder, "--step", 10), "--step 10 goes with --source")


def test_the_step_may_be_said_afterwards(run: Path, tmp_path: Path, runtimes: RuntimePool) -> None:
    """A behavior's own folder, and the step on the command line."""
    (result,) = exported(run / "Walker", tmp_path / "out", step=10, to="bytes", verify="none")
    (place,) = (tmp_path / "out").iterdir()
    assert place == result.folder
    ran = export_model("verify", place, "--source", run / "Walker", "--step", 10, "--runtimes", "tensorflow", "--json")
    assert ran.json["reports"][0]["reference"] == "source/tensorflow"
    assert ran.json["reports"][0]["passed"] is True


def test_without_a_step_none_is_said(run: Path, tmp_path: Path, runtimes: RuntimePool) -> None:
    for result in exported(run, tmp_path / "out", to="bytes", verify="none"):
        assert "step" not in json.loads((result.folder / "policy.json").read_text())["source"]
        assert verify_bundle(result.folder, source=run, runtimes="tensorflow").passed is True
