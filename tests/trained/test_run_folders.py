"""The run folders: small, what write_run writes, and the same policy by every way in."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter import demo
from export_model.exporter.play.environments import ENVIRONMENTS
from fixtures import FOLDER as FIXTURES
from fixtures import trained
from fixtures.evaluate import play
from fixtures.goldens import read_npz
from fixtures.trained import DEMONSTRATED, FOLDER, TRAINED, run_folder, weights_file
from fixtures.trained.scores import README, decide, in_readme
from tests.commands import ROOT
from tests.exporting import export_model, inspect_model
from tests.trained.conftest import Stage

REPORT = trained.report()


@pytest.mark.parametrize("name", TRAINED)
def test_a_run_folder_has_the_files_of_a_run(name: str) -> None:
    steps = REPORT["policies"][name]["steps"]
    prefix = f"model-{steps}.cptk"
    expected = {
        "checkpoint",
        "frozen_graph_def.pb",
        "raw_graph_def.pb",
        f"{prefix}.index",
        f"{prefix}.data-00000-of-00001",
    }
    assert {f.name for f in run_folder(name).iterdir()} == expected
    assert f'model_checkpoint_path: "{prefix}"' in (run_folder(name) / "checkpoint").read_text()
    assert sum(f.stat().st_size for f in run_folder(name).iterdir()) < 200_000


def test_all_of_it_is_small() -> None:
    assert sum(f.stat().st_size for f in trained.FOLDER.rglob("*") if f.is_file() and f.suffix != ".pyc") < 800_000


def test_the_readme_holds_the_report() -> None:
    text = README.read_text(encoding="utf-8")
    assert in_readme(text, REPORT) == text


def test_there_is_no_other_trained_policy() -> None:
    with pytest.raises(ValueError, match="unknown trained policy 'Walker'; there are 3DBall"):
        run_folder("Walker")


@pytest.mark.parametrize("name", TRAINED)
def test_the_weights_are_in_the_frozen_graph_under_their_names(name: str) -> None:
    nodes = {n.name: n for n in read_graph((run_folder(name) / "frozen_graph_def.pb").read_bytes()).nodes}
    weights = read_npz(weights_file(name))
    frozen = {n for n in weights if n in nodes}
    # Only the value's layers may be left out.
    assert all("extrinsic_value" in n for n in weights.keys() - frozen)
    for variable in frozen:
        value = nodes[variable].value
        assert value is not None
        np.testing.assert_array_equal(value, weights[variable])


def test_the_two_brains_of_a_graph_are_two_policies(bundles: Path) -> None:
    policies = inspect_model(run_folder("Tennis") / "frozen_graph_def.pb").policies
    assert len(policies) == 2
    left, right = (
        json.loads((bundles / f"Tennis-{b}" / "policy.json").read_text()) for b in ("LeftBrain", "RightBrain")
    )
    assert (left["action_space"], left["branches"]) == ("discrete", [3])
    assert (right["action_space"], right["branches"]) == ("continuous", [])
    assert [i["name"] for i in left["inputs"]] == ["state", "action_masks"]
    assert [i["name"] for i in right["inputs"]] == ["state", "epsilon"]
    sources = [{i["source"] for i in policy["inputs"]} for policy in (left, right)]
    assert all(s.startswith("LeftBrain/") for s in sources[0])
    assert all(s.startswith("RightBrain/") for s in sources[1])


@pytest.mark.parametrize("name", TRAINED)
def test_checkpoint_and_frozen_graph_are_the_same_policy(
    name: str, tmp_path: Path, stage: Stage, pool: RuntimePool
) -> None:
    restored = export_model(
        run_folder(name), tmp_path, step=REPORT["policies"][name]["steps"], to="onnx", verify="none"
    )
    again = Stage(tmp_path, pool)
    assert len(restored) == (2 if name == "Tennis" else 1)
    one, other = (play(ENVIRONMENTS[name](20), s.decide(name), seed=9) for s in (stage, again))
    assert len(one.actions) == len(other.actions)
    for ours, theirs in zip(one.actions, other.actions, strict=True):
        np.testing.assert_equal(ours, theirs)


@pytest.mark.slow
@pytest.mark.parametrize("name", TRAINED)
@pytest.mark.usefixtures("runtimes")
def test_tensorflow_restores_the_checkpoint_to_what_is_exported(name: str, tmp_path: Path) -> None:
    steps = REPORT["policies"][name]["steps"]
    for result in export_model(run_folder(name), tmp_path, step=steps, to="onnx", verify=["tensorflow", "onnxruntime"]):
        assert result.passed
        assert result.report is not None
        assert result.report.reference == "source/tensorflow"


@pytest.mark.slow
def test_the_run_folders_are_what_write_run_writes(pool: RuntimePool) -> None:
    command = [sys.executable, "-m", "fixtures.trained.write_run", "--check"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", TRAINED)
def test_numpy_weights_and_the_exported_policy_decide_alike(stage: Stage, name: str) -> None:
    weights = read_npz(weights_file(name))
    ours, theirs = decide(name, weights), stage.decide(name)
    environment = ENVIRONMENTS[name](64)
    observation, _ = environment.reset(seed=11)
    for _ in range(40):
        expected, got = ours(observation), theirs(observation)
        np.testing.assert_equal(type(got), type(expected))
        pairs = [(expected[b], got[b]) for b in expected] if isinstance(expected, dict) else [(expected, got)]
        for a, b in pairs:
            assert a.shape == b.shape
            np.testing.assert_allclose(b, a, atol=1e-5)
        observation, *_ = environment.step(got)


def test_the_demo_has_the_policies_that_were_trained() -> None:
    made = {f"{name}.bytes": FOLDER / name / "frozen_graph_def.pb" for name in DEMONSTRATED}
    made |= {n: FIXTURES / "sb3" / n for n in ("sb3_discrete.onnx", "torch_actor.onnx", "torch_actor.onnx.data")}
    made["3DBall.pt"] = FIXTURES / "torch_checkpoint" / "ppo_1_1.pt"
    there = {p.name for p in demo.FOLDER.iterdir() if p.suffix in (".bytes", ".onnx", ".data", ".pt")}
    assert there == set(made)
    assert [n for n, path in made.items() if (demo.FOLDER / n).read_bytes() != path.read_bytes()] == []
