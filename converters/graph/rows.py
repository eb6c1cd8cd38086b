"""Reductions in rows: some terms at a time are added to all elements of a row, one after the other, where they lie.

The weights are read in their order, a compiler sees one loop of constant length and no dependence in it, and the order
of additions is that of one element at a time: the same bits (48-512-256-128-12 with Elu, gcc 12, AMD Zen 5, µs: -O2
10.6, -O3 -march=native 5.9; eight sums of a column side by side 16.2 and 16.4).
"""

from __future__ import annotations

import numpy as np
from msgspec.structs import replace

from export_model.converters.graph.blocks import stride_of
from export_model.converters.graph.ops.loops.base import Applied, Counter, Element, Expression, Number, Reduced, number
from export_model.converters.graph.program import children, elements, every, inline_scalars

#: Terms that are added in one statement: a row is loaded and stored once for so many.
TERMS = 8
#: Elements of the shortest row; of fewer, each is kept in a register.
_SHORTEST = 8
#: What leaves a reduction as it is.
_NEUTRAL = {"sum": 0.0, "max": -np.inf, "min": np.inf}


def in_rows(result: Element, summed: Reduced, counter: Counter) -> bool:
    """Whether all that a reduction reads stays, or goes on by one element, as ``counter`` does, and its result, too."""
    strides = [stride_of(e, counter) for e in elements(summed.body)]
    return counter.length >= _SHORTEST and stride_of(result, counter) == 1 and 1 in strides and set(strides) <= {0, 1}


def take_guard(summed: Reduced) -> tuple[Expression | None, Reduced]:
    """Return the condition without which a term changes nothing, as in padding, and the reduction where it holds."""
    body = summed.body
    if summed.kind == "sum" and isinstance(body, Applied) and body.function == "mul":
        chosen, factor = body.operands
        guard = _guard(chosen, 0.0) if _is_finite(factor) else None  # 0 times infinity is none
        return (
            (None, summed)
            if guard is None
            else (guard[0], replace(summed, body=replace(body, operands=(guard[1], factor))))
        )
    guard = _guard(body, _NEUTRAL.get(summed.kind))
    return (None, summed) if guard is None else (guard[0], replace(summed, body=guard[1]))


def _guard(x: Expression, neutral: float | None) -> tuple[Expression, Expression] | None:
    if isinstance(x, Applied) and x.function == "select":
        condition, inside, outside = x.operands
        if isinstance(outside, Number) and outside.value == neutral:
            return condition, inside
    return None


def _is_finite(x: Expression) -> bool:
    values = [e.tensor.place.value for e in elements(x)]
    return all(v is not None and bool(np.isfinite(v).all()) for v in values)


def join_counters(summed: Reduced, guard: Expression | None) -> Reduced:
    """Return a reduction that counts once what lies in one piece: a window's columns and their channels."""
    while len(summed.counters) > 1:
        *outer, before, last = summed.counters
        strides = [(stride_of(e, before), stride_of(e, last)) for e in elements(summed.body)]
        loose = _outside_elements(summed.body) | ({id(e) for e in every(guard)} if guard is not None else set())
        if loose & {id(before), id(last)} or any(None in s or s[0] != (s[1] or 0) * last.length for s in strides):
            break
        both = Counter(last.name, before.length * last.length)
        body = inline_scalars(summed.body, {id(before): number(0), id(last): both})
        summed = replace(summed, counters=(*outer, both), body=body)
    return summed


def _outside_elements(x: Expression) -> set[int]:
    if isinstance(x, Element):
        return set()
    return {id(x)}.union(*map(_outside_elements, children(x)))
