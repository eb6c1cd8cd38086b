"""``verify BUNDLE --log FILE``: a log of an agent held against its policy."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from export_model.exporter.cli.console import Console
from export_model.exporter.cli.options import as_given
from export_model.exporter.cli.terminal import say_paragraph
from export_model.signatures.errors import UsageError

if TYPE_CHECKING:
    from export_model.exporter.verify.options import VerifyOptions


#: Parameters of ``verify`` that nothing of a log depends on.
_UNHEARD = frozenset(
    (
        *("source", "step", "trust_source", "runtimes", "allow_unverified", "junit", "markdown", "tolerances"),
        *("samples", "seed", "steps", "sizes", "required", "golden"),
    )
)


def check_log_of(bundles: Sequence[Path], log: Path, options: VerifyOptions, console: Console) -> None:
    """Compute every step of ``log`` again and say what explains the steps that differ; ends with status 1 for those."""
    from export_model.exporter.acting.loading import load_policy
    from export_model.exporter.logs.check import check_log
    from export_model.exporter.logs.judging import LOG_TOLERANCE
    from export_model.exporter.verify.tolerances import Tolerance

    if len(bundles) != 1:
        raise UsageError(f"--log goes with one policy, and {len(bundles)} were given", fix="verify them one by one")
    for flag in as_given(_UNHEARD)[:1]:
        raise UsageError(
            f"{flag} does not go with --log",
            why="a log's own steps are computed again, and nothing else",
            fix="leave one of them out; --json and --html FILE write what was found",
        )
    wanted, default = options.tolerance, Tolerance()
    tolerance = LOG_TOLERANCE if (wanted.atol, wanted.rtol) == (default.atol, default.rtol) else wanted
    with console.progress() as progress:
        progress("computing the steps again")
        report = check_log(load_policy(bundles[0]), log, tolerance)
        progress.clear()
    if console.html is not None:
        from export_model.exporter.logs.page import log_page

        console.html.write_text(log_page(report), encoding="utf-8")
    console.json(report.to_dict())
    if not console.as_json and not (console.quiet and report.fits):
        from export_model.exporter.logs.wording import report_lines, sentence

        for line in report_lines(report):
            indent = line[: len(line) - len(line.lstrip())]
            say_paragraph(line.lstrip(), indent, f"{indent}    ")
        say_paragraph(sentence(report), colour="green" if report.fits else "red")
    if not report.fits:
        sys.exit(1)
