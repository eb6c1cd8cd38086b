"""Reports of play: JUnit XML that CI systems read, Markdown, and a page that needs nothing else."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import onnx
import pytest
from msgspec.structs import replace

from export_model.exporter.play.documents import html, junit, markdown
from export_model.exporter.play.options import PlayOptions
from export_model.exporter.play.report import PlayReport
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.plays import DIFFERENT, EQUIVALENT, NOT_DECIDED
from tests.commands import export_model, is_refused
from tests.play.conftest import FEW, Play
from tests.play.faults import order, through
from tests.reports.test_junit import ALLOWED, outcomes
from tests.reports.test_page import Page, is_self_contained


@pytest.fixture(scope="module")
def made() -> dict[str, PlayReport]:
    """Reports by their verdict, made once."""
    return {}


@pytest.fixture
def reports(made: dict[str, PlayReport], bundles: Path, tmp_path: Path, play: Play) -> dict[str, PlayReport]:
    if not made:
        one, options = VerifyOptions(runtimes="onnxruntime"), PlayOptions(60)
        folder = bundles / "GridWorld"
        made[EQUIVALENT] = good = play(folder, "GridWorld", options=options, judging=one)
        model = onnx.load(folder / "GridWorld.onnx")
        through("action", "Gather", order(1, 0, 2, 3), axis=1)(model)
        onnx.save(model, tmp_path / "worse.onnx")
        made[DIFFERENT] = play(folder, "GridWorld", tmp_path / "worse.onnx", options=options, judging=one)
        (played,) = good.played
        compared = replace(played.compared, verdict=NOT_DECIDED, low=-0.5, high=0.5, needed=4321)
        made[NOT_DECIDED] = replace(good, played=(replace(played, compared=compared),))
    return made


@pytest.mark.parametrize(
    ("verdict", "outcome"), [(EQUIVALENT, "passed"), (DIFFERENT, "failure"), (NOT_DECIDED, "skipped")]
)
def test_junit_has_a_case_for_what_each_earned(verdict: str, outcome: str, reports: dict[str, PlayReport]) -> None:
    root = ET.fromstring(junit(reports[verdict]))
    for element in root.iter():
        needed, more, inside = ALLOWED[element.tag]
        assert needed <= set(element.keys()) <= needed | more
        assert {child.tag for child in element} <= inside
    suites = {s.get("name"): s for s in root}
    assert {"GridWorld.play.GridWorld", "GridWorld.onnx"} <= set(suites)
    found = outcomes(root)
    assert found["GridWorld.onnx.onnxruntime", "returns"] == outcome
    assert found["GridWorld.onnx.onnxruntime", "action"] == ("failure" if verdict == DIFFERENT else "passed")
    assert int(root.get("failures", "")) == sum(o == "failure" for o in found.values())


def test_markdown_says_what_is_different_and_what_would_decide(reports: dict[str, PlayReport]) -> None:
    text = markdown(reports[EQUIVALENT])
    assert text.startswith("### ✅ `GridWorld` in `GridWorld`") and "❌" not in text
    text = markdown(reports[DIFFERENT])
    assert "- ❌ onnx in onnxruntime: action differs" in text
    assert "first difference: action" in text and "different: mean return -" in text
    assert "about 4,321 episodes would decide" in markdown(reports[NOT_DECIDED])
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in rows}) == 1


@pytest.mark.parametrize("verdict", [EQUIVALENT, DIFFERENT, NOT_DECIDED])
def test_the_page_is_whole_and_shows_the_pictures(verdict: str, reports: dict[str, PlayReport]) -> None:
    source = html(reports[verdict])
    page = Page(source)
    is_self_contained(source, page)
    assert source.count("<svg") >= 3
    assert ("What disagrees" in source) is (verdict == DIFFERENT)
    assert "nan" not in source.replace("finance", "")


def test_names_in_it_are_text(reports: dict[str, PlayReport]) -> None:
    odd = replace(reports[EQUIVALENT], policy="<script>|a", environment="</style>`b`")
    assert "<script>" not in html(odd) and "</style>`b`" not in html(odd)
    text = markdown(odd)
    assert "<script>" not in text.replace("`<script>\\|a`", "") and "&lt;script&gt;" in text
    ET.fromstring(junit(odd))


def test_returns_that_are_all_alike_are_drawn(reports: dict[str, PlayReport]) -> None:
    good = reports[EQUIVALENT]
    flat = replace(good.episodes, returns=np.zeros(60), lengths=np.ones(60, np.int64))
    (played,) = good.played
    compared = replace(played.compared, difference=0.0, low=0.0, high=0.0, margin=0.0)
    none = replace(good, margin=0.0, episodes=flat, played=(replace(played, episodes=flat, compared=compared),))
    source = html(none)
    assert "nan" not in source and "inf" not in source.replace("info", "")


def test_the_command_writes_them(bundles: Path, tmp_path: Path) -> None:
    files = {kind: tmp_path / f"report.{kind}" for kind in ("html", "junit", "markdown")}
    options = [word for kind, file in files.items() for word in (f"--{kind}", file)]
    where = (bundles / "GridWorld", "--env", "GridWorld", "--runtimes", "onnxruntime", "--episodes", FEW)
    ran = export_model("play", *where, *options)
    assert ran.status == 0, ran.err
    assert all(file.read_bytes() for file in files.values())
    is_refused(export_model("play", *where, "--junit", files["html"], "--html", files["html"]), "named for two reports")


@pytest.mark.parametrize("columns", ["80", "200"])
def test_the_table_breaks_no_word_on_a_terminal(
    reports: dict[str, PlayReport], monkeypatch: pytest.MonkeyPatch, columns: str
) -> None:
    """Also with the longest names that runtimes have."""
    (played,) = reports[DIFFERENT].played
    far = replace(played, format="saved_model", runtime="onnxruntime-web@chromium")
    report = replace(reports[DIFFERENT], reference="GridWorld", played=(played, far))
    monkeypatch.setenv("COLUMNS", "1000")
    whole = sorted(word for line in report.lines() for word in line.split() if set(word) != {"-"})
    monkeypatch.setenv("COLUMNS", columns)
    lines = list(report.lines())
    assert sorted(word for line in lines for word in line.split() if set(word) != {"-"}) == whole
    table = lines[: len(lines) - sum(bool(p.sentence) for p in report.played)]
    assert max(map(len, table[:8])) <= int(columns)
