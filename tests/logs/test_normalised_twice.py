"""Observations that are normalised twice, in the forms that six projects keep their statistics in: by the agent, which
``verify --log`` names, and by a file, which ``verify`` finds.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper

from export_model.converters.trainers.stable_baselines3.normaliser import read_normaliser
from export_model.signatures.contract import POLICY
from fixtures import trained
from fixtures.sb3_zip import NORMALISED
from tests.commands import export_model
from tests.exporting import load_policy
from tests.interfaces.made import write_onnx
from tests.logs.planting import Array, Fault, recorded
from tests.stable_baselines3.saved_models import saved
from tests.torch_checkpoint.robots import checkpoint, states
from tests.torch_checkpoint.test_state_dicts import saved as state_dict
from tests.torch_checkpoint.test_state_dicts import tensors

#: (the source, options to read it with, what its observations are normalised by: mean, deviation, bound)
Given = tuple[Path, Sequence[object], tuple[Array, Array, float]]
NONE = np.inf


def vec_normalize(folder: Path) -> Given:
    """clip((x − mean) / √(variance + 1e-8), ±clip_obs)."""
    shutil.copy(saved("ppo_box", folder), folder / "model.zip")
    shutil.copy(NORMALISED / "ppo_box.pkl", folder / "vecnormalize.pkl")
    found = read_normaliser("vecnormalize.pkl", (NORMALISED / "ppo_box.pkl").read_bytes())
    ((_, moments),) = found.moments.items()
    return folder / "model.zip", (), (moments.mean, moments.deviation, found.limit)


def rl_games(folder: Path) -> Given:
    """clamp((x − mean) / √(variance + 1e-5), ±5)."""
    state = states("rl_games_mlp")["model"]
    mean, variance = (state[f"running_mean_std.running_{k}"] for k in ("mean", "var"))
    return checkpoint(folder, "rl_games_mlp"), (), (mean, np.sqrt(variance + 1e-5), 5.0)


def skrl(folder: Path) -> Given:
    """clamp((x − mean) / (√variance + 1e-8), ±5)."""
    state = states("skrl_ppo")["observation_preprocessor"]
    mean, variance = state["running_mean"], state["running_variance"]
    return checkpoint(folder, "skrl_ppo"), (), (mean, np.sqrt(variance) + 1e-8, 5.0)


def rsl_rl(folder: Path) -> Given:
    """(x − mean) / (deviation + 0.01)."""
    state = tensors("rsl_5_5")["actor_state_dict"]
    mean, deviation = (state[f"obs_normalizer.{k}"].reshape(-1) for k in ("_mean", "_std"))
    return state_dict(folder, "rsl_5_5"), ("--activation", "elu"), (mean, deviation + 1e-2, NONE)


def ml_agents(folder: Path) -> Given:
    """clip((x − mean) / √(variance / steps), ±5): what its graph has, as constants."""
    graph = load_policy(trained.run_folder("3DBall"), runtime="numpy").signature.observations[0].distribution
    assert graph is not None
    return trained.run_folder("3DBall"), (), (np.array(graph["mean"]), np.array(graph["std"]), 5.0)


def metadata(folder: Path) -> Given:
    """A scale of each term, stated in an ONNX; the environment applies it."""
    said = {"observation_names": "turn,speed", "observation_terms_scale": "0.2;0.2;0.2,0.05;0.05"}
    said |= {"joint_names": "a,b", "action_scale": "1.0,1.0"}
    return write_onnx(folder / "robot.onnx", metadata=said), (), (np.zeros(5), 1 / np.repeat([0.2, 0.05], [3, 2]), NONE)


FORMS: dict[str, Callable[[Path], Given]] = {
    "VecNormalize": vec_normalize,
    "rl_games": rl_games,
    "skrl": skrl,
    "rsl_rl": rsl_rl,
    "ML-Agents": ml_agents,
    "ONNX metadata": metadata,
}


@pytest.fixture
def exported(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, tuple[Array, Array, float]]:
    """The bundle, and what its observations are normalised by."""
    source, options, moments = FORMS[request.param](tmp_path)
    ran = export_model(source, "-o", tmp_path / "out", "--to", "bytes,onnx", "--verify", "none", *options)
    assert ran.status == 0, ran.err
    (bundle,) = (tmp_path / "out").iterdir()
    return bundle, moments


every_form = pytest.mark.parametrize("exported", FORMS, indirect=True)


@every_form
def test_a_log_names_it(exported: tuple[Path, tuple[Array, Array, float]], tmp_path: Path) -> None:
    bundle, (mean, deviation, bound) = exported
    policy = load_policy(bundle, runtime="onnxruntime")
    (name,) = (s.name for s in policy.signature.observations)

    def once_more(inputs: dict[str, Array]) -> dict[str, Array]:
        seen = ((inputs[name] - mean) / deviation).clip(-bound, bound)
        return {**inputs, name: seen.astype(np.float32)}

    clean, faulty = tmp_path / "clean.npz", tmp_path / "faulty.npz"
    np.savez(clean, **recorded(policy, Fault(), seed=3))  # type: ignore[arg-type]
    np.savez(faulty, **recorded(policy, Fault(given=once_more), seed=3))  # type: ignore[arg-type]
    assert export_model("verify", bundle, "--log", clean).status == 0
    ran = export_model("verify", bundle, "--log", faulty)
    assert ran.status == 1
    assert "twice" in " ".join(ran.out.split()), ran.out


@every_form
def test_verify_finds_it_in_a_file(exported: tuple[Path, tuple[Array, Array, float]]) -> None:
    """The contract has the hash of the file that was changed, as if a tool had written both."""
    bundle, (mean, deviation, _) = exported
    assert export_model("verify", bundle, "--runtimes", "onnxruntime").status == 0
    (path,) = bundle.glob("*.onnx")
    model = onnx.load(path)
    seen = next(i.name for i in model.graph.input if i.name in {n for node in model.graph.node for n in node.input})
    constants = {"twice/mean": mean, "twice/deviation": deviation}
    model.graph.initializer.extend(numpy_helper.from_array(v.astype(np.float32), n) for n, v in constants.items())
    for node in model.graph.node:
        node.input[:] = ["twice/seen" if n == seen else n for n in node.input]
    model.graph.node.insert(0, helper.make_node("Sub", [seen, "twice/mean"], ["twice/centred"]))
    model.graph.node.insert(1, helper.make_node("Div", ["twice/centred", "twice/deviation"], ["twice/seen"]))
    onnx.save(model, path)
    content = json.loads((bundle / POLICY).read_text())
    data = path.read_bytes()
    content["files"][path.name] = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
    (bundle / POLICY).write_text(json.dumps(content))
    ran = export_model("verify", bundle, "--runtimes", "onnxruntime")
    assert ran.status == 1 and "action" in ran.out
