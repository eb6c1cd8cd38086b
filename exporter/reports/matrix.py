"""The comparisons of a report as a table: a row per format and runtime, a column per output."""

from __future__ import annotations

from collections.abc import Mapping

from exporter.tables import sized
from exporter.verify.findings import Failure, Finding
from exporter.verify.report import ParityReport
from signatures.records import dataclass


@dataclass(frozen=True, slots=True)
class Cell:
    """The worst comparison of one output; ``text`` is its difference in short."""

    worst: Finding
    passed: bool
    text: str


@dataclass(frozen=True, slots=True)
class Row:
    """One format in one runtime; ``reason`` says why it gave no answer at all, ``size`` may be empty."""

    format: str
    runtime: str
    size: str
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
    rows = []
    for pair in report.pairs:
        by_output: dict[str, list[Finding]] = {}
        for c in pair.findings:
            if not isinstance(c, Failure):
                by_output.setdefault(c.output, []).append(c)
        reasons = [c.reason for c in pair.findings if isinstance(c, Failure)]
        cells = {output: _cell(found) for output, found in by_output.items()}
        size = sized(pair.format, report.sizes, report.whole_sizes)
        rows.append(Row(pair.format, pair.runtime, size, cells, next(iter(reasons), None)))
    outputs = tuple(dict.fromkeys(c.output for c in report.comparisons if not isinstance(c, Failure)))
    return Matrix(outputs, tuple(rows))


def _cell(comparisons: list[Finding]) -> Cell:
    """The worst of an output's numbers, rollout and draws."""
    worst = max(comparisons, key=lambda c: (not c.passed, c.measured, c.max_abs_diff))
    return Cell(worst, worst.passed, short(worst))


def short(c: Finding) -> str:
    """A difference in a few characters."""
    if not c.measured:
        return c.cell() if c.passed else f"✗ {c.cell()}"
    if c.reason and not c.passed:
        return f"✗ {c.reason.split(' instead of')[0]}" if len(c.reason) < 40 else "✗"
    return c.cell()
