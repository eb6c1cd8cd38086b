"""A folder of bundles as a gallery: an index without scripts, a page for each policy, served or as a static folder."""

from __future__ import annotations

import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from export_model.exporter.serve.gallery import assemble_gallery
from export_model.exporter.serve.scenes import SCENES
from export_model.exporter.serve.site import PAGE, PREVIEWS, assemble, assemble_one_file, describe_page
from export_model.signatures.errors import BundleError
from tests.commands import export_model, files_in, is_refused
from tests.serve.browsing import CHECKED, served, visit
from tests.serve.conftest import Bundle

NAMES = ("3DBall", "GridWorld", "Tennis-LeftBrain", "Tennis-RightBrain", "continuous")


@pytest.fixture
def folder(bundle: Bundle, tmp_path: Path) -> Path:
    """A folder of five bundles, two of which play one game."""
    for name in NAMES:
        shutil.copytree(bundle(name), tmp_path / "policies" / name)
    return tmp_path / "policies"


def test_every_environment_has_a_picture() -> None:
    assert {p.stem for p in PREVIEWS.glob("*.png")} == {s.id for s in SCENES}
    assert sum(p.stat().st_size for p in PREVIEWS.iterdir()) < 60_000


def test_a_folder_is_written_as_pages_of_one_file_and_an_index(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "gallery"
    for _ in range(2):  # in place of an older one
        ran = export_model("serve", folder, "-o", out)
        assert ran.status == 0, ran.err
    assert "4 pages and an index" in ran.out
    shown = ["3DBall", "GridWorld", "Tennis-LeftBrain", "continuous"]
    pictures = {"pictures", *(f"pictures/{n}.png" for n in ("ball3d", "gridworld", "tennis"))}
    assert files_in(out) == {
        "index.html",
        "gallery.css",
        "icon.svg",
        "site.json",
        *(f"{n}.html" for n in shown),
        *pictures,
    }
    index = (out / "index.html").read_text(encoding="utf-8")
    assert re.findall(r'<a href="([^"]+)">', index) == [f"{n}.html" for n in shown]
    assert "<script" not in index and "4 policies" in index
    assert '<meta property="og:image" content="pictures/ball3d.png">' in index
    page = (out / "3DBall.html").read_text(encoding="utf-8")
    assert '<meta property="og:image" content="pictures/ball3d.png">' in page
    assert "og:image" not in (out / "continuous.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["3DBall", "continuous"])
def test_a_page_says_what_messengers_show_of_a_link(bundle: Bundle, name: str) -> None:
    for page in (assemble(bundle(name))["index.html"], assemble_one_file(bundle(name))):
        text = page.decode()
        assert f"<title>{name} · export-model</title>" in text
        (described,) = re.findall(r'<meta name="description" content="([^"]+)">', text)
        assert f'<meta property="og:description" content="{described}">' in text
        assert ("untrained" in described) == (name == "3DBall")
    site = assemble(bundle(name))
    assert (
        ("preview.png" in site)
        == (b'property="og:image" content="preview.png"' in site["index.html"])
        == (name == "3DBall")
    )


@given(st.text(), st.booleans())
def test_what_a_bundle_calls_its_family_stays_text(family: str, acts: bool) -> None:
    page = (PAGE / "index.html").read_bytes()
    found = Attributes()
    found.feed(describe_page(page, "name", family, acts).decode())
    said = [a["content"] for tag, a in found.tags if tag == "meta" and a.get("name") == "description"]
    assert len(said) == 1
    assert f"({family})" in (said[0] or "")
    plain = Attributes()
    plain.feed(page.decode())
    assert len(found.tags) == len(plain.tags) + 3


class Attributes(HTMLParser):
    """Every element that begins, as Python's own parser reads a page."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))


def test_what_cannot_be_shown_is_left_out_by_name(folder: Path, tmp_path: Path) -> None:
    (folder / "GridWorld" / "tfjs" / "model.json").write_text("{}")
    ran = export_model("serve", folder, "-o", tmp_path / "gallery")
    assert ran.status == 0
    assert "left out" in ran.err and "GridWorld" in ran.err
    assert "3 pages and an index" in ran.out
    with pytest.raises(BundleError, match="changed since"):
        assemble_gallery([folder / "GridWorld"], whole=False)


@pytest.mark.parametrize("whole", [True, False])
def test_bundles_of_one_name_have_pages_of_their_own(bundle: Bundle, tmp_path: Path, whole: bool) -> None:
    folders = [tmp_path / name for name in ("continuous", "newer", "newest")]
    for folder in folders:
        shutil.copytree(bundle("continuous"), folder)
    gallery = assemble_gallery(folders, whole=whole)
    addresses = re.findall(r'<a href="([^"]+)">([^<]+)</a>', gallery.files["index.html"].decode())
    assert len(set(addresses)) == len(set(map(str.casefold, gallery.shown))) == 3
    assert all((f"{address}index.html" if whole else address) in gallery.files for address, _ in addresses)
    assert [name for _, name in addresses] == list(gallery.shown)


def test_options_of_a_single_page_are_refused(folder: Path, tmp_path: Path) -> None:
    is_refused(export_model("serve", folder, "-o", tmp_path / "all.html"), "do not fit", "-o gallery")
    is_refused(export_model("serve", folder, "--scene", "tennis", "-o", tmp_path / "x"), "a single bundle")


@pytest.mark.browser
@pytest.mark.slow
@pytest.mark.xdist_group("browser")
def test_a_served_gallery_leads_to_pages_that_play(folder: Path) -> None:
    gallery = assemble_gallery([folder / n for n in NAMES], whole=True)
    with served(gallery.files) as server:
        wide = ["eval", "document.documentElement.scrollWidth - innerWidth"]
        looks = [["viewport", *size] for size in ((1280, 900), (390, 844))]
        loaded = ["eval", "[...document.images].map((image) => image.naturalWidth)"]
        seen = visit(
            server.url,
            [
                *(step for look in looks for step in (look, wide)),
                loaded,
                ["click", "a[href='3DBall/']"],
                ["wait", CHECKED],
                ["eval", "location.pathname"],
                ["eval", "document.querySelector('#verdict').textContent"],
            ],
        )
    assert (seen.results[1], seen.results[3]) == (0, 0)
    assert seen.results[4] == [640, 640, 640]
    assert seen.results[-2] == "/3DBall/"
    assert seen.results[-1].startswith("✓ Computes what was exported (worst ")
    assert [said for said in seen.console if said != "warning: No available adapters."] == []
