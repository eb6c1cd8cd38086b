"""The one way to the terminal: what an untrusted file is called, or says, cannot act there. Imports click only.

A terminal obeys control characters (colours, the title, the clipboard by OSC 52), and writes backwards where it is told
so. What cannot be printed is replaced in every text of the commands; only our own colours pass, and the line ends of
``say_lines``: those who put lines together see to it that no name brings one.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any

import click

from export_model.signatures.fields import printable

_ERASE = "\r\x1b[2K"
#: What the logs of a CI obey: a line that begins with "::" (GitHub), "##[", "##vso[" (Azure), "##teamcity[".
_COMMANDS = re.compile(r"^[ \t]*:(?=:)|#(?=#\w*\[)", re.MULTILINE)
_UNSEEN = "\u200b"
#: A word of a command, its quotes included.
_WORD = re.compile(r"""(?:'[^']*'|"[^"]*"|[^\s'"])+""")


def say(text: str = "", *, mark: str = "", colour: str | None = None, err: bool = False) -> None:
    """Print one line; ``mark`` stands before it in a colour."""
    _echo((click.style(mark, fg=colour) if mark else "") + _inert(printable(text)), err=err)


def say_lines(text: str, *, colour: str | None = None, keep: str = "", err: bool = False, nl: bool = True) -> None:
    """Print a text of several lines, each of which was made safe; ``keep`` is what else passes."""
    safe = _inert(printable(text, f"\n{keep}"))
    _echo(safe if colour is None else click.style(safe, fg=colour), err=err, nl=nl)


def say_paragraph(text: str, first: str = "", rest: str = "  ", *, colour: str | None = None) -> None:
    """Print one text after ``first``, wrapped with ``rest`` before the lines that follow."""
    from export_model.exporter.tables import paragraph

    say_lines(paragraph(text, first, rest), colour=colour)


def say_next(step: str) -> None:
    """Print what to do next."""
    say_lines(next_text(printable(step)))


def next_text(step: str) -> str:
    """Return ``next:`` and what to do, as wide as the terminal; a command is wrapped so that it can be pasted."""
    from export_model.exporter.tables import paragraph, room

    width = room()
    if width is None or len(step) + 6 <= width:
        return f"next: {step}"
    if not step.startswith("export-model "):
        return paragraph(step, "next: ", "      ")
    lines, line = [], "next:"
    for word in _WORD.findall(step):
        if len(line) + len(word) + 3 > width and line.strip() not in ("", "next:"):
            lines.append(f"{line} \\")
            line = "     "
        line += f" {word}"
    return "\n".join([*lines, line])


def _inert(text: str) -> str:
    """A text in which no log of a CI finds a command."""
    return _COMMANDS.sub(lambda found: found[0] + _UNSEEN, text)


def _echo(text: str, *, err: bool, nl: bool = True) -> None:
    """Colours are kept by click for terminals; NO_COLOR (no-color.org) turns them off there too."""
    click.echo(text, err=err, nl=nl, color=False if os.environ.get("NO_COLOR") else None)


def say_json(content: Mapping[str, Any]) -> None:
    """Print JSON, in ASCII: what cannot be printed is escaped, so that a program gets it as it is."""
    click.echo(json.dumps(content, indent=1).replace("\x7f", "\\u007f").replace("##", "#\\u0023"))


class Progress(AbstractContextManager["Progress"]):
    """Which step is being done: one line that is overwritten, on a terminal; a line each with ``--verbose``."""

    def __init__(self, *, quiet: bool, verbose: bool) -> None:
        self._lines = verbose
        self._shown = not quiet and not verbose and sys.stderr.isatty() and os.environ.get("TERM") != "dumb"
        self._start = time.monotonic()
        self._steps: list[tuple[float, str]] = []

    def __call__(self, text: str) -> None:
        """Say that a step begins."""
        if self._lines:
            self._steps.append((time.monotonic() - self._start, text))
            say(f"{self._steps[-1][0]:7.1f} s  {text}", err=True)
        elif self._shown:
            room = shutil.get_terminal_size().columns - 3
            click.echo(f"{_ERASE}  {printable(text)[:room]}", nl=False, err=True, color=True)

    def clear(self) -> None:
        """Make room for a result."""
        if self._shown:
            click.echo(_ERASE, nl=False, err=True, color=True)

    def __exit__(self, *error: object) -> None:
        self.clear()
        if self._steps:
            ends = [*(begun for begun, _ in self._steps[1:]), time.monotonic() - self._start]
            took = [(end - begun, text) for end, (begun, text) in zip(ends, self._steps, strict=True)]
            say("where the time went:", err=True)
            for seconds, text in sorted(took, key=lambda each: -each[0]):
                say(f"{seconds:7.1f} s  {text}", err=True)


class Bar:
    """How many of many are done, how many in a second, and how long the rest takes; on a terminal only."""

    def __init__(self, length: int, *, shown: bool) -> None:
        self._rate = 0.0
        self._bar: Any = click.progressbar(
            length=length,
            file=sys.stderr,
            hidden=not shown or not sys.stderr.isatty(),
            show_pos=True,
            show_eta=True,
            item_show_func=lambda name: None if name is None else f"{self._rate:.1f}/s  {printable(name)}",
        )

    def advance(self, name: str, rate: float) -> None:
        """One more is done, ``rate`` in a second."""
        self._rate = rate
        self._bar.update(1, name)

    def __enter__(self) -> Bar:
        self._bar.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.__exit__(*error)
