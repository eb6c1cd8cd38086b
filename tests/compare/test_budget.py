"""The size budget."""

from __future__ import annotations

import pytest

from export_model.exporter.verify.checks.size import check_budget, parse_budget, sizes
from export_model.signatures.errors import UsageError

WRITTEN = {"tfjs": 50_000, "onnx": 30_000}


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


def test_a_budget_that_is_kept_passes() -> None:
    assert [f.passed for f in sizes({"tfjs": 50_000, "total": 80_000}, WRITTEN)] == [True, True]


@pytest.mark.parametrize(("name", "most"), [("tfjs", 49_999), ("total", 79_999), ("onnx", 0)])
def test_what_is_larger_fails_and_says_by_how_much(name: str, most: int) -> None:
    (found,) = sizes({name: most}, WRITTEN)
    assert not found.passed
    assert (found.format, found.kind) == (name, "size")
    assert "and the budget is" in found.reason


def test_a_format_that_was_not_written_has_no_budget() -> None:
    with pytest.raises(UsageError, match="unknown format") as caught:
        check_budget({"tfsj": 1}, WRITTEN)
    assert "tfjs" in (caught.value.fix or "")
