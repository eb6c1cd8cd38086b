"""Checkpoints of rsl_rl, CleanRL's scripts and PPO-PyTorch against what their modules gave (fixtures/state_dicts)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.converters.formats.source import ReadOptions
from export_model.converters.graph.run import run_graph
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import NotAPolicyError, SourceError, UsageError
from export_model.signatures.roles import Role
from fixtures.goldens import read_npz
from fixtures.state_dicts import FOLDER, ROWS
from fixtures.torch_checkpoint.cases import waves
from tests.commands import export_model
from tests.torch_checkpoint.pt_files import RETURNS, Writer

ACTIVATIONS = {
    **dict.fromkeys(("rsl_2_3", "rsl_5_5", "rsl_5_5_gru"), "elu"),
    **dict.fromkeys(("rsl_3_1_lstm", "clean_ppo", "clean_ppo_continuous"), "tanh"),
    **dict.fromkeys(("ppo_pytorch_continuous", "ppo_pytorch_continuous_2022", "ppo_pytorch_discrete"), "tanh"),
    "rsl_3_1_student": "selu",
}
#: Where the names of the layers do not tell the script.
SCRIPTS = {"clean_ppo": "cleanrl-ppo", **dict.fromkeys(("clean_dqn", "clean_pqn"), "cleanrl-dqn")}
EYE = ((2, 36, 38),)


def tensors(name: str) -> dict[str, dict[str, np.ndarray]]:
    """The checkpoint's state dictionaries by key."""
    found: dict[str, dict[str, np.ndarray]] = {}
    for key, layout in json.loads((FOLDER / f"{name}.json").read_text()).items():
        found[key] = {
            n: np.array(e["values"], e["dtype"]).reshape(e["shape"]) if "values" in e else waves(n, e["shape"])
            for n, e in layout.items()
        }
    return found


def saved(folder: Path, name: str, **changed: Any) -> Path:
    """A file as torch.save writes it; a state dictionary alone where it has no key."""
    writer = Writer()
    states = {key: writer.state({**state, **changed}) for key, state in tensors(name).items()}
    path = folder / f"{name}.pt"
    path.write_bytes(writer.zip(states.get("", {**states, "iter": 7, "infos": RETURNS})))
    return path


def options(name: str) -> ReadOptions:
    eye = "atari" in name
    script = SCRIPTS.get(name, name.replace("_", "-") if name.startswith("ppo_pytorch") else None)
    return ReadOptions(sensors=EYE if eye else (), activation=ACTIVATIONS.get(name, "relu"), script=script)


@pytest.mark.parametrize("name", sorted(p.stem for p in FOLDER.glob("*.npz")))
def test_gives_what_the_modules_give(name: str, tmp_path: Path) -> None:
    (policy,) = read_source(saved(tmp_path, name), options(name)).policies()
    golden = read_npz(FOLDER / f"{name}.npz")
    given = {k.removeprefix("in/"): v for k, v in golden.items() if k.startswith("in/")}
    feeds = {}
    for spec in policy.signature.inputs:
        key = spec.source if spec.source in given else spec.name
        feeds[spec.name] = given[str(key)].reshape(tuple(ROWS if n is None else n for n in spec.shape))
    answers = run_graph(policy.graph, feeds, [s.name for s in policy.signature.outputs])
    wanted = {k: v for k, v in golden.items() if not k.startswith("in/")}
    if "logits" in wanted:  # drawn: what the draw is taken from
        logits = wanted.pop("logits").astype(np.float64)
        wanted["action_log_probs"] = logits - np.log(np.exp(logits).sum(1, keepdims=True))
        wanted["deterministic_action"] = logits.argmax(1)
    for output, value in wanted.items():
        assert answers[output].reshape(value.shape) == pytest.approx(value, abs=2e-6, rel=2e-5), output
    unchecked = {s.name for s in policy.signature.outputs if s.role is not Role.SAMPLED} - set(wanted)
    assert unchecked <= {"deterministic_action"}


