"""The documented schemas: themselves valid, and what they allow is what the tool writes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from export_model.converters.formats.bundle.bundle import dumps
from fixtures import FIXTURES
from fixtures import path as fixture
from tests.commands import ROOT, export_model
from tests.reports.made import FAILING, PASSING, UNVERIFIED
from tests.reports.validation import check_parity, check_policy, schema

NAMES = ("log", "parity", "play", "policy")


@pytest.mark.parametrize("name", NAMES)
def test_a_schema_is_one(name: str) -> None:
    found = schema(name)
    Draft202012Validator.check_schema(found)
    assert found["$schema"] == "https://json-schema.org/draft/2020-12/schema"


@pytest.mark.parametrize("report", [PASSING, FAILING, UNVERIFIED])
def test_reports_fit(report: object) -> None:
    check_parity(dumps(report.to_dict()))  # type: ignore[attr-defined]


def test_what_is_not_finite_is_a_string() -> None:
    written = json.loads(dumps(FAILING.to_dict()))
    found = [c["max_abs_diff"] for c in written["comparisons"]] + [
        d for c in written["comparisons"] for d in c.get("drift", [])
    ]
    assert {"inf", "nan"} <= {v for v in found if isinstance(v, str)}


@pytest.mark.parametrize(
    ("where", "value"),
    [("passed", "yes"), ("seed", -1), ("undocumented", 1), ("verdict", "fine"), ("sizes", {"onnx": -1})],
)
def test_what_is_wrong_does_not_fit(where: str, value: object) -> None:
    with pytest.raises(AssertionError):
        check_parity(json.dumps({**PASSING.to_dict(), where: value}))


@pytest.mark.parametrize("name", FIXTURES)
def test_contracts_fit(name: str, tmp_path: Path) -> None:
    assert export_model(fixture(name), "-o", tmp_path, "--verify", "none").status == 0
    for file in tmp_path.glob("*/policy.json"):
        check_policy(file.read_bytes())
        broken = {**json.loads(file.read_text()), "action_space": "both"}
        with pytest.raises(AssertionError):
            check_policy(json.dumps(broken))


@pytest.mark.parametrize("name", NAMES)
def test_every_field_is_documented(name: str) -> None:
    """In the schema, which the pages name; a reference to a part that says it itself will do."""
    for where, part in properties(schema(name)):
        assert {"description", "$ref", "const"} & part.keys(), where
    text = (ROOT / "docs" / "agreement.md").read_text(encoding="utf-8")
    assert name not in ("parity", "policy") or f"{name}.schema.json" in text


def properties(part: Any, where: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """(path, schema) of every field under ``part``."""
    if isinstance(part, list):
        for number, item in enumerate(part):
            yield from properties(item, f"{where}[{number}]")
    elif isinstance(part, dict):
        yield from ((f"{where}.{name}", found) for name, found in part.get("properties", {}).items())
        for name, found in part.items():
            yield from properties(found, f"{where}/{name}")
