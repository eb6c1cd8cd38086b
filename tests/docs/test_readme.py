"""The first command of the README: ``make demo``."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.commands import PYTHONPATH, ROOT
from tests.docs.blocks import blocks

README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.fixture
def make() -> str:
    found = shutil.which("make")
    if found is None:
        pytest.skip("make is not here; get it with: apt-get install make")
    return found


@pytest.mark.slow
@pytest.mark.xdist_group("docs")
def test_make_demo_ends_with_something_to_look_at(make: str, tmp_path: Path) -> None:
    """In the environment that is there: ``--old-file install`` keeps make from setting up another."""
    binaries, out = Path(sys.executable).parent, tmp_path / "exported"
    command = [make, "--old-file", "install", "demo", f"BIN={binaries}", f"OUT={out}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, encoding="utf-8", check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("PASSED: ") == 2
    assert f"{out}/parity.html" in done.stdout
    assert f"export-model serve {out}/3DBall" in done.stdout
    assert (out / "parity.html").stat().st_size > 10_000
    assert {p.name for p in out.iterdir()} == {"3DBall", "recurrent", "parity.html"}


@pytest.mark.slow
@pytest.mark.xdist_group("docs")
def test_every_command_of_the_readme_runs_as_pasted_with_an_empty_home(make: str, tmp_path: Path) -> None:
    """From a fresh clone, in one folder, in the order of the page; what fetches packages is tests/install's.

    ``make demo`` is the first: ``--old-file install`` has it use the environment that is there.
    """
    clone, home = tmp_path / "clone", tmp_path / "home"
    home.mkdir()
    subprocess.run(["git", "clone", "--quiet", "--shared", str(ROOT), str(clone)], check=True)
    binaries = Path(sys.executable).parent
    environment = {
        **os.environ,
        **{name: str(home) for name in ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME")},
        "PATH": f"{binaries}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": PYTHONPATH,
    }
    demo = [make, "--old-file", "install", "demo", f"BIN={binaries}"]
    done = subprocess.run(demo, cwd=clone, env=environment, capture_output=True, encoding="utf-8", check=False)
    assert done.returncode == 0, done.stderr
    commands = [b for b in blocks(ROOT / "README.md") if b.language == "sh" and b.verb != "skip"]
    assert len(commands) >= 2
    for block in commands:
        for line in block.text.splitlines():
            done = subprocess.run(
                ["bash", "-euc", line], cwd=clone, env=environment, capture_output=True, encoding="utf-8", check=False
            )
            assert done.returncode == 0, f"{line}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"


def test_the_commands_of_the_readme_are_goals_of_the_makefile(make: str) -> None:
    goals = re.findall(r"^make (\w+)", README, re.MULTILINE)
    assert goals[:2] == ["demo", "test"]
    for goal in goals:
        done = subprocess.run([make, "--dry-run", goal], cwd=ROOT, capture_output=True, check=False)
        assert done.returncode == 0, goal


@pytest.mark.parametrize("page", ["README.md", "docs/start.md"])
def test_what_is_installed_is_what_there_is_to_install(page: str) -> None:
    """Before the first release no registry has the name, so a reader installs the clone."""
    tool = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    text = (ROOT / page).read_text(encoding="utf-8")
    first = next(line for line in text.splitlines() if line.startswith("pip install"))
    name = "export-model" if tool["export-model"]["published"] else "."
    assert first.split("#")[0].split() == ["pip", "install", f'"{name}[onnxruntime]"']
