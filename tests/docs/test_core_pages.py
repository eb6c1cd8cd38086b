"""The core pages as a reader follows them: the wheel installed, an empty folder, then every block in order.

The first of each page is ``demo --files``.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.commands import ROOT
from tests.docs.blocks import blocks, name_of, pages
from tests.docs.test_pages import CORE_PAGES
from tests.docs.workshop import MODULES, NARROW, Workshop

CORE = [ROOT / name for name in CORE_PAGES]
MOST_CORE_WORDS, MOST_WORDS = 6_000, 22_800
#: README alone, and all pages, by ``wc -w``, which counts blocks and the bars of tables, too.
MOST_IN_README, MOST_IN_ALL = 600, 30_000
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
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment that pip installed the wheel into; its dependencies are the tests' own."""
    home = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    build = [*pip, "wheel", "--no-deps", "--wheel-dir", str(home), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(home / "own")], check=True)
    python = home / "own" / "bin" / "python"
    (wheel,) = home.glob("*.whl")
    install = [*pip, "--python", str(python), "install", "--no-deps", "--no-index", str(wheel)]
    subprocess.run(install, check=True, capture_output=True)
    packages = _packages(python)
    # The .pth files in a folder that a .pth file names are not read, so the checkout stays out.
    (packages / "dependencies.pth").write_text(f"{_packages(Path(sys.executable))}\n")
    return python


def _packages(python: Path) -> Path:
    ask = [str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    return Path(subprocess.run(ask, check=True, capture_output=True, encoding="utf-8").stdout.strip())


class Reader(Workshop):
    """Somebody who has installed the wheel and pastes what the pages say."""

    def _environment(self) -> dict[str, str]:
        return {**super()._environment(), "PYTHONPATH": str(NARROW)}


@pytest.mark.slow
def test_every_block_runs_in_order(installed: Path, tmp_path: Path) -> None:
    folder = tmp_path / "empty"
    folder.mkdir()
    reader = Reader(folder, python=installed)
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
        [
            str(installed),
            "-c",
            "import export_model.exporter as inner, export_model; print(inner.__file__, export_model.__file__)",
        ],
        env=reader._environment(),
        cwd=folder,
        capture_output=True,
        encoding="utf-8",
        check=True,
    )
    assert all(Path(place).is_relative_to(installed.parents[1]) for place in found.stdout.split())


def test_all_pages_are_short_together() -> None:
    assert sum(map(words, pages())) <= MOST_WORDS, {name_of(p): words(p) for p in pages()}


def test_all_pages_are_short_by_wc() -> None:
    counts = {name_of(p): len(p.read_text(encoding="utf-8").split()) for p in pages()}
    assert counts["README.md"] <= MOST_IN_README
    assert sum(counts.values()) <= MOST_IN_ALL, counts
