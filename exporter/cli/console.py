"""What the commands say: results on stdout, progress on stderr, reports to files. Imports click only."""

from __future__ import annotations

import functools
import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import click

from signatures.errors import UsageError

if TYPE_CHECKING:
    from exporter.export.pipeline import ExportResult
    from exporter.reports.entry import Entry
    from exporter.verify.report import ParityReport
    from exporter.verify.tolerances import ToleranceRule

_ERASE = "\r\x1b[2K"
_COLOURS = {True: "green", False: "red", None: "yellow"}


class Progress:
    """Which step is being done: one line that is overwritten, on a terminal; a line each with ``--verbose``."""

    def __init__(self, *, quiet: bool, verbose: bool) -> None:
        self._lines = verbose
        self._shown = not quiet and not verbose and sys.stderr.isatty() and os.environ.get("TERM") != "dumb"
        self._start = time.monotonic()

    def __call__(self, text: str) -> None:
        """Say that a step begins."""
        if self._lines:
            click.echo(f"{time.monotonic() - self._start:7.1f} s  {text}", err=True)
        elif self._shown:
            room = shutil.get_terminal_size().columns - 3
            click.echo(f"{_ERASE}  {text[:room]}", nl=False, err=True, color=True)

    def clear(self) -> None:
        """Make room for a result."""
        if self._shown:
            click.echo(_ERASE, nl=False, err=True, color=True)

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.clear()


@dataclass(frozen=True, slots=True)
class Console:
    """How a command speaks, and which reports it writes."""

    as_json: bool = False
    quiet: bool = False
    verbose: bool = False
    junit: Path | None = None
    markdown: Path | None = None
    html: Path | None = None
    tolerances: Path | None = None

    def prepare(self, *, verifies: bool = True) -> None:
        """Refuse what does not go together, before anything takes long. Raises UsageError."""
        if self.quiet and self.verbose:
            raise UsageError("--quiet and --verbose contradict each other", fix="give one of them")
        if self.as_json and self._markdown_on_stdout:
            raise UsageError("--json and --markdown - both want stdout", fix="give --markdown a file")
        if not self._reports:
            return
        if not verifies:
            raise UsageError(
                "a report needs a verification", why="--verify none was given", fix="leave one of them out"
            )
        from exporter.reports.write import Destinations

        Destinations(self.junit, self.markdown, self.html).prepare()

    @property
    def _reports(self) -> bool:
        return any(p is not None for p in (self.junit, self.markdown, self.html))

    @property
    def _markdown_on_stdout(self) -> bool:
        return self.markdown == Path("-")

    @property
    def _silent(self) -> bool:
        """Whether stdout belongs to something else than words for people."""
        return self.as_json or self._markdown_on_stdout

    def rules(self) -> tuple[ToleranceRule, ...]:
        """What ``--tolerances`` says. Raises UsageError."""
        if self.tolerances is None:
            return ()
        from exporter.verify.tolerance_file import read_tolerances

        return read_tolerances(self.tolerances)

    def check_rules(self, reports: Sequence[ParityReport]) -> None:
        """Raise UsageError where a rule of ``--tolerances`` covered no comparison: a name in it is mistyped."""
        for number, rule in enumerate(self.rules(), 1):
            if any(rule.covers(r.policy, c.format, c.runtime, c.output) for r in reports for c in r.comparisons):
                continue
            parts = {n: getattr(rule, n) for n in ("policy", "format", "runtime", "output")}
            said = ", ".join(f"{n} {v!r}" for n, v in parts.items() if v is not None)
            raise UsageError(
                f"--tolerances: entry {number} covers no comparison",
                where=str(self.tolerances),
                why=f"it is for {said}",
                fix="check its names against the report, or take it out",
            )

    def progress(self) -> Progress:
        """For the steps of a command; nothing where stdout is for a program and stderr should stay empty."""
        return Progress(quiet=self.quiet or self._silent, verbose=self.verbose)

    def write_reports(self, entries: Callable[[], Sequence[Entry]]) -> None:
        """Write the reports that were asked for; ``entries`` is not called where there are none."""
        if self._reports:
            from exporter.reports.write import Destinations

            Destinations(self.junit, self.markdown, self.html).write(entries(), click.echo)

    # ---- results, for people

    def result(self, result: ExportResult) -> None:
        """One policy that was exported."""
        if self._silent or (self.quiet and result.passed is not False):
            return
        signature = result.policy.signature
        click.echo(f"{result.policy.name}: {signature.family}, {signature.action_space} actions -> {result.folder}")
        self._notes(result.notes)
        if result.report is not None:
            self._report(result.report)
            return
        from exporter.cli.tables import size_text, table

        rows = [[kind, size_text(size)] for kind, size in result.sizes.items()]
        click.echo(table(("format", "size"), rows))
        click.echo("NOT VERIFIED: --verify none")

    def verified(self, report: ParityReport, place: object) -> None:
        """One policy that was verified."""
        if self._silent or (self.quiet and report.passed is not False):
            return
        click.echo(f"{report.policy}: {place}")
        self._notes(report.notes)
        self._report(report)

    def _notes(self, notes: Sequence[str]) -> None:
        if not self.quiet:
            from exporter.cli.tables import paragraph

            for note in notes:
                click.echo(paragraph(note, "  note: ", "    "))

    def _report(self, report: ParityReport) -> None:
        from exporter.cli.summary import comparison_table, failure_lines, not_run_line, parity_table, verdict
        from exporter.cli.tables import paragraph

        if not self.quiet and report.comparisons:
            for line in (comparison_table(report) if self.verbose else parity_table(report)).splitlines():
                failed = line.startswith("FAIL ")
                _say(f"{click.style('FAIL', fg='red')}{line[4:]}" if failed else line)
        for line in failure_lines(report):
            indent = line[: len(line) - len(line.lstrip())]
            click.echo(paragraph(line.lstrip(), indent, f"{indent}    "))
        missing = not_run_line(report)
        if not self.quiet and report.passed is not None and missing is not None:
            click.echo(paragraph(missing, rest="  "))
        _say(click.style(paragraph(verdict(report), rest="  "), fg=_COLOURS[report.passed]))

    def whole(self, reports: Sequence[ParityReport]) -> None:
        """What came of several policies, in one line."""
        if len(reports) < 2 or self._silent or (self.quiet and all(r.passed is not False for r in reports)):
            return
        from exporter.cli.summary import whole_summary
        from exporter.cli.tables import paragraph

        verdicts = {r.passed for r in reports}
        colour = _COLOURS[False if False in verdicts else None if None in verdicts else True]
        _say(click.style(paragraph(whole_summary(reports), rest="  "), fg=colour))

    def profiles(self) -> None:
        """Every profile with what it is for (``--for help``)."""
        from converters.targets.profiles import PROFILES

        if self.as_json:
            entries = [
                {"name": p.name, "aliases": list(p.aliases), "for": p.purpose, "formats": list(p.formats)}
                for p in PROFILES
            ]
            self.json({"profiles": entries})
            return
        width = max(len(p.name) for p in PROFILES)
        for profile in PROFILES:
            click.echo(f"{profile.name:{width}}  {profile.purpose}")
            details = [f"writes {', '.join(profile.formats)}"]
            details += [f"also called {', '.join(profile.aliases)}"] if profile.aliases else []
            click.echo(f"{'':{width}}  {'; '.join(details)}")

    def next_step(self, results: Sequence[ExportResult], names: str, profile: str | None = None) -> None:
        """What to do next, in a line or two."""
        if not results or self._silent or self.quiet:
            return
        failed = next((r for r in results if r.passed is False), None)
        if failed is not None:
            click.echo(
                f"next: read {failed.folder}/parity.json; the bundle was kept apart because its formats disagree"
            )
            return
        if profile is not None:
            last = results[-1]
            files = ", ".join(sorted(p.name for p in last.folder.iterdir() if p.suffix in (".onnx", ".nn", ".bytes")))
            from converters.targets.profiles import profile as known

            wanted = known(profile)
            click.echo(f"next: put {files} of {last.folder} into a project of {wanted.purpose}")
            click.echo(f"next: export-model snippets {last.folder} --for {wanted.name}    (what to set there)")
            return
        if names == "canonical" and not {"bytes", "onnx"}.isdisjoint(results[-1].sizes):
            click.echo("note: Unity looks up other names: export with --for unity6 (--for help: the others)")
        click.echo(f"next: {_next(results)}")

    def json(self, content: Mapping[str, Any]) -> None:
        """The answer for a program, where it was asked for."""
        if self.as_json:
            click.echo(json.dumps(content, indent=1))


