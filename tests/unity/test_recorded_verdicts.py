"""Our checker says what ML-Agents' own checkers said: every file and setting of ../shared/unity/checker.

Compared are the outcome of the import, the exception of loading, the Inspector's list word for word and in its order,
the outputs that a player fetches, and the verdict; in four pairs of release and runtime, with Deterministic Inference
off and on.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from export_model.converters.consumers.unity.checker import MODES, UnityVerdict, check_file
from export_model.converters.consumers.unity.consumers import CONSUMERS
from export_model.converters.consumers.unity.findings import Thrown
from export_model.converters.consumers.unity.settings import Brain
from tests.unity.conftest import lines

pytestmark = pytest.mark.corpus

ROWS = lines("checker/checker.jsonl")
LATER = {row["id"]: row for row in lines("checker/r23.jsonl")}
#: Our name of a pair → the column that holds it.
COLUMNS = {"R20": "R20", "R22": "R22", "R23": "R23", "R23-2.4": "R23 on 2.4.0"}
PARAMETERS = [pytest.param(row, id=row["id"]) for row in ROWS] or [pytest.param({}, id="shared-is-absent")]


@pytest.mark.parametrize("row", PARAMETERS)
def test_a_verdict_is_the_recorded_one(row: dict[str, Any], unity_data: Path) -> None:
    brain = Brain.from_dict(row["brain"]) if row["brain"] else Brain()
    recorded = {**row, **{k: v for k, v in LATER.get(row["id"], {}).items() if k != "accepted"}}
    accepted = {**row["accepted"], **LATER.get(row["id"], {}).get("accepted", {})}
    compared = [name for name, column in COLUMNS.items() if column in recorded]
    assert compared
    for name in compared:
        verdict = check_file(unity_data / "checker" / row["file"], CONSUMERS[name], brain)
        assert said(verdict, recorded[COLUMNS[name]]) == expected(recorded[COLUMNS[name]]), name
        assert verdict.checked == accepted[COLUMNS[name]], name


def test_all_rows_are_there(unity_data: Path) -> None:
    assert (len(ROWS), len(LATER)) == (407, 300)


def said(verdict: UnityVerdict, recorded: dict[str, Any]) -> dict[str, Any]:
    """Ours in the columns of the record."""
    if verdict.refused is not None:
        text = recorded["import"]["message"] if recorded["import"] != "ok" else ""
        whole = text if text.startswith(verdict.refused.message) else verdict.refused.message
        return {"import": (verdict.refused.exception, whole)}
    found: dict[str, Any] = {"import": "ok"}
    for mode in MODES:
        ours = verdict.modes[mode]
        listed = [[f.severity.value, f.message] for f in ours.checks]
        fetched = outcome(ours.fetched) if isinstance(ours.fetched, Thrown) else list(ours.fetched)
        found[mode] = (outcome(ours.load), outcome(ours.check_throws) if ours.check_throws else listed, fetched)
    return found


def expected(recorded: dict[str, Any]) -> dict[str, Any]:
    """The record, without the methods that an exception went through."""
    if recorded["import"] != "ok":
        return {"import": thrown(recorded["import"])}
    modes = {m: tuple(thrown(recorded[m][k]) for k in ("constructor", "check", "output_names")) for m in MODES}
    return {"import": "ok", **modes}


def outcome(found: Thrown | None) -> Any:
    return "ok" if found is None else (found.exception, found.message)


def thrown(cell: Any) -> Any:
    return (cell["exception"], cell["message"]) if isinstance(cell, dict) else cell
