"""A policy's layout is told alike from every file that it may come in, its normaliser inside of it and outside."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from fixtures.layout import FOLDER
from fixtures.sb3_zip import FOLDER as SB3
from tests.commands import export_model
from tests.torch_checkpoint.pt_files import Writer, zipped

#: Order of the joints that the walkers were trained with.
LEVEL = "level by level (Isaac Sim)"


@pytest.fixture(scope="module")
def walker(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The walker with its normaliser inside, as ONNX."""
    folder = tmp_path_factory.mktemp("walker")
    assert export_model(FOLDER / "walker.pt", "-o", folder, "--to", "onnx", "--verify", "none").status == 0
    return folder / "walker" / "walker.onnx"


def weights_of(path: Path) -> dict[str, np.ndarray]:
    return {i.name: numpy_helper.to_array(i) for i in onnx.load(path).graph.initializer}


def sb3_zip(weights: dict[str, np.ndarray], path: Path) -> Path:
    """PPO of Stable-Baselines3 with the walker's layers: what it sees is normalised outside of it."""
    data = json.loads((SB3 / "a2c_discrete.json").read_text())["data"]  # ELU
    data["policy_kwargs"]["net_arch"] = [48, 32]
    for space, n, bound in (("observation_space", 45, 100.0), ("action_space", 12, 100.0)):
        ends = {key: f"[{' '.join([f'{sign}{bound}'] * n)}]" for key, sign in (("low", "-"), ("high", ""))}
        kind = {":type:": "<class 'gymnasium.spaces.box.Box'>", "dtype": "float32", "low_repr": None, "high_repr": None}
        data[space] = {**kind, "_shape": [n], **ends}
    names = ("mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2", "action_net")
    state = {"log_std": np.zeros(12, np.float32)}
    for name, layer in zip(names, (0, 2, 4), strict=True):
        state[f"{name}.weight"] = weights[f"actor/{layer}/transposed"].T.copy()
        state[f"{name}.bias"] = weights[f"actor/{layer}/bias"]
    for name, shape in (("policy_net.0", (48, 45)), ("policy_net.2", (32, 48))):
        value = f"mlp_extractor.{name.replace('policy', 'value')}"
        state[f"{value}.weight"], state[f"{value}.bias"] = np.zeros(shape, np.float32), np.zeros(shape[0], np.float32)
    state["value_net.weight"], state["value_net.bias"] = np.zeros((1, 32), np.float32), np.zeros(1, np.float32)
    writer = Writer()
    path.write_bytes(zipped({"data": json.dumps(data).encode(), "policy.pth": writer.zip(writer.state(state))}))
    return path


def test_a_saved_model_of_stable_baselines3_that_is_normalised_outside(walker: Path, tmp_path: Path) -> None:
    inside = export_model("layout", walker, "--json").json
    outside = export_model("layout", sb3_zip(weights_of(walker), tmp_path / "ppo.zip"), "--json").json
    for found in (inside, outside):
        assert (found["verdict"], found["decided"]["joint order"]) == ("decided", LEVEL)
    assert outside["score"] == pytest.approx(inside["score"], abs=1e-3)  # both are tried in the normaliser's units
    assert not any("normaliser" in e["says"] for e in outside["evidence"])


@pytest.mark.parametrize(
    ("name", "stacking"),
    [
        ("walker.pt", None),
        ("walker_history.pt", "5 frames, term by term"),
        ("walker_lstm.pt", None),
        ("walker_gru.pt", None),
    ],
)
def test_torchscript_and_the_bundle_made_of_it(name: str, stacking: str | None, tmp_path: Path) -> None:
    """MLP, histories, LSTM and GRU: the memory of the ONNX is fed back as the script's own is."""
    assert export_model(FOLDER / name, "-o", tmp_path, "--to", "onnx", "--verify", "none").status == 0
    stem = Path(name).stem
    found = [export_model("layout", path, "--json").json for path in (FOLDER / name, tmp_path / stem / f"{stem}.onnx")]
    assert {f["verdict"] for f in found} == {"decided"}
    assert [f["decided"].get("stacking") for f in found] == [stacking] * 2
    assert found[0]["score"] == pytest.approx(found[1]["score"], abs=1e-3)


