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
        f"Planted on {counted['date']} by `{counted['command']}` into {counted['policies']} policies, judged by "
        f"`export`, `verify --source` and `compare` in turn. {counted['without_effect']} more change nothing at 4,096 "
        f"of the policy's own inputs, {len(counted['small'])} move odds in source code by less than agreement.md says "
        "is seen. *Located*: the tensor or function is named.",
        "",
        "| family | caught | located | missed |",
        "|---|---|---|---|",
        *(
            f"| {name} | {caught} | {located} | {planted - caught} |"
            for name, (caught, located, planted) in rows.items()
        ),
        "",
        f"Missed: {'; '.join(missed) or 'none'}.",
        "",
    ]


def _family(cells: Mapping[str, list[int]]) -> tuple[int, int, int]:
    """(caught, located, planted) of one family's classes."""
    caught, located, planted = (sum(cell[i] for cell in cells.values()) for i in range(3))
    return caught, located, planted
