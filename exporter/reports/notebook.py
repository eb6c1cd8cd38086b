"""Results as a notebook shows them: a line and small tables that take the notebook's own style."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from exporter.reports.markup import Markup, el

Rows = Iterable[Sequence[str]]


def notebook(title: str, *tables: tuple[Sequence[str], Rows]) -> Markup:
    """A line of text, and tables: each has a head and rows."""
    return Markup(el("p", title) + "".join(_table(head, rows) for head, rows in tables))


def _table(head: Sequence[str], rows: Rows) -> Markup:
    body = [el("tr", [el("td", cell) for cell in row]) for row in rows]
    return el("table", el("thead", el("tr", [el("th", h) for h in head])), el("tbody", body))
