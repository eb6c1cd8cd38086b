"""Every command and program of README.md and docs/ runs as it stands there.

On a page of EVERY ``auto`` stands for all runtimes that are installed, on the others for onnxruntime, which starts in a
tenth of the time; with EXPORT_MODEL_TEST_FULL=1 for all of them everywhere.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from tests.commands import ROOT
from tests.conftest import FULL
from tests.docs.blocks import Block, blocks, blocks_of, name_of, pages
from tests.docs.workshop import HOW, Workshop, furnish

CORE_PAGES = ("README.md", "docs/start.md", "docs/unity.md", "docs/web.md", "docs/robots.md")
#: Pages whose blocks have a test of their own.
ELSEWHERE = {
    "docs/python-guide.md": "tests/acting/test_docs.py",
    "docs/extending.md": "tests/docs/test_extending.py",
    **dict.fromkeys(CORE_PAGES, "tests/docs/test_core_pages.py"),
}
#: Pages that run with all runtimes.
EVERY = {"docs/agreement.md"}
#: Languages that stand for something to run; the rest is looked at.
RUN = {"sh", "python", "js"}

HERE = [p for p in pages() if name_of(p) not in ELSEWHERE]
QUICK = [p for p in HERE if not any(b.language in RUN and b.verb != "skip" for b in blocks(p))]


def directive(block: Block) -> bool:
    """Sphinx's own: the build looks at them."""
    return block.language.startswith("{")


@pytest.fixture(scope="session")
def furnished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("workshop")
    furnish(folder)
    return folder


@pytest.fixture
def workshop(furnished: Path, tmp_path: Path) -> Workshop:
    """A folder of the page's own."""
    folder = tmp_path / "here"
    shutil.copytree(furnished, folder, symlinks=True)
    return Workshop(folder)


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in HERE if p not in QUICK], ids=name_of)
def test_the_blocks_of_a_page_run(page: Path, workshop: Workshop) -> None:
    workshop.narrow = name_of(page) not in EVERY and not os.environ.get(FULL)
    for block in blocks(page):
        if not directive(block):
            workshop.run(block)


@pytest.mark.parametrize("page", QUICK, ids=name_of)
def test_what_is_not_run_is_well_formed(page: Path, tmp_path: Path) -> None:
    for block in blocks(page):
        if not directive(block):
            Workshop(tmp_path).run(block)


def test_every_block_has_a_language_that_is_tested() -> None:
    found = {b.language for page in pages() for b in blocks(page) if not directive(b)}
    assert found <= set(HOW)


#: Characters of a line of code that the site shows beside both its sidebars at 1280 pixels.
WIDTH = 100


def test_no_line_of_code_is_wider_than_the_site_shows() -> None:
    found = [b for page in pages() for b in blocks(page) if not directive(b)]
    assert [(b.where, line) for b in found for line in b.text.splitlines() if len(line) > WIDTH] == []


def test_pages_with_tests_of_their_own_have_them() -> None:
    assert set(map(name_of, HERE)) >= EVERY
    for page, test in ELSEWHERE.items():
        assert (ROOT / page).is_file()
        text = (ROOT / test).read_text(encoding="utf-8")
        assert ("CORE_PAGES" if page in CORE_PAGES else Path(page).name) in text


# ------------------------------------------------------------------ the collector itself


def test_blocks_are_found_with_what_is_said_of_them() -> None:
    text = (
        "a\n\n<!-- test: status 2 -->\n```sh\nfalse\n```\n\n  ```python\n  x = 1\n    y\n  ```\n````text\n```\n````\n"
    )
    first, second, third = blocks_of(text, "page")
    assert (first.language, first.text, first.verb, first.argument) == ("sh", "false\n", "status", "2")
    assert (second.text, second.verb, second.where) == ("x = 1\n  y\n", "", "page:8")
    assert third.text == "```\n"


@pytest.mark.parametrize("text", ["```sh\nls\n", "<!-- test: perhaps -->\n```sh\n```\n"])
def test_a_page_that_is_wrong_is_seen(text: str) -> None:
    with pytest.raises(AssertionError):
        list(blocks_of(text, "page"))


@pytest.mark.parametrize(
    "block",
    [
        Block("p", 1, "sh", "true\nfalse\ntrue\n"),
        Block("p", 1, "sh", "true\n", "status", "1"),
        Block("p", 1, "sh", "true\n", "skip", ""),
        Block("p", 1, "sh", "echo no\n", "until", "http://"),
        Block("p", 1, "python", "raise SystemExit(1)\n"),
        Block("p", 1, "text", "export-model x\n"),
        Block("p", 1, "json", "{"),
    ],
    ids=lambda b: f"{b.language}-{b.verb}",
)
def test_a_block_that_fails_fails(block: Block, tmp_path: Path) -> None:
    with pytest.raises((AssertionError, ValueError)):
        Workshop(tmp_path).run(block)
