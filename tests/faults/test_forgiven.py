"""Every rule that forgave stands in every report, with the elements that it forgave, wherever a check asked it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.reports.entry import Entry
from export_model.exporter.reports.junit import junit_xml
from export_model.exporter.reports.page import page
from export_model.exporter.reports.summary import comparison_table
from export_model.exporter.verify import excuses
from export_model.exporter.verify.difference import Difference
from export_model.exporter.verify.excuses import EXCUSES, Excuse, Forgiven, add_forgiven
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.report import ParityReport
from export_model.exporter.verify.tolerances import Tolerance
from export_model.exporter.verify.trial import Trial
from fixtures import path as fixture


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> ParityReport:
    """A report of one comparison at least."""
    pytest.importorskip("onnxruntime")
    options = ExportOptions(tmp_path_factory.mktemp("out"), ("onnx",), verify="onnxruntime")
    (result,) = export([fixture("continuous")], options)
    assert result.report is not None and result.report.passed is True
    return result.report


def test_every_rule_is_in_the_list() -> None:
    named = [each for each in vars(excuses).values() if isinstance(each, Excuse)]
    assert {id(e) for e in named} == {id(e) for e in EXCUSES}
    assert len({e.title for e in EXCUSES}) == len(EXCUSES)


@pytest.mark.parametrize("excuse", EXCUSES, ids=lambda e: e.title)
def test_each_rule_that_forgave_stands_in_every_report(excuse: Excuse, report: ParityReport) -> None:
    number = next(i for i, c in enumerate(report.comparisons) if c.output == "action")
    found = replace(report.comparisons[number], forgiven=(Forgiven(excuse, 7, 0.25),), elements=4321)
    made = replace(report, comparisons=(*report.comparisons[:number], found, *report.comparisons[number + 1 :]))
    shown = {
        "terminal": comparison_table(made),
        "JUnit": junit_xml([Entry(made)]).decode(),
        "HTML": page([Entry(made)]),
    }
    for how, text in shown.items():
        told = text.replace("&#x27;", "'").replace("&#39;", "'")
        assert excuse.title in told and "7 of 4,321" in told and "0.25" in told, how
    told = json.loads(json.dumps(made.to_dict()))["comparisons"][number]["forgiven"]
    assert told == [{"excuse": excuse.title, "elements": 7, "of": 4321, "most": 0.25, "open": excuse.leaves_open}]
    left_open = f"7 of {sum(c.elements for c in made.comparisons):,} elements left open: {excuse.title}"
    assert (left_open in made.sentence) is excuse.leaves_open


@pytest.mark.runtimes
@pytest.mark.parametrize(
    ("name", "form"), [("recurrent", "onnx"), ("sampled", "onnx"), ("discrete", "js"), ("continuous", "js")]
)
def test_no_check_keeps_to_itself_what_it_forgave(
    name: str, form: str, tmp_path: Path, processes: RuntimePool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With no tolerance at all, rounding is asked of everything: inputs, steps, drawn outputs, source code's agents."""
    kept: list[Sequence[Difference]] = []
    right = Trial.differences

    def differences(trial: Trial, output: str, *rest: Any) -> list[Difference]:
        found = right(trial, output, *rest)
        kept.append(found)
        return found

    monkeypatch.setattr(Trial, "differences", differences)
    runtime = {"onnx": "onnxruntime", "js": "node"}[form]
    options = ExportOptions(tmp_path, (form,), verify=runtime, parity=VerifyOptions(tolerance=Tolerance(0, 0)))
    (result,) = export([fixture(name)], options, pool=processes)
    assert result.report is not None
    asked = add_forgiven(d.forgiven for found in kept for d in found)
    told = add_forgiven(c.forgiven for c in result.report.comparisons)
    assert asked and [(f.excuse.title, f.elements) for f in told] == [(f.excuse.title, f.elements) for f in asked]
