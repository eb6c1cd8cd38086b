"""Links of README.md and docs/: files and headings exist, addresses are addresses."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlparse

import pytest

from tests.commands import ROOT
from tests.docs.blocks import name_of, pages

_FENCED = re.compile(r"^( *)(`{3,}).*?^\1\2\s*$", re.MULTILINE | re.DOTALL)
_CODE = re.compile(r"`[^`\n]+`")
_LINK = re.compile(r"(?<!\!)\[[^\]]+\]\(([^)\s]+)\)")
_IMAGE = re.compile(r"\!\[[^\]]*\]\(([^)\s]+)\)")


def links(page: Path) -> list[str]:
    prose = _CODE.sub("code", _FENCED.sub("", page.read_text(encoding="utf-8")))
    return [*_LINK.findall(prose), *_IMAGE.findall(prose)]


def anchors(page: Path) -> Iterator[str]:
    """What a forge calls the headings of a page."""
    seen: Counter[str] = Counter()
    prose = _FENCED.sub("", page.read_text(encoding="utf-8"))
    for heading in re.findall(r"^#+ (.*)$", prose, re.MULTILINE):
        slug = re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")
        yield f"{slug}-{seen[slug]}" if seen[slug] else slug
        seen[slug] += 1


@pytest.mark.parametrize("page", [*pages(), ROOT / "CONTRIBUTING.md"], ids=name_of)
def test_links_resolve(page: Path) -> None:
    for link in links(page):
        address = urlparse(link)
        if address.scheme:
            assert address.scheme == "https", link
            assert "." in address.netloc, link
            continue
        target = (page.parent / address.path).resolve() if address.path else page
        assert target.is_relative_to(ROOT), f"{link} leaves the repository"
        assert target.exists(), f"{name_of(page)} links to {link}"
        if address.fragment:
            assert address.fragment in set(anchors(target)), f"{name_of(page)} links to {link}"


#: Entries of the site's sidebar; more than these nobody reads through.
MOST_ENTRIES = 20


def listed(page: Path) -> list[str]:
    """The pages in the tables of contents of a page."""
    tables = re.findall(r"```\{toctree\}(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    return re.findall(r"^[a-z][a-z\-/]*$", "".join(tables), re.M)


def test_every_page_can_be_reached() -> None:
    """From index.md, by the tables of contents; a page that another one lists is shown when that is open."""
    entries = listed(ROOT / "docs/index.md")
    below = [name for entry in entries for name in listed(ROOT / f"docs/{entry}.md")]
    there = {p.relative_to(ROOT / "docs").with_suffix("").as_posix() for p in pages() if p.parent != ROOT} - {"index"}
    assert sorted(entries + below) == sorted(there)
    assert len(entries) <= MOST_ENTRIES


def test_headings_are_found() -> None:
    assert "pytorch-checkpoints" in set(anchors(ROOT / "docs/sources.md"))
    assert "sources.md#pytorch-checkpoints" in links(ROOT / "docs/unity.md")


def test_the_messages_of_the_faq_are_ones_that_are_said() -> None:
    code = "".join(
        p.read_text(encoding="utf-8") for top in ("exporter", "converters") for p in (ROOT / top).rglob("*.py")
    )
    asked = re.findall(r"^## `(.*)`$", (ROOT / "docs/faq.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert len(asked) > 8
    assert [message for message in asked if message not in code] == []


@pytest.mark.parametrize("page", [*pages(), ROOT / "CONTRIBUTING.md"], ids=name_of)
def test_no_page_was_left_between_two_versions(page: Path) -> None:
    """A merge that was not finished leaves lines of its own in the text."""
    assert not re.findall(r"^(?:<{7}|>{7}|={7})(?: .*)?$", page.read_text(encoding="utf-8"), re.MULTILINE)
