"""A parity report as the lines that a terminal shows."""

from __future__ import annotations

from collections.abc import Iterable

from exporter.cli.tables import size_text, table
from exporter.verify.findings import Accepted, Failure, Finding, Size
from exporter.verify.report import ParityReport


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


def comparison_table(report: ParityReport) -> str:
    """Every comparison on a line of its own."""
    rows = [
        [c.format, c.runtime, c.output, c.kind, *c.columns(), c.worst_input or "", "ok" if c.passed else "FAIL"]
        for c in report.comparisons
    ]
    head = ("format", "runtime", "output", "kind", "max |Δ|", "max |Δ| / |b|", "allowed", "worst input", "verdict")
    return table(head, rows)


def _groups(comparisons: Iterable[Finding]) -> dict[tuple[str, str], list[Finding]]:
    groups: dict[tuple[str, str], list[Finding]] = {}
    for comparison in comparisons:
        groups.setdefault((comparison.format, comparison.runtime), []).append(comparison)
    return groups


def _worst_by_output(group: Iterable[Finding]) -> list[str]:
    worst: dict[str, tuple[float, str]] = {}
    for c in group:
        if isinstance(c, Failure):
            continue
        value = c.max_abs_diff if c.measured else -1.0
        if c.output not in worst or value > worst[c.output][0]:
            worst[c.output] = (value, c.cell())
    return [f"{name} {text}" for name, (_, text) in worst.items()]


def failure_lines(report: ParityReport) -> list[str]:
    """What to read about every comparison that failed: where, by how much, what would pass."""
    lines = []
    for c in report.failures:
        first, *rest = c.explanation()
        lines.append(f"  {first}")
        lines += [f"    {line}" for line in rest]
    return lines


def verdict(report: ParityReport) -> str:
    """One line."""
    if report.passed is None:
        said = [c.runtime for c in report.comparisons if isinstance(c, Accepted)]
        if said:
            return f"ACCEPTED by the checks of {', '.join(said)}; no numbers were compared"
        return "NOT VERIFIED: no independent runtime ran"
    pairs = {
        (c.format, c.runtime)
        for c in report.comparisons
        if c.format not in ("reference", "golden") and not isinstance(c, Size)
    }
    count, seen = len(pairs), {kind.partition(":")[0] for kind, _ in pairs}
    unseen = [kind for kind in report.sizes if kind.partition(":")[0] not in seen]
    rest = f"; not verified: {', '.join(unseen)}" if unseen else ""
    if report.verdict == "self-consistent":
        rest = f"; nothing runs the source{rest}"
        return f"SELF-CONSISTENT: {count} format/runtime pairs agree with {report.reference}{rest}"
    if report.passed:
        return f"PASSED: {count} format/runtime pairs agree with {report.reference}{rest}"
    return f"FAILED: {len(report.failures)} of {len(report.comparisons)} comparisons disagree with {report.reference}"


def not_run_lines(report: ParityReport) -> list[str]:
    """Runtimes that could have run but are not installed, with the command that installs them."""
    return [
        f"  not run: {name} ({entry['reason']})"
        for name, entry in report.runtimes.items()
        if entry["status"] == "not run" and (entry["reason"] or "").startswith("not installed;")
    ]
