"""What the commands say: results on stdout, progress on stderr, reports to files. Imports click only."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from msgspec import Struct

from export_model.exporter.cli.rows import FILE
from export_model.exporter.cli.terminal import Bar, Progress, say, say_json, say_lines, say_next, say_paragraph
from export_model.signatures.errors import ExportModelError, UsageError

if TYPE_CHECKING:
    from export_model.converters.policy.policy import Policy
    from export_model.exporter.export.options import ExportOptions
    from export_model.exporter.export.pipeline import ExportResult
    from export_model.exporter.play.report import PlayReport
    from export_model.exporter.reports.entry import Entry
    from export_model.exporter.reports.write import Documents
    from export_model.exporter.verify.report import ParityReport
    from export_model.exporter.verify.tolerances import ToleranceRule

#: Bytes of weights above which a file beside the source is proposed.
_MANY_WEIGHTS = 4_000_000


def _colour(reports: Sequence[ParityReport]) -> str:
    """Green only where every original ran and agrees."""
    if any(r.passed is False for r in reports):
        return "red"
    return "green" if all(r.proven for r in reports) else "yellow"


class Console(Struct, frozen=True):
    """How a command speaks, and which reports it writes."""

    as_json: bool = False
    quiet: bool = False
    verbose: bool = False
    junit: Path | None = None
    markdown: Path | None = None
    html: Path | None = None
    tolerances: Path | None = None

    def prepare(self) -> None:
        """Refuse what does not go together, before anything takes long. Raises UsageError."""
        if self.quiet and self.verbose:
            raise UsageError("--quiet and --verbose contradict each other", fix="give one of them")
        if self.as_json and self._markdown_on_stdout:
            raise UsageError("--json and --markdown - both want stdout", fix="give --markdown a file")
        if self.wants_reports:
            from export_model.exporter.reports.write import Destinations

            Destinations(self.junit, self.markdown, self.html).prepare()

    def check_verified(self, runtimes: str) -> None:
        """Raise UsageError where reports are asked for on what no runtime verifies."""
        if runtimes == "none" and self.wants_reports:
            asked = {"--junit": self.junit, "--markdown": self.markdown, "--html": self.html}
            given = [option for option, value in asked.items() if value is not None]
            raise UsageError(
                f"{', '.join(given)} {'needs' if len(given) == 1 else 'need'} a verification",
                why="--verify none was given",
                fix="leave one of them out",
            )

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
        from export_model.exporter.verify.tolerance_file import read_tolerances

        return read_tolerances(self.tolerances)

    def check_rules(self, reports: Sequence[ParityReport]) -> None:
        """Raise UsageError where a rule of ``--tolerances`` covered no comparison: a name in it is mistyped."""
        for number, rule in enumerate(self.rules(), 1):
            if any(rule.covers(r.policy, c.format, c.runtime, c.output) for r in reports for c in r.comparisons):
                continue
            raise UsageError(
                f"--tolerances: entry {number} covers no comparison",
                where=str(self.tolerances),
                why=f"it is for {rule.names}",
                fix="check its names against the report, or take it out",
            )

    @property
    def wants_reports(self) -> bool:
        """Whether a report is to be written."""
        return any(p is not None for p in (self.junit, self.markdown, self.html))

    def progress_bar(self, length: int) -> Bar:
        """A bar for many sources."""
        return Bar(length, shown=not (self.quiet or self.verbose or self._silent))

    def progress(self) -> Progress:
        """For the steps of a command; nothing where stdout is for a program and stderr should stay empty."""
        return Progress(quiet=self.quiet or self._silent, verbose=self.verbose)

    def write_reports(self, entries: Callable[[], Sequence[Entry]], refused: Sequence[ExportModelError] = ()) -> None:
        """Write the reports that were asked for; ``entries`` is not called where there are none."""
        if self.wants_reports:
            from export_model.exporter.reports.write import parity_documents

            self.write_documents(parity_documents(functools.cache(entries), refused))

    def write_documents(self, documents: Documents) -> None:
        """Write the reports that were asked for."""
        if self.wants_reports:
            from export_model.exporter.reports.markdown import UNSEEN
            from export_model.exporter.reports.write import Destinations

            echo = functools.partial(say_lines, keep=UNSEEN)
            Destinations(self.junit, self.markdown, self.html).write(documents, echo)

    def note_size(self, policy: Policy, job: ExportOptions) -> None:
        """Name ``--weights file`` before weights are written as text, where they are many."""
        from export_model.converters.formats.registry import WRITTEN

        programs = [key for key in job.targets or () if key in WRITTEN and WRITTEN[key].program]
        if not programs or job.code.weights == "file" or self.quiet or self._silent:
            return
        count = sum(n.value.size for n in policy.graph.nodes if n.value is not None)
        if count * 4 > _MANY_WEIGHTS:
            text, file = (f"{count * size / 1e6:.0f} MB" for size in (16, 4))
            said = f"the weights of {policy.name} take {text} as text ({','.join(programs)}), {file} by --weights file"
            say_lines(f"note: {said}", err=True)

    # ---- results, for people

    def print_result(self, result: ExportResult) -> None:
        """One policy that was exported."""
        if self._silent or (self.quiet and result.passed is not False):
            return
        signature = result.policy.signature
        say(f"{result.policy.name}: {signature.family}, {signature.action_space} actions -> {result.folder}")
        self._notes(result.notes)
        if result.report is not None:
            self._report(result.report)
            return
        from export_model.exporter.tables import size_with_original, table

        rows = [[kind, size_with_original(kind, result.sizes, result.whole_sizes)] for kind in result.sizes]
        say_lines(table(("format", "size"), rows))
        say("NOT VERIFIED: --verify none")

    def fleet(self, failures: Sequence[str], summary: str) -> None:
        """Many sources: what failed, and the sum."""
        for line in failures:
            say_lines(line, err=True)
        if not self._silent and not self.quiet:
            say(summary)

    def report_policy(self, report: ParityReport, place: object) -> None:
        """One policy that was verified."""
        if self._silent or (self.quiet and report.passed is not False):
            return
        say(f"{report.policy}: {place}")
        self._notes(report.notes)
        self._report(report)

    def report_play(self, report: PlayReport) -> None:
        """One policy that played."""
        if self._silent or (self.quiet and report.passed is True):
            return
        self._notes(report.notes)
        for line in report.lines():
            say_lines(line)
        say_paragraph(report.sentence, colour={True: "green", False: "red", None: "yellow"}[report.passed])

    def _notes(self, notes: Sequence[str]) -> None:
        for note in () if self.quiet else notes:
            say_paragraph(note, "  note: ", "    ")

    def _report(self, report: ParityReport) -> None:
        from export_model.exporter.reports.summary import (
            comparison_table,
            failure_lines,
            foreign_words,
            not_run_line,
            parity_table,
        )

        if not self.quiet and report.comparisons:
            for line in (comparison_table(report) if self.verbose else parity_table(report)).splitlines():
                failed = "FAIL" if line.startswith("FAIL ") else ""
                say(line[len(failed) :], mark=failed, colour="red")
        for line in failure_lines(report):
            indent = line[: len(line) - len(line.lstrip())]
            say_paragraph(line.lstrip(), indent, f"{indent}    ")
        for line in foreign_words(report) if self.verbose else ():
            say_lines(line)
        for played in report.played:
            say_paragraph(f"played in {played.environment}: {played.sentence}")
        missing = not_run_line(report)
        if not self.quiet and report.passed is not None and missing is not None:
            say_paragraph(missing)
        say_paragraph(report.sentence, colour=_colour([report]))

    def print_summary(self, reports: Sequence[ParityReport], refused: int = 0) -> None:
        """What came of several policies, in one line; ``refused`` sources or bundles were."""
        if len(reports) + refused < 2 or self._silent or (self.quiet and all(r.passed is not False for r in reports)):
            return
        from export_model.exporter.reports.summary import whole_summary

        say_paragraph(whole_summary(reports, refused), colour="red" if refused else _colour(reports))

    def profiles(self) -> None:
        """Every profile with what it is for (``--for help``)."""
        from export_model.converters.consumers.profiles import PROFILES

        if self.as_json:
            entries = [
                {"name": p.name, "aliases": list(p.aliases), "for": p.purpose, "formats": list(p.formats)}
                for p in PROFILES
            ]
            self.json({"profiles": entries})
            return
        width = max(len(p.name) for p in PROFILES)
        indent = " " * (width + 2)
        for profile in PROFILES:
            say_paragraph(profile.purpose, f"{profile.name:{width}}  ", indent)
            details = [f"writes {', '.join(profile.formats)}"]
            details += [f"also called {', '.join(profile.aliases)}"] if profile.aliases else []
            say_paragraph("; ".join(details), indent, indent)

    def next_step(
        self,
        results: Sequence[ExportResult],
        names: str | None,
        profile: str | None = None,
        sources: Sequence[Path] = (),
    ) -> None:
        """What to do next, in a line or two; ``sources`` are what was exported, as it was typed."""
        if not results or self._silent or self.quiet:
            return
        failed = next((r for r in results if r.passed is False), None)
        if failed is not None:
            say_next(f"read {failed.folder}/parity.json; the bundle was kept apart because its formats disagree")
            return
        if profile is not None:
            for line in _next_for(results, profile, sources):
                say_next(line)
            return
        ours = results[-1].policy.signature.family.startswith("ML-Agents")
        if ours and names != "source" and _can_be_dressed(results[-1].sizes):
            say_paragraph("note: Unity looks up other names: export with --for unity6 (--for help: the others)")
        for line in _next(results, sources):
            say_next(line)

    def json(self, content: Mapping[str, Any]) -> None:
        """The answer for a program, where it was asked for."""
        if self.as_json:
            say_json(content)


def _can_be_dressed(sizes: Mapping[str, int]) -> bool:
    """Whether a format was written that Unity loads, under other names."""
    from export_model.converters.formats.registry import WRITTEN

    return any(WRITTEN[key].unity for key in sizes)


def _verify_again(results: Sequence[ExportResult], sources: Sequence[Path]) -> list[str]:
    """The commands that verify bundles: with their source, where they have no file that is a reference."""
    from export_model.converters.formats.registry import own_reference
    from export_model.exporter.tables import command_text

    folders: dict[tuple[object, ...], list[Path]] = {}
    for result in results:
        source: tuple[object, ...] = ()
        if own_reference(result.sizes) is None:
            named = [s for s in sources if s.name == result.agreed.origin.path]
            source = ("--source", *(named or [Path(result.agreed.origin.path)])[:1])
        folders.setdefault(source, []).append(result.folder)
    return [command_text("verify", *bundles, *source) for source, bundles in folders.items()]


def _to_verify(results: Sequence[ExportResult], sources: Sequence[Path]) -> list[str]:
    """How to get a runtime, and what to verify then, where none ran."""
    from export_model.exporter.reports.summary import to_verify
    from export_model.exporter.tables import hint

    open_ = [r for r in results if r.report is not None and r.report.passed is None]
    install = next(filter(None, (to_verify(r.report) for r in open_ if r.report is not None)), None)
    if install is None:
        return []
    first, *others = _verify_again(open_, sources)
    return [hint(install, f"then: {first}"), *others]


def _next_for(results: Sequence[ExportResult], profile: str, sources: Sequence[Path]) -> list[str]:
    """What to do with the files for a consumer, and where each policy's settings are told."""
    from export_model.converters.consumers.profiles import profile as known
    from export_model.exporter.tables import command_text, hint

    wanted = known(profile)
    *rest, last = (f"{_files(r)} of {r.folder}" for r in results)
    files = f"{', '.join(rest)} and {last}" if rest else last
    place = f"give {files} to {' and '.join(wanted.loaders)}"
    if not wanted.loaders:
        place = f"put {files} into a project of {wanted.purpose}"
    settings = [hint(command_text("snippets", r.folder, "--for", wanted.name), "what to set there") for r in results]
    return [*_to_verify(results, sources), place, *settings]


