"""Checkpoints of rl_games, skrl and SBX against what their own players answered (fixtures/robots)."""

from __future__ import annotations

import base64
import json
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from export_model.converters.formats.source import ReadOptions
from export_model.converters.graph.run import run_graph
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import SourceError, UsageError
from export_model.signatures.roles import Role
from fixtures.goldens import read_npz
from fixtures.robots import FOLDER, ROWS, STEPS
from tests.commands import export_model
from tests.torch_checkpoint.pt_files import Writer
from tests.torch_checkpoint.robots import checkpoint, states

NAMES = sorted(p.stem for p in FOLDER.glob("*.npz"))
SENSORS = {"rl_games_cnn_plain": ((2, 16, 12),), "skrl_ppo_eye": ((2, 14, 12),)}


@pytest.mark.parametrize("name", NAMES)
def test_acts_as_the_trainers_own_player(name: str, tmp_path: Path) -> None:
    """Over three steps, the memory fed on; the deviation, or the odds, at the first."""
    (policy,) = read_source(checkpoint(tmp_path, name), ReadOptions(sensors=SENSORS.get(name, ()))).policies()
    golden = read_npz(FOLDER / f"{name}.npz")
    inputs = {spec.role: spec for spec in policy.signature.inputs}
    outputs = {spec.role: spec.name for spec in policy.signature.outputs}
    names = [spec.name for spec in policy.signature.outputs]
    act = "deterministic_action" if "deterministic_action" in names else "action"
    memory = inputs.get(Role.MEMORY_IN)
    state = None if memory is None else np.zeros((ROWS, *memory.shape[1:]), np.float32)
    for step in range(STEPS):
        seen = policy.signature.observations
        feeds = {s.name: golden[f"in/{'obs' if len(seen) == 1 else s.source}"][step] for s in seen}
        feeds |= {s.name: np.zeros((ROWS, *s.shape[1:]), np.float32) for r, s in inputs.items() if r is Role.NOISE}
        if Role.MASKS in inputs:
            feeds[inputs[Role.MASKS].name] = golden["in/action_masks"][step]
        if memory is not None:
            feeds[memory.name] = state
        answers = run_graph(policy.graph, feeds, names)
        wanted = golden["deterministic_action"][step]
        assert answers[act].reshape(wanted.shape) == pytest.approx(wanted, abs=2e-6, rel=2e-5), step
        state = None if memory is None else answers[outputs[Role.MEMORY_OUT]]
        for output in {n for n in golden if not n.startswith("in/")} - {"deterministic_action"} if step == 0 else ():
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


# ------------------------------------------------------------------ skrl


@pytest.mark.parametrize(
    ("change", "value", "message"),
    [
        (
            ("models", "policy", "class"),
            "MultivariateGaussianMixin",
            r"models\.policy\.class is MultivariateGaussianMixin",
        ),
        (("models", "policy", "output"), "cube(ACTIONS)", "calls cube, which is not known there"),
        (("models", "policy", "output"), "__import__('os').system('x')", "has a part that is not known"),
        (("models", "policy", "output"), "2 **", "must be an expression"),
        (("models", "policy", "network"), [], "must have a container"),
        (
            ("models", "policy", "clip_mean_actions"),
            True,
            "clip_mean_actions is true: the limits are the environment's",
        ),
        (("agent", "observation_preprocessor"), None, "the settings none"),
        (("agent", "observation_preprocessor"), "Whitening", "is Whitening; RunningStandardScaler is built"),
        (("models", "separate"), False, "has no policy_layer.weight"),
    ],
)
def test_models_of_skrl_that_are_not_known_are_refused_with_their_key(
    change: tuple[str, ...], value: Any, message: str, tmp_path: Path
) -> None:
    with pytest.raises(SourceError, match=message):
        read_source(changed_settings(tmp_path, "skrl_ppo", change, value))


def test_a_checkpoint_of_skrl_1_calls_observations_states(tmp_path: Path) -> None:
    """skrl 1.4 in Isaac Lab: STATES, state_preprocessor."""
    path = checkpoint(tmp_path, "skrl_ppo")
    file = tmp_path / "run/params/agent.yaml"
    file.write_text(file.read_text().replace("OBSERVATIONS", "STATES").replace("observation_pre", "state_pre"))
    writer = Writer()
    old = {k.replace("observation_pre", "state_pre"): writer.state(s) for k, s in states("skrl_ppo").items()}
    path.write_bytes(writer.zip(old))
    (policy,) = read_source(path).policies()
    golden = read_npz(FOLDER / "skrl_ppo.npz")
    (answer,) = run_graph(policy.graph, {"state": golden["in/obs"][0]}, ["action"]).values()
    assert answer == pytest.approx(golden["deterministic_action"][0], abs=2e-6, rel=2e-5)