def trunk_of_ones_own(folder: Path) -> Path:
    """Linear layers that an actor and a critic share, which no script of CleanRL has."""
    layers = {"network.0": (6, 4), "network.2": (6, 6), "actor": (2, 6), "critic": (1, 6)}
    state = {f"{n}.weight": waves(n, shape) for n, shape in layers.items()}
    writer = Writer()
    path = folder / "own.pt"
    path.write_bytes(writer.zip(writer.state(state | {f"{n}.bias": waves(n, s[:1]) for n, s in layers.items()})))
    return path


@pytest.mark.parametrize("name", ["rsl_5_5", "own"])
def test_the_activation_is_asked_for_where_no_script_tells_it(name: str, tmp_path: Path) -> None:
    path = trunk_of_ones_own(tmp_path) if name == "own" else saved(tmp_path, name)
    script = "cleanrl-ppo" if name == "own" else None
    with pytest.raises(SourceError, match="does not say which activation") as caught:
        read_source(path, ReadOptions(script=script))
    assert f"--activation NAME ({'rsl_rl' if name == 'rsl_5_5' else 'CleanRL'}" in str(caught.value)
    which = ("--script", script) if script else ()
    exported = export_model(path, "-o", tmp_path / "out", "--activation", "elu", *which, "--verify", "none")
    assert exported.status == 0, exported.err
    again = export_model(
        "verify", tmp_path / "out" / name, "--source", path, "--runtimes", "numpy", "--allow-unverified"
    )
    assert again.status == 0, again.err


@pytest.mark.parametrize("name", sorted(p.stem for p in FOLDER.glob("*.npz") if p.stem[:3] in ("cle", "ppo")))
def test_the_activation_of_a_script_is_the_default_and_said(name: str, tmp_path: Path) -> None:
    """The weights and answers of the fixtures are of the scripts' own classes."""
    path, told = saved(tmp_path, name), options(name)
    (given,) = read_source(path, told).policies()
    (taken,) = read_source(path, replace(told, activation=None)).policies()
    assert [(n.op, n.inputs) for n in taken.graph.nodes] == [(n.op, n.inputs) for n in given.graph.nodes]
    (note,) = set(taken.signature.notes) - set(given.signature.notes)
    maker = "CleanRL" if name.startswith("clean") else "PPO-PyTorch"
    assert f"taken to be {told.activation}, as in {maker}'s" in note
    assert "--activation NAME" in note


def test_the_activation_that_isaac_lab_wrote_is_taken(tmp_path: Path) -> None:
    path = saved(tmp_path, "rsl_5_5")
    (tmp_path / "params").mkdir()
    agent = tmp_path / "params/agent.yaml"
    agent.write_text(
        "seed: 42\npolicy:\n  class_name: ActorCritic\n  activation: tanh\nalgorithm:\n  activation: relu\n"
    )
    (policy,) = read_source(path).policies()
    assert any("its activation is tanh, as params/agent.yaml says" in note for note in policy.signature.notes)
    assert sum(n.op == "Tanh" for n in policy.graph.nodes) == 2
    with pytest.raises(UsageError, match=r"contradicts params/agent\.yaml"):
        read_source(path, ReadOptions(activation="elu"))
    agent.write_text("actor:\n  activation: tanh\nstudent:\n  activation: relu\n")  # two: neither is taken
    with pytest.raises(SourceError, match="does not say which activation"):
        read_source(path)


def test_what_the_weights_do_not_tell_is_refused_and_named(tmp_path: Path) -> None:
    weight = np.ones((4, 4), np.float32)
    for name, more, words in (
        ("rsl_5_5", {"cnns.0.weight": weight}, "cnns.0.weight"),
        ("rsl_3_1_lstm", {"memory_a.rnn.weight_hh_l0_reverse": weight}, "reads its history backwards"),
        ("clean_ppo", {"critic.0.weight": np.ones((1, 9), np.float32)}, "are of no PPO"),
        ("clean_ppo", {"std": np.ones(4, np.float32)}, "not read from a checkpoint: std"),
        ("clean_dqn_atari", {"network.0.weight": np.ones((4, 2, 5, 5), np.float32)}, "its strides are not in the file"),
    ):
        with pytest.raises(SourceError) as caught:
            read_source(saved(tmp_path, name, **more), options(name))
        assert words in str(caught.value), name
    with pytest.raises(SourceError, match="the size of the image") as caught:
        read_source(saved(tmp_path, "clean_dqn_atari"), ReadOptions(activation="relu"))
    assert "--sensors 2x84x84" in str(caught.value)
    writer = Writer()
    state = writer.state({"mlp_extractor.policy_net.0.weight": weight, "action_net.weight": weight})
    (tmp_path / "policy.pth").write_bytes(writer.zip(state))
    with pytest.raises(NotAPolicyError, match=r"give the \.zip"):
        read_source(tmp_path / "policy.pth")
    between = {
        f"network.{i}.{part}": np.ones((size, 4) if part == "weight" else size, np.float32)
        for i, size in ((0, 4), (1, 2))
        for part in ("weight", "bias")
    }
    (tmp_path / "dqn.pt").write_bytes(writer.zip(writer.state(between)))
    with pytest.raises(SourceError, match="nothing stands between"):
        read_source(tmp_path / "dqn.pt", ReadOptions(activation="relu", script="cleanrl-dqn"))


