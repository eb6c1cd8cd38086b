"""Saved models of Stable-Baselines3 and sb3-contrib against what their own ``predict`` gave (fixtures/sb3_zip)."""

from __future__ import annotations

import json
import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.formats.source import ReadOptions
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import DamagedFileError, ExportModelError, NotAPolicyError, SourceError, UsageError
from fixtures.goldens import read_npz
from fixtures.sb3_zip import FOLDER, weight
from fixtures.torch_checkpoint.cases import waves
from tests.stable_baselines3.saved_models import answered, saved
from tests.torch_checkpoint.pt_files import Writer, zipped

NAMES = sorted(p.stem for p in FOLDER.glob("*.npz"))
#: The widest gap between float32 sums in PyTorch's order and in ours.
ATOL, RTOL = 2e-6, 2e-5


def changed(folder: Path, name: str, state: Mapping[str, np.ndarray] | None = None, **data: Any) -> Path:
    """A model with other data, or further tensors."""
    about = json.loads((FOLDER / f"{name}.json").read_text())
    writer = Writer()
    tensors = {k: waves(k, e["shape"]) for k, e in about["tensors"].items()} | dict(state or {})
    path = folder / "changed.zip"
    entries = {"data": json.dumps(about["data"] | data).encode(), "policy.pth": writer.zip(writer.state(tensors))}
    path.write_bytes(zipped(entries))
    return path


def compiled(path: Path) -> Policy:
    (policy,) = read_source(path).policies()
    return policy


@pytest.mark.parametrize("name", NAMES)
def test_gives_what_predict_gives(name: str, tmp_path: Path) -> None:
    policy = compiled(saved(name, tmp_path))
    golden = read_npz(FOLDER / f"{name}.npz")
    answers = answered(policy, {k: v for k, v in golden.items() if k != "in/epsilon"})
    wanted = golden["deterministic"]
    assert answers["deterministic_action"].reshape(wanted.shape) == pytest.approx(wanted, abs=ATOL, rel=RTOL)
    assert len(np.unique(wanted.reshape(len(wanted), -1), axis=0)) > 1 or {"probs", "q_values"} & set(golden)
    if "drawn" in golden:
        drawn = answered(policy, golden)["action"]
        assert drawn.reshape(golden["drawn"].shape) == pytest.approx(golden["drawn"], abs=ATOL, rel=RTOL)
    if "probs" in golden:
        probs = np.exp(answers["action_log_probs"])
        if probs.shape != golden["probs"].shape:  # of a bit there are two
            probs = probs[:, 1::2]
        assert probs == pytest.approx(golden["probs"], abs=ATOL, rel=RTOL)
    for name_of in ("q_values", "recurrent_out"):
        assert (name_of in golden) == (name_of in answers)
        if name_of in golden:
            assert answers[name_of] == pytest.approx(golden[name_of], abs=ATOL, rel=RTOL)


@pytest.mark.parametrize("name", ["ars_linear", "ars_clipped"])
def test_a_linear_policy_of_ars_before_its_layer_had_a_number_is_read(name: str, tmp_path: Path) -> None:
    """sb3-contrib before 1.7: action_net.weight; the answers are those of the same layer as it is kept now."""
    about = json.loads((FOLDER / f"{name}.json").read_text())
    writer, path, golden = Writer(), tmp_path / "old.zip", read_npz(FOLDER / f"{name}.npz")
    state = {k.replace(".0.", "."): weight(k, waves(e["waves"], e["shape"])) for k, e in about["tensors"].items()}
    entries = {"data": json.dumps(about["data"]).encode(), "policy.pth": writer.zip(writer.state(state))}
    path.write_bytes(zipped(entries))
    wanted = golden["deterministic"]
    found = answered(compiled(path), golden)["deterministic_action"]
    assert found.reshape(wanted.shape) == pytest.approx(wanted, abs=ATOL, rel=RTOL)


def test_the_zoos_linear_policy_of_2022_acts_as_the_library_loads_it() -> None:
    """The answers are those of sb3-contrib 2.9.2, which loads the file."""
    path = Path(__file__).resolve().parents[2] / "../shared/corpus4/DLR-RM+rl-trained-agents+CartPole-v1.zip"
    if not path.exists():
        pytest.skip(f"{path} is not here")
    seen = np.random.default_rng(0).normal(size=(8, 4)).astype(np.float32)
    actions = run_graph(compiled(path).graph, {"state": seen}, ["action"])["action"]
    assert actions.reshape(-1).tolist() == [1, 1, 0, 0, 1, 1, 0, 0]


def test_the_bounds_of_discrete_observations_are_known_column_by_column(tmp_path: Path) -> None:
    """``nvec`` of a MultiDiscrete, ``n`` of a Discrete."""
    wanted = {"ppo_branches": ("state", 0, [2, 1]), "ppo_state": ("state", 0, 5), "ppo_mixed": ("gear", 0, 2)}
    for name, (source, low, high) in wanted.items():
        specs = compiled(saved(name, tmp_path)).signature.inputs
        (spec,) = [s for s in specs if source in (s.name, s.source)]
        lows = [low] * len(high) if isinstance(high, list) else low
        assert spec.distribution == {"kind": "integer", "low": lows, "high": high}


def test_an_unpacked_folder_is_the_same_model(tmp_path: Path) -> None:
    with zipfile.ZipFile(FOLDER / "ppo_box.zip") as archive:
        archive.extractall(tmp_path / "ppo_box")
    whole, folder = compiled(FOLDER / "ppo_box.zip"), compiled(tmp_path / "ppo_box")
    assert whole.signature.inputs == folder.signature.inputs
    assert whole.signature.algorithm == folder.signature.algorithm == "PPO"
    assert not any("VecNormalize" in note for note in whole.signature.notes)


