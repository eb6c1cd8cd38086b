"""Borders, and elements that are picked: nothing is computed."""

from __future__ import annotations

from collections.abc import Sequence

from converters.graph.builder import Builder

#: What is put before and after an axis.
Pairs = Sequence[tuple[int, int]]


def padded(b: Builder, x: str, pairs: Pairs, fill: str | float | None = None) -> str:
    """``x`` with a pair of paddings per axis, of zeros or ``fill`` (a number or scalar); a negative one cuts off."""
    if isinstance(fill, float | int):
        fill = b.number(x, fill) if fill else None
    for axis, (before, after) in enumerate(pairs):
        if min(before, after) < 0:
            x = b.slice(x, axis, -before if before < 0 else None, after if after < 0 else None)
    wide = [[max(a, 0), max(z, 0)] for a, z in pairs]
    if not any(map(any, wide)):
        return x
    operand = b.ints(wide, "paddings")
    return b.add("Pad", [x, operand]) if fill is None else b.add("PadV2", [x, operand, fill])


def taken(b: Builder, x: str, index: Sequence[int], axis: int) -> str:
    """The elements ``index`` of an axis, in that order."""
    return b.add("GatherV2", [x, b.ints(list(index), "indices"), b.ints(axis, "axis")])
