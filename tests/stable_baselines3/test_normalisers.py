"""VecNormalize beside a saved model, against ``predict`` behind ``normalize_obs`` (fixtures/sb3_zip/normalised)."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.formats.source import NO_NORMALISER, ReadOptions
from export_model.converters.policy.policy import Policy
from export_model.converters.trainers.stable_baselines3.normaliser import read_normaliser
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import ExportModelError, SourceError, UsageError
from fixtures.goldens import read_npz
from fixtures.sb3_zip import NORMALISED
from tests.commands import export_model
from tests.stable_baselines3.saved_models import answered, saved

NAMES = sorted(p.stem for p in NORMALISED.glob("*.pkl"))
ATOL = 1e-5


def placed(name: str, folder: Path, statistics: str | None = "vecnormalize.pkl") -> Path:
    """A model, and its statistics where they are wanted."""
    folder.mkdir(parents=True, exist_ok=True)
    model = shutil.copy(saved(name, folder.parent), folder / "model.zip")
    if statistics is not None:
        (folder / statistics).parent.mkdir(exist_ok=True)
        shutil.copy(NORMALISED / f"{name}.pkl", folder / statistics)
    return Path(model)


def compiled(path: Path, **said: str) -> Policy:
    (policy,) = read_source(path, ReadOptions(**said)).policies()
    return policy


@pytest.mark.parametrize("name", NAMES)
def test_raw_observations_give_what_predict_gives_behind_the_normaliser(name: str, tmp_path: Path) -> None:
    golden = read_npz(NORMALISED / f"{name}.npz")
    answers = answered(compiled(placed(name, tmp_path / "run")), {k: v for k, v in golden.items() if k != "in/epsilon"})
    for theirs, ours in (("deterministic", "deterministic_action"), ("q_values",) * 2, ("recurrent_out",) * 2):
        if theirs in golden:
            assert answers[ours].reshape(golden[theirs].shape) == pytest.approx(golden[theirs], abs=ATOL, rel=ATOL)
    if "probs" in golden:
        assert np.exp(answers["action_log_probs"]) == pytest.approx(golden["probs"], abs=ATOL, rel=ATOL)
    without = compiled(placed(name, tmp_path / "bare", None))
    assert any("normalis" in note for note in without.signature.notes) is False
    if name != "ddpg_box":  # norm_obs=False: nothing to normalise
        others = answered(without, {k: v for k, v in golden.items() if k != "in/epsilon"})
        compared = [k for k in answers if k in others and answers[k].shape == others[k].shape]
        assert max(float(np.abs(answers[k] - others[k]).max()) for k in compared) > 1e-3


# ------------------------------------------------------------------ other versions


@pytest.mark.parametrize("file", sorted((NORMALISED / "versions").glob("*.pkl")), ids=lambda file: file.stem)
def test_pickles_of_other_versions_hold_the_same(file: Path) -> None:
    found = read_normaliser(file.name, file.read_bytes())
    wanted = read_npz(file.with_suffix(".npz"))
    assert {f"{key}/{i}" for key in found.moments for i in "01"} == wanted.keys()
    for key, moments in found.moments.items():
        assert np.array_equal(moments.mean, wanted[f"{key}/0"])
        assert np.array_equal(moments.deviation, np.sqrt(wanted[f"{key}/1"] + 1e-8))


# ------------------------------------------------------------------ where it lies


@pytest.mark.parametrize(
    ("model", "file"),
    [
        ("model.zip", "vecnormalize.pkl"),
        ("model.zip", "vec_normalize.pkl"),
        ("model.zip", "model_vecnormalize.pkl"),
        ("model.zip", "vecnormalize_model.pkl"),
        ("best_model.zip", "../vecnormalize.pkl"),
        ("model.zip", "model/vecnormalize.pkl"),
        ("rl_model_500_steps.zip", "rl_model_vecnormalize_500_steps.pkl"),
    ],
)
def test_the_statistics_are_found_where_the_library_and_its_zoo_put_them(model: str, file: str, tmp_path: Path) -> None:
    path = placed("ppo_box", tmp_path / "run", file)
    path = path.rename(path.parent / model)
    notes = compiled(path).signature.notes
    assert any(Path(file).name in note and "normalised inside" in note for note in notes)


@pytest.mark.parametrize(
    ("files", "taken"),
    [
        (("vecnormalize.pkl", "vec_normalize.pkl"), "error"),
        (("vecnormalize.pkl", "vecnormalize_best.pkl"), "error"),
        (("VecNormalize_stats.pkl",), "error"),
        (("../vecnormalize.pkl",), "error"),
        (("lander_vecnorm.pkl",), "error"),
        (("../env_stats.pickle", "../vecnorm"), "error"),
        (("../vec_normalize.pkl", "../vecnormalize.pkl"), "error"),
        (("vecnormalize.pkl", "../vecnormalize.pkl"), "vecnormalize.pkl"),
        (("model_vecnormalize.pkl", "vecnormalize.pkl"), "model_vecnormalize.pkl"),
        (("vecnormalize.pkl", "rl_model_vecnormalize_500_steps.pkl", "other_vecnormalize.pkl"), "vecnormalize.pkl"),
        (("rl_model_vecnormalize_500_steps.pkl",), None),
        (("other_vecnormalize.pkl", "../rl_model_vecnormalize_500_steps.pkl"), None),
    ],
)
def test_all_statistics_that_were_seen_are_named_and_none_is_guessed(
    files: tuple[str, ...], taken: str | None, tmp_path: Path
) -> None:
    """Of one or none of them the names say that it is this model's; else the error says what to type."""
    model = placed("ppo_box", tmp_path / "logs/run", None)
    shutil.copy(model, model.parent / "other.zip")
    for number, file in enumerate(files):
        data = (NORMALISED / "ppo_box.pkl").read_bytes()
        (model.parent / file).write_bytes(data.replace(b"clip_obs", b"clip_ob" + bytes([115 - number])))
    paths = [(model.parent / file).resolve() for file in files]
    if taken == "error":
        with pytest.raises(SourceError, match="may have been normalised by") as caught:
            compiled(model)
        assert all(f"--normaliser {path}" in str(caught.value) for path in paths)
        assert "--set normaliser=none" in str(caught.value)
        for said in (str(paths[0]), NO_NORMALISER):
            assert compiled(model, normaliser=said).signature.notes
        return
    notes = "\n".join(compiled(model).signature.notes)
    assert ("normalised inside" in notes) == (taken is not None)
    assert all(str(path) in notes for path in paths if path.name != taken or path.parent != model.parent)
    assert ("--normaliser FILE takes one" in notes) == (len(files) > 1 or taken is None)


