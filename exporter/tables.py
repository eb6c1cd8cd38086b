"""Plain text for the terminal: tables and paragraphs that fit its width."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
import textwrap
from collections.abc import Mapping, Sequence
from itertools import zip_longest

from export_model.signatures.fields import printable

#: No column is made narrower where words have to be broken.
_LEAST = 8
_GAP = 2
#: A column of sentences has this much before names are broken.
_SENTENCE = 26


def room() -> int | None:
    """Columns of the terminal; None where nobody looks (a pipe, a file): what a program reads stays on its line.

    ``COLUMNS`` goes before, as everywhere.
    """
    if os.environ.get("COLUMNS", "").isdecimal() or sys.stdout.isatty():
        return max(shutil.get_terminal_size().columns, 40)
    return None


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns two spaces apart, as wide as their longest cell; where the terminal is narrower, long cells wrap.

    What cannot be printed, a line's end too, is replaced: a name in a cell cannot look like another row.
    """
    head, *rows = [[printable(str(cell)) for cell in row] for row in (head, *rows)]
    columns = [[r[i] for r in (head, *rows)] for i in range(len(head))]
    widths = _fitting(columns, room())
    lines = []
    for row in (head, ["-" * w for w in widths], *rows):
        cells = [_wrap(c, w) for c, w in zip(row, widths, strict=True)]
        for parts in zip_longest(*cells, fillvalue=""):
            line = "  ".join(part.ljust(w) for part, w in zip(parts, widths, strict=True))
            lines.append(line.rstrip())
    return "\n".join(lines)


def _fitting(columns: Sequence[Sequence[str]], total: int | None) -> list[int]:
    """The widths: where together they are wider than ``total``, the widest are cut to one measure, words last."""
    widths = [max(map(len, cells)) for cells in columns]
    if total is None:
        return widths
    free = total - _GAP * (len(widths) - 1)
    words = [max(len(word) for cell in cells for word in (*cell.split(), "")) for cells in columns]
    words = [max(n, min(w, _SENTENCE)) if w > 2 * _SENTENCE else n for n, w in zip(words, widths, strict=True)]
    for least, lowest in ((words, 1), ([_LEAST] * len(widths), _LEAST)):
        limit, natural = max(widths, default=0), widths
        while limit > lowest and sum(widths) > free:
            limit -= 1
            widths = [min(w, max(limit, n)) for w, n in zip(natural, least, strict=True)]
    return widths


def _wrap(cell: str, width: int) -> list[str]:
    if len(cell) <= width:
        return [cell]
    return textwrap.wrap(cell, width, break_on_hyphens=False) or [""]


def paragraph(text: str, first: str = "", rest: str = "") -> str:
    """``text`` after ``first``, wrapped to the terminal with ``rest`` before the lines that follow."""
    text, width = printable(text), room()
    if width is None or len(first) + len(text) <= width:
        return first + text
    return textwrap.fill(
        text, width, initial_indent=first, subsequent_indent=rest, break_long_words=False, break_on_hyphens=False
    )


def command_text(*words: object) -> str:
    """A call of this program as a shell takes it: what has spaces or quotes is quoted."""
    return shlex.join(["export-model", *map(str, words)])


def hint(command: str, why: str) -> str:
    """A command, and what it is for where there is room for both on a line that begins with a word."""
    width = room()
    return command if width is not None and len(command) + len(why) + 12 > width else f"{command}    ({why})"


def size_text(count: int) -> str:
    """Bytes for people."""
    return f"{count} B" if count < 1000 else f"{count / 1000:.1f} kB" if count < 1_000_000 else f"{count / 1e6:.1f} MB"


def size_with_original(kind: str, sizes: Mapping[str, int], whole: Mapping[str, int]) -> str:
    """The size of a format, and what it would be with weights in float32 where these are kept in less."""
    text = size_text(sizes[kind]) if kind in sizes else ""
    return f"{text} of {size_text(whole[kind])}" if kind in whole else text


def count_text(count: int, one: str, several: str | None = None) -> str:
    """Return a number with its noun: ``1 source``, ``2,000 sources``."""
    return f"{count:,} {one if count == 1 else several or f'{one}s'}"
