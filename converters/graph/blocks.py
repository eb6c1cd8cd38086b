"""Constants in blocks: what some sums side by side take of a constant in some turns, one after the other.

A virtual machine looks at a bound for every element of an array that it reads; of a block, a structure of ``TERMS`` by
``LANES`` numbers, it looks once. Blocks lie in the order in which the loops read them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.graph.ops.loops.base import Applied, Counter, Element, Expression, Number, Reduced
from export_model.converters.graph.program import Place, every
from export_model.converters.graph.types import FLOAT32

#: Products that are added in one statement, and sums side by side (Mono 6.8, 64 by 64 products, ns for each: 0.158;
#: 8 by 8: 0.186, 4 by 16: 0.193, 16 by 8: 0.220, without blocks 0.291; RyuJIT of .NET Core 3.1: 0.131 and 0.207).
TERMS, LANES = 8, 16


class Packed(Struct, frozen=True):
    """How a constant is cut.

    ``lengths`` and ``steps`` are the loops over its blocks, outermost first, with how many elements each goes on by;
    ``term`` and ``lane`` are how far apart the elements of a block lie, from one term and from one lane to the next.
    """

    place: Place
    start: int
    lengths: tuple[int, ...]
    steps: tuple[int, ...]
    term: int
    lane: int
    #: Terms in all; the last block has the rest.
    terms: int

    @property
    def of_a_lane(self) -> int:
        """How many blocks some sums side by side read."""
        return int(np.prod(self.lengths[1:]))


def stride_of(x: Element, counter: Counter) -> int | None:
    """How far apart the elements for two numbers of a counter lie, one after the other; None if that varies."""
    stride, distance = 1, 0
    for length, one in reversed(list(zip(x.tensor.shape, x.at, strict=True))):
        slope = _slope(one, counter)
        if slope is None:
            return None
        distance += stride * slope
        stride *= length
    return distance


def _slope(x: Expression, counter: Counter) -> int | None:
    """How much an index grows as a counter does; None if that varies."""
    if x is counter:
        return 1
    if not any(e is counter for e in every(x)):
        return 0
    if isinstance(x, Applied) and x.function in ("add", "sub", "mul"):
        a, b = (_slope(o, counter) for o in x.operands)
        times = x.operands[1]
        if x.function != "mul" and a is not None and b is not None:
            return a + b if x.function == "add" else a - b
        if x.function == "mul" and a is not None and isinstance(times, Number):
            return a * int(times.value)
    return None


def packed_in(summed: Reduced, counter: Counter) -> tuple[Packed, Element, Reduced] | None:
    """The constant that sums along a counter multiply by, in blocks; where it is read; the sum, led by it.

    None where they take no constant, take it by another index than the loops', or are too few.
    """
    body, last = summed.body, summed.counters[-1]
    if summed.kind != "sum" or not (isinstance(body, Applied) and body.function == "mul"):
        return None
    found = [e for e in body.operands if isinstance(e, Element) and e.tensor.place.value is not None]
    if len(found) != 1 or counter.length < LANES or body.dtype != FLOAT32:
        return None
    (x,) = found
    (other,) = (e for e in body.operands if e is not x)
    strides = _strides(x, (counter, *summed.counters))
    if strides is None or any(e is counter for e in every(other)):
        return None
    lane, *outer, term = strides
    packed = Packed(
        place=x.tensor.place,
        start=_start(x),
        lengths=(
            counter.length // LANES,
            *(c.length for c in summed.counters[:-1]),
            -(-last.length // TERMS),
        ),
        steps=(LANES * lane, *outer, TERMS * term),
        term=term,
        lane=lane,
        terms=last.length,
    )
    return packed, x, replace(summed, body=replace(body, operands=(x, other)))  # Mono copies what leads a product


def _strides(x: Element, loops: Sequence[Counter]) -> list[int] | None:
    """How far each loop goes on in a constant; None where one does not, or where another index is in the way."""
    if not all(isinstance(i, Number) or any(i is c for c in loops) for i in x.at):
        return None
    found = [stride_of(x, c) for c in loops]
    return [int(s) for s in found if s] if all(found) else None


def _start(x: Element) -> int:
    """Where a constant is read while all loops stand at 0."""
    at = [int(i.value) if isinstance(i, Number) else 0 for i in x.at]
    return int(np.ravel_multi_index(at, x.tensor.shape))
