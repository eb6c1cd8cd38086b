"""parity.schema.json has no field and no word that nothing writes; that nothing else is written, conftest holds."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace

from export_model.converters.formats.bundle.bundle import dumps
from export_model.exporter.compare import explaining
from export_model.exporter.verify import findings
from export_model.exporter.verify.excuses import NOT_FROM_ZERO, ROUNDING, Forgiven
from export_model.exporter.verify.findings import Bisection, Finding
from export_model.exporter.verify.plays import VERDICTS, Interval, Player, PlayRecord
from export_model.exporter.verify.report import ParityReport, SideCause
from export_model.exporter.verify.tolerances import Tolerance
from tests.reports.made import BEGINNING, FAILING, PASSING, UNVERIFIED, comparison
from tests.reports.validation import check_parity, schema

Node = Mapping[str, Any]


def kinds(kind: type[Finding] = Finding) -> Iterator[type[Finding]]:
    """The findings that are written, by kind."""
    for each in kind.__subclasses__():
        if each.__module__ == findings.__name__:
            yield each
            yield from kinds(each)


#: One comparison that has every field.
WHOLE = comparison(
    "onnx",
    "onnxruntime",
    passed=False,
    tolerance=Tolerance(1e-3, 1e-3, "a reason"),
    worst_input=None,
    reason="a reason",
    drift=(0.5,),
    rounding=1e-7,
    smallest_tolerance=0.2,
    bisection=replace(BEGINNING, input="step 3", reason="a reason"),
    against="numpy",
    elements=40_000,
    forgiven=(Forgiven(NOT_FROM_ZERO, 6, float("inf")), Forgiven(ROUNDING, 60, 3e-5)),
)
RETURNS = Interval(9.5, 9.25, 9.75)
REPORTS = [
    PASSING,
    UNVERIFIED,
    replace(PASSING, self_consistent=True, original=None),
    replace(
        FAILING,
        comparisons=(
            *FAILING.comparisons,
            *(comparison("onnx", "onnxruntime", kind=kind) for kind in kinds()),
            WHOLE,
            replace(WHOLE, bisection=Bisection(None, reason="it runs no more")),
            replace(WHOLE, bisection=replace(BEGINNING, source=("a:0", "b:0"), got=float("-inf"))),
        ),
        whole_sizes={"onnx": 4000},
        causes=tuple(
            SideCause("onnx", side, kind, "column 1", "a sentence")
            for kind in explaining.CHANGES
            for side in ("candidate", "reference")
        ),
        played=tuple(
            PlayRecord(
                environment="Walk",
                verdict=verdict,
                sentence="a sentence",
                seed=1,
                deterministic=True,
                asked="5%",
                margin=0.5,
                reference=Player("reference", RETURNS, 200),
                players=(Player("onnx in onnxruntime", RETURNS, 200, verdict, RETURNS, "a sentence"),),
            )
            for verdict in VERDICTS
        ),
    ),
]


def documented(node: Any, place: str = "#") -> Iterator[str]:
    """Every property of a schema, and every word of its lists of words, by where it stands."""
    if isinstance(node, dict):
        yield from (f"{place}/properties/{name}" for name in node.get("properties", ()))
        yield from (f"{place}={word}" for word in node.get("enum", ()))
        for key, inner in node.items():
            yield from documented(inner, f"{place}/{key}")
    elif isinstance(node, list):
        for number, inner in enumerate(node):
            yield from documented(inner, f"{place}/{number}")


def met(whole: Node, node: Node, value: Any, place: str = "#") -> Iterator[str]:
    """Of those, what a value has."""
    if "$ref" in node:
        name = node["$ref"].rpartition("/")[2]
        yield from met(whole, whole["$defs"][name], value, f"#/$defs/{name}")
    for number, each in enumerate(node.get("anyOf", ())):
        yield from met(whole, each, value, f"{place}/anyOf/{number}")
    if "enum" in node:
        yield f"{place}={value}"
    if isinstance(value, list) and "items" in node:
        for item in value:
            yield from met(whole, node["items"], item, f"{place}/items")
    if isinstance(value, dict):
        named = node.get("properties", {})
        for name, entry in value.items():
            if name in named:
                yield f"{place}/properties/{name}"
                yield from met(whole, named[name], entry, f"{place}/properties/{name}")
            elif isinstance(node.get("additionalProperties"), dict):
                yield from met(whole, node["additionalProperties"], entry, f"{place}/additionalProperties")


def never_written(whole: Node) -> set[str]:
    """What a schema of parity.json documents and none of the reports has."""
    written = {at for report in REPORTS for at in met(whole, whole, json.loads(dumps(report.to_dict())))}
    return set(documented(whole)) - written


def test_what_is_documented_is_written() -> None:
    assert never_written(schema("parity")) == set()


@pytest.mark.parametrize(
    ("way", "change", "place"),
    [
        (("properties",), {"colour": {}}, "#/properties/colour"),
        (("$defs", "bisection", "properties"), {"colour": {}}, "#/$defs/bisection/properties/colour"),
        (
            ("$defs", "comparison", "properties", "kind", "enum"),
            "guessed",
            "#/$defs/comparison/properties/kind=guessed",
        ),
        (("$defs", "runtime", "properties", "status", "enum"), "died", "#/$defs/runtime/properties/status=died"),
    ],
)
def test_what_is_documented_and_not_written_is_found(way: tuple[str, ...], change: Any, place: str) -> None:
    whole = schema("parity")
    inner = whole
    for step in way:
        inner = inner[step]
    if isinstance(inner, list):
        inner.append(change)
    else:
        inner.update(change)
    assert never_written(whole) == {place}


@pytest.mark.parametrize("report", REPORTS)
def test_the_reports_fit(report: ParityReport) -> None:
    check_parity(dumps(report.to_dict()))


def test_the_reports_have_every_field_of_their_records() -> None:
    """A field that a record gains has to be given here, and then stands in the schema."""
    records: dict[type, set[str]] = {}

    def take(value: Any) -> None:
        if isinstance(value, msgspec.Struct):
            for field in msgspec.structs.fields(value):
                inner = getattr(value, field.name)
                if inner not in (None, "", (), {}, False, 0):
                    records.setdefault(type(value), set()).add(field.name)
                take(inner)
        elif isinstance(value, tuple):
            for item in value:
                take(item)

    take(tuple(REPORTS))
    for kind in (ParityReport, findings.Numbers, Bisection, PlayRecord, Player, Tolerance):
        lacking = {f.name for f in msgspec.structs.fields(kind)} - records[kind]
        assert not lacking, kind
    assert {*kinds()} <= records.keys()
