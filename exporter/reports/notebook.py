"""Results as a notebook shows them: a line and small tables that take the notebook's own style.

Notebooks read $…$ as mathematics, which has links of its own in MathJax: names are not read so.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from exporter.reports.markup import Markup, el

#: What MathJax 2 and 3 leave alone.
_PLAIN = "tex2jax_ignore mathjax_ignore"
Rows = Iterable[Sequence[str]]


def notebook(title: str, *tables: tuple[Sequence[str], Rows]) -> Markup:
    """A line of text, and tables: each has a head and rows."""
    return el("div", el("p", title), [_table(head, rows) for head, rows in tables], class_=_PLAIN)


def _table(head: Sequence[str], rows: Rows) -> Markup:
    body = [el("tr", [el("td", cell) for cell in row]) for row in rows]
    return el("table", el("thead", el("tr", [el("th", h) for h in head])), el("tbody", body))
