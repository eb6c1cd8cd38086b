"""Files of settings that are no such: pipes, devices, keys that take the parser hours."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from fixtures import path as fixture
from tests.commands import export_model

KINDS = {"--tolerances": "given.toml", "--labels": "given.toml", "--golden": "given.npz"}


@pytest.mark.skipif(sys.platform == "win32", reason="they are POSIX's")
@pytest.mark.parametrize("option", KINDS)
@pytest.mark.parametrize("odd", ["a pipe", "a device", "a hole", "a folder", "a link to itself"])
def test_what_is_no_file_is_refused_at_once(option: str, odd: str, tmp_path: Path) -> None:
    given = tmp_path / KINDS[option]
    match odd:
        case "a pipe":
            os.mkfifo(given)
        case "a device":
            given.symlink_to("/dev/zero")
        case "a hole":
            with given.open("wb") as file:
                file.truncate(1 << 40)
        case "a folder":
            given.mkdir()
        case _:
            given.symlink_to(given)
    ran = export_model(
        fixture("continuous"), "-o", tmp_path / "out", "--to", "bytes", "--verify", "numpy", option, given
    )
    assert ran.status == 2
    assert str(given) in ran.err
    assert not [*(tmp_path / "out").rglob("*")]


@pytest.mark.parametrize("option", ["--tolerances", "--labels"])
@pytest.mark.parametrize(
    "text",
    ["x = 0x" + "F" * 6000, "a." * 300_000 + "a = 1", "x = {" + "a." * 300_000 + "a = 1}", "x = " + "[" * 300_000],
)
def test_keys_of_any_depth_and_endless_numbers_are_refused(option: str, text: str, tmp_path: Path) -> None:
    given = tmp_path / "given.toml"
    given.write_text(text)
    ran = export_model(
        fixture("continuous"), "-o", tmp_path / "out", "--to", "bytes", "--verify", "numpy", option, given
    )
    assert ran.status == 2
    assert "TOML" in ran.err


@pytest.mark.parametrize("sensors", [[{"shape": [8]}] * 100_000, [{"shape": [1 << 40]}], {"shape": [8]}, "8"])
def test_an_agent_has_no_more_than_an_agent_has(sensors: object, tmp_path: Path) -> None:
    """A hundred thousand sensors took minutes."""
    given = tmp_path / "given.json"
    given.write_text(json.dumps({"continuous": 2, "sensors": sensors}))
    ran = export_model("inspect", fixture("continuous"), "--unity", "R22", "--brain-parameters", given)
    assert ran.status == 2
    assert str(given) in ran.err
