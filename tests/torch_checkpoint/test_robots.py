"""Checkpoints of rl_games, skrl and SBX against what their own players answered (fixtures/robots)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from converters.formats.source import ReadOptions
from converters.graph.run import run_graph
from exporter.export.sources import read_source
from fixtures.goldens import read_npz
from fixtures.robots import FOLDER, ROWS, STEPS
from fixtures.torch_checkpoint.cases import waves
from signatures.errors import SourceError, UsageError
from signatures.roles import Role
from tests.commands import export_model
from tests.torch_checkpoint.pt_files import Writer

NAMES = sorted(p.stem for p in FOLDER.glob("*.npz"))
SENSORS = {"rl_games_cnn_plain": ((2, 16, 12),), "skrl_ppo_eye": ((2, 14, 12),)}


def states(name: str) -> dict[str, dict[str, np.ndarray]]:
    """The checkpoint's state dictionaries by key."""
    return {
        key: {
            n: np.array(e["values"], e["dtype"]).reshape(e["shape"])
            if "values" in e
            else waves(n, e["shape"]).astype(e["dtype"])
            for n, e in layout.items()
        }
        for key, layout in json.loads((FOLDER / f"{name}.json").read_text()).items()
    }


def checkpoint(
    folder: Path, name: str, place: str = "run/nn/last.pth", settings: str = "run/params/agent.yaml"
) -> Path:
    """The checkpoint and its settings, laid out as Isaac Lab does."""
    writer = Writer()
    path = folder / place
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(writer.zip({**{k: writer.state(s) for k, s in states(name).items()}, "epoch": 3, "frame": 9}))
    if settings:
        (folder / settings).parent.mkdir(parents=True, exist_ok=True)
        (folder / settings).write_bytes((FOLDER / f"{name}.yaml").read_bytes())
    return path


@pytest.mark.parametrize("name", NAMES)
def test_acts_as_the_trainers_own_player(name: str, tmp_path: Path) -> None:
    """Over three steps, the memory fed on; the deviation, or the odds, at the first."""
    (policy,) = read_source(checkpoint(tmp_path, name), ReadOptions(sensors=SENSORS.get(name, ()))).policies()
    golden = read_npz(FOLDER / f"{name}.npz")
    inputs = {spec.role: spec for spec in policy.signature.inputs}
    outputs = {spec.role: spec.name for spec in policy.signature.outputs}
    names = [spec.name for spec in policy.signature.outputs]
    act = "action" if policy.signature.action_space == "continuous" else "deterministic_action"
    memory = inputs.get(Role.MEMORY_IN)
    state = None if memory is None else np.zeros((ROWS, *memory.shape[1:]), np.float32)
    for step in range(STEPS):
        feeds = {s.name: golden["in/obs"][step] for r, s in inputs.items() if r in (Role.VECTOR, Role.VISUAL)}
        if Role.MASKS in inputs:
            feeds[inputs[Role.MASKS].name] = golden["in/action_masks"][step]
        if memory is not None:
            feeds[memory.name] = state
        answers = run_graph(policy.graph, feeds, names)
        wanted = golden["deterministic_action"][step]
        assert answers[act].reshape(wanted.shape) == pytest.approx(wanted, abs=2e-6, rel=2e-5), step
        state = None if memory is None else answers[outputs[Role.MEMORY_OUT]]
        for output in golden.keys() - {"in/obs", "in/action_masks", "deterministic_action"} if step == 0 else ():
            assert answers[output] == pytest.approx(golden[output], abs=5e-6, rel=2e-5), output


def changed_settings(folder: Path, name: str, change: tuple[str, ...], value: Any) -> Path:
    """A checkpoint whose settings say something else at a path of keys."""
    path = checkpoint(folder, name)
    file = folder / "run/params/agent.yaml"
    content = json.loads(json.dumps(yaml.safe_load(file.read_text())))
    section = content
    for key in change[:-1]:
        section = section[key]
    section[change[-1]] = value
    file.write_text(yaml.safe_dump(content))
    return path


