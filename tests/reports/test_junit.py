"""JUnit XML, parsed again and read case by case."""

from __future__ import annotations

import xml.etree.ElementTree as ET

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from export_model.exporter.reports.junit import junit_xml
from export_model.exporter.verify.report import ParityReport
from tests.reports.made import FAILING, PASSING, UNVERIFIED, entry

#: element → (attributes it must have, others it may have, elements inside): what Jenkins's junit-10 schema allows
ALLOWED = {
    "testsuites": ({"name"}, {"tests", "failures", "errors", "time"}, {"testsuite"}),
    "testsuite": (
        {"name", "tests", "failures", "errors"},
        {"skipped", "time", "timestamp", "hostname", "id", "package", "file"},
        {"properties", "testcase"},
    ),
    "properties": (set(), set(), {"property"}),
    "property": ({"name", "value"}, set(), set()),
    "testcase": ({"name"}, {"classname", "time"}, {"skipped", "error", "failure"}),
    "failure": (set(), {"type", "message"}, set()),
    "error": (set(), {"type", "message"}, set()),
    "skipped": (set(), {"type", "message"}, set()),
}


def parsed(*reports: ParityReport) -> ET.Element:
    """The file of ``reports``, checked for its form and its sums."""
    root = ET.fromstring(junit_xml([entry(r) for r in reports]))
    for element in root.iter():
        needed, more, inside = ALLOWED[element.tag]
        assert needed <= set(element.keys()) <= needed | more
        assert {child.tag for child in element} <= inside
    for suite in root:
        for key, tag in (("tests", "testcase"), ("failures", "failure"), ("errors", "error"), ("skipped", "skipped")):
            assert int(suite.get(key, "")) == len(list(suite.iter(tag)))
    for key in ("tests", "failures", "errors"):
        assert int(root.get(key, "")) == sum(int(s.get(key, "")) for s in root)
    return root


def outcomes(root: ET.Element) -> dict[tuple[str, str], str]:
    return {
        (case.get("classname", ""), case.get("name", "")): case[0].tag if len(case) else "passed"
        for case in root.iter("testcase")
    }


def test_a_report_that_passes_has_a_case_per_runtime_and_output() -> None:
    root = parsed(PASSING)
    assert [s.get("name") for s in root] == ["runner.reference", "runner.onnx", "runner.tfjs"]
    assert outcomes(root) == {
        ("runner.reference.numpy", "action"): "passed",
        ("runner.onnx.onnxruntime", "action"): "passed",  # its numbers and its rollout
        ("runner.onnx.onnxruntime", "value_estimate"): "passed",
        ("runner.tfjs.tfjs-cpu", "not run"): "skipped",
    }
    skipped = next(root.iter("skipped"))
    assert skipped.get("message") == "not installed; export-model runtimes install tfjs"
    properties = {p.get("name"): p.get("value") for p in root[1].iter("property")}
    assert properties["version.onnxruntime"] == "1.31"
    assert (properties["bytes"], properties["seed"]) == ("1234", "3")


def test_a_failure_says_by_how_much_where_it_begins_and_what_would_pass() -> None:
    root = parsed(FAILING)
    found = outcomes(root)
    assert found["runner.tfjs.tfjs-cpu", "action"] == "failure"
    assert found["runner.tfjs.tfjs-cpu", "value_estimate"] == "failure"
    assert found["runner.bytes.tensorflow", "runs"] == "error"
    assert found["runner.onnx.onnxruntime", "action"] == "passed"
    first, second = list(root.iter("failure"))
    assert "differs by 0.25" in str(first.get("message"))
    for words in ("dense/BiasAdd", "main/BiasAdd:0", "expected 0.25, got 0.5", "dense/MatMul", "pass: 0.2", "[rollout"):
        assert words in str(first.text)
    assert "shape [1] instead of [2]" in str(second.get("message"))
    error = next(root.iter("error"))
    assert error.get("message") == "bytes in tensorflow: it died"


def test_nothing_verified_is_skipped_not_passed() -> None:
    report = replace(
        UNVERIFIED,
        runtimes={**UNVERIFIED.runtimes, "onnxruntime": {"version": None, "status": "not run", "reason": "no"}},
    )
    found = outcomes(parsed(report))
    assert found == {
        ("runner.reference.numpy", "action"): "passed",
        ("runner.onnx.onnxruntime", "not run"): "skipped",
        ("runner.tfjs.tfjs-cpu", "not run"): "skipped",
    }


def test_many_policies_are_one_file() -> None:
    root = parsed(PASSING, replace(FAILING, policy="other"))
    assert {str(s.get("name")).split(".")[0] for s in root} == {"runner", "other"}


@given(st.text(st.characters(codec=None), min_size=1), st.text(min_size=1))
def test_no_name_breaks_the_file(name: str, reason: str) -> None:
    bad = replace(FAILING.comparisons[-1], reason=reason, output=name)
    root = parsed(replace(FAILING, policy=name, comparisons=(bad,)))
    assert len(list(root.iter("error"))) == 1
