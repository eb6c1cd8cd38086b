"""docs/extending.md, followed to the letter in a copy of the repository."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.commands import PACKAGE, PLACES, ROOT
from tests.docs.blocks import Block, blocks
from tests.docs.workshop import NARROW

PAGE = ROOT / "docs" / "extending.md"
PARTS = ("exporter", "converters", "signatures", "fixtures", "tests")
LEFT_OUT = shutil.ignore_patterns("node_modules", "__pycache__", "trained", "corpus")


def copied(folder: Path) -> None:
    for part in PARTS:
        shutil.copytree(ROOT / part, folder / part, ignore=LEFT_OUT)
    shutil.copytree(PACKAGE, folder / PACKAGE.relative_to(ROOT), symlinks=True)
    shutil.copy(ROOT / "pyproject.toml", folder)
    modules = "converters/runtimes/javascript/js/node_modules"
    if (ROOT / modules).is_dir():
        (folder / modules).symlink_to(ROOT / modules)


def insert(block: Block, folder: Path) -> None:
    """Put the block's lines after the one line that ends with the given text."""
    name, _, text = block.argument.partition(" after ")
    path = folder / name
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    places = [i for i, line in enumerate(lines) if line.strip() == text]
    assert len(places) == 1, f"{block.where}: {len(places)} lines of {name} are: {text}"
    lines.insert(places[0] + 1, block.text)
    path.write_text("".join(lines), encoding="utf-8")


def run(command: list[str], block: Block, folder: Path) -> None:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    places = (NARROW, *PLACES)
    modules = os.pathsep.join(str(folder / place.relative_to(ROOT)) for place in places)
    environment = {**os.environ, "PATH": path, "PYTHONPATH": modules, "PYTHONSAFEPATH": "1"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, encoding="utf-8", check=False)
    assert done.returncode == 0, f"{block.where}:\n{done.stdout[-4000:]}\n{done.stderr[-2000:]}"
    if "pytest" in block.text:
        assert " passed" in done.stdout, done.stdout[-2000:]
        assert "skipped" not in done.stdout.splitlines()[-1], done.stdout[-2000:]


@pytest.mark.slow
@pytest.mark.xdist_group("docs")
def test_what_the_page_says_works(tmp_path: Path) -> None:
    copied(tmp_path)
    for block in blocks(PAGE):
        if block.verb == "insert":
            insert(block, tmp_path)
        elif block.verb == "file":
            path = tmp_path / block.argument
            path.parent.mkdir(exist_ok=True)
            path.write_text(block.text, encoding="utf-8")
        elif block.language == "sh":
            assert block.verb == "in the copy", block.where
            run(["bash", "-euo", "pipefail", "-c", block.text], block, tmp_path)
        else:
            run([sys.executable, "-c", block.text], block, tmp_path)
    checked = ["converters/formats/steps", "converters/runtimes/plain", "converters/trainers/lander"]
    for tool in (["ruff", "check", "--no-cache"], ["ruff", "format", "--check", "--no-cache"]):
        done = subprocess.run([sys.executable, "-m", *tool, *checked], cwd=tmp_path, capture_output=True, check=False)
        assert done.returncode == 0, done.stdout.decode()


def test_the_page_names_lines_that_are_there() -> None:
    """Quick, so that who moves a line learns of it at once."""
    for block in blocks(PAGE):
        if block.verb == "insert":
            name, _, text = block.argument.partition(" after ")
            lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
            assert [line.strip() for line in lines].count(text) == 1, f"{block.where}: {text}"
