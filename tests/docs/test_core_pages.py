"""The core pages as a reader follows them: the wheel, an empty folder, ``demo --files``, then every block in order."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.commands import ROOT
from tests.docs.blocks import blocks, name_of, pages
from tests.docs.test_pages import CORE_PAGES
from tests.docs.workshop import MODULES, NARROW, Workshop

CORE = [ROOT / name for name in CORE_PAGES]
MOST_CORE_WORDS, MOST_WORDS = 6_000, 24_000
LANGUAGES = {"sh", "python", "js"}


def words(page: Path) -> int:
    """Words that are read: without blocks, the tests' notes and what holds no letter or digit."""
    text = re.sub(r"<!--.*?-->|```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    return sum(bool(re.search(r"\w", word)) for word in text.split())


def test_the_core_pages_are_short() -> None:
    assert sum(map(words, CORE)) <= MOST_CORE_WORDS


def test_words_are_counted_as_they_are_read(tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text("# A page\n\n| a | — |\n<!-- b -->\n```sh\nc d\n```\ne-f `g` 1\n")
    assert words(tmp_path / "page.md") == 6


def test_each_begins_with_the_files_to_try() -> None:
    for page in CORE:
        first = next(b for b in blocks(page) if b.language == "sh" and b.verb != "skip")
        assert first.text.split()[:3] == ["export-model", "demo", "--files"], first.where


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the wheel holds, and the command that it installs."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as archive:
        archive.extractall(folder / "packages")
    script = folder / "bin" / "export-model"
    script.parent.mkdir()
    script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m exporter "$@"\n')
    script.chmod(0o755)
    return folder


class Reader(Workshop):
    """Somebody who has installed the wheel and pastes what the pages say."""

    def __init__(self, folder: Path, wheel: Path) -> None:
        super().__init__(folder)
        self._wheel = wheel

    def _environment(self) -> dict[str, str]:
        own = super()._environment()
        packages = [str(NARROW), str(self._wheel / "packages")]
        path = f"{self._wheel / 'bin'}{os.pathsep}{own['PATH']}"
        return {**own, "PYTHONPATH": os.pathsep.join(packages), "PATH": path}


@pytest.mark.slow
def test_every_block_runs_in_order(wheel: Path, tmp_path: Path) -> None:
    folder = tmp_path / "empty"
    folder.mkdir()
    reader = Reader(folder, wheel)
    if MODULES.is_dir():
        (tmp_path / "node_modules").symlink_to(MODULES)  # as npm leaves it, found from the folder below
    if shutil.which("gcc") is None and shutil.which("clang") is None:
        pytest.skip("no C compiler; get one with: apt-get install gcc")
    count = 0
    for page in CORE:
        for block in blocks(page):
            reader.run(block)
            count += block.language in LANGUAGES and block.verb != "skip"
    assert count > 25
    found = subprocess.run(
        [sys.executable, "-c", "import exporter, export_model; print(exporter.__file__, export_model.__file__)"],
        env=reader._environment(),
        cwd=folder,
        capture_output=True,
        encoding="utf-8",
        check=True,
    )
    assert all(Path(place).is_relative_to(wheel) for place in found.stdout.split())


def test_all_pages_are_short_together() -> None:
    assert sum(map(words, pages())) <= MOST_WORDS, {name_of(p): words(p) for p in pages()}
