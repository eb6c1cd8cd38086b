"""Elements that are chosen, put into another order or summed up to each: tables, the largest, turned axes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from export_model.converters.formats.torchscript.machine import Machine
from export_model.converters.formats.torchscript.values import ScriptTensor
from export_model.converters.graph.nn import choosing
from export_model.converters.graph.ops.einsum import einsum
from export_model.converters.graph.types import FLOAT32, INT64
from export_model.signatures.errors import UnsupportedOpError


def _embedding(m: Machine, weight: Any, indices: Any, *rest: Any) -> ScriptTensor:
    table, at = m.ref(weight), m.ref(indices)
    return ScriptTensor(m.b.add("GatherV2", [table, m.b.cast(at, INT64), m.b.ints(0, "axis")]))


def _one_hot(m: Machine, x: Any, count: Any = -1) -> ScriptTensor:
    if not isinstance(count, int) or count < 1:
        raise UnsupportedOpError("a list of classes of unknown length", why="one_hot must say how many there are")
    m.b.room(count)
    at = m.b.expand_dims(m.b.cast(m.ref(x), INT64), m.b.rank(m.ref(x)))
    return ScriptTensor(m.b.cast(m.b.add("Equal", [at, m.b.const(np.arange(count, dtype=np.int64), "classes")]), INT64))


def _on_last_axis(m: Machine, x: Any, dim: Any, make: Callable[[str], str]) -> ScriptTensor:
    value = m.ref(x)
    axis = m.b.axis(value, dim)
    return ScriptTensor(choosing.moved_back(m.b, make(choosing.last(m.b, value, axis)), axis))


def _top_k(
    m: Machine, x: Any, k: Any, dim: Any = -1, largest: Any = True, ordered: Any = True
) -> tuple[ScriptTensor, ScriptTensor]:
    value = m.ref(x)
    axis = m.b.axis(value, dim)
    made = choosing.top_k(m.b, choosing.last(m.b, value, axis), int(k), largest=bool(largest))
    values, places = (choosing.moved_back(m.b, each, axis) for each in made)
    return ScriptTensor(values), ScriptTensor(places)


def _cumulate(*, product: bool = False) -> Callable[..., ScriptTensor]:
    def translate(m: Machine, x: Any, dim: Any, dtype: Any = None) -> ScriptTensor:
        made = ScriptTensor(m.b.cast(m.ref(x), FLOAT32))
        return _on_last_axis(m, made, dim, lambda last: choosing.cumulate(m.b, last, product=product))

    return translate


def _gather(m: Machine, x: Any, dim: Any, index: Any, sparse: Any = False) -> ScriptTensor:
    axis = m.b.axis(m.ref(x), dim)
    at = choosing.last(m.b, m.ref(index), axis)
    return _on_last_axis(m, x, dim, lambda last: choosing.gather_elements(m.b, last, at))


def _roll(m: Machine, x: Any, shifts: Any, dims: Any = ()) -> ScriptTensor:
    value = m.ref(x)
    if not dims:
        raise UnsupportedOpError("all elements are rolled as one row", why="axes must be named")
    for shift, dim in zip(shifts, dims, strict=True):
        axis = m.b.axis(value, dim)
        length = m.b.length(value, axis)
        m.b.room(length)
        value = m.b.take(value, np.roll(np.arange(length), int(shift)).tolist(), axis)
    return ScriptTensor(value)


def _flip(m: Machine, x: Any, dims: Any) -> ScriptTensor:
    value = m.ref(x)
    for dim in dims:
        axis = m.b.axis(value, dim)
        m.b.room(m.b.length(value, axis))
        value = m.b.take(value, list(range(m.b.length(value, axis)))[::-1], axis)
    return ScriptTensor(value)


def _cross(m: Machine, a: Any, b: Any, dim: Any = -1) -> ScriptTensor:
    """The product of vectors of three: a₊₁·b₊₂ - a₊₂·b₊₁."""
    left, right = m.pair(a, b)
    axis = m.b.axis(left, -1 if dim is None else dim)
    if m.b.length(left, axis) != 3:
        raise UnsupportedOpError("a cross product", why="its vectors must have three elements")
    first, second = ([1, 2, 0], [2, 0, 1])
    one, other = (
        m.b.add("Mul", [m.b.take(left, i, axis), m.b.take(right, j, axis)])
        for i, j in ((first, second), (second, first))
    )
    return ScriptTensor(m.b.add("Sub", [one, other]))


def _einsum(m: Machine, equation: Any, operands: Any, *rest: Any) -> ScriptTensor:
    return ScriptTensor(einsum(m.b, str(equation), [m.ref(o) for o in operands], shape_of=lambda r: m.b.shape(r)))


OPS: Mapping[str, Callable[..., Any]] = {
    "embedding": _embedding,
    "one_hot": _one_hot,
    "topk": _top_k,
    "cumsum": _cumulate(),
    "cumprod": _cumulate(product=True),
    "gather": _gather,
    "roll": _roll,
    "flip": _flip,
    "cross": _cross,
    "linalg_cross": _cross,
    "einsum": _einsum,
}