def test_other_pickles_beside_a_model_are_no_statistics(tmp_path: Path) -> None:
    model = placed("ppo_box", tmp_path / "run", None)
    (model.parent / "replay_buffer.pkl").write_bytes(pickle.dumps({"observations": [1.0, 2.0]}))
    (model.parent / "monitor").write_bytes(b"")
    assert not [note for note in compiled(model).signature.notes if "normalis" in note]


def test_two_names_of_the_same_statistics_are_one(tmp_path: Path) -> None:
    model = placed("ppo_box", tmp_path / "run")
    shutil.copy(model.parent / "vecnormalize.pkl", model.parent / "vec_normalize.pkl")
    assert any("normalised inside" in note for note in compiled(model).signature.notes)


def test_the_best_model_of_a_run_has_the_statistics_of_the_run(tmp_path: Path) -> None:
    run = zoo_run(tmp_path)
    best = run / "best_model.zip"
    shutil.copy(run / "Hop-v1.zip", best)
    assert any("normalised inside" in note for note in compiled(best).signature.notes)
    other = run / "other.zip"
    shutil.copy(best, other)
    assert not any("normalised inside" in note for note in compiled(other).signature.notes)


def test_another_file_is_named_and_the_bundle_is_verified_against_both(tmp_path: Path) -> None:
    model = placed("ppo_box", tmp_path / "run", None)
    statistics = shutil.copy(NORMALISED / "ppo_box.pkl", model.parent / "seen.pkl")
    out = tmp_path / "out"
    said = ("--verify", "onnxruntime", "--normaliser", statistics, "-o", out, "--to", "onnx,bytes")
    assert export_model(model, *said).status == 0
    assert '"normaliser": "seen.pkl"' in (out / "model" / "policy.json").read_text()
    assert export_model("verify", out / "model", "--source", model, "--runtimes", "onnxruntime").status == 0
    Path(statistics).write_bytes((NORMALISED / "tqc_box.pkl").read_bytes())
    ran = export_model("verify", out / "model", "--source", model, "--runtimes", "onnxruntime")
    assert ran.status == 2
    assert "is not the source of this bundle" in ran.err


def test_it_is_left_out_on_request_and_the_export_says_so(tmp_path: Path) -> None:
    model = placed("ppo_box", tmp_path / "run")
    left_out, bare = compiled(model, normaliser=NO_NORMALISER), compiled(placed("ppo_box", tmp_path / "bare", None))
    assert [n.op for n in left_out.graph.nodes] == [n.op for n in bare.graph.nodes]
    assert any("vecnormalize.pkl is left out" in note for note in left_out.signature.notes)
    ran = export_model("inspect", model, "--set", "normaliser=none", "--json")
    assert "is left out (--set normaliser=none)" in ran.out
    ran = export_model("inspect", model, "--set", "normaliser=none", "--normaliser", NORMALISED / "ppo_box.pkl")
    assert ran.status == 2
    assert "give one of them" in ran.err


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ("!!python/object/apply:collections.OrderedDict\n- - - n_envs\n    - 8\n  - - normalize\n    - true\n", True),
        ("- - - normalize\n    - dict(norm_obs=True, norm_reward=False)\n", True),
        ("- - - normalize\n    - '{''norm_obs'': False, ''norm_reward'': True}'\n", False),
        ("normalize: \"{'norm_obs': True}\"\n", True),
        ("normalize: true\nnormalize_kwargs:\n  norm_obs: false\n", False),
        ("- - - normalize\n    - false\n", False),
        ("- - - n_envs\n    - 8\n", False),
    ],
)
def test_a_note_says_that_the_file_is_missing_where_the_settings_say_that_it_was_used(
    settings: str, said: bool, tmp_path: Path
) -> None:
    model = placed("ppo_box", tmp_path / "run", None)
    (model.parent / "model").mkdir()
    (model.parent / "model" / "config.yml").write_text(settings)
    notes = [note for note in compiled(model).signature.notes if "config.yml" in note]
    assert bool(notes) is said
    assert all("--normaliser FILE" in note for note in notes)


