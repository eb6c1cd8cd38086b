"""The Markdown summary: failures first, tables that no name breaks."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from export_model.exporter.reports.markdown import markdown_text
from export_model.exporter.reports.write import Destinations, parity_documents
from tests.reports.made import FAILING, PASSING, UNVERIFIED, comparison, entry


def test_a_report_that_fails_comes_first_and_says_what_fails() -> None:
    text = markdown_text([entry(PASSING), entry(replace(FAILING, policy="broken")), entry(UNVERIFIED)])
    assert [line for line in text.splitlines() if line.startswith("### ")] == [
        "### ❌ `broken`",
        "### ⚠️ `runner`",
        "### ✅ `runner`",
    ]
    broken = text[text.index("### ❌") : text.index("### ⚠️")]
    assert broken.index("tfjs in tfjs-cpu: action differs by 0.25") < broken.index("| format |")
    for words in ("first difference: dense/BiasAdd", "smallest tolerance that would pass: 0.2", "it died"):
        assert words in broken
    assert re.search(r"\| `tfjs` \| `tfjs-cpu` \|.*\| \*\*FAIL\*\* \|", broken)
    assert "NOT VERIFIED: no independent runtime ran" in text


def test_a_report_that_passes_is_short() -> None:
    text = markdown_text([entry(PASSING)])
    assert (
        "PASSED: onnx \\(1 of 2 formats; install tfjs-cpu to check the other\\) agrees with the original in TensorFlow"
        in text
    )
    assert "❌" not in text
    assert r"a reason \| with a bar" in text
    assert "not installed; export-model runtimes install tfjs" in text


def cells(line: str) -> int:
    """Columns of a row as GitHub splits it: a bar behind a backslash is text."""
    return len(re.split(r"(?<!\\)\|", line)) - 2


@given(st.text(st.characters(codec=None), min_size=1))
def test_no_name_breaks_a_table(name: str) -> None:
    report = replace(PASSING, comparisons=(comparison("onnx", "onnxruntime", name), comparison(name, name, name)))
    text = markdown_text([entry(report)])
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert len(rows) == 2 + len({("onnx", "onnxruntime"), (name, name)})
    assert {cells(row.replace("\\\\", "")) for row in rows} <= {cells(rows[1])} or "\\" in name
    text.encode()


def test_markup_in_a_name_is_text() -> None:
    text = markdown_text([entry(replace(FAILING, notes=("<img src=x> [a](b) *c* @someone",)))])
    assert r"&lt;img src=x&gt; \[a\]\(b\) \*c\* " in text
    assert "@someone" not in text


def test_the_summary_of_a_github_step_is_appended_to_and_any_other_file_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    summary, other = tmp_path / "summary", tmp_path / "other.md"
    summary.write_text("before\n")
    other.write_text("before\n")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(summary))
    for path in (summary, other):
        Destinations(markdown=path).write(parity_documents(lambda: [entry(PASSING)]), pytest.fail)
    assert summary.read_text().startswith("before\n\n## export-model")
    assert other.read_text().startswith("## export-model")
