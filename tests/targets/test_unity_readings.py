"""The table of what Unity's importers misread, against what they did (../shared/unity/onnx_rules)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import onnx
import pytest

from export_model.converters.consumers.unity.constructs import constructs
from export_model.converters.consumers.unity.exceptions import exception_of
from export_model.converters.consumers.unity.importers import IMPORTERS
from export_model.converters.consumers.unity.readings import MEASURED, RULES, Reading, misreadings

RULES_FOLDER = Path(__file__).resolve().parents[3] / "shared" / "unity" / "onnx_rules"

#: Recorded verdict → what our table may say; an exception at import may come before another one at run.
RECORDED: Mapping[str, frozenset[Reading]] = {
    "equal": frozenset(),
    "close": frozenset(),
    "runs": frozenset(),
    "import error": frozenset({Reading.REFUSED}),
    "run error": frozenset({Reading.FAILS}),
    "WRONG": frozenset({Reading.WRONG}),
    "output missing": frozenset({Reading.LOST}),
    "equal at batch 1, run error at batch 3": frozenset({Reading.FAILS}),
    "equal at batch 1, WRONG at batch 3": frozenset({Reading.WRONG}),
    "WRONG at batch 1, run error at batch 3": frozenset({Reading.WRONG}),
}
#: Constructs that are right for the numbers which were fed, and wrong for others; a model does not tell what is fed.
BY_WHAT_IS_FED = {
    **dict.fromkeys(("OneHot_01", "OneHot_02", "OneHot_03", "OneHot_04"), "indices are whole numbers"),
    **dict.fromkeys(("Cast_06", "Equal_03", "Gather_05", "Gather_06"), "whole numbers are fed"),
    **dict.fromkeys(("Cast_07", "Where_03"), "zeros and ones are fed"),
}


def _rows() -> list[dict[str, Any]]:
    if not RULES_FOLDER.is_dir():
        return []
    rows = [json.loads(line) for line in (RULES_FOLDER / "onnx_rules.jsonl").read_text().splitlines()]
    later = {r["id"]: r for r in map(json.loads, (RULES_FOLDER / "inference_engine.jsonl").read_text().splitlines())}
    both = ("verdict", "results")
    return [{**row, **{key: {**row[key], **later[row["id"]][key]} for key in both}} for row in rows]


ROWS = _rows()
needs_rows = pytest.mark.skipif(not ROWS, reason="../shared/unity is not beside this checkout")


@needs_rows
def test_every_recorded_construct_is_read_as_the_importers_read_it() -> None:
    wrong = []
    for row in ROWS:
        found: dict[str, set[Reading]] = {name: set() for name in IMPORTERS}
        for misreading in misreadings(constructs(onnx.load(RULES_FOLDER / row["file"]))):
            found[misreading.importer].add(misreading.rule.reading)
        for importer, readings in found.items():
            expected = RECORDED[row["verdict"][importer]]
            fits = expected <= readings and bool(expected) == bool(readings)
            if not fits and row["id"] not in BY_WHAT_IS_FED:
                wrong.append(f"{row['id']} ({row['form']}) in {importer}: {row['verdict'][importer]}, ours {readings}")
    assert not wrong, "\n".join(wrong)


@needs_rows
def test_the_exceptions_are_recorded_as_right_and_called_wrong_by_us() -> None:
    for row in ROWS:
        if row["id"] not in BY_WHAT_IS_FED:
            continue
        found = {m.importer: m.rule.reading for m in misreadings(constructs(onnx.load(RULES_FOLDER / row["file"])))}
        assert row["verdict"]["Barracuda 3.0.0"] == "equal" and found["Barracuda 3.0.0"] is Reading.WRONG


@needs_rows
def test_every_rule_comes_from_a_construct_that_was_measured() -> None:
    known = {row["id"] for row in ROWS}
    played = RULES_FOLDER.parent / "r3"
    beside = {r.evidence for r in RULES if r.evidence not in known and not (played / r.evidence).is_dir()}
    # READMEs of the data tell of both: the Identity of a reshaped output, and what the importer of 3.0.0 threw at
    assert beside == {"beside the 352", "r4, entity_attention"}


@needs_rows
def test_the_operators_called_measured_are_the_recorded_ones() -> None:
    assert {c.op for row in ROWS for c in constructs(onnx.load(RULES_FOLDER / row["file"]))} == MEASURED


def _thrown(result: Mapping[str, Any]) -> str | None:
    """What a construct threw at import or, of one row or of three, when it ran."""
    for part in (result.get("import"), result.get("b1"), result.get("b3")):
        for held in (part, part.get("run")) if isinstance(part, dict) else ():
            if isinstance(held, dict) and "exception" in held:
                return f"{held['exception']}: {held['message']}"
    return None


@needs_rows
def test_the_exceptions_are_those_that_were_thrown() -> None:
    rows = {row["id"]: row for row in ROWS}
    for rule in RULES:
        for importer in rule.importers if rule.evidence in rows else ():
            said = exception_of(rule.evidence, importer) if rule.reading in (Reading.REFUSED, Reading.FAILS) else None
            if said is not None:
                thrown = _thrown(rows[rule.evidence]["results"][importer])
                assert thrown is not None and thrown.split("\n\nJson:")[0].strip() == said, (rule.evidence, importer)
