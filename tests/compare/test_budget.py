"""The size budget."""

from __future__ import annotations

import pytest

from exporter.verify.budget import held_to, parse_budget
from exporter.verify.report import ParityReport
from signatures.errors import UsageError


def report(passed: bool | None = True) -> ParityReport:
    return ParityReport("p", passed, 0, 2, "numpy", {}, (), {"tfjs": 50_000, "onnx": 30_000})


@pytest.mark.parametrize(
    ("text", "budget"),
    [
        ("tfjs=60kB", {"tfjs": 60_000}),
        ("1.5MB", {"total": 1_500_000}),
        ("onnx=64KiB", {"onnx": 65_536}),
        ("total=80000", {"total": 80_000}),
        ("tfjs = 3 b", {"tfjs": 3}),
    ],
)
def test_sizes_are_read_with_their_units(text: str, budget: dict[str, int]) -> None:
    assert parse_budget([text]) == budget


@pytest.mark.parametrize("text", ["", "tfjs=", "=60kB", "tfjs=60kg", "tfjs=-1", "60 k B", "nan", "1e3"])
def test_what_is_no_size_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--max-size"):
        parse_budget([text])


@pytest.mark.parametrize("passed", [True, False, None])
def test_within_the_budget_nothing_changes(passed: bool | None) -> None:
    held = held_to(report(passed), {"tfjs": 50_000, "total": 80_000})
    assert held.passed is passed
    assert [c.passed for c in held.comparisons] == [True, True]


@pytest.mark.parametrize(("name", "most"), [("tfjs", 49_999), ("total", 79_999), ("onnx", 0)])
def test_what_is_larger_fails_and_says_by_how_much(name: str, most: int) -> None:
    held = held_to(report(), {name: most})
    assert held.passed is False
    (failure,) = held.failures
    assert (failure.format, failure.kind) == (name, "size")
    assert "and the budget is" in failure.reason


def test_a_format_that_was_not_written_has_no_budget() -> None:
    with pytest.raises(UsageError, match="no such format") as caught:
        held_to(report(), {"tfsj": 1})
    assert "tfjs" in (caught.value.fix or "")
