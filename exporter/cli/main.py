"""The program's entry: runs a command, and turns errors into one message and an exit status.

What it needs is imported when it is entered, so that an interrupt is answered from the first moment on.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line ``args``, this process's own where there are none. Raises SystemExit unless all is well."""
    try:
        _run(sys.argv[1:] if args is None else list(args))
    except KeyboardInterrupt:
        sys.stderr.write("\nstopped\n")
        sys.exit(130)


def _run(args: list[str]) -> None:
    import io

    import click

    from exporter.cli.app import app
    from exporter.cli.terminal import say, say_json, say_lines
    from signatures.errors import ExportModelError, UsageError

    wants_json = "--json" in args
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a Windows console, or a pipe there, has no Δ
    try:
        app.main(args=args, prog_name="export-model", standalone_mode=False)
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except click.Abort:
        say("stopped", err=True)
        sys.exit(130)
    except click.ClickException as error:
        if wants_json:
            say_json(UsageError(error.format_message(), fix="export-model --help").to_dict())
        shown = io.StringIO()
        error.show(shown)
        say_lines(shown.getvalue(), err=True, nl=False)
        sys.exit(2)
    except ExportModelError as error:
        if wants_json:
            say_json(error.to_dict())
        say_lines(f"error: {error.message}", err=True)
        sys.exit(error.exit_status)
    except OSError as error:  # of the terminal or the pipe; files have errors of their own
        say(f"error: {error}", err=True)
        sys.exit(2)
