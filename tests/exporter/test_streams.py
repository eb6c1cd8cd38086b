"""Standard streams that are closed, or that nobody reads: no traceback, nothing lost, nothing written into a file."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from fixtures import path as fixture
from tests.commands import PYTHONPATH, ROOT

PROGRAM = f"{sys.executable} -P -m export_model"


def shell(line: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "-c", line],
        cwd=ROOT,
        env={"PYTHONPATH": PYTHONPATH, "PATH": "/usr/bin:/bin", "HOME": str(Path.home())},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_a_closed_stream_changes_nothing_else(closed: str, tmp_path: Path) -> None:
    ran = shell(f"{PROGRAM} {fixture('continuous')} -o {tmp_path}/out --to bytes,onnx --verify none {closed}")
    assert (ran.returncode, ran.stderr) == (0, "")
    written = json.loads((tmp_path / "out/continuous/policy.json").read_text())
    for name, entry in written["files"].items():
        assert (tmp_path / "out/continuous" / name).stat().st_size == entry["bytes"]
    again = shell(f"{PROGRAM} inspect {tmp_path}/missing {closed}")
    assert again.returncode == 2
    assert "Traceback" not in again.stderr


@pytest.mark.parametrize("command", ["--help", f"inspect {fixture('continuous')}", "inspect missing 2>&1", "runtimes"])
def test_a_reader_that_has_gone_ends_it_as_the_shells_own_programs(command: str) -> None:
    ran = shell(f"(sleep 0.2; {PROGRAM} {command}; echo $? >&2) | true")
    assert ran.stderr in ("141\n", "0\n")
    if command != "runtimes":
        assert ran.stderr == "141\n"


def test_nothing_is_left_of_an_export_whose_reader_has_gone(tmp_path: Path) -> None:
    shell(f"{PROGRAM} {fixture('continuous')} -o {tmp_path}/out --to bytes --verify none -v 2>&1 | true")
    left = [p.name for p in (tmp_path / "out").iterdir()] if (tmp_path / "out").is_dir() else []
    assert not [name for name in left if name.startswith(".export-model")]