@pytest.mark.parametrize(
    ("change", "value", "message"),
    [
        (
            ("params", "network", "name"),
            "resnet_actor_critic",
            r"params\.network\.name is resnet_actor_critic, which is",
        ),
        (("params", "model", "name"), "continuous_a2c_tanh", r"params\.model\.name is continuous_a2c_tanh"),
        (("params", "network", "mlp", "units"), [12, 9], r"\[9, 12\] fits the network"),
        (("params", "network", "mlp", "units"), [12], r"and \[\?, 12\] fits"),
        (("params", "network", "mlp", "units"), "12", r"params\.network\.mlp\.units must be a list"),
        (("params", "network", "mlp", "activation"), "cube", "'cube', which is not an activation"),
        (("params", "network", "mlp"), [1], r"params\.network\.mlp must be a mapping"),
        (("params", "network", "rnn"), {"name": "lstm", "units": 6, "layers": 1}, "rnn.rnn"),
        (("params", "config", "normalize_input"), False, "running_mean_std"),
        (("params", "config", "clip_actions"), "yes?", r"params\.config\.clip_actions must be true or false"),
    ],
)
def test_settings_that_do_not_fit_are_refused_with_their_key(
    change: tuple[str, ...], value: Any, message: str, tmp_path: Path
) -> None:
    with pytest.raises(SourceError, match=message):
        read_source(changed_settings(tmp_path, "rl_games_mlp", change, value))


@pytest.mark.parametrize("settings", ["run/nn/agent.yaml", "run/nn/params/agent.yaml", "run/config.yaml"])
def test_settings_are_found_where_a_run_keeps_them(settings: str, tmp_path: Path) -> None:
    (policy,) = read_source(checkpoint(tmp_path, "rl_games_mlp", settings=settings)).policies()
    assert any("built as" in note and Path(settings).name in note for note in policy.signature.notes)


def test_a_checkpoint_without_settings_names_what_is_missing(tmp_path: Path) -> None:
    path = checkpoint(tmp_path, "rl_games_mlp", settings="")
    with pytest.raises(SourceError, match=r"its agent\.yaml is missing(?s:.*)params/agent\.yaml"):
        read_source(path)
    with pytest.raises(UsageError, match="--activation says nothing about a checkpoint of rl_games"):
        read_source(path, ReadOptions(activation="elu"))
    with pytest.raises(SourceError, match=r"--sensors 2x84x84"):
        read_source(checkpoint(tmp_path, "rl_games_cnn_plain"))


def test_settings_above_another_folder_are_not_taken(tmp_path: Path) -> None:
    """One folder up is looked at only from where a run keeps its checkpoints: others may hold anything."""
    path = checkpoint(tmp_path, "rl_games_mlp", place="run/weights/last.pth")
    with pytest.raises(SourceError, match="is missing"):
        read_source(path)


def test_names_of_a_compiled_model_and_settings_of_isaac_gym_are_read(tmp_path: Path) -> None:
    writer = Writer()
    state = {f"_orig_mod.{n}": value for n, value in states("rl_games_mlp")["model"].items()}
    path = tmp_path / "ant.pth"
    path.write_bytes(writer.zip({"model": writer.state(state), "epoch": 1}))
    settings = yaml.safe_load((FOLDER / "rl_games_mlp.yaml").read_text())
    (tmp_path / "config.yaml").write_text(yaml.safe_dump({"task": {"name": "Ant"}, "train": settings}))
    (policy,) = read_source(path).policies()
    assert policy.signature.inputs[0].shape == (None, 7)


def test_is_exported_and_verified(tmp_path: Path) -> None:
    path = checkpoint(tmp_path, "rl_games_lstm")
    exported = export_model(path, "-o", tmp_path / "out", "--verify", "none")
    assert exported.status == 0, exported.err
    contract = json.loads((tmp_path / "out/last/policy.json").read_text())
    assert contract["family"] == "rl_games"
    assert [s["role"] for s in contract["outputs"]] == ["action", "memory_out", "log_std"] or contract["memory"]
    again = export_model("verify", tmp_path / "out/last", "--source", path, "--runtimes", "numpy", "--allow-unverified")
    assert again.status == 0, again.err