def _next(results: Sequence[ExportResult]) -> str:
    """The one command that is worth most now: for the policy that the page has a scene for, else the last."""
    from exporter.cli.summary import to_verify
    from exporter.cli.tables import hint
    from exporter.serve.scenes import scene_of

    last = next((r for r in results if scene_of(r.policy.name, r.policy.signature) is not None), results[-1])
    if last.report is None:
        return hint(f"export-model verify {last.folder}", "nothing was compared yet")
    if last.report.passed is None and (install := to_verify(last.report)) is not None:
        return hint(install, f"then: export-model verify {last.folder}")
    if {"tfjs", "bytes"} <= {*last.sizes}:
        return hint(f"export-model serve {last.folder}", "see it act, in a browser")
    return hint(f"export-model snippets {last.folder}", "code for Python, JavaScript, C#, Unity, TF Serving")


def _say(text: str) -> None:
    """Print styled text; click keeps colours for terminals, NO_COLOR (no-color.org) turns them off there too."""
    click.echo(text, color=False if os.environ.get("NO_COLOR") else None)


def reporting(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options on output and reports; the command gets them as one ``console``."""

    @functools.wraps(command)
    def collected(*args: Any, **options: Any) -> Any:
        names = ("as_json", "quiet", "verbose", "junit", "markdown", "html", "tolerances")
        console = Console(**{name: options.pop(name) for name in names})
        return command(*args, console=console, **options)

    file = click.Path(path_type=Path, dir_okay=False)
    for option in (
        click.option("--tolerances", type=file, metavar="FILE", help="Other tolerances, each with its reason (TOML)."),
        click.option("--junit", type=file, metavar="FILE", help="Write JUnit XML for a CI system."),
        click.option("--markdown", type=file, metavar="FILE", help="Write a Markdown summary; '-' is stdout."),
        click.option("--html", type=file, metavar="FILE", help="Write one page with tables and pictures."),
        click.option("--json", "as_json", is_flag=True, help="Print the result as JSON."),
        click.option("-q", "--quiet", is_flag=True, help="Say only what disagrees."),
        click.option("-v", "--verbose", is_flag=True, help="Say every step and every comparison."),
    ):
        collected = option(collected)
    return collected
