"""HTML and inline SVG, built from elements so that every text is escaped."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from typing import TypeAlias

from export_model.signatures.fields import printable

_VOID = frozenset({"meta", "br", "hr", "wbr"})
#: What MathJax 2 and 3 leave alone: a notebook reads $…$ as mathematics, which has links of its own.
_PLAIN = "tex2jax_ignore mathjax_ignore"


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


Child: TypeAlias = "str | int | Iterable[Child] | None"
Rows: TypeAlias = Iterable[Sequence[str]]


def escape(child: Child) -> Markup:
    """A child as HTML: markup as it is, text escaped, None nothing, anything else its parts."""
    if child is None:
        return Markup("")
    if isinstance(child, Markup):
        return child
    if isinstance(child, str | int):
        return Markup(html.escape(printable(str(child), "\t\n")))
    return Markup("".join(escape(part) for part in child))


def el(tag: str, /, *children: Child, **attributes: str | int | float | None) -> Markup:
    """An element. ``class_`` is ``class``, other underscores are hyphens; an attribute that is None is left out."""
    parts = [tag]
    for key, value in attributes.items():
        if value is not None:
            text = f"{value:g}" if isinstance(value, float) else str(value)
            parts.append(f'{key.rstrip("_").replace("_", "-")}="{escape(text)}"')
    opening = f"<{' '.join(parts)}>"
    return Markup(opening if tag in _VOID else f"{opening}{escape(children)}</{tag}>")


def svg(*children: Child, width: float, height: float, **more: str | None) -> Markup:
    """A picture of so many pixels."""
    xmlns, box = more.pop("xmlns", None), f"0 0 {width:g} {height:g}"
    sizes = {"width": float(width), "height": float(height)}
    return el("svg", *children, xmlns=xmlns, viewBox=box, **sizes, role="img", **more)


def svg_file(*children: Child, width: float, height: float) -> str:
    """A picture as a file of its own."""
    return f"{svg(*children, width=width, height=height, xmlns='http://www.w3.org/2000/svg')}\n"


def notebook(title: str, *tables: tuple[Sequence[str], Rows]) -> Markup:
    """A result as a notebook shows it, in its own style: a line of text, and tables of a head and rows."""
    return el("div", el("p", title), [_table(head, rows) for head, rows in tables], class_=_PLAIN)


def _table(head: Sequence[str], rows: Rows) -> Markup:
    body = [el("tr", [el("td", cell) for cell in row]) for row in rows]
    return el("table", el("thead", el("tr", [el("th", h) for h in head])), el("tbody", body))