def _sequence(*layers: tuple[int, tuple[int, ...]], module: str = "actor_mean") -> dict[str, np.ndarray]:
    """Weights and biases of an ``nn.Sequential`` of 3 numbers to 4 and 2, at the indices that are given."""
    made = {"actor_logstd": np.zeros((1, 2), np.float32)} if module == "actor_mean" else {}
    for index, shape in layers:
        bias = shape if len(shape) in (1, 3) else shape[:1]
        made |= {f"{module}.{index}.weight": waves(f"w{index}", shape), f"{module}.{index}.bias": waves("b", bias)}
    return made


def _exported(folder: Path, state: dict[str, np.ndarray], **told: Any) -> Any:
    writer = Writer()
    path = folder / "policy.pt"
    path.write_bytes(writer.zip(writer.state(state)))
    (policy,) = read_source(path, ReadOptions(activation="tanh", **told)).policies()
    return policy


def _norm(x: np.ndarray, state: dict[str, np.ndarray], name: str) -> np.ndarray:
    axes = tuple(range(1, x.ndim))
    value = (x - x.mean(axes, keepdims=True)) / np.sqrt(x.var(axes, keepdims=True) + 1e-5)
    return np.asarray(value * state[f"{name}.weight"] + state[f"{name}.bias"])


@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_layer_norm_stands_where_its_number_says(place: int, tmp_path: Path) -> None:
    """Before the first layer, before the activation, after it: none of them adds an activation of its own."""
    indices = {0: (1, 3, 0), 1: (0, 3, 1), 2: (0, 3, 2)}[place]
    state = _sequence((indices[0], (4, 3)), (indices[1], (2, 4)), (indices[2], (3,) if place == 0 else (4,)))
    x = np.array([[0.5, -1, 2], [3, 0.1, -0.2]], np.float32)

    def linear(value: np.ndarray, index: int) -> np.ndarray:
        return value @ state[f"actor_mean.{index}.weight"].T + state[f"actor_mean.{index}.bias"]

    norm = f"actor_mean.{indices[2]}"
    hidden = linear(_norm(x, state, norm) if place == 0 else x, indices[0])
    hidden = np.tanh(_norm(hidden, state, norm)) if place == 1 else np.tanh(hidden)
    wanted = linear(_norm(hidden, state, norm) if place == 2 else hidden, indices[1])
    found = run_graph(_exported(tmp_path, state).graph, {"state": x}, ["action"])["action"]
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)


def test_what_stands_between_layers_and_has_no_weights_is_not_guessed(tmp_path: Path) -> None:
    windows = ((0, (32, 2, 8, 8)), (3, (4, 32, 4, 4)), (6, (4, 4, 3, 3)))
    norms = ((1, (32,)), (4, (4,)), (7, (4,)))
    image = _sequence(*windows, *norms, (10, (2, 4)), module="network")
    for state, words, told in (
        (_sequence((0, (4, 3)), (3, (2, 4))), "2 modules without weights stand between its layers 0 and 3", {}),
        (_sequence((0, (4, 3)), (1, (2, 4))), "nothing stands between its layers 0 and 1", {}),
        (image, "network.1.*it must be a LayerNorm", {"sensors": EYE}),
    ):
        with pytest.raises(SourceError, match=rf"(?s){words}"):
            _exported(tmp_path, state, **told)