# ------------------------------------------------------------------ a run's folder


def zoo_run(folder: Path) -> Path:
    """A run as rl-baselines3-zoo leaves it, with what else lies in one."""
    run = folder / "Hop-v1_1"
    model = placed("ppo_box", run, "Hop-v1/vecnormalize.pkl")
    model.rename(run / "Hop-v1.zip")
    (run / "Hop-v1" / "args.yml").write_text("- - - algo\n    - ppo\n")
    (run / "replay_buffer.pkl").write_bytes(pickle.dumps({"of": Path()}))
    np.savez(run / "evaluations.npz", results=np.zeros(3))
    (run / "0.monitor.csv").write_text("#{}\nr,l,t\n")
    return run


def test_a_runs_folder_is_one_policy_with_its_pieces(tmp_path: Path) -> None:
    run = zoo_run(tmp_path)
    for other in ("best_model.zip", "rl_model_100_steps.zip"):
        shutil.copy(run / "Hop-v1.zip", run / other)
    ran = export_model(run, "-o", tmp_path / "out", "--verify", "none")
    assert ran.status == 0, ran.err
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["Hop-v1"]
    contract = json.loads((tmp_path / "out" / "Hop-v1" / "policy.json").read_text())
    assert any("normalised inside" in note for note in contract["notes"])
    assert any("also here, not used: best_model.zip, rl_model_100_steps.zip" in note for note in contract["notes"])
    assert "pkl" not in ran.err
    (policy,) = read_source(run, ReadOptions(step=100)).policies()
    assert policy.name == "Hop-v1"
    with pytest.raises(SourceError, match="models of steps: 100"):
        read_source(run, ReadOptions(step=7))


def test_a_folder_of_runs_is_as_many_policies(tmp_path: Path) -> None:
    zoo_run(tmp_path / "logs")
    (tmp_path / "logs" / "Hop-v1_1").rename(tmp_path / "logs" / "Hop-v1_2")
    zoo_run(tmp_path / "logs")
    ran = export_model(tmp_path / "logs", "-o", tmp_path / "out", "--verify", "none")
    assert ran.status == 0, ran.err
    assert len([p for p in (tmp_path / "out").iterdir() if p.is_dir()]) == 2


# ------------------------------------------------------------------ what does not fit


class _Other:
    pass


class _Runs:
    def __init__(self, touched: Path) -> None:
        self.touched = touched

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, (f"touch {self.touched}",)


def test_what_is_not_a_normaliser_is_refused_and_nothing_in_it_is_run(tmp_path: Path) -> None:
    model = placed("ppo_box", tmp_path / "run", None)
    touched = tmp_path / "touched"
    whole = (NORMALISED / "ppo_box.pkl").read_bytes()
    for content, words in (
        (pickle.dumps(_Other()), "is not a VecNormalize"),
        (pickle.dumps({"mean": 1}), "is not a VecNormalize"),
        (pickle.dumps(_Runs(touched)), "its pickle asks for"),
        (pickle.dumps([_Runs(touched), 1]), "its pickle asks for"),
        (whole[: len(whole) // 2], "vecnormalize.pkl: its pickle"),
        (Path("fixtures/sb3/sb3_continuous.onnx").read_bytes(), "vecnormalize.pkl: its pickle"),
        ((NORMALISED / "ppo_mixed.pkl").read_bytes(), "normalises a Dict of observations, and the policy observes one"),
        (whole.replace(b"mean", b"main"), "is not an array of numbers"),
    ):
        (model.parent / "vecnormalize.pkl").write_bytes(content)
        with pytest.raises(ExportModelError, match=words):
            compiled(model)
    assert not touched.exists()


def test_statistics_of_another_shape_are_refused(tmp_path: Path) -> None:
    model = placed("ppo_box", tmp_path / "run", None)
    shutil.copy(NORMALISED / "versions" / "1.8.0-box-4.pkl", model.parent / "vecnormalize.pkl")
    with pytest.raises(SourceError, match=r"\[3\], and the policy's observation has \[5\]"):
        compiled(model)
    with pytest.raises(UsageError, match="says nothing about this source"):
        read_source(Path("fixtures/continuous.bytes"), ReadOptions(normaliser=NO_NORMALISER))
