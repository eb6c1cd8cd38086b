"""A mapping that a settings file or metadata holds: values are taken by key, and what nobody took is kept as text."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Any, TypeVar

from export_model.signatures.fields import printable
from export_model.signatures.interface import (
    MAX_KEPT_CHARACTERS,
    MAX_NAME_CHARACTERS,
    MAX_TERMS,
    MAX_VALUES,
    Range,
    Statement,
)

_Value = TypeVar("_Value")
#: Characters of what names a file and a key.
_MOST_WHERE = 300


class Table:
    """Keys of ``content`` (none unless it is a mapping), which is of ``file``, below ``path``.

    A value that is not what was asked for counts as not taken.
    """

    def __init__(self, content: Any, file: str, path: str = "") -> None:
        self._content: dict[str, Any] = content if isinstance(content, dict) else {}
        self._file, self._path = file, path
        self._taken: set[str] = set()
        self._below: dict[str, Table] = {}

    def __iter__(self) -> Iterator[str]:
        return iter(self._content)

    def __contains__(self, key: str) -> bool:
        return key in self._content

    def where(self, key: str = "") -> str:
        """The file, and the key's place in it."""
        place = ".".join(part for part in (self._path, key) if part)
        return short_text(f"{self._file}: {place}" if place else self._file, _MOST_WHERE)

    def value(self, key: str) -> Any:
        """The value as it is, which is not taken by that."""
        return self._content.get(key)

    def take(self, *keys: str) -> None:
        """Count keys as understood."""
        self._taken.update(keys)

    def below(self, key: str) -> Table:
        """The table of a key; what is not taken of that is kept in its place."""
        if key not in self._below:
            self._below[key] = Table(self.value(key), self._file, f"{self._path}.{key}" if self._path else key)
            if isinstance(self.value(key), dict):
                self._taken.add(key)
        return self._below[key]

    def rows(self, key: str) -> list[Table]:
        """The tables of a list."""
        rows = self.value(key)
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows) or len(rows) > MAX_TERMS:
            return []
        self._taken.add(key)
        found = [Table(row, self._file, f"{self._path}.{key}[{i}]".lstrip(".")) for i, row in enumerate(rows)]
        self._below.update({f"{key}[{i}]": table for i, table in enumerate(found)})
        return found

    def _taken_as(self, key: str, value: _Value) -> _Value:
        if value not in (None, ()) or self.value(key) is None:
            self._taken.add(key)
        return value

    def text(self, key: str) -> str | None:
        """A name or a unit."""
        value = self.value(key)
        return self._taken_as(key, short_text(value) or None if isinstance(value, str) else None)

    def texts(self, key: str) -> tuple[str, ...]:
        """A list of names."""
        value = self.value(key)
        whole = isinstance(value, list) and len(value) <= MAX_VALUES and all(isinstance(v, str) and v for v in value)
        return self._taken_as(key, tuple(map(short_text, value)) if whole else ())

    def number(self, key: str) -> float | None:
        """A finite number."""
        return self._taken_as(key, finite(self.value(key)))

    def count(self, key: str) -> int | None:
        """A whole number from 0."""
        number = finite(self.value(key))
        whole = number is not None and number >= 0 and number == int(number) and number < 1 << 16
        return self._taken_as(key, int(number) if whole and number is not None else None)

    def numbers(self, key: str) -> tuple[float, ...]:
        """One number, or a list of them."""
        return self._taken_as(key, numbers_of(self.value(key)))

    def ranges(self, key: str) -> tuple[Range, ...]:
        """A lowest and highest value, or a list of such pairs."""
        return self._taken_as(key, ranges_of(self.value(key)))

    def rest(self) -> list[Statement]:
        """What was not taken, of the tables below it too."""
        found = []
        for key, value in self._content.items():
            if key not in self._taken and value not in (None, {}, []):
                found.append(Statement(cut_text(value), self.where(key)))
            elif key in self._below:
                found += self._below[key].rest()
        for key, table in self._below.items():
            if key not in self._content:  # a row of a list
                found += table.rest()
        return found


def short_text(value: str, most: int = MAX_NAME_CHARACTERS) -> str:
    """The text on one line of at most ``most`` characters that can be printed."""
    return printable(value[:most])


def cut_text(value: Any) -> str:
    """A value as JSON, cut where it is long; the rest is never made."""
    text = ""
    if isinstance(value, str):
        text = value
    else:
        for piece in json.JSONEncoder(ensure_ascii=False).iterencode(value):
            text += piece[: MAX_KEPT_CHARACTERS + 1]
            if len(text) > MAX_KEPT_CHARACTERS:
                break
    return printable(text if len(text) <= MAX_KEPT_CHARACTERS else f"{text[:MAX_KEPT_CHARACTERS]}…")


def finite(value: Any) -> float | None:
    """The finite number that a value is; None for all else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:  # an integer beyond float64
        return None


def numbers_of(value: Any) -> tuple[float, ...]:
    """One finite number, or a list of them; nothing for all else."""
    values = value if isinstance(value, list) else [value]
    found = [finite(v) for v in values[: MAX_VALUES + 1]]
    return () if None in found or len(found) > MAX_VALUES else tuple(v for v in found if v is not None)


def ranges_of(value: Any) -> tuple[Range, ...]:
    """One pair of numbers, or a list of pairs; infinite ends are not bounded, pairs without an end say nothing."""
    if not isinstance(value, list) or not value or len(value) > MAX_VALUES:
        return ()
    pairs = value if all(isinstance(pair, list) for pair in value) else [value]
    found: list[Range] = []
    for pair in pairs:
        if len(pair) != 2 or any(isinstance(v, bool) or not isinstance(v, int | float) for v in pair):
            return ()
        low, high = finite(pair[0]), finite(pair[1])
        if low is not None and high is not None and low > high:
            return ()
        found.append((low, high))
    return () if all(pair == (None, None) for pair in found) else tuple(found)
