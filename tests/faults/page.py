"""The table of ``python -m tests.faults`` in docs/figures.md."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def totals(counted: Mapping[str, Any]) -> tuple[int, int, int]:
    """(caught, located, planted) of all faults."""
    caught, located, planted = (sum(column) for column in zip(*map(_family, counted["cells"].values()), strict=True))
    return caught, located, planted


def section(counted: Mapping[str, Any]) -> list[str]:
    """The section on planted faults."""
    missed = [f"{m['member']}: {m['kind']} at {m['tensor'] or 'the file'}, by {m['way']}" for m in counted["missed"]]
    rows = {family: _family(cells) for family, cells in counted["cells"].items()}
    rows["all"] = totals(counted)
    return [
        "## Planted faults",
        "",
        f"`{counted['command']}`, {counted['date']}, {counted['policies']} policies: caught, of these located, and "
        f"missed, by `export`, `verify --source` and `compare` in turn; {counted['without_effect']} more change nothing"
        f"{f', {small} odds too little to be seen' if (small := len(counted['small'])) else ''}.",
        "",
        "|family|caught|located|missed|",
        "|---|---|---|---|",
        *(f"|{name}|{caught}|{located}|{every - caught}|" for name, (caught, located, every) in rows.items()),
        "",
        *([f"Missed: {'; '.join(missed)}.", ""] if missed else []),
    ]


def _family(cells: Mapping[str, list[int]]) -> tuple[int, int, int]:
    """(caught, located, planted) of one family's classes."""
    caught, located, planted = (sum(cell[i] for cell in cells.values()) for i in range(3))
    return caught, located, planted
