"""A parity report as the lines that a terminal shows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from export_model.converters.formats.registry import WRITTEN
from export_model.exporter.tables import count_text, size_with_original, table
from export_model.exporter.verify.findings import Failure, Finding, Undecided
from export_model.exporter.verify.report import ParityReport
from export_model.exporter.verify.verdict import key_of, missing_runtimes
from export_model.signatures.fields import printable


def parity_table(report: ParityReport) -> str:
    """Verdict, format, runtime, size, and the largest share of what is allowed with its output."""
    rows = []
    for pair in report.pairs:
        shown = size_with_original(pair.format, report.sizes, report.whole_sizes)
        rows.append([pair.word, pair.format, pair.runtime, shown, pair.worst_text])
    return table(("verdict", "format", "runtime", "size", "of tolerance"), rows)


def comparison_table(report: ParityReport) -> str:
    """Every comparison on a line of its own, by format and runtime."""
    head = ("verdict", "output", "kind", "of tolerance", "|Δ|", "|Δ| / |b|", "allowed", "worst input")
    parts = []
    for pair in report.pairs:
        rows = [[_word(c.passed), _output(c), c.kind, *c.columns(), c.worst_input or ""] for c in pair.findings]
        told = [f"{c.output} [{c.kind}]: {c.forgiven_text}" for c in pair.findings if c.forgiven]
        parts.append("\n".join([f"{pair.format} in {pair.runtime}", table(head, rows), *_forgiven_lines(told)]))
    return "\n\n".join(parts)


def foreign_words(report: ParityReport) -> list[str]:
    """What programs said when they failed, each line marked as theirs, in printable characters."""
    lines = []
    for found in report.failures:
        if isinstance(found, Failure) and found.said:
            lines += [f"{found.where} said, in its own words:"]
            lines += [f"  | {printable(line)}" for line in found.said.splitlines()]
    return lines


def _forgiven_lines(told: Sequence[str]) -> list[str]:
    return ["forgiven beyond the tolerance (docs/agreement.md):", *(f"  {line}" for line in told)] if told else []


def _word(passed: bool) -> str:
    return "ok" if passed else "FAIL"


def _output(found: Finding) -> str:
    """What a finding is of; one that is of a whole file names no output."""
    return "" if found.output == "*" else found.output


def failure_lines(report: ParityReport) -> list[str]:
    """What to read about every comparison that failed: where, by how much, what would pass."""
    lines = []
    told = [c for c in report.failures if not isinstance(c, Undecided)]  # the verdict says why nothing was decided
    for c in told:
        first, *rest = c.explanation()
        lines.append(f"  {first}")
        lines += [f"    {line}" for line in rest]
    return lines


def not_run_line(report: ParityReport) -> str | None:
    """Runtimes that could have run but are not installed, in one line; None where there are none."""
    missing = _missing(report)
    if not missing:
        return None
    more = f" and {len(missing) - 3} more" if len(missing) > 4 else ""
    shown = ", ".join(list(missing)[: 3 if more else 4])
    return f"not run here: {shown}{more}    (export-model runtimes says how to install them)"


def _missing(report: ParityReport) -> dict[str, str]:
    """Runtime that is not installed and runs what was written → how to install it."""
    kinds = [WRITTEN[key] for key in map(key_of, report.sizes) if key in WRITTEN]
    useful = {name for kind in kinds for name in kind.runtimes}
    states = {n: e for n, e in report.runtimes.items() if not kinds or n in useful}
    found = {n: e["reason"] or "" for n, e in states.items() if e["status"] == "not run"}
    return {n: r.removeprefix("not installed; ") for n, r in found.items() if r.startswith("not installed; ")}


def to_verify(report: ParityReport) -> str | None:
    """The one command that gets a runtime to compare in, the lightest there is; None where all are here."""
    missing = _missing(report)
    install, _ = missing_runtimes(report, report.unchecked) if report.undecided else ([], [])
    if install:
        return missing.get(install[0])
    return missing.get("onnxruntime") or next(iter(missing.values()), None)


def whole_summary(reports: Sequence[ParityReport], refused: int = 0) -> str:
    """Many policies in one line, with how many files or bundles were refused."""
    counts = Counter(r.verdict for r in reports)
    said = ", ".join(f"{counts[v]} {v}" for v in ("passed", "self-consistent", "failed", "not verified") if counts[v])
    failed = [r.policy for r in reports if r.passed is False]
    named = f" ({', '.join(failed[:5])}{', …' if len(failed) > 5 else ''})" if failed else ""
    measured = [(c, r.policy) for r in reports for c in r.comparisons if c.measured and c.passed]
    worst = max(measured, key=lambda found: found[0].share, default=None)
    most = ""
    if worst is not None and not failed:
        most = f"; at most {worst[0].cell()} of the tolerance: {worst[0].output} of {worst[1]}, {worst[0].where}"
    partial = sum(r.partial for r in reports)
    some = f"; {partial} in part: not every format was checked" if partial else ""
    told = [f"{count_text(len(reports), 'policy', 'policies')}: {said}{named}{some}{most}"] if reports else []
    return "; ".join([*told, *([f"{refused} REFUSED"] if refused else [])])
