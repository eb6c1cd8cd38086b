"""The program's entry: runs a command, and turns errors into one message and an exit status.

What it needs is imported when it is entered, so that an interrupt is answered from the first moment on.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from typing import Any

#: Seconds in which a command that was told to stop does so by itself.
_GRACE = 3


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line ``args``, this process's own where there are none. Raises SystemExit unless all is well."""
    told: list[int] = []
    try:
        with _stoppable(told):
            try:
                _run(sys.argv[1:] if args is None else list(args))
            except BaseException:
                if told:
                    _clean_up()
                raise
            finally:
                if (folders := _folders()) is not None:
                    folders.sweep_scratch()
    except BaseException as error:
        # Whatever an interrupt was turned into on its way (an import that failed, say): it is what happened.
        if not told and not isinstance(error, KeyboardInterrupt):
            raise
        sys.stderr.write("stopped\n" if isinstance(error, KeyboardInterrupt) and error.args else "\nstopped\n")
        sys.exit(128 + (told or [2])[0])


@contextlib.contextmanager
def _stoppable(told: list[int]) -> Iterator[None]:
    """Ctrl-C, SIGTERM and a terminal that is closed are an interrupt inside, so that folders and processes are ended.

    A second one ends at once, and so does an alarm, as Python loses an interrupt that comes in a destructor. ``told``
    gets the signals. What was ignored from outside (nohup) stays so.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: object) -> None:
        told.append(number)
        if len(told) > 1:
            _clean_up()
            os._exit(128 + told[0])
        if hasattr(signal, "SIGALRM"):
            signal.signal(signal.SIGALRM, stop)
            signal.alarm(_GRACE)
        raise KeyboardInterrupt

    numbers = [n for n in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, n)]
    wanted = [n for n in (getattr(signal, name) for name in numbers) if signal.getsignal(n) is not signal.SIG_IGN]
    before = {number: signal.signal(number, stop) for number in wanted}
    try:
        yield
    finally:
        if told and hasattr(signal, "SIGALRM"):
            signal.alarm(0)
        for number, handler in before.items():
            signal.signal(number, handler)


def _clean_up() -> None:
    """Remove the folders of this process, if it came as far as to make any."""
    if (folders := _folders()) is not None:
        folders.remove_all()


def _folders() -> Any:
    return sys.modules.get("export_model.converters.files.folders")


def _use_one_thread() -> None:
    """Have numpy's matrix products take one thread, unless the user says otherwise; numpy reads it as it is imported.

    A policy's products are small, and OpenBLAS' second thread spins while it waits: a tenth of a cold export's time, a
    third of the processor's in a verification, and 4 to 20 times where environments are played beside other work.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _run(args: list[str]) -> None:
    _use_one_thread()
    from export_model.exporter.cli.streams import whole_streams
    from export_model.signatures.cycles import raise_gc_threshold

    raise_gc_threshold()  # before the imports, which are a good part of an export
    with whole_streams():
        _command(args)


def _command(args: list[str]) -> None:
    import io
    import warnings

    import click

    from export_model.exporter.cli.app import app
    from export_model.exporter.cli.terminal import say, say_json, say_lines
    from export_model.signatures.errors import ExportModelError, UsageError

    wants_json = "--json" in args
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = lambda message, *rest: say(f"warning: {message}", err=True)
            app.main(args=args, prog_name="export-model", standalone_mode=False)
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except click.Abort as error:
        raise KeyboardInterrupt("click has ended the line") from error
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
