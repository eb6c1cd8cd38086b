"""A parity report as the lines that a terminal shows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from exporter.tables import sized, table
from exporter.verify.findings import Accepted, Decisions, Draws, Size
from exporter.verify.report import ParityReport

UNVERIFIED = "NOT VERIFIED: no independent runtime ran"


def parity_table(report: ParityReport) -> str:
    """Verdict, format, runtime, size, and the worst difference with its output."""
    rows = []
    for pair in report.pairs:
        shown = sized(pair.format, report.sizes, report.whole_sizes)
        rows.append([_word(pair.passed), pair.format, pair.runtime, shown, pair.worst_text])
    return table(("verdict", "format", "runtime", "size", "worst |Δ|"), rows)


def comparison_table(report: ParityReport) -> str:
    """Every comparison on a line of its own, by format and runtime."""
    head = ("verdict", "output", "kind", "|Δ|", "|Δ| / |b|", "allowed", "worst input")
    parts = []
    for pair in report.pairs:
        rows = [[_word(c.passed), c.output, c.kind, *c.columns(), c.worst_input or ""] for c in pair.findings]
        parts.append(f"{pair.format} in {pair.runtime}\n{table(head, rows)}")
    return "\n\n".join(parts)


def _word(passed: bool) -> str:
    return "ok" if passed else "FAIL"


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
        return f"NOT VERIFIED: {report.undecided}" if report.undecided else UNVERIFIED
    pairs = {
        (c.format, c.runtime)
        for c in report.comparisons
        if c.format not in ("reference", "golden") and not isinstance(c, (Decisions, Size))
    }
    count, seen = len(pairs), {kind.partition(":")[0] for kind, _ in pairs}
    unseen = [kind for kind in report.sizes if kind.partition(":")[0] not in seen]
    rest = f"; not verified: {', '.join(unseen)}" if unseen else ""
    if report.verdict == "self-consistent":
        rest = f"; nothing runs the source{rest}"
        return f"SELF-CONSISTENT: {count} format/runtime pairs agree with {report.reference}{rest}"
    if report.passed:
        return f"PASSED: {count} format/runtime pairs agree with {report.reference}{rest}{_apart(report)}"
    failed = f"{len(report.failures)} of {len(report.comparisons)} comparisons disagree with {report.reference}"
    return f"FAILED: {failed}{_apart(report)}"


def _apart(report: ParityReport) -> str:
    """A clause on what was drawn, and what follows from it, where the source has nothing to hold it against."""
    apart = [c for c in report.comparisons if c.against]
    drawn = list(dict.fromkeys(c.output for c in apart if isinstance(c, Draws)))
    if not drawn:
        return ""
    told = [*dict.fromkeys(c.output for c in apart if c.output not in drawn), f"the draws of {', '.join(drawn)}"]
    return f"; compared between the formats, not with the source: {', '.join(told)}"


def not_run_line(report: ParityReport) -> str | None:
    """Runtimes that could have run but are not installed, in one line; None where there are none."""
    missing = _missing(report)
    if not missing:
        return None
    more = f" and {len(missing) - 3} more" if len(missing) > 4 else ""
    shown = ", ".join(list(missing)[: 3 if more else 4])
    return f"not run here: {shown}{more}    (export-model runtimes says how to install them)"


def _missing(report: ParityReport) -> dict[str, str]:
    """Runtime that is not installed → how to install it."""
    found = {n: e["reason"] or "" for n, e in report.runtimes.items() if e["status"] == "not run"}
    return {n: r.removeprefix("not installed; ") for n, r in found.items() if r.startswith("not installed; ")}


def to_verify(report: ParityReport) -> str | None:
    """The one command that gets a runtime to compare in, the lightest there is; None where all are here."""
    missing = _missing(report)
    return missing.get("onnxruntime") or next(iter(missing.values()), None)


def whole_summary(reports: Sequence[ParityReport], refused: int = 0) -> str:
    """Many policies in one line, with how many files or bundles were refused."""
    counts = Counter(r.verdict for r in reports)
    said = ", ".join(f"{counts[v]} {v}" for v in ("passed", "self-consistent", "failed", "not verified") if counts[v])
    failed = [r.policy for r in reports if r.passed is False]
    named = f" ({', '.join(failed[:5])}{', …' if len(failed) > 5 else ''})" if failed else ""
    measured = [(c, r.policy) for r in reports for c in r.comparisons if c.measured and c.passed]
    worst = max(measured, key=lambda found: found[0].max_abs_diff, default=None)
    most = ""
    if worst is not None and not failed:
        most = f"; worst |Δ| {worst[0].cell()}: {worst[0].output} of {worst[1]}, {worst[0].where}"
    told = [f"{len(reports)} {'policy' if len(reports) == 1 else 'policies'}: {said}{named}{most}"] if reports else []
    return "; ".join([*told, *([f"{refused} REFUSED"] if refused else [])])
