"""README and the site's pages as a browser lays them out: nothing is wider than the window, every picture is there."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any

import pytest

from tests.commands import ROOT
from tests.docs.test_build import site  # noqa: F401 (a fixture)
from tests.serve.browsing import visit

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.xdist_group("docs-build")]

SIZES = ((1280, 900), (390, 844))
SCHEMES = ("light", "dark")
#: How GitHub and PyPI lay a README out: code and tables scroll in themselves, a picture is as wide as the text.
STYLE = """
body { font: 16px/1.5 sans-serif; max-width: 978px; margin: 0 auto; padding: 32px; overflow-wrap: break-word; }
pre { overflow: auto; padding: 16px; font-size: 85%; } table { display: block; max-width: 100%; overflow: auto; }
img { max-width: 100%; } code { font-family: monospace; }
@media (max-width: 767px) { body { padding: 15px; } }
"""
#: What sticks out of the window, and which pictures are broken.
LOOK = """[document.documentElement.scrollWidth - innerWidth,
  [...document.images].filter((i) => i.complete && !i.naturalWidth).map((i) => i.getAttribute("src"))]"""
PAGES = ("index", "start", "robots", "python-guide", "interface", "tasks/unity-old-brain")
#: How far lines of a block of code go beyond it.
CUT = """[...document.querySelectorAll("pre")].filter((p) => p.scrollWidth > p.clientWidth + 1)
  .map((p) => p.innerText.split("\\n").sort((a, b) => b.length - a.length)[0])"""


def layouts(address: str) -> list[tuple[int, list[str]]]:
    """(pixels beyond the window, broken pictures), wide and narrow, light and dark."""
    steps: list[list[Any]] = []
    for size in SIZES:
        for scheme in SCHEMES:
            steps += [["viewport", *size], ["scheme", scheme], ["eval", LOOK]]
    return [(beyond, broken) for beyond, broken in visit(address, steps).results[2::3]]


def test_what_sticks_out_is_seen(tmp_path: Path) -> None:
    page = tmp_path / "wide.html"
    page.write_text(
        '<!doctype html><meta name="viewport" content="width=device-width">'
        '<img src="gone.png"><p style="width:1000px">wide'
    )
    (wide, broken), *_, (narrow, _) = layouts(page.as_uri())
    assert wide <= 0 < narrow
    assert broken == ["gone.png"]


def test_readme_fits_the_window(tmp_path: Path) -> None:
    markdown = pytest.importorskip("markdown_it", reason="get it with: pip install 'export-model[docs]'")
    body = markdown.MarkdownIt("commonmark").enable("table").render((ROOT / "README.md").read_text(encoding="utf-8"))
    assert "<table>" in body or "<pre>" in body
    page = tmp_path / "README.html"
    title = html.escape("export-model")
    base = f'<base href="{ROOT.as_uri()}/">'
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width">{base}'
    page.write_text(f"<!doctype html><title>{title}</title>{head}<style>{STYLE}</style>{body}", encoding="utf-8")
    assert layouts(page.as_uri()) == [(0, [])] * 4


@pytest.mark.parametrize("name", PAGES)
def test_a_page_of_the_site_fits_the_window(site: Path, name: str) -> None:  # noqa: F811
    assert layouts((site / f"{name}.html").as_uri()) == [(0, [])] * 4


@pytest.mark.parametrize("name", PAGES)
def test_no_line_of_code_is_cut_on_a_wide_window(site: Path, name: str) -> None:  # noqa: F811
    page = visit((site / f"{name}.html").as_uri(), [["viewport", *SIZES[0]], ["eval", CUT]])
    assert page.results[-1] == []