def custom(name: str, module: str = "__main__") -> dict[str, Any]:
    return {":type:": "<class 'abc.ABCMeta'>", ":serialized:": "", "__module__": module, "__name__": name}


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a2c_discrete", {"policy_class": custom("Mine")}, "its class is of __main__"),
        ("a2c_discrete", {"policy_class": None}, "its class"),
        (
            "ppo_eye",
            {"policy_kwargs": {"features_extractor_class": "<class '__main__.MyEyes'>"}},
            "its features extractor is MyEyes",
        ),
        (
            "a2c_discrete",
            {"policy_kwargs": {"activation_fn": "<function <lambda> at 0x7f00>"}},
            "its activation is not known",
        ),
        (
            "a2c_discrete",
            {"action_space": {":type:": "<class 'gym.spaces.tuple.Tuple'>"}},
            "its action_space is a Tuple",
        ),
    ],
)
def test_what_is_not_in_the_file_is_refused_and_named(
    name: str, data: dict[str, Any], words: str, tmp_path: Path
) -> None:
    with pytest.raises(SourceError) as caught:
        read_source(changed(tmp_path, name, **data))
    assert words in str(caught.value)


def test_an_activation_of_ones_own_is_said_and_one_that_is_known_is_not_overruled(tmp_path: Path) -> None:
    elu = compiled(saved("a2c_discrete", tmp_path))
    unknown = changed(tmp_path, "a2c_discrete", policy_kwargs={"activation_fn": "<function <lambda> at 0x7f00>"})
    (said,) = read_source(unknown, ReadOptions(activation="elu")).policies()
    assert [n.op for n in said.graph.nodes] == [n.op for n in elu.graph.nodes]
    with pytest.raises(UsageError, match="contradicts the file"):
        read_source(saved("a2c_discrete", tmp_path), ReadOptions(activation="tanh"))
    with pytest.raises(UsageError, match="unknown activation"):
        read_source(unknown, ReadOptions(activation="elou"))


def test_weights_that_no_layer_reads_are_refused(tmp_path: Path) -> None:
    more = {"mlp_extractor.policy_net.1.weight": np.ones(8, np.float32)}  # a LayerNorm, a PReLU
    with pytest.raises(SourceError, match=r"with weights at 0, 1, 2"):
        read_source(changed(tmp_path, "a2c_discrete", more))
    with pytest.raises(SourceError, match="attention"):
        read_source(changed(tmp_path, "a2c_discrete", {"attention.weight": np.ones(8, np.float32)}))


@pytest.mark.parametrize(
    "data",
    [
        {"action_space": {}},
        {"observation_space": {":type:": "<class 'gym.spaces.dict.Dict'>", "spaces": "{'a': Box((((("}},
        {"observation_space": {":type:": "<class 'gym.spaces.box.Box'>", "_shape": [10**12]}},
        {"observation_space": {":type:": "<class 'gym.spaces.box.Box'>", "_shape": "no"}},
        {"action_space": {":type:": "<class 'gym.spaces.discrete.Discrete'>", "n": "5"}},
        {"action_space": {":type:": "<class 'gym.spaces.box.Box'>", "_shape": [4], "low": "[-1 ... -1]", "high": "1"}},
        {"policy_kwargs": {"activation_fn": 3}},
    ],
)
def test_data_that_does_not_fit_is_an_error_and_no_traceback(data: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(ExportModelError):
        compiled(changed(tmp_path, "a2c_discrete", **data))


@pytest.mark.parametrize(
    ("state", "kwargs", "said"),
    [
        ({"actor.latent_pi.7.weight": np.ones((6, 6), np.float32)}, {}, "by turns are expected"),
        ({"actor.latent_pi.3.scale": np.ones(5, np.float32)}, {}, r"\[5\], and \[8\] fits"),
        ({}, {"batch_norm_eps": "much"}, "batch_norm_eps must be a number"),
    ],
)
def test_other_renormalised_layers_are_refused(
    state: dict[str, Any], kwargs: dict[str, Any], said: str, tmp_path: Path
) -> None:
    with pytest.raises(SourceError, match=said):
        compiled(changed(tmp_path, "crossq_box", state, policy_kwargs={"net_arch": [8, 6], **kwargs}))


def test_a_bomb_is_refused_before_it_unfolds_and_nothing_in_a_pickle_is_run(tmp_path: Path) -> None:
    path = tmp_path / "a.zip"
    path.write_bytes(zipped({"data": bytes(1 << 26), "policy.pth": b"x"}, zipfile.ZIP_DEFLATED))
    with pytest.raises(DamagedFileError, match="unfolds to"):
        read_source(path)
    code = pickle.dumps({"a": _Runs(tmp_path / "touched")}, 2)
    path.write_bytes(zipped({"data": b"{}", "policy.pth": zipped({"a/data.pkl": code})}))
    with pytest.raises(NotAPolicyError, match="its pickle asks for"):
        read_source(path)
    assert not (tmp_path / "touched").exists()


class _Runs:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return Path.touch, (self.path,)


def test_a_spread_that_is_no_number_warns_of_nothing(tmp_path: Path) -> None:
    """A signalling NaN, of which a cast makes a quiet one; verification finds it."""
    spread = np.full(2, 0x7F800001, np.uint32).view(np.float32)
    assert compiled(changed(tmp_path, "ppo_mixed", {"log_std": spread})).signature.outputs
