"""A parity report as the lines that a terminal shows."""

from __future__ import annotations

import math
from collections.abc import Iterable

from exporter.parity.report import Comparison, ParityReport
from exporter.tables import size_text, table


def parity_table(report: ParityReport) -> str:
    """Format, runtime, size, worst difference of each output, verdict."""
    rows = []
    for (kind, runtime), group in _groups(report.comparisons).items():
        failed = [c for c in group if not c.passed]
        base = kind.split(":")[0]
        size = report.sizes.get(base)
        rows.append(
            [
                kind,
                runtime,
                size_text(size) if size is not None and ":" not in kind else "",
                ", ".join(_worst_by_output(group)) or "-",
                "FAIL" if failed else "ok",
            ]
        )
    return table(("format", "runtime", "size", "max |Δ| per output", "verdict"), rows)


def _groups(comparisons: Iterable[Comparison]) -> dict[tuple[str, str], list[Comparison]]:
    groups: dict[tuple[str, str], list[Comparison]] = {}
    for comparison in comparisons:
        groups.setdefault((comparison.format, comparison.runtime), []).append(comparison)
    return groups


def _worst_by_output(group: Iterable[Comparison]) -> list[str]:
    worst: dict[str, tuple[float, str]] = {}
    for c in group:
        if c.kind == "failure":
            continue
        text = "drawn" if c.kind in ("draws", "shape") else f"{c.max_abs_diff:.1e}" if c.max_abs_diff else "0"
        value = -1.0 if c.kind in ("draws", "shape") else c.max_abs_diff
        if c.output not in worst or value > worst[c.output][0]:
            worst[c.output] = (value, text)
    return [f"{name} {text}" for name, (_, text) in worst.items()]


def failure_lines(report: ParityReport) -> list[str]:
    """One line per comparison that failed: where, by how much, what would pass."""
    lines = []
    for c in report.failures:
        where = f"{c.format} in {c.runtime}"
        if c.kind == "failure":
            lines.append(f"  {where}: {c.reason}")
            continue
        text = f"  {where}: {c.output} differs"
        if c.reason:
            text += f": {c.reason}"
        elif math.isfinite(c.max_abs_diff):
            text += f" by {c.max_abs_diff:.3g} (relative {c.max_rel_diff:.3g}), allowed {c.tolerance.atol:g} + "
            text += f"{c.tolerance.rtol:g}·|reference|"
        lines.append(f"{text} [{c.kind}, {c.worst_input}]")
    return lines


def verdict(report: ParityReport) -> str:
    """One line."""
    if report.passed is None:
        return "NOT VERIFIED: no independent runtime ran"
    count = len({(c.format, c.runtime) for c in report.comparisons if c.format != "reference"})
    if report.verdict == "self-consistent":
        return f"SELF-CONSISTENT: {count} format/runtime pairs agree with {report.reference}; nothing runs the source"
    if report.passed:
        return f"PASSED: {count} format/runtime pairs agree with {report.reference}"
    return f"FAILED: {len(report.failures)} of {len(report.comparisons)} comparisons disagree with {report.reference}"


def not_run_lines(report: ParityReport) -> list[str]:
    """Runtimes that could have run but are not installed, with the command that installs them."""
    return [
        f"  not run: {name} ({entry['reason']})"
        for name, entry in report.runtimes.items()
        if entry["status"] == "not run" and (entry["reason"] or "").startswith("not installed;")
        if "later version" not in (entry["reason"] or "")
    ]