def _files(result: ExportResult) -> str:
    return ", ".join(sorted(p.name for p in result.folder.iterdir() if p.is_file() and p.suffix != ".json"))


def _next(results: Sequence[ExportResult], sources: Sequence[Path]) -> list[str]:
    """The command that is worth most now: for the policy that the page has a scene for, else the last."""
    from export_model.exporter.tables import command_text, hint

    last = results[-1]
    if len(results) > 1:
        from export_model.exporter.serve.scenes import scene_of

        last = next((r for r in results if scene_of(r.policy.name, r.policy.signature) is not None), last)
    if last.report is None:
        return [hint(command, "nothing was compared yet") for command in _verify_again(results, sources)]
    if told := _to_verify(results, sources):
        return told
    from export_model.exporter.serve.site import NEEDED

    if NEEDED.keys() <= last.sizes.keys():
        return [hint(command_text("serve", last.folder), "see it act, in a browser")]
    from export_model.exporter.snippets.registry import languages

    if not (said := languages(last.sizes)):
        return [hint(command, "in a job, whenever it may have changed") for command in _verify_again(results, sources)]
    return [hint(command_text("snippets", last.folder), f"code for {said}")]


def reporting(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options on output and reports; the command gets them as one ``console``.

    A command that ends in an error writes it into the reports.
    """

    @functools.wraps(command)
    def call_with_console(*args: Any, **options: Any) -> Any:
        names = ("as_json", "quiet", "verbose", "junit", "markdown", "html", "tolerances")
        console = Console(**{name: options.pop(name) for name in names})
        console.prepare()
        try:
            return command(*args, console=console, **options)
        except ExportModelError as error:
            with contextlib.suppress(UsageError):  # a file that cannot be written must not hide what happened
                console.write_reports(list, [error])
            raise

    for option in (
        click.option("--tolerances", type=FILE, metavar="FILE", help="Other tolerances, each with its reason (TOML)."),
        click.option("--junit", type=FILE, metavar="FILE", help="Write JUnit XML for a CI system."),
        click.option("--markdown", type=FILE, metavar="FILE", help="Write a Markdown summary; '-' is stdout."),
        click.option("--html", type=FILE, metavar="FILE", help="Write one page with tables and pictures."),
        click.option("--json", "as_json", is_flag=True, help="Print the result as JSON."),
        click.option("-q", "--quiet", is_flag=True, help="Print only what disagrees."),
        click.option("-v", "--verbose", is_flag=True, help="Print every step and every comparison."),
    ):
        call_with_console = option(call_with_console)
    return call_with_console
