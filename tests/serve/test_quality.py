"""What Lighthouse would look at: accessibility by axe-core, width, weight, and what comes before the first movement."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from msgspec.structs import replace

from export_model.exporter.reports.page import page
from export_model.exporter.serve.onefile import modules_of
from export_model.exporter.serve.site import assemble, assemble_one_file
from fixtures import path as fixture
from tests.commands import export_model
from tests.reports.made import FAILING, PASSING, entry
from tests.serve.browsing import CHECKED, served, visit, with_backends
from tests.serve.conftest import Bundle

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.xdist_group("browser")]

AXE = Path(__file__).parent / "js" / "node_modules" / "axe-core" / "axe.min.js"
SIZES = ((1280, 900), (390, 844))
SCHEMES = ("light", "dark")
MOVED = "performance.getEntriesByName('first-movement').length > 0"
FIRST = """({ at: performance.getEntriesByName("first-movement")[0].startTime,
  asked: performance.getEntriesByType("resource").map(({ name, startTime }) => [name, startTime]) })"""
#: What a page of 3DBall may weigh as one file, and uncompressed until it moves, in bytes.
ONE_FILE, UNTIL_IT_MOVES = 200_000, 200_000


@pytest.fixture(scope="module")
def axe() -> Path:
    if not AXE.is_file():
        pytest.skip("axe-core is not installed: make install")
    return AXE


def looked_at(url: str, axe: Path, ready: str) -> None:
    """Wide and narrow, light and dark: axe-core has nothing to say, nothing is wider than the window, nothing moves."""
    views = [(size, scheme) for size in SIZES for scheme in SCHEMES]
    each = [
        [
            ["viewport", *size],
            ["scheme", scheme],
            ["axe", str(axe)],
            ["eval", "document.documentElement.scrollWidth - innerWidth"],
        ]
        for size, scheme in views
    ]
    open_all = "document.querySelectorAll('details').forEach((d) => (d.open = true))"
    playing = "document.querySelector('#pause')?.textContent === 'Pause'"
    first = [["wait", ready], ["eval", open_all]]
    seen = visit(url, [*first, *(step for steps in each for step in steps), ["eval", playing]], reducedMotion="reduce")
    answers = seen.results[len(first) : -1]
    assert answers[2::4] == [[]] * len(views), json.dumps(answers[2::4], indent=1)
    assert [max(0, beyond) for beyond in answers[3::4]] == [0] * len(views)
    assert seen.results[-1] is False, "nothing moves by itself where the visitor wants it so"


@pytest.mark.parametrize("name", ["3DBall", "recurrent", "visual"])
def test_the_page_is_accessible_and_fits(bundle: Bundle, axe: Path, name: str) -> None:
    site = assemble(bundle(name))
    with served(site if name == "3DBall" else with_backends(site, "js", "cpu")) as server:
        looked_at(server.url, axe, CHECKED)


def test_the_page_of_one_file_is_accessible_and_fits(bundle: Bundle, axe: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_bytes(assemble_one_file(bundle("3DBall")))
    assert page.stat().st_size <= ONE_FILE
    looked_at(page.as_uri(), axe, CHECKED)


def verified(report: Path) -> None:
    assert export_model(fixture("discrete"), "-o", report.parent, "--to", "onnx,bytes", "--verify", "none").status == 0
    ran = export_model("verify", report.parent / "discrete", "--runtimes", "onnxruntime", "--html", report)
    assert ran.status == 0, ran.err


def compared(report: Path) -> None:
    ran = export_model("compare", fixture("continuous"), fixture("discrete"), "--html", report)
    assert ran.status == 1, ran.err


def many(report: Path) -> None:
    """Twenty policies, one of which failed."""
    policies = [PASSING] * 19 + [FAILING]
    entries = [entry(replace(made, policy=f"policy_with_a_long_name_{n}")) for n, made in enumerate(policies)]
    report.write_text(page(entries), encoding="utf-8")


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_report_on_twenty_policies_is_short_until_one_is_opened(tmp_path: Path, scheme: str) -> None:
    report = tmp_path / "report.html"
    policies = [replace(PASSING, policy=f"policy_{n}") for n in range(20)]
    report.write_text(page([entry(made) for made in policies]), encoding="utf-8")
    height, shown = "document.documentElement.scrollHeight", "document.querySelector('#policy-7').checkVisibility()"
    for size in SIZES:
        steps = [["viewport", *size], ["scheme", scheme], ["eval", height], ["eval", shown]]
        *_, tall, closed = visit(report.as_uri(), steps).results
        assert tall <= 6_000 and closed is False
        *_, opened = visit(f"{report.as_uri()}#policy-7", [["viewport", *size], ["eval", shown]]).results
        assert opened is True  # as a link of the table does


@pytest.mark.parametrize("write", [verified, compared, many], ids=["verified", "compared", "many"])
def test_the_report_is_accessible_and_fits(axe: Path, tmp_path: Path, write: Callable[[Path], None]) -> None:
    pytest.importorskip("onnxruntime")
    report = tmp_path / "report.html"
    write(report)
    looked_at(report.as_uri(), axe, "true")


def test_it_moves_before_anything_else_is_asked_for(bundle: Bundle) -> None:
    """No backend, no check, nothing of npm's comes before the scene has moved: only the page and the policy."""
    site = assemble(bundle("3DBall"))
    with served(site) as server:
        found = visit(server.url, [["wait", MOVED], ["eval", FIRST]]).results[1]
    asked = {urlsplit(name).path.removeprefix("/") for name, at in found["asked"] if at < found["at"]}
    data = {"model/weights.bin", "page.css", "site.json", "policy.json"}
    assert asked - {"icon.svg"} == {*modules_of(site), *data}
    weight = sum(len(site[name]) for name in asked) + len(site["index.html"])
    print(f"\nfirst movement {found['at'] / 1000:.2f} s after the page was opened; {weight / 1000:.0f} kB until then")
    assert weight <= UNTIL_IT_MOVES