def test_a_checkpoint_of_rsl_rl() -> None:
    found = export_model("layout", FOLDER / "walker_rsl_rl.pt", "--activation", "elu", "--json").json
    assert (found["verdict"], found["decided"]["joint order"]) == ("decided", LEVEL)


# ------------------------------------------------------------------ evidence, where mirrors are alike

ORDER = ("joint_pos", "joint_vel", "last_action")
#: What public policies' normalisers hold (tests/layout/held_out.py): mean in deviations, deviation.
REAL = {"joint_pos": (0.3, 0.1), "joint_vel": (0.0, 2.0), "last_action": (0.3, 0.45)}
SCALED = {**REAL, "joint_vel": (0.0, 0.1)}


def normalised(walker: Path, path: Path, terms: tuple[str, ...], statistics: dict[str, tuple[float, float]]) -> Path:
    """The walker with other statistics of its three blocks of twelve joints: its network stays, and its score."""
    model = onnx.load(walker)
    rows = {i.name: i for i in model.graph.initializer}
    mean, deviation = (numpy_helper.to_array(rows[f"forward/{op}/row"]).copy() for op in ("Sub", "RealDiv"))
    for start, name in zip((9, 21, 33), terms, strict=True):
        far, spread = statistics[name]
        deviation[start : start + 12] = spread
        mean[start + 4 : start + 12] = far * spread  # of thighs and calves, which no mirror turns
    for op, row in (("Sub", mean), ("RealDiv", deviation)):
        rows[f"forward/{op}/row"].CopyFrom(numpy_helper.from_array(row, f"forward/{op}/row"))
    del model.metadata_props[:]
    onnx.save(model, path)
    return path


def test_the_normaliser_closes_which_is_which(walker: Path, tmp_path: Path) -> None:
    found = export_model("layout", normalised(walker, tmp_path / "a.onnx", ORDER, REAL), "--json").json
    assert [fact["term"] for fact in found["closed"]] == ["joint_vel", "last_action"]
    assert "means are, in deviations" in found["closed"][0]["says"]
    assert ["joint_pos", *ORDER[1:]] not in [fact["members"] for fact in found["open"]]


def test_velocities_that_are_scaled_are_told_by_their_means(walker: Path, tmp_path: Path) -> None:
    """Velocities × 0.05 spread no further than positions: only that they rest at zero says it."""
    found = export_model("layout", normalised(walker, tmp_path / "a.onnx", ORDER, SCALED), "--json").json
    says = {fact["term"]: fact["says"] for fact in found["closed"]}
    assert "means" in says["joint_vel"]
    assert "deviations are" not in says["joint_vel"]


@pytest.mark.parametrize("statistics", [REAL, SCALED], ids=["radians", "scaled"])
@pytest.mark.parametrize(
    "terms", [("joint_vel", "joint_pos", "last_action"), ("last_action", "joint_pos", "joint_vel")], ids=str
)
def test_an_order_that_is_not_the_conventions_is_not_closed(
    terms: tuple[str, ...], statistics: dict[str, tuple[float, float]], walker: Path, tmp_path: Path
) -> None:
    """The rules speak against it, and it stays open with what they saw."""
    found = export_model("layout", normalised(walker, tmp_path / "a.onnx", terms, statistics), "--json").json
    assert found["closed"] == []
    (fact,) = [fact for fact in found["open"] if fact["members"] == list(ORDER)]
    assert any("against this order" in says for says in fact["evidence"])


def test_where_no_rule_sees_anything_all_stays_open(walker: Path, tmp_path: Path) -> None:
    alike = dict.fromkeys(ORDER, (0.2, 0.3))
    found = export_model("layout", normalised(walker, tmp_path / "a.onnx", ORDER, alike), "--json").json
    assert found["closed"] == []
    assert list(ORDER) in [fact["members"] for fact in found["open"]]


def test_the_words_name_the_rule(walker: Path, tmp_path: Path) -> None:
    said = " ".join(export_model("layout", normalised(walker, tmp_path / "a.onnx", ORDER, REAL)).out.split())
    assert (
        "by its evidence: joint_vel (the normaliser's means are, in deviations, 0.24 of joint_pos, 0.00 of joint_vel"
        in said
    )
    assert "actions spread further than positions" in said
