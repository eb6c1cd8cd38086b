"""Shapes of a model that was exported for a fixed number of rows, read as if the number had been left free.

PyTorch's exporters write every length that is not declared free as a number. A reshape keeps the order of the elements,
so the batch stays where it was among them; which axis of the target has it follows from how many elements come before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from msgspec import Struct

from export_model.converters.graph.types import BATCH, Dim, Symbols


class Axis(Struct, frozen=True):
    """A free axis: its length at export, and how many elements of it came before the batch's (1: the batch leads)."""

    length: int
    before: int = 1


class FixedBatch:
    """What the free axes of a model stand for: the batch, and those it was joined to (the heads of an attention)."""

    def __init__(self, batch: int, symbols: Symbols) -> None:
        self.axes: dict[str, Axis] = {BATCH: Axis(batch)}
        self._symbols = symbols

    def target(self, target: Sequence[int], shape: Sequence[Dim]) -> list[Dim] | None:
        """The target of a reshape with the batch free; None where the batch is not to be found."""
        names = [d for d in shape if isinstance(d, str)]
        if len(names) != 1 or names[0] not in self.axes:
            return None
        place, inner = shape.index(names[0]), self.axes[names[0]]
        lengths = [inner.length if isinstance(d, str) else d for d in shape]
        dims = _resolve_open_dim(target, math.prod(lengths))
        if dims is None:
            return None
        before = math.prod(lengths[:place]) * inner.before
        axis = _batch_place(dims, before, lengths, place)
        begin = math.prod(dims[:axis])
        if before % begin:
            return None
        return [*dims[:axis], self._symbol(Axis(dims[axis], before // begin)), *dims[axis + 1 :]]

    def _symbol(self, axis: Axis) -> str:
        known = next((name for name, other in self.axes.items() if other == axis), None)
        if known is None:
            known = self._symbols.fresh()
            self.axes[known] = axis
        return known


def _resolve_open_dim(target: Sequence[int], total: int) -> list[int] | None:
    """The target with -1 as a number; None where it does not fit."""
    known = math.prod(d for d in target if d != -1)
    dims = [total // known if d == -1 and known else d for d in target]
    return dims if dims and math.prod(dims) == total else None


def _batch_place(dims: Sequence[int], before: int, lengths: Sequence[int], place: int) -> int:
    """The axis that has the batch: one that begins after ``before`` elements, else the one that they end in.

    Axes of length 1 leave a choice: the same axes in front, the same axes behind, or the first. The last axis holds
    features, which a layer's weights are made for; the batch joins the axis in front of it.
    """
    begins = [math.prod(dims[:i]) for i in range(len(dims))]
    last = len(dims) - 1
    candidates = [i for i, begin in enumerate(begins) if begin == before and (i < last or not last)]
    if not candidates:
        return max(i for i, begin in enumerate(begins) if begin <= before and (i < last or not last))
    front = [i for i in candidates if i and list(dims[:i]) == list(lengths[:place])]
    behind = [i for i in candidates if list(dims[i:]) == list(lengths[place:])]
    return (front or behind or candidates)[0]
