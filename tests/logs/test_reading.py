"""Logs in their three forms, and what is refused of them: with the column's name, and nothing executed."""

from __future__ import annotations

import json
import pickle
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from export_model.exporter.acting.policy import LoadedPolicy
from export_model.exporter.logs.reading import read_recording
from export_model.exporter.logs.recording import NONE, links
from export_model.signatures.errors import UsageError
from tests.commands import ROOT, export_model, is_refused
from tests.exporting import load_policy
from tests.logs.planting import Arrays
from tests.reports.validation import closed, schema


@cache
def policy() -> LoadedPolicy:
    return load_policy(ROOT / "fixtures" / "trained" / "3DBall", runtime="numpy")


def steps(count: int = 6) -> Arrays:
    seen = np.random.default_rng(0).normal(0, 0.3, (count, 8)).astype(np.float32)
    action = policy().decide(seen, deterministic=True).action
    return {"observation": seen, "action": action, "episode": np.arange(count) // 3}


def written(path: Path, log: Arrays) -> Path:
    if path.suffix == ".npz":
        np.savez(path, **log)  # type: ignore[arg-type]
    elif path.suffix == ".jsonl":
        rows = [{n: a[i].tolist() for n, a in log.items()} for i in range(len(log["action"]))]
        path.write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    else:
        flat = {n: a.reshape(len(a), -1) for n, a in log.items()}
        names = [f"{n}[{i}]" if a.shape[1] > 1 else n for n, a in flat.items() for i in range(a.shape[1])]
        body = np.concatenate(list(flat.values()), axis=1)
        path.write_text("\n".join([",".join(names), *(",".join(f"{x:.9g}" for x in row) for row in body)]))
    return path


@pytest.mark.parametrize("form", ["npz", "csv", "jsonl"])
def test_a_log_is_the_same_in_every_form(form: str, tmp_path: Path) -> None:
    log = steps()
    found = read_recording(written(tmp_path / f"run.{form}", log), policy().signature)
    np.testing.assert_allclose(found.inputs["state"], log["observation"], rtol=1e-6)
    np.testing.assert_allclose(found.outputs["action"], log["action"], rtol=1e-6)
    assert found.before.tolist() == [NONE, 0, 1, NONE, 3, 4]
    assert found.episodes == 2


def test_an_episode_ends_after_a_step_that_is_done(tmp_path: Path) -> None:
    log = {**steps(), "done": np.array([0, 1, 0, 0, 0, 1])}
    del log["episode"]
    found = read_recording(written(tmp_path / "run.npz", log), policy().signature)
    assert found.before.tolist() == [NONE, 0, NONE, 2, 3, 4]


@given(st.lists(st.integers(0, 3), min_size=1, max_size=40))
def test_steps_of_agents_are_linked_to_their_own(agents: list[int]) -> None:
    before, last = links(np.asarray(agents), np.zeros(len(agents), bool))
    for row, agent in enumerate(agents):
        earlier = [i for i in range(row) if agents[i] == agent]
        assert before[row] == last[row] == (earlier[-1] if earlier else NONE)


#: name → (what is changed of a good log, what the message has to name)
WRONG = {
    "an unknown column": (lambda log: {**log, "speed": log["action"]}, "'speed'"),
    "a missing observation": (lambda log: {n: a for n, a in log.items() if n != "observation"}, "'state'"),
    "no action": (lambda log: {n: a for n, a in log.items() if n != "action"}, "nothing that the policy answers"),
    "too few columns": (lambda log: {**log, "observation": log["observation"][:, :7]}, "'observation'"),
    "steps that are missing": (lambda log: {**log, "action": log["action"][:4]}, "action 4"),
    "a NaN": (lambda log: {**log, "observation": log["observation"] + np.diag([np.nan] * 8)[:6]}, "observation[0]"),
    "an episode in parts": (lambda log: {**log, "episode": log["episode"] + 0.5}, "'episode'"),
    "texts": (lambda log: {**log, "action": log["action"].astype("U8")}, "'action'"),
    "nothing": (lambda log: {n: a[:0] for n, a in log.items()}, "no steps"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_does_not_fit_is_refused_by_name(case: str, tmp_path: Path) -> None:
    change, named = WRONG[case]
    with pytest.raises(UsageError, match="--log") as caught:
        read_recording(written(tmp_path / "run.npz", change(steps())), policy().signature)
    assert named in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "named"),
    [
        ("run.csv", b"", "no steps"),
        ("run.csv", b"observation[0],action\n1\n", "line 2"),
        ("run.csv", b"observation[0],action\n1,up\n", "'up'"),
        ("run.csv", b"observation[1],action\n1,2\n", "observation[0] is missing"),
        ("run.jsonl", b"[1]\n", "line 1"),
        ("run.jsonl", b"{\n", "line 1"),
        ("run.jsonl", b'{"a": [1]}\n{"a": [1, 2]}\n', "'a'"),
        ("run.npz", b"PK\x03\x04", "--log"),
        ("run.pkl", pickle.dumps(1), ".npz"),
    ],
)
def test_a_damaged_log_is_refused(name: str, content: bytes, named: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(UsageError) as caught:
        read_recording(path, policy().signature)
    assert named in str(caught.value)


@given(st.binary(max_size=200), st.sampled_from(["csv", "jsonl", "npz"]))
def test_any_bytes_are_read_or_refused(content: bytes, form: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"run.{form}"
        path.write_bytes(content)
        with pytest.raises(UsageError):
            read_recording(path, policy().signature)


def test_an_array_of_objects_is_not_loaded(tmp_path: Path) -> None:
    class Runs:
        def __reduce__(self) -> tuple[object, ...]:
            return (Path(tmp_path / "ran").touch, ())

    np.savez(tmp_path / "run.npz", **{**steps(), "action": np.array([Runs()] * 6, object)})  # type: ignore[arg-type]
    with pytest.raises(UsageError):
        read_recording(tmp_path / "run.npz", policy().signature)
    assert not (tmp_path / "ran").exists()


def test_verify_explains_a_log(tmp_path: Path) -> None:
    source = ROOT / "fixtures" / "trained" / "3DBall"
    log = steps(80)
    good, wrong = written(tmp_path / "good.npz", log), tmp_path / "wrong.npz"
    turned = log["observation"] * np.float32([1, -1, 1, 1, 1, 1, 1, 1])
    written(wrong, {**log, "observation": turned})
    fits = export_model("verify", source, "--log", good)
    assert fits.status == 0, fits.err
    assert "FITS" in fits.out
    page = tmp_path / "log.html"
    differs = export_model("verify", source, "--log", wrong, "--html", page)
    assert differs.status == 1
    assert "state[1]: the policy was given -1 ×" in differs.out
    assert "</svg>" in page.read_text()
    printed = json.loads(export_model("verify", source, "--log", wrong, "--json").out)
    Draft202012Validator(closed(schema("log"))).validate(printed)
    assert printed["causes"][0]["where"] == "state[1]"
    assert export_model("verify", source, "--log", wrong, "--source", source).status == 2
    for unheard in (
        ("--require", "onnx"),
        ("--samples", "9"),
        ("--golden", wrong),
        ("--junit", str(tmp_path / "a.xml")),
        ("--seed", "3"),
        ("--verify", "none"),
        ("--allow-unverified",),
    ):
        ran = export_model("verify", source, "--log", wrong, *unheard)
        is_refused(ran, f"{unheard[0]} does not go with --log")
