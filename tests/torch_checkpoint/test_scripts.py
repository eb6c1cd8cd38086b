"""State dictionaries whose names fit more than one script: nothing is chosen in silence."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.formats.source import ReadOptions
from export_model.converters.graph.run import run_graph
from export_model.converters.trainers.scripts.choice import known_state
from export_model.converters.trainers.scripts.table import SCRIPTS
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import SourceError, UsageError
from fixtures.state_dicts import FOLDER
from fixtures.torch_checkpoint.cases import waves
from tests.commands import export_model
from tests.exporting import inspect_model
from tests.torch_checkpoint.pt_files import Writer
from tests.torch_checkpoint.test_state_dicts import saved, trunk_of_ones_own

ALONE = ("cleanrl-ppo", "ppo-pytorch-discrete", "ppo-pytorch-continuous", "ppo-pytorch-continuous-2022")
CONTINUOUS = ALONE[2:]
ATARI = ("cleanrl-ppo", "cleanrl-ppo-pettingzoo")
#: Every group of scripts whose files have the same names, and a file of each kind.
GROUPS = [ALONE, CONTINUOUS, ATARI]
#: Fixture → the only script that it fits.
SINGLE = {
    "clean_ppo_continuous": "cleanrl-ppo-continuous",
    "clean_ppo_atari_lstm": "cleanrl-ppo",
    "clean_sac": "cleanrl-sac",
    "clean_td3": "cleanrl-td3",
    "clean_c51": "cleanrl-c51",
    **dict.fromkeys(("clean_dqn", "clean_dqn_atari", "clean_pqn"), "cleanrl-dqn"),
}


def written(folder: Path, layers: dict[str, tuple[int, ...]], name: str = "policy.pth") -> Path:
    """A state dictionary of layers, weight and bias, as torch.save writes it."""
    state = {f"{n}.weight": waves(n, shape) for n, shape in layers.items()}
    state |= {f"{n}.bias": waves(n, shape[:1]) for n, shape in layers.items()}
    writer = Writer()
    (path := folder / name).parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(writer.zip(writer.state(state)))
    return path


def alone(actions: int, critic: int = 4) -> dict[str, tuple[int, ...]]:
    return {
        "actor.0": (6, 4), "actor.2": (6, 6), "actor.4": (actions, 6),
        "critic.0": (6, critic), "critic.2": (6, 6), "critic.4": (1, 6),
    }  # fmt: skip


def atari(channels: int) -> dict[str, tuple[int, ...]]:
    images = {"network.0": (4, channels, 8, 8), "network.2": (5, 4, 4, 4), "network.4": (6, 5, 3, 3)}
    return {**images, "network.7": (6, 6), "actor": (4, 6), "critic": (1, 6)}


def of_group(folder: Path, group: tuple[str, ...]) -> Path:
    layers = {ALONE: alone(3), CONTINUOUS: alone(1), ATARI: atari(6)}[group]
    return written(folder, layers)


@pytest.mark.parametrize("group", GROUPS, ids=lambda group: group[-1])
def test_scripts_that_share_names_are_asked_for_and_each_is_read(group: tuple[str, ...], tmp_path: Path) -> None:
    """No two of a group compute the same, but the two that draw a choice by the same logits."""
    path, sensors = of_group(tmp_path, group), ((6, 36, 38),) if group is ATARI else ()
    with pytest.raises(SourceError, match="may be of any of these scripts") as caught:
        read_source(path, ReadOptions(sensors=sensors))
    said = str(caught.value)
    assert all(f"--script {key}" in said and f"{key}: " in said for key in group)
    assert not any(f"--script {s.key}" in said for s in SCRIPTS if s.key not in group)
    graphs = {}
    for key in group:
        (policy,) = read_source(path, ReadOptions(sensors=sensors, script=key)).policies()
        graphs[key] = [(n.op, None if n.value is None else n.value.tolist()) for n in policy.graph.nodes]
        assert any(f"read as {key} (--script {key})" in note for note in policy.signature.notes)
    alike = [(a, b) for i, a in enumerate(group) for b in group[i + 1 :] if graphs[a] == graphs[b]]
    assert alike == ([("cleanrl-ppo", "ppo-pytorch-discrete")] if group is ALONE else [])
    with pytest.raises(UsageError, match="does not fit the checkpoint"):
        read_source(path, ReadOptions(sensors=sensors, script="cleanrl-sac"))
    with pytest.raises(UsageError, match="unknown script"):
        read_source(path, ReadOptions(sensors=sensors, script="ppo"))


@pytest.mark.parametrize("name", sorted(p.stem for p in FOLDER.glob("*.npz") if not p.stem.startswith("rsl")))
def test_every_fixture_fits_the_scripts_of_its_names(name: str, tmp_path: Path) -> None:
    """The table's rows overlap where the scripts do, and nowhere else."""
    known = known_state(read_pickle(saved(tmp_path, name)))
    assert known is not None
    certain = tuple(s.key for s in known.scripts if s.activation)
    assert certain == ((SINGLE[name],) if name in SINGLE else ALONE)


