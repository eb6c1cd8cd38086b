"""The comparisons of a report as a table: a row per format and runtime, a column per output."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from exporter.verify.report import Comparison, ParityReport


@dataclass(frozen=True, slots=True)
class Cell:
    """The worst comparison of one output; ``text`` is its difference in short."""

    worst: Comparison
    passed: bool
    text: str


@dataclass(frozen=True, slots=True)
class Row:
    """One format in one runtime; ``reason`` says why it gave no answer at all."""

    format: str
    runtime: str
    size: int | None
    cells: Mapping[str, Cell]
    reason: str | None

    @property
    def passed(self) -> bool:
        """Whether all of it agrees."""
        return self.reason is None and all(c.passed for c in self.cells.values())


@dataclass(frozen=True, slots=True)
class Matrix:
    """Rows and columns, in the order of the report."""

    outputs: tuple[str, ...]
    rows: tuple[Row, ...]


def matrix(report: ParityReport) -> Matrix:
    """The table of ``report``."""
    groups: dict[tuple[str, str], list[Comparison]] = {}
    for c in report.comparisons:
        groups.setdefault((c.format, c.runtime), []).append(c)
    rows = []
    for (kind, runtime), group in groups.items():
        by_output: dict[str, list[Comparison]] = {}
        for c in group:
            if c.kind != "failure":
                by_output.setdefault(c.output, []).append(c)
        reasons = [c.reason for c in group if c.kind == "failure"]
        cells = {output: _cell(found) for output, found in by_output.items()}
        rows.append(Row(kind, runtime, report.sizes.get(kind), cells, reasons[0] if reasons else None))
    outputs = tuple(dict.fromkeys(c.output for c in report.comparisons if c.kind != "failure"))
    return Matrix(outputs, tuple(rows))


def _cell(comparisons: list[Comparison]) -> Cell:
    """The worst of an output's numbers, rollout and draws."""
    worst = max(comparisons, key=lambda c: (not c.passed, c.kind in ("numbers", "rollout"), c.max_abs_diff))
    return Cell(worst, worst.passed, short(worst))


def short(c: Comparison) -> str:
    """A difference in a few characters."""
    if c.kind in ("draws", "shape"):
        return "drawn" if c.passed else "✗ drawn"
    if c.kind == "size":
        return "kept" if c.passed else "✗ exceeded"
    if c.reason and not c.passed:
        return f"✗ {c.reason.split(' instead of')[0]}" if len(c.reason) < 40 else "✗"
    return "0" if c.max_abs_diff == 0 else f"{c.max_abs_diff:.1e}"