def test_a_checkpoint_of_skrl_without_settings_names_what_is_missing(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"its agent\.yaml is missing(?s:.*)a custom class"):
        read_source(checkpoint(tmp_path, "skrl_ppo", settings=""))


# ------------------------------------------------------------------ Sample Factory


@pytest.mark.parametrize(
    ("change", "value", "message"),
    [
        (("encoder_mlp_layers",), [12], r"and \[\?, 12\] fits"),
        (("encoder_mlp_layers",), [], "encoder_mlp_layers must have a layer"),
        (("encoder_mlp_layers",), [9, 12], r"and \[9, 6\] fits"),
        (("nonlinearity",), "cube", "'cube', which is not an activation"),
        (("normalize_input",), False, "normalize_input is false, and the checkpoint has statistics"),
        (("use_rnn",), True, "has no core.core.weight_hh_l0"),
        (("actor_critic_share_weights",), False, "must have a layer for each observation"),
        (("obs_scale",), 0, "obs_scale must not be 0"),
        (("decoder_mlp_layers",), [4], "has no decoder.mlp.0.weight"),
    ],
)
def test_settings_of_sample_factory_that_do_not_fit_are_refused(
    change: tuple[str, ...], value: Any, message: str, tmp_path: Path
) -> None:
    path = checkpoint(tmp_path, "sample_factory_mlp")
    file = tmp_path / "run/config.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), change[0]: value}))
    with pytest.raises(SourceError, match=message):
        read_source(path)


def test_sample_factory_without_settings_or_a_deviation_of_its_own_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"its config\.json is missing"):
        read_source(checkpoint(tmp_path, "sample_factory_mlp", settings=""))
    path, writer = checkpoint(tmp_path, "sample_factory_mlp"), Writer()
    state = states("sample_factory_mlp")["model"]
    del state["action_parameterization.learned_stddev"]
    path.write_bytes(writer.zip({"model": writer.state(state)}))
    with pytest.raises(SourceError, match="its 3 numbers for actions may be of one choice, of several"):
        read_source(path)


# ------------------------------------------------------------------ RLlib


def test_modules_of_rllib_are_found_in_a_checkpoint(tmp_path: Path) -> None:
    module = checkpoint(tmp_path, "rllib_box")
    (module.parent / "other").mkdir()
    for file in module.iterdir():
        (module.parent / "other" / file.name).write_bytes(file.read_bytes())
    found = read_source(tmp_path / "run").policies()
    assert [p.name for p in found] == ["default_policy", "other"]


def changed_pickle(folder: Path, name: str, file: str, old: bytes, new: bytes) -> Path:
    """A module of RLlib with other bytes of the same length in one of its pickles."""
    module = checkpoint(folder, name)
    data = (module / file).read_bytes()
    assert len(old) == len(new) and old in data
    (module / file).write_bytes(data.replace(old, new))
    return module


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("box", b"DefaultPPOTorchRLModule", b"DefaultBCTorchRLModuleX", "its module is DefaultBCTorchRLModuleX, which"),
        ("box", b"\x8c\x04tanh", b"\x8c\x04cube", r"model_config\.fcnet_activation is 'cube'"),
        ("box", b"\x8c\x03Box", b"\x8c\x03Bag", "its space of actions is Bag"),
        ("box", b"model_config", b"model_konfig", "has no model_config"),
        ("lstm", b"use_lstm\x94\x88", b"use_lstm\x94\x89", r"has no encoder\.encoder\.net\.mlp\.0\.weight"),
        ("box", b"use_lstm\x94\x89", b"use_lstm\x94\x88", r"has no encoder\.encoder\.tokenizer\.net\.mlp\.0"),
        ("branches", b"nvec", b"nvek", "nvec"),
    ],
)
def test_modules_of_rllib_that_are_not_known_are_refused(
    name: str, old: bytes, new: bytes, message: str, tmp_path: Path
) -> None:
    with pytest.raises(SourceError, match=message):
        read_source(changed_pickle(tmp_path, f"rllib_{name}", "class_and_ctor_args.pkl", old, new))


def test_a_module_of_rllib_without_its_arguments_names_what_is_missing(tmp_path: Path) -> None:
    module = checkpoint(tmp_path, "rllib_box")
    (module / "class_and_ctor_args.pkl").unlink()
    with pytest.raises(SourceError, match=r"its class_and_ctor_args\.pkl is missing"):
        read_source(module)