def read_pickle(path: Path) -> Any:
    from export_model.converters.files.torch_archive import Archive

    return Archive(path.read_bytes()).value


@pytest.mark.parametrize(
    ("place", "found"),
    [
        ("ppo.cleanrl_model", "cleanrl-ppo"),
        ("CartPole-v1__ppo__1__1770946839/agent.pt", "cleanrl-ppo"),
        ("PPO_CartPole-v1_0_0.pth", ""),
        ("policy.pth", ""),
    ],
)
def test_what_the_file_is_called_may_decide(place: str, found: str, tmp_path: Path) -> None:
    path = written(tmp_path, alone(3), place)
    if found:
        (policy,) = read_source(path).policies()
        assert any(f"read as {found} (its f" in note for note in policy.signature.notes)
        return
    with pytest.raises(SourceError) as caught:
        read_source(path)
    asked = ALONE[1:] if place.startswith("PPO_") else ALONE
    assert [key for key in ALONE if f"--script {key}" in str(caught.value)] == list(asked)


def test_the_channels_of_pettingzoo_that_are_no_colours_are_not_scaled(tmp_path: Path) -> None:
    """Oracle: the same layers under ppo_atari.py, whose image is divided by 255 as a whole."""
    path, image = of_group(tmp_path, ATARI), np.abs(waves("image", (2, 6, 36, 38))) * 100
    answers = {}
    for key, fed in ((ATARI[1], image), (ATARI[0], image * np.array([1] * 4 + [255] * 2).reshape(1, 6, 1, 1))):
        (policy,) = read_source(path, ReadOptions(sensors=((6, 36, 38),), script=key)).policies()
        (spec,) = policy.signature.inputs
        answers[key] = run_graph(policy.graph, {spec.name: fed.astype(np.float32)}, ["action_log_probs"])
    first, second = (a["action_log_probs"] for a in answers.values())
    assert first == pytest.approx(second, abs=1e-5)


def test_what_no_script_has_is_not_taken_for_the_nearest(tmp_path: Path) -> None:
    for name in ("clean_dqn", "clean_pqn"):  # a Sequential that is called network: a classifier's, a policy's
        path = saved(tmp_path, name)
        with pytest.raises(SourceError, match=r"networks of any kind(?s:.*)--script cleanrl-dqn"):
            read_source(path)
        (policy,) = read_source(path.rename(tmp_path / f"{name}.cleanrl_model")).policies()
        assert any("read as cleanrl-dqn (its file is a .cleanrl_model)" in note for note in policy.signature.notes)
    path = trunk_of_ones_own(tmp_path)
    with pytest.raises(SourceError, match="no known script has quite the names") as caught:
        read_source(path, ReadOptions(activation="tanh"))
    assert "--script cleanrl-ppo" in str(caught.value)
    for layers, words in (
        (alone(3, critic=7), "are of no PPO"),
        ({"network.0": (6, 4), "network.2": (1, 6)}, "as a critic gives it"),
        ({**atari(4), "actor": (1, 6)}, "as a critic gives it"),
    ):
        with pytest.raises(SourceError, match=words):
            read_source(written(tmp_path, layers))
    with pytest.raises(UsageError, match="--script says nothing about a checkpoint of rsl_rl"):
        read_source(saved(tmp_path, "rsl_5_5"), ReadOptions(script="cleanrl-ppo"))


def test_every_command_asks_alike_and_takes_the_flag(tmp_path: Path) -> None:
    path, out = saved(tmp_path, "ppo_pytorch_continuous"), tmp_path / "out"
    flag = ("--script", "ppo-pytorch-continuous")
    bundle = out / path.stem
    for command in (
        (path, "-o", out, "--to", "onnx", "--verify", "numpy"),
        (path, path, "-o", out, "--to", "onnx", "--verify", "numpy", "--jobs", "1"),
        ("inspect", path),
        ("compare", path, bundle, "--runtimes", "numpy", "--allow-unverified"),
    ):
        refused = export_model(*command)
        assert refused.status == 2
        assert "--script ppo-pytorch-continuous-2022" in refused.err
        taken = export_model(*command, *flag)
        assert taken.status in (0, 3), (command, taken.err)
    assert json.loads((bundle / "policy.json").read_text())["source"]["script"] == flag[1]
    again = export_model("verify", bundle, "--source", path, "--runtimes", "numpy", "--allow-unverified")
    assert again.status == 0, again.err
    assert inspect_model(path, script=flag[1]).policies
