"""The command ``verify``. Imports click only; the rest when it runs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from export_model.exporter.cli.console import Console, reporting
from export_model.exporter.cli.group import command
from export_model.exporter.cli.options import JUDGING, as_given, comparing, located, trusting
from export_model.exporter.cli.rows import FILE, PATH
from export_model.exporter.cli.terminal import say_lines
from export_model.signatures.errors import ExportModelError, RuntimeUnavailableError, UsageError
from export_model.signatures.fields import printable

if TYPE_CHECKING:
    from export_model.exporter.reports.entry import Entry
    from export_model.exporter.verify.options import VerifyOptions
    from export_model.exporter.verify.report import ParityReport


@command(
    "verify",
    "Verify bundles again: hashes, then every format.",
    ("export-model verify exported/3DBall", "one bundle"),
    ("export-model verify exported --junit parity.xml", "all in a folder"),
    ("export-model verify out/3DBall --source 3DBall.bytes", "against the original"),
    ("export-model verify out/3DBall --log run.npz", "an agent's log"),
    core=(
        "source",
        "runtimes",
        "log",
        "allow_unverified",
        "trust_source",
        "html",
        "junit",
        "as_json",
        "verbose",
        "quiet",
    ),
)
@click.argument("bundles", nargs=-1, required=True, type=PATH, metavar="BUNDLE...")
@click.option("--source", type=PATH, help="The file the bundle was exported from.")
@click.option("--step", type=int, metavar="N", help="The source's checkpoint (default: the one of the export).")
@trusting
@located
@click.option("--log", type=FILE, metavar="FILE", help="Explain an agent's log instead: .npz, .csv, .jsonl.")
@click.option("--allow-unverified", is_flag=True, help="Succeed even if no independent runtime is installed.")
@reporting
@comparing
def verify_command(
    bundles: tuple[Path, ...],
    source: Path | None,
    step: int | None,
    trust_source: bool,
    runtimes: str,
    log: Path | None,
    allow_unverified: bool,
    console: Console,
    options: VerifyOptions,
) -> None:
    """Verify bundles again: hashes first, then every format in the runtimes.

    Given a folder of bundles, it verifies all of them.
    """
    from export_model.exporter.export.again import verify_folder
    from export_model.exporter.remote.fetching import nearby

    if log is not None:
        from export_model.exporter.cli.logs import check_log_of

        check_log_of(bundles, log, options, console)
        return
    with ExitStack() as fetched:
        near = [(given, fetched.enter_context(nearby(given))) for given in bundles]
        places = [found for given, place in near for found in _bundles_at(given, place, quiet=console.quiet)]
        verifying = partial(
            verify_folder,
            source=None if source is None else fetched.enter_context(nearby(source)),
            step=step,
            trust_source=trust_source,
            runtimes=runtimes,
            options=options,
            allow_unverified=allow_unverified,
        )
        verified, refused = _verify_all(places, verifying, console)
        reports = [report for _, report in verified]
        console.print_summary(reports, refused=len(refused))
        console.check_rules(reports)
        told = {"refused": [e.to_dict() for e in refused]} if refused else {}
        console.json({"reports": [r.to_dict() for r in reports], **told})
        console.write_reports(
            lambda: _bundle_entries(reports, [place for place, _ in verified], options.steps), refused
        )
    if refused:
        sys.exit(2)
    if any(r.passed is False for r in reports):
        sys.exit(1)
    if any(r.undecided for r in reports) and not allow_unverified:
        sys.exit(3)


def _verify_all(
    places: Sequence[tuple[Path, Path | None]], verifying: Callable[..., ParityReport], console: Console
) -> tuple[list[tuple[tuple[Path, Path | None], ParityReport]], list[ExportModelError]]:
    """Verify bundles one after the other, and print what came of each; return the reports and what was refused."""
    from export_model.exporter.export.pipeline import numbered_progress

    verified, refused = [], list[ExportModelError]()
    with console.progress() as progress:
        for number, place in enumerate(places, 1):
            try:
                report = verifying(place[0], progress=numbered_progress(progress, number, len(places)))
            except (UsageError, RuntimeUnavailableError):
                raise
            except ExportModelError as error:
                if len(places) == 1:
                    raise
                refused.append(error)
                progress.clear()
                say_lines(f"error: {error.message}", err=True)
                continue
            verified.append((place, report))
            progress.clear()
            console.report_policy(report, place[0])
    return verified, refused


def _bundles_at(given: Path, place: Path, *, quiet: bool) -> list[tuple[Path, Path | None]]:
    """Return each bundle of a folder, or the folder, with the address it is from; say what else lies there."""
    from export_model.converters.files.fetch import path_text
    from export_model.converters.formats.bundle.bundle import bundles_in, other_folders_in

    whole, (broken, others) = bundles_in(place), other_folders_in(place)
    if (whole or broken) and others and not quiet:
        names = ", ".join(f"{p.name} (it holds some)" if bundles_in(p) else p.name for p in others)
        say_lines(f"note: {path_text(given)} also holds folders that are not bundles: {printable(names)}", err=True)
    return [(found, None if given == place else given) for found in (*whole, *broken) or [place]]


def _bundle_entries(
    reports: Sequence[ParityReport], places: Sequence[tuple[Path, Path | None]], steps: int
) -> list[Entry]:
    from export_model.exporter.reports.entry import of_bundle

    words = as_given(JUDGING)
    return [of_bundle(report, *place, steps, words) for report, place in zip(reports, places, strict=True)]
