"""HTML and inline SVG, built from elements so that every text is escaped."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable
from typing import TypeAlias

#: Characters that XML 1.0 has no place for (and HTML no use): controls, lone surrogates, non-characters.
_UNPRINTABLE = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_VOID = frozenset({"meta", "br", "hr", "wbr"})


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


Child: TypeAlias = "str | int | Iterable[Child] | None"


def printable(text: str) -> str:
    """``text`` with a replacement character wherever XML allows none."""
    return _UNPRINTABLE.sub("\ufffd", text)


def escaped(child: Child) -> Markup:
    """A child as HTML: markup as it is, text escaped, None nothing, anything else its parts."""
    if child is None:
        return Markup("")
    if isinstance(child, Markup):
        return child
    if isinstance(child, str | int):
        return Markup(html.escape(printable(str(child))))
    return Markup("".join(escaped(part) for part in child))


def el(tag: str, /, *children: Child, **attributes: str | int | float | None) -> Markup:
    """An element. ``class_`` is ``class``, other underscores are hyphens; an attribute that is None is left out."""
    parts = [tag]
    for key, value in attributes.items():
        if value is not None:
            text = f"{value:g}" if isinstance(value, float) else str(value)
            parts.append(f'{key.rstrip("_").replace("_", "-")}="{escaped(text)}"')
    opening = f"<{' '.join(parts)}>"
    return Markup(opening if tag in _VOID else f"{opening}{escaped(children)}</{tag}>")
