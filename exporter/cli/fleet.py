"""Many sources on the command line: a bar while they are exported, and a summary of what failed."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from export_model.converters.files.fetch import path_text
from export_model.exporter.cli.console import Console
from export_model.exporter.cli.options import RULES, as_given
from export_model.exporter.cli.terminal import say_lines
from export_model.exporter.fleet.fleet import export_fleet
from export_model.exporter.fleet.outcome import Outcome
from export_model.exporter.fleet.sources import PassedOver, paths_text, sources_in
from export_model.exporter.fleet.worker import Wanted
from export_model.exporter.tables import count_text
from export_model.signatures.errors import ExportModelError, UsageError

if TYPE_CHECKING:
    from export_model.exporter.export.options import ExportOptions
    from export_model.exporter.reports.entry import Entry

#: Sources whose failure is told; of more, the number.
_MOST_SHOWN = 50


def run_fleet(
    given: Sequence[Path],
    options: ExportOptions,
    jobs: int | None,
    cluster: str | None,
    again: bool,
    fail_fast: bool,
    console: Console,
) -> None:
    """Export what the paths stand for.

    Ends with status 2 where a source was refused, 1 where formats disagree, 3 where nothing was decided.
    """
    if cluster is not None and jobs is not None:
        raise UsageError("--jobs and --cluster contradict each other", fix="a cluster's workers are as many as it has")
    passed_over = PassedOver()
    paths = sources_in(given, options.out, passed_over, options.read)
    if passed_over.others and not console.quiet:
        count = len(passed_over.others)
        many = f"{count} files that are not models" if count > 1 else "a file that is not a model"
        say_lines(f"note: the pattern also matches {many}: {paths_text(passed_over.others)}", err=True)
    if passed_over.forms and not console.quiet:
        say_lines(f"note: also here, not used: {paths_text(passed_over.forms)} (give them by their paths)", err=True)
    wanted = Wanted(console.as_json, console.wants_reports)
    tally = _Tally(len(paths))
    entries: list[Entry] = []
    words = as_given(RULES)
    answers: list[Any] = []
    refused: list[ExportModelError] = []
    count = 1 if jobs is None else jobs
    outcomes = export_fleet(
        paths,
        options,
        jobs=count,
        cluster=cluster,
        again=again,
        fail_fast=fail_fast,
        wanted=wanted,
    )
    with console.progress_bar(len(paths)) as bar:
        for outcome in outcomes:
            tally.count(outcome)
            bar.advance(Path(path_text(outcome.path)).name, tally.rate)
            entries.extend(
                replace(p.entry, command=(*p.entry.command, *words)) for p in outcome.policies if p.entry is not None
            )
            answers.extend(p.answer for p in outcome.policies if p.answer is not None)
            if outcome.error is not None and (console.as_json or console.wants_reports):
                refused.append(outcome.error)
            if console.verbose:
                for line in _lines(outcome):
                    say_lines(line)
    told = {"refused": [e.to_dict() for e in refused]} if refused else {}
    console.json({"policies": answers, "unchanged": tally.unchanged, **told})
    console.fleet(tally.failures, tally.summary)
    console.write_reports(lambda: entries, refused)
    if tally.refused:
        sys.exit(2)
    if tally.disagree:
        sys.exit(1)
    if tally.undecided:
        sys.exit(3)


class _Tally:
    def __init__(self, sources: int) -> None:
        self.sources, self.done, self.unchanged = sources, 0, 0
        self.policies, self.verified, self.disagree, self.refused = 0, 0, 0, 0
        self.failed, self.undecided = 0, 0
        self._told: list[str] = []
        self._start = time.monotonic()

    @property
    def rate(self) -> float:
        """Sources that were exported in a second."""
        return (self.done - self.unchanged) / max(time.monotonic() - self._start, 1e-3)

    def count(self, outcome: Outcome) -> None:
        """One more source."""
        self.done += 1
        self.unchanged += outcome.unchanged
        self.policies += len(outcome.policies)
        self.verified += sum(p.passed is True for p in outcome.policies)
        self.disagree += sum(p.passed is False for p in outcome.policies)
        self.undecided += sum(bool(p.undecided) for p in outcome.policies)
        self.refused += outcome.error is not None
        if outcome.failed or any(p.undecided for p in outcome.policies):
            self.failed += 1
            if self.failed <= _MOST_SHOWN:
                self._told.extend(_lines(outcome, failed=True))

    @property
    def failures(self) -> list[str]:
        """What went wrong, a text each; of very many the first, and how many more."""
        more = self.failed - _MOST_SHOWN
        return [
            *self._told,
            *([f"… and {count_text(more, 'more source')}; -v or --json shows all"] if more > 0 else []),
        ]

    @property
    def summary(self) -> str:
        """All of it in a line."""
        seconds = time.monotonic() - self._start
        parts = [f"{count_text(self.policies, 'policy', 'policies')} exported ({self.verified} verified)"]
        parts += [f"{count_text(self.unchanged, 'source')} unchanged"] if self.unchanged else []
        parts += [f"{self.disagree} DISAGREE"] if self.disagree else []
        parts += [f"{self.undecided} NOT DECIDED"] if self.undecided else []
        parts += [f"{count_text(self.refused, 'source')} REFUSED"] if self.refused else []
        parts += [f"{count_text(self.sources - self.done, 'source')} not reached"] if self.done < self.sources else []
        done = f"{self.done} of {count_text(self.sources, 'source')}"
        return f"{done} in {seconds:.1f} s ({self.rate:.1f}/s): {', '.join(parts)}"


def _lines(outcome: Outcome, *, failed: bool = False) -> list[str]:
    """What is said of a source; ``failed``: only what went wrong."""
    source = path_text(outcome.path)
    lines = [f"{source}: unchanged"] if outcome.unchanged else []
    for policy in outcome.policies:
        if failed and policy.passed is not False and not policy.undecided:
            continue
        verdict = {True: "passed", False: f"FAILED: {policy.failure}", None: "not verified"}[policy.passed]
        verdict += f": {policy.undecided}" if policy.undecided else ""
        note = "" if policy.renamed is None else f" ({policy.renamed})"
        lines.append(f"{source}: {policy.what} -> {path_text(policy.folder)}: {verdict}{note}")
    if outcome.error is not None:
        lines.append(f"error: {outcome.error.message}")
    return lines
