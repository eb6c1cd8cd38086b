"""Standard streams that are closed from the start, and those that nobody reads any more.

``export-model … >&-`` starts without a standard output: what is opened first would get its number, and what is printed
would go into that file. Where the reader of a pipe has gone (``| head``), the program ends as the shell's own do: with
141, which is 128 and SIGPIPE, after its folders and processes were cleaned up.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Iterator
from typing import Any, NoReturn, TextIO, cast

_STREAMS = ("stdin", "stdout", "stderr")
#: 128 and the number of SIGPIPE.
NOBODY_READS = 141


@contextlib.contextmanager
def whole_streams() -> Iterator[None]:
    """Standard streams that are there, and end the program where their reader has gone, in the block."""
    for number, name in enumerate(_STREAMS):
        if not _is_open(number):
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free: this one
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w" if number else "r", encoding="utf-8", closefd=False))  # noqa: SIM115
    before = sys.stdout, sys.stderr
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a Windows console, or a pipe there, has no Δ
    sys.stdout, sys.stderr = (cast(TextIO, _Read(stream)) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def _is_open(number: int) -> bool:
    try:
        os.fstat(number)
    except OSError:
        return False
    return True


class _Read:
    """A stream as it is, but for the end of its reader."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """As the stream's. Raises SystemExit where nobody reads."""
        try:
            return self._stream.write(text)
        except BrokenPipeError:
            self._end()

    def flush(self) -> None:
        """As the stream's. Raises SystemExit where nobody reads."""
        try:
            self._stream.flush()
        except BrokenPipeError:
            self._end()

    def _end(self) -> NoReturn:
        """What is still in the buffer goes nowhere, without another error when Python ends."""
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)
        raise SystemExit(NOBODY_READS) from None
