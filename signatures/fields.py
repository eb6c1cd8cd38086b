"""Values that came from JSON, taken out strictly: each knows where it lies, and what is wrong with it is said there."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

#: What one text may hold: a note is a sentence or two.
MOST_CHARACTERS = 4000


class FieldError(ValueError):
    """A value is not what stands there; ``field`` is its path (``inputs[0].shape``)."""

    def __init__(self, field: str, why: str) -> None:
        self.field, self.why = field, why
        super().__init__(f"{field}: {why}")


class Field:
    """A value of parsed JSON. Every question raises FieldError where the value does not answer it."""

    __slots__ = ("path", "value")

    def __init__(self, value: Any, path: str = "") -> None:
        self.value, self.path = value, path

    def error(self, why: str) -> FieldError:
        """What is wrong with it."""
        return FieldError(self.path or "the whole", why)

    @property
    def missing(self) -> bool:
        """Whether it is null, or not there."""
        return self.value is None

    def __getitem__(self, key: str) -> Field:
        """A member of an object; one that is not there is null."""
        if not isinstance(self.value, dict):
            raise self.error("must be an object")
        return Field(self.value.get(key), f"{self.path}.{key}" if self.path else key)

    def members(self) -> dict[str, Field]:
        """An object's members, whose names are texts; none where it is missing."""
        if self.missing:
            return {}
        if not isinstance(self.value, dict):
            raise self.error("must be an object")
        return {Field(key, f"{self.path}: the name").text(): self[key] for key in self.value}

    def items(self, most: int = 100_000) -> list[Field]:
        """A list's items; none where it is missing."""
        if self.missing:
            return []
        if not isinstance(self.value, list) or len(self.value) > most:
            raise self.error(f"must be a list of at most {most} items")
        return [Field(item, f"{self.path}[{i}]") for i, item in enumerate(self.value)]

    def text(self, *, blank: bool = False) -> str:
        """Printable characters on one line."""
        if not isinstance(self.value, str) or not self.value.isprintable() or len(self.value) > MOST_CHARACTERS:
            raise self.error(f"must be text of at most {MOST_CHARACTERS} printable characters")
        if not self.value and not blank:
            raise self.error("is empty")
        return self.value

    def one_of(self, words: Collection[str]) -> str:
        """One of these words."""
        if not isinstance(self.value, str) or self.value not in words:
            raise self.error(f"is {str(self.value)[:80]!r}, and none of {', '.join(words)}")
        return self.value

    def integer(self, low: int, high: int = 2**63 - 1) -> int:
        """A whole number from ``low`` to ``high``."""
        if not isinstance(self.value, int) or isinstance(self.value, bool) or not low <= self.value <= high:
            raise self.error(f"must be an integer from {low} to {high}")
        return self.value

    def number(self) -> int | float:
        """A finite number."""
        if not isinstance(self.value, int | float) or isinstance(self.value, bool) or not _is_finite(self.value):
            raise self.error("must be a finite number")
        return self.value

    def truth(self) -> bool:
        """True or false; false where it is missing."""
        if not isinstance(self.value, bool | None):
            raise self.error("must be true or false")
        return bool(self.value)

    def shape(self) -> tuple[int | None, ...]:
        """Sizes of axes, None for a free one."""
        if not isinstance(self.value, list):
            raise self.error("must be a list of sizes")
        return tuple(None if item.missing else item.integer(0, 2**31 - 1) for item in self.items(32))


def without_none(**given: Any) -> dict[str, Any]:
    """What is not None of what JSON is to say."""
    return {name: value for name, value in given.items() if value is not None}


def _is_finite(value: int | float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond float64
        return False


def printable(text: str, keep: str = "") -> str:
    """The text with U+FFFD for what cannot be printed: controls (a terminal obeys them), C1, what turns the direction
    of writing, lone surrogates. Characters in ``keep`` stay.
    """
    return text if text.isprintable() else "".join(c if c.isprintable() or c in keep else "\ufffd" for c in text)
