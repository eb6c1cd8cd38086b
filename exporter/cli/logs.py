"""``verify BUNDLE --log FILE``: a log of an agent held against its policy."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from exporter.cli.console import Console
from exporter.cli.terminal import say_paragraph
from signatures.errors import UsageError

if TYPE_CHECKING:
    from exporter.verify.options import VerifyOptions


def check_log_of(
    bundles: Sequence[Path], log: Path, source: Path | None, options: VerifyOptions, console: Console
) -> None:
    """Compute every step of ``log`` again and say what explains the steps that differ; ends with status 1 for those."""
    from exporter.acting.loading import load_policy
    from exporter.logs.check import check_log
    from exporter.logs.judging import LOG_TOLERANCE
    from exporter.verify.tolerances import Tolerance

    if len(bundles) != 1:
        raise UsageError(f"--log goes with one policy, and {len(bundles)} were given", fix="verify them one by one")
    if source is not None or console.junit is not None or console.markdown is not None:
        raise UsageError("--log goes without --source, --junit and --markdown", fix="use --json or --html FILE")
    default = Tolerance()
    given = options.tolerance
    tolerance = LOG_TOLERANCE if (given.atol, given.rtol) == (default.atol, default.rtol) else given
    with console.progress() as progress:
        progress("computing the steps again")
        report = check_log(load_policy(bundles[0]), log, tolerance)
        progress.clear()
    if console.html is not None:
        from exporter.logs.page import log_page

        console.html.write_text(log_page(report), encoding="utf-8")
    console.json(report.to_dict())
    if not console.as_json and not (console.quiet and report.fits):
        from exporter.logs.wording import report_lines, sentence

        for line in report_lines(report):
            indent = line[: len(line) - len(line.lstrip())]
            say_paragraph(line.lstrip(), indent, f"{indent}    ")
        say_paragraph(sentence(report), colour="green" if report.fits else "red")
    if not report.fits:
        sys.exit(1)
