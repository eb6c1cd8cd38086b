"""JUnit XML: one test suite per policy and format, one test case per runtime and output.

The elements and attributes are those that pytest writes and Jenkins reads (its junit-10 schema). ``time`` is left out:
comparisons share the runs that they are made of.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence

from export_model.converters.formats.registry import FORMATS
from export_model.exporter.reports.entry import Entry
from export_model.exporter.reports.refused import place_of
from export_model.exporter.verify.findings import Failure, Finding
from export_model.exporter.verify.plays import DIFFERENT, NOT_DECIDED, PlayRecord
from export_model.signatures.errors import ExportModelError
from export_model.signatures.fields import printable


def junit_xml(entries: Sequence[Entry], refused: Sequence[ExportModelError] = ()) -> bytes:
    """The whole file, UTF-8; what was refused has a suite with one error."""
    return junit_file([*map(_refused_suite, refused), *(suite for entry in entries for suite in suites_of(entry))])


def _refused_suite(error: ExportModelError) -> ET.Element:
    suite = ET.Element("testsuite", name=_text(place_of(error)))
    case = ET.SubElement(suite, "testcase", classname=_text(place_of(error)), name="refused")
    kind = f"export-model.{type(error).__name__}"
    ET.SubElement(case, "error", type=kind, message=_text(error.what)).text = _text(error.message)
    count_cases(suite)
    return suite


def junit_file(suites: Sequence[ET.Element]) -> bytes:
    """Return a file of suites, UTF-8."""
    root = ET.Element("testsuites", name="export-model")
    root.extend(suites)
    for key in ("tests", "failures", "errors"):
        root.set(key, str(sum(int(s.get(key, "0")) for s in suites)))
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True)) + b"\n"


def suites_of(entry: Entry) -> Iterable[ET.Element]:
    """Return the suites of one policy, a suite for each format."""
    report = entry.report
    ran: dict[str, dict[tuple[str, str, str], list[Finding]]] = {}
    for c in report.comparisons:
        # Signatures of a SavedModel are cases of its suite, told apart by their class name.
        suite = ran.setdefault(c.format.partition(":")[0], {})
        suite.setdefault((c.format, c.runtime, c.output), []).append(c)
    missing = _not_run(entry)
    for kind in dict.fromkeys([*ran, *missing]):
        suite_element = ET.Element("testsuite", name=_text(f"{report.policy}.{kind}"))
        properties = ET.SubElement(suite_element, "properties")
        for name, value in _properties(entry, kind):
            ET.SubElement(properties, "property", name=name, value=_text(value))
        for (label, runtime, output), comparisons in ran.get(kind, {}).items():
            place = f"{report.policy}.{label}.{runtime}"
            case = ET.SubElement(
                suite_element, "testcase", classname=_text(place), name=_text("runs" if output == "*" else output)
            )
            _outcome(case, comparisons)
        for runtime, reason in missing.get(kind, {}).items():
            place = f"{report.policy}.{kind}.{runtime}"
            case = ET.SubElement(suite_element, "testcase", classname=_text(place), name="not run")
            ET.SubElement(case, "skipped", type="export-model.not-run", message=_text(reason))
        count_cases(suite_element)
        yield suite_element
    yield from (play_suite(report.policy, record) for record in report.played)


def play_suite(policy: str, record: PlayRecord) -> ET.Element:
    """Return a suite of returns, a case for everything that played."""
    suite = ET.Element("testsuite", name=_text(f"{policy}.play.{record.environment}"))
    properties = ET.SubElement(suite, "properties")
    facts = {
        "verdict": record.sentence,
        "episodes": record.reference.episodes,
        "seed": record.seed,
        "margin": record.margin,
    }
    for name, value in facts.items():
        ET.SubElement(properties, "property", name=name, value=_text(str(value)))
    for player in record.players:
        case = ET.SubElement(suite, "testcase", classname=_text(f"{policy}.{player.place}"), name="returns")
        message = _text(f"{player.name}: {player.sentence}")
        if player.verdict == DIFFERENT:
            ET.SubElement(case, "failure", type="export-model.returns", message=message).text = message
        elif player.verdict == NOT_DECIDED:
            ET.SubElement(case, "skipped", type="export-model.not-decided", message=message)
    count_cases(suite)
    return suite


def count_cases(suite: ET.Element) -> None:
    """Write into a suite how many cases it has, and what came of them."""
    for key, tag in (("tests", "testcase"), ("failures", "failure"), ("errors", "error"), ("skipped", "skipped")):
        suite.set(key, str(len(list(suite.iter(tag)))))


def _properties(entry: Entry, kind: str) -> Iterable[tuple[str, str]]:
    report = entry.report
    yield from (
        ("verdict", report.sentence),
        ("partial", str(report.partial).lower()),
        ("reference", report.reference),
        ("seed", str(report.seed)),
    )
    if kind in report.sizes:
        yield "bytes", str(report.sizes[kind])
    for name in dict.fromkeys(c.runtime for c in report.comparisons if c.format.partition(":")[0] == kind):
        version = report.runtimes.get(name, {}).get("version")
        if version:
            yield f"version.{name}", version


def _outcome(case: ET.Element, comparisons: Sequence[Finding]) -> None:
    """At most one failure or error per case, as readers expect; its text has all that went wrong."""
    failed = [c for c in comparisons if not c.passed]
    lines = [line for c in failed for line in c.explanation()]
    if failed:
        kind = "error" if all(isinstance(c, Failure) for c in failed) else "failure"
        element = ET.SubElement(case, kind, type=f"export-model.{failed[0].kind}", message=_text(lines[0]))
        element.text = _text("\n".join(lines))
    if forgiven := [f"{c.kind}: {c.forgiven_text}" for c in comparisons if c.forgiven]:
        ET.SubElement(case, "system-out").text = _text("forgiven beyond the tolerance\n" + "\n".join(forgiven))


def _not_run(entry: Entry) -> dict[str, dict[str, str]]:
    """Format → runtime → why it did not run, for the formats of this policy."""
    missing: dict[str, dict[str, str]] = {}
    for runtime, state in entry.report.runtimes.items():
        if state["status"] != "not run":
            continue
        formats = [f.key for f in FORMATS if runtime in f.runtimes and f.key in entry.report.sizes]
        for kind in formats:
            missing.setdefault(kind, {})[runtime] = state["reason"] or "not run"
    return missing


def _text(text: str) -> str:
    return printable(text, "\t\n")
