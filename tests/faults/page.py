"""The table of ``python -m tests.faults`` in docs/figures.md."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def totals(counted: Mapping[str, Any]) -> tuple[int, int, int]:
    """(caught, located, planted) of all faults."""
    cells = [cell for row in counted["cells"].values() for cell in row.values()]
    caught, located, planted = (sum(cell[i] for cell in cells) for i in range(3))
    return caught, located, planted


def section(counted: Mapping[str, Any]) -> list[str]:
    """The section on planted faults."""
    caught, located, planted = totals(counted)
    cells = counted["cells"]
    kinds = list(dict.fromkeys(kind for row in cells.values() for kind in row))
    missed = [f"{m['member']}: {m['kind']} at {m['tensor'] or 'the file'}, by {m['way']}" for m in counted["missed"]]
    return [
        "## Planted faults",
        "",
        f"Planted on {counted['date']} by `python -m tests.faults`: {planted} faults in what was written for "
        f"{counted['policies']} policies, each judged by `export`, `verify --source` or `compare` in turn. {caught} "
        f"were caught, of {located} the place was named, {planted - caught} were missed; of "
        f"{len(counted['without_effect'])} more no number changes beyond the tolerance, and no decision, at 4,096 of "
        "the policy's own inputs. A cell has those caught of those planted.",
        "",
        "| fault | " + " | ".join(cells) + " |",
        "|" + "---|" * (len(cells) + 1),
        *(f"| {kind} | " + " | ".join(_cell(row.get(kind)) for row in cells.values()) + " |" for kind in kinds),
        "",
        f"Missed: {'; '.join(missed) or 'none'}.",
        "",
        f"Without an effect: {'; '.join(counted['without_effect']) or 'none'}.",
        "",
    ]


def _cell(cell: list[int] | None) -> str:
    return "" if cell is None else f"{cell[0]}/{cell[2]}"