@pytest.mark.parametrize("file", ["module_state.pkl", "class_and_ctor_args.pkl"])
def test_a_pickle_of_rllib_that_acts_on_the_machine_does_nothing(file: str, tmp_path: Path) -> None:
    proof, module = tmp_path / "ran", checkpoint(tmp_path, "rllib_box")
    (module / file).write_bytes(pickle.dumps({"x": Command(f"touch {proof}")}))
    with pytest.raises(SourceError, match=r"asks for (posix|os)\.system"):
        read_source(module)
    assert not proof.exists()


# ------------------------------------------------------------------ SBX


def changed_model(folder: Path, name: str, change: Callable[[dict[str, Any]], None]) -> Path:
    """A saved model whose ``data`` says something else."""
    path = folder / "model.zip"
    with zipfile.ZipFile(FOLDER / f"{name}.zip") as whole, zipfile.ZipFile(path, "w") as other:
        for entry in whole.infolist():
            data = whole.read(entry)
            if entry.filename == "data":
                content = json.loads(data)
                change(content)
                data = json.dumps(content).encode()
            other.writestr(entry.filename, data)
    return path


def pickled_policy(data: dict[str, Any], old: bytes, new: bytes) -> None:
    """Put other bytes of the same length into the policy's pickle."""
    assert len(old) == len(new)
    code = base64.b64decode(data["policy"][":serialized:"])
    assert old in code
    data["policy"][":serialized:"] = base64.b64encode(code.replace(old, new)).decode()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda d: d["policy_class"].update(__module__="sbx.crossq.policies"),
            r"of sbx\.crossq\.policies, which is not",
        ),
        (lambda d: d.pop("policy"), "its policy cannot be read|pickle"),
        (lambda d: d["policy"].update({":serialized:": "!"}), "its policy cannot be read"),
        (lambda d: pickled_policy(d, b"Dense_0", b"Conv__0"), "a part that is not built: Conv__0"),
        (lambda d: pickled_policy(d, b"SquashedGaussianActor", b"SomethingOfOnesOwnxx1"), "its network is Something"),
        (lambda d: pickled_policy(d, b"kernel", b"kernal"), "has no kernel and bias"),
        (
            lambda d: d["observation_space"].update({":type:": "<class 'gymnasium.spaces.discrete.Discrete'>"}),
            "is Discrete",
        ),
    ],
)
def test_models_of_sbx_that_are_not_known_are_refused(
    change: Callable[[dict[str, Any]], None], message: str, tmp_path: Path
) -> None:
    with pytest.raises(SourceError, match=message):
        read_source(changed_model(tmp_path, "sbx_sac", change))


def test_a_pickle_that_acts_on_the_machine_is_refused_and_does_nothing(tmp_path: Path) -> None:
    proof = tmp_path / "ran"
    code = pickle.dumps(Command(f"touch {proof}"))
    path = changed_model(
        tmp_path, "sbx_sac", lambda d: d["policy"].update({":serialized:": base64.b64encode(code).decode()})
    )
    with pytest.raises(SourceError, match=r"asks for (posix|os)\.system"):
        read_source(path)
    assert not proof.exists()


class Command:
    """An object that runs a command where it is unpickled."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (self.text,)


# ------------------------------------------------------------------ FastTD3


@pytest.mark.parametrize(
    ("name", "tensor", "args", "message"),
    [
        ("fast_td3_plain", ("task_embedding.weight", (4, 3)), {}, "an actor of several tasks"),
        ("fast_td3_plain", ("net.4.weight", (3, 16)), {}, "no net.4.bias"),
        ("fast_td3_plain", ("extra.weight", (3, 3)), {}, "extra.weight"),
        ("fast_td3_simplices", None, {"actor_seq_len": 7}, "actor_seq_len=7 groups"),
        ("fast_td3_simplices", None, {"actor_seq_len": "6"}, "actor_seq_len='6' groups"),
    ],
)
def test_actors_of_fast_td3_that_are_not_known_are_refused(
    name: str, tensor: tuple[str, tuple[int, ...]] | None, args: dict[str, Any], message: str, tmp_path: Path
) -> None:
    saved = states(name)
    if tensor is not None:
        saved["actor_state_dict"][tensor[0]] = np.zeros(tensor[1], np.float32)
    writer, path = Writer(), tmp_path / "model_final.pt"
    path.write_bytes(writer.zip({**{k: writer.state(s) for k, s in saved.items()}, "args": args}))
    with pytest.raises(SourceError, match=message):
        read_source(path)


def test_an_activation_says_nothing_about_fast_td3(tmp_path: Path) -> None:
    path = checkpoint(tmp_path, "fast_td3_plain")
    with pytest.raises(UsageError, match="says nothing about FastTD3"):
        read_source(path, ReadOptions(activation="elu"))
