"""The site builds without a warning, its links resolve, and it fetches nothing."""

from __future__ import annotations

import importlib.util
import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlparse

import pytest

from tests.commands import ROOT, python

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("docs-build")]


class _Page(HTMLParser):
    """What a page links to, what it fetches, and what can be linked to on it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.names: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {key: value or "" for key, value in attrs}
        self.names |= {found[key] for key in ("id", "name") if key in found}
        if tag == "a" and "href" in found:
            self.links.append(found["href"])
        if "src" in found:
            self.fetched.append(found["src"])
        if tag == "link" and "href" in found:
            self.fetched.append(found["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if importlib.util.find_spec("sphinx") is None:
        pytest.skip("Sphinx is not installed; get it with: pip install 'export-model[docs]'")
    folder = tmp_path_factory.mktemp("site")
    options = ("--builder", "html", "--fail-on-warning", "--keep-going", "--quiet", "--doctree-dir", folder / "trees")
    ran = python("-m", "sphinx", *options, "docs", folder / "html")
    assert ran.status == 0, ran.err
    assert ran.err == ""
    return folder / "html"


@pytest.fixture(scope="module")
def parsed(site: Path) -> dict[Path, _Page]:
    return {p: _Page(p.read_text(encoding="utf-8")) for p in site.rglob("*.html")}


def test_links_resolve(parsed: dict[Path, _Page]) -> None:
    assert len(parsed) > 20
    for path, page in parsed.items():
        for link in page.links:
            address = urlparse(link)
            if address.scheme:
                assert address.scheme == "https", f"{path.name}: {link}"
                continue
            target = (path.parent / unquote(address.path)).resolve() if address.path else path
            assert target.exists(), f"{path.name}: {link}"
            if address.fragment and target in parsed:
                assert unquote(address.fragment) in parsed[target].names, f"{path.name}: {link}"


def test_nothing_is_fetched(site: Path, parsed: dict[Path, _Page]) -> None:
    for path, page in parsed.items():
        for address in page.fetched:
            assert not urlparse(address).netloc, f"{path.name} fetches {address}"
    for sheet in site.rglob("*.css"):
        for address in re.findall(r"url\(['\"]?([^'\")]+)", sheet.read_text(encoding="utf-8")):
            assert not urlparse(address).netloc, f"{sheet.name} fetches {address}"
        assert "@import" not in sheet.read_text(encoding="utf-8"), sheet.name


def test_the_reference_is_whole(parsed: dict[Path, _Page]) -> None:
    import export_model
    from export_model.exporter.cli.app import app

    names = {name for page in parsed.values() for name in page.names}
    for function in (n for n in export_model.__all__ if not n.startswith("_")):
        assert any(name.endswith(f".{function}") for name in names), function
    for command in app.commands:
        assert f"export-model-{command}" in names, command


def test_no_place_of_this_machine_is_in_it(parsed: dict[Path, _Page]) -> None:
    for path in parsed:
        assert str(ROOT) not in path.read_text(encoding="utf-8"), path.name
