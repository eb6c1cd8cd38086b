"""The command ``verify``. Imports click only; the rest when it runs."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from exporter.cli.console import Console, reporting
from exporter.cli.options import comparing, trusting

if TYPE_CHECKING:
    from exporter.reports.entry import Entry
    from exporter.verify.options import VerifyOptions
    from exporter.verify.report import ParityReport


@click.command("verify")
@click.argument("bundles", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="BUNDLE...")
@click.option("--source", type=click.Path(path_type=Path), help="The file the bundle was exported from.")
@click.option("--step", type=int, metavar="N", help="The source's checkpoint (default: the one of the export).")
@trusting
@click.option(
    "--runtimes", default="auto", show_default=True, metavar="auto|full|RUNTIME,...", help="Runtimes to compare in."
)
@click.option("--allow-unverified", is_flag=True, help="Succeed although no independent runtime is installed.")
@reporting
@comparing
def verify_command(
    bundles: tuple[Path, ...],
    source: Path | None,
    step: int | None,
    trust_source: bool,
    runtimes: str,
    allow_unverified: bool,
    console: Console,
    options: VerifyOptions,
) -> None:
    """Verify bundles again: hashes first, then every format in the runtimes."""
    from exporter.export.pipeline import verify_folder

    console.prepare()
    reports = []
    with console.progress() as progress:
        for folder in bundles:
            report = verify_folder(
                folder,
                source=source,
                step=step,
                trust_source=trust_source,
                runtimes=runtimes,
                options=options,
                allow_unverified=allow_unverified,
                progress=progress,
            )
            reports.append(report)
            progress.clear()
            console.verified(report, folder)
    console.whole(reports)
    console.check_rules(reports)
    console.json({"reports": [r.to_dict() for r in reports]})
    console.write_reports(lambda: _bundle_entries(reports, bundles, options.steps))
    if any(r.passed is False for r in reports):
        sys.exit(1)


def _bundle_entries(reports: Sequence[ParityReport], bundles: Sequence[Path], steps: int) -> list[Entry]:
    from exporter.reports.entry import of_bundle

    return [of_bundle(report, folder, steps) for report, folder in zip(reports, bundles, strict=True)]
