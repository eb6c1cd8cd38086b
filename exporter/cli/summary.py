"""A parity report as the lines that a terminal shows."""

from __future__ import annotations

import math
from collections.abc import Iterable

from exporter.cli.tables import size_text, table
from exporter.verify.report import Comparison, ParityReport
from exporter.verify.statistics import FALSE_ALARM


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
    rows = []
    for c in report.comparisons:
        if c.kind in ("numbers", "rollout"):
            sizes = [f"{c.max_abs_diff:.2e}", f"{c.max_rel_diff:.2e}", allowed(c)]
        else:  # a difference means something else there: draws have a p-value, a size has bytes
            sizes = ["", "", f"p >= {FALSE_ALARM:g}: p = {1 - c.max_abs_diff:.2g}" if c.kind == "draws" else ""]
        rows.append([c.format, c.runtime, c.output, c.kind, *sizes, c.worst_input or "", "ok" if c.passed else "FAIL"])
    head = ("format", "runtime", "output", "kind", "max |Δ|", "max |Δ| / |b|", "allowed", "worst input", "verdict")
    return table(head, rows)


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
        told = {"draws": "drawn", "shape": "drawn", "size": "kept" if c.passed else "exceeded"}.get(c.kind)
        text = told or (f"{c.max_abs_diff:.1e}" if c.max_abs_diff else "0")
        value = c.max_abs_diff if told is None else -1.0
        if c.output not in worst or value > worst[c.output][0]:
            worst[c.output] = (value, text)
    return [f"{name} {text}" for name, (_, text) in worst.items()]


def failure_lines(report: ParityReport) -> list[str]:
    """What to read about every comparison that failed: where, by how much, what would pass."""
    lines = []
    for c in report.failures:
        first, *rest = explanation(c)
        lines.append(f"  {first}")
        lines += [f"    {line}" for line in rest]
    return lines


def explanation(c: Comparison) -> list[str]:
    """Why a comparison failed, a line each: what and where, the first tensor that differs, what would pass."""
    where = f"{c.format} in {c.runtime}"
    if c.kind == "failure":
        return [f"{where}: {c.reason}"]
    if c.kind == "size":
        return [f"{c.format} is too large: {c.reason}"]
    text = f"{where}: {c.output} differs"
    if c.reason:
        text += f": {c.reason}"
    elif math.isfinite(c.max_abs_diff):
        text += f" by {c.max_abs_diff:.3g} (relative {c.max_rel_diff:.3g}), allowed {allowed(c)}"
    return [line for line in (f"{text} [{c.kind}, {c.worst_input}]", first_difference(c), would_pass(c)) if line]


def allowed(c: Comparison) -> str:
    """The bound of a comparison, as a formula."""
    return f"{c.tolerance.atol:g} + {c.tolerance.rtol:g}·|reference|"


def first_difference(c: Comparison) -> str | None:
    """Where a disagreement begins, in a line; None where it was not looked for."""
    found = c.bisection
    if found is None:
        return None
    if found.tensor is None:
        return f"first difference: not found, {found.reason}"
    text = f"first difference: {found.tensor}"
    if found.op:
        text += f" ({found.op})"
    if found.source:
        text += f", in the source {found.source if isinstance(found.source, str) else ', '.join(found.source)}"
    if found.expected is not None and found.got is not None:
        place = "" if found.index is None else f" at {list(found.index)}"
        text += f":{place} expected {found.expected:.8g}, got {found.got:.8g}"
    if found.input is not None:
        text += f", fed {found.input}"
    if found.hidden:
        text += f"; not seen before it: {', '.join(found.hidden)}"
    return f"{text}; {found.reason}" if found.reason else text


def would_pass(c: Comparison) -> str | None:
    """The smallest tolerance that would pass, where a comparison failed and one would."""
    if c.passed or c.smallest_tolerance is None:
        return None
    return f"smallest tolerance that would pass: {_rounded_up(c.smallest_tolerance)}, as atol and rtol"


def _rounded_up(value: float) -> str:
    """Three digits, never less than ``value``: who gives it as a tolerance must pass."""
    if value <= 0:
        return "0"
    digit = 10.0 ** (math.floor(math.log10(value)) - 2)
    text = f"{value:.3g}"
    return text if float(text) >= value else f"{float(text) + digit:.3g}"


def verdict(report: ParityReport) -> str:
    """One line."""
    if report.passed is None:
        return "NOT VERIFIED: no independent runtime ran"
    pairs = {
        (c.format, c.runtime)
        for c in report.comparisons
        if c.format not in ("reference", "golden") and c.kind != "size"
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
        if "later version" not in (entry["reason"] or "")
    ]
