"""``export --env``: what was written plays in the same call."""

from __future__ import annotations

from pathlib import Path

import pytest

from fixtures import trained
from tests.commands import export_model, is_refused

WHERE = ("--verify", "onnxruntime", "--to", "bytes,onnx")


def test_an_export_plays_what_it_wrote_beside_its_source(tmp_path: Path) -> None:
    ran = export_model(trained.run_folder("GridWorld"), "-o", tmp_path, "--env", "GridWorld", *WHERE)
    assert ran.status == 0, ran.err
    lines = ran.out.splitlines()
    assert any(line.startswith("PASSED") for line in lines)
    assert any("GridWorld in GridWorld: EQUIVALENT, 1 of 1 agree" in line for line in lines)
    told = export_model(trained.run_folder("GridWorld"), "-o", tmp_path, "--env", "GridWorld", *WHERE, "--json").json
    assert [p["verdict"] for p in told["play"]] == ["EQUIVALENT"] and told["policies"][0]["passed"] is True


def test_rounded_weights_are_held_by_returns_against_the_source_as_it_was(tmp_path: Path) -> None:
    command = (trained.run_folder("3DBall"), "-o", tmp_path, "--env", "3DBall", "--quantize", "int8", *WHERE)
    ran = export_model(*command, "--json")
    assert ran.status == 0, ran.err
    (played,) = ran.json["play"]
    assert played["verdict"] == "EQUIVALENT" and played["replay"]["passed"] is True
    assert "decisions" in {c["kind"] for c in played["replay"]["comparisons"]}
    assert [(p["format"], p["runtime"]) for p in played["played"]] == [("onnx", "onnxruntime")]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--env", "nowhere"), "unknown environment"),
        (("--env", "GridWorld", "--verify", "none"), "--env needs runtimes"),
        (("--env", "GridWorld", "--for", "unity6"), "--env does not go with --for"),
        (("--env", "GridWorld", "--jobs", "2"), "--env goes with a single source"),
        (("--env", "3DBall", *WHERE), "--env 3DBall: the policy does not fit the environment"),
    ],
)
def test_what_cannot_play_is_refused_before_anything_is_written(
    options: tuple[str, ...], says: str, tmp_path: Path
) -> None:
    is_refused(export_model(trained.run_folder("GridWorld"), "-o", tmp_path / "out", *options), says)
    assert not (tmp_path / "out").exists()
