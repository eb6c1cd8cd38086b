"""A Markdown summary for a CI job's page: verdicts first, then failures, then who compared what."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from export_model.exporter.reports.entry import Entry
from export_model.exporter.reports.refused import place_of
from export_model.exporter.tables import size_with_original
from export_model.exporter.verify.plays import CONFIDENCE, DIFFERENT, EQUIVALENT, NOT_DECIDED, PlayRecord
from export_model.exporter.verify.report import ParityReport
from export_model.signatures.errors import ExportModelError
from export_model.signatures.fields import printable

#: What the numbers of the table are.
_CELLS = "Numbers are the largest difference as a share of what is allowed."
#: Behind an @, so that no user is called by it.
UNSEEN = "\u200b"
_MARKS = {True: "✅", False: "❌", None: "⚠️"}
PLAY_MARKS = {EQUIVALENT: _MARKS[True], DIFFERENT: _MARKS[False], NOT_DECIDED: _MARKS[None]}


def markdown_text(entries: Sequence[Entry], refused: Sequence[ExportModelError] = ()) -> str:
    """The whole document; what was refused comes first, then failed policies."""
    ordered = sorted(entries, key=lambda e: (e.report.passed is not False, e.report.passed is not None))
    lines = ["## export-model", ""]
    if len(entries) + len(refused) > 1:
        rows = [[_MARKS[False], code(place_of(error)), "refused", "–"] for error in refused]
        rows += [[_mark(e.report), code(e.name), e.report.verdict, str(len(e.report.failures))] for e in ordered]
        lines += [*markdown_table(("", "policy", "verdict", "disagreements"), rows), ""]
    for error in refused:
        said = [f"- {text(line)}" for line in error.message.splitlines()]
        lines += [f"### {_MARKS[False]} {code(place_of(error))}", "", "REFUSED", "", *said, ""]
    for entry in ordered:
        lines += _policy(entry)
    return "\n".join(lines).rstrip() + "\n"


def _mark(report: ParityReport) -> str:
    """Green only where the original ran."""
    return _MARKS[False if report.passed is False else report.proven or None]


def _policy(entry: Entry) -> list[str]:
    report = entry.report
    lines = [f"### {_mark(report)} {code(report.policy)}", "", text(report.sentence), ""]
    for c in report.failures:
        first, *rest = c.explanation()
        lines += [f"- ❌ {text(first)}", *(f"  - {text(line)}" for line in rest)]
    if report.failures:
        lines.append("")
    head = ("format", "runtime", "size", *(code(o) for o in report.outputs), "verdict")
    rows = []
    for pair in sorted(report.pairs, key=lambda p: p.passed):
        cells = [pair.worst.get(o) for o in report.outputs]
        shown = ["–" if c is None else c.short() if c.passed else f"**{c.short()}**" for c in cells]
        size = size_with_original(pair.format, report.sizes, report.whole_sizes)
        rows.append(
            [code(pair.format), code(pair.runtime), size, *shown, pair.word if pair.passed else f"**{pair.word}**"]
        )
    lines += [*markdown_table(head, rows), "", _CELLS, ""]
    for record in report.played:
        lines += [f"{PLAY_MARKS[record.verdict]} {text(record.sentence)}", "", *play_table(record), ""]
    tolerances = [
        f"- {code(c.output)} in {code(f'{c.format}/{c.runtime}')}: atol {c.tolerance.atol:g}, "
        f"rtol {c.tolerance.rtol:g}: {text(c.tolerance.reason)}"
        for c in report.comparisons
        if c.tolerance.reason
    ]
    lines += _collapsible_section("Tolerances other than the default", list(dict.fromkeys(tolerances)))
    missing = [f"- {code(name)}: {text(reason)}" for name, reason in entry.missing.items()]
    lines += _collapsible_section("Runtimes that did not run", missing)
    return lines + _collapsible_section("Notes", [f"- {text(note)}" for note in report.notes])


def play_table(record: PlayRecord) -> list[str]:
    """What each earned in an environment."""
    head = ("played by", f"mean return ({CONFIDENCE:.0%} interval)", "difference", "episodes", "verdict")
    rows = [[text(p.name), p.returns.words, p.difference_words, str(p.episodes), p.verdict] for p in record.rows]
    return markdown_table(head, rows)


def _collapsible_section(title: str, lines: Sequence[str]) -> list[str]:
    """A section that opens on a click; nothing where it would be empty."""
    return [f"<details><summary>{title}</summary>", "", *lines, "", "</details>", ""] if lines else []


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a table; its cells are Markdown."""
    return [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)]


def text(value: str) -> str:
    """``value`` as words: nothing in it is markup, a table's bar or a line's end."""
    flat = printable(" ".join(value.split()))
    marked = re.sub(r"([\\`*_{}\[\]()#!|~])", r"\\\1", flat)
    return marked.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace("@", f"@{UNSEEN}")


def code(value: str) -> str:
    """``value`` as code, in a table cell too: a backslash before a bar is the table's, not the code's."""
    flat = printable(" ".join(value.split()))
    fence = "`" * (max((len(m) for m in re.findall("`+", flat)), default=0) + 1)
    pad = " " if flat.startswith("`") or flat.endswith("`") else ""
    return f"{fence}{pad}{flat}{pad}{fence}".replace("|", "\\|") if flat else "``"
