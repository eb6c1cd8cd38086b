"""Keras 3's operations that move, pick, repeat or pad elements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from export_model.converters.formats.keras.layers.arguments import argument, axis_of, constant, named_dtype, promote
from export_model.converters.formats.keras.layers.step import Step, Translate
from export_model.converters.graph.nn.choosing import gather_elements, last, moved_back
from export_model.converters.graph.types import INT32
from export_model.signatures.errors import UnsupportedOpError

#: ``numpy.pad``'s modes that repeat elements, which TensorFlow has too.
_MIRRORS = ("reflect", "symmetric")


def _concatenate(step: Step) -> str:
    values = promote(step, argument(step, 0, "xs"))
    return step.net.concat(values, step.net.axis(step.x, int(argument(step, 1, "axis", -1) or 0)))


def _stack(step: Step) -> str:
    axis = int(argument(step, 1, "axis", 0))
    return step.net.add("Pack", promote(step, argument(step, 0, "x")), axis=axis % (step.rank + 1))


def _reshape(step: Step) -> str:
    b = step.net
    shape = [b.shape(step.x)[0] if n is None else int(n) for n in argument(step, 1, "newshape")]
    if shape[0] == -1 and shape.count(-1) == 1:
        return b.reshape(step.x, shape)
    known = [n for n in shape[1:] if isinstance(n, int)]
    if -1 in known:
        whole = int(np.prod([b.length(step.x, i) for i in range(1, step.rank)], dtype=object))
        shape[shape.index(-1, 1)] = whole // max(-int(np.prod(known, dtype=object)), 1)
    return b.reshape(step.x, [b.shape(step.x)[0], *shape[1:]])


def _item(step: Step) -> str:
    """``x[..., None, 1:3, 0]``: slices, new axes, and single indices, whose axes go."""
    b, value, axis = step.net, step.x, 0
    said = argument(step, 1, "key")
    keys = [*said] if isinstance(said, list | tuple) else [said]
    if Ellipsis in keys:
        at = keys.index(Ellipsis)
        left_out = step.rank - sum(k is not None and k is not Ellipsis for k in keys)
        keys[at : at + 1] = [slice(None)] * left_out
    for key in keys:
        if key is None:
            value = b.expand_dims(value, axis)
            axis += 1
        elif isinstance(key, slice):
            start, stop, by = key.start, key.stop, key.step or 1
            if (start, stop, by) != (None, None, 1):
                value = b.slice(value, axis, start, stop, by)
            axis += 1
        elif isinstance(key, int):
            value = b.squeeze(b.slice(value, axis, key, key + 1 if key != -1 else None), [axis])
        else:
            raise UnsupportedOpError("it picks elements by more than slices and numbers")
    return value


def _transpose(step: Step) -> str:
    axes = argument(step, 1, "axes")
    return step.net.transpose(step.x, [*range(step.rank)][::-1] if axes is None else [int(a) for a in axes])


def _swap_axes(step: Step) -> str:
    order = [*range(step.rank)]
    first, second = (step.net.axis(step.x, int(argument(step, i, f"axis{i}"))) for i in (1, 2))
    order[first], order[second] = second, first
    return step.net.transpose(step.x, order)


def _move_axes(step: Step) -> str:
    said = [argument(step, i, k) for i, k in ((1, "source"), (2, "destination"))]
    source, target = ([step.net.axis(step.x, a) for a in ([s] if isinstance(s, int) else s)] for s in said)
    order = [a for a in range(step.rank) if a not in source]
    for place, axis in sorted(zip(target, source, strict=True)):
        order.insert(place, axis)
    return step.net.transpose(step.x, order)


def _squeeze(step: Step) -> str:
    axis = argument(step, 1, "axis")
    if axis is None:
        raise UnsupportedOpError("it squeezes every axis of length 1")
    return step.net.squeeze(
        step.x, [step.net.axis(step.x, int(a)) for a in (axis if isinstance(axis, list) else [axis])]
    )


def _expand_dims(step: Step) -> str:
    axis = argument(step, 1, "axis")
    value, axes = step.x, [axis] if isinstance(axis, int) else axis
    for place in sorted(int(a) % (step.rank + len(axes)) for a in axes):
        value = step.net.expand_dims(value, place)
    return value


# ------------------------------------------------------------------ elements of one axis, in another order


def _pick(step: Step, index: Sequence[int] | np.ndarray, axis: int) -> str:
    """The elements ``index`` of an axis, which are counted before they are made."""
    step.net.room(len(index))
    return step.net.take(step.x, [int(i) for i in index], axis)


def _flip(step: Step) -> str:
    axis = axis_of(step, 1, None)
    return _pick(step, range(step.net.length(step.x, axis) - 1, -1, -1), axis)


def _roll(step: Step) -> str:
    axis, shift = axis_of(step, 2, None), int(argument(step, 1, "shift"))
    length = step.net.length(step.x, axis)
    return _pick(step, (np.arange(length) - shift) % max(length, 1), axis)


def _repeat(step: Step) -> str:
    axis, counts = axis_of(step, 2, None), argument(step, 1, "repeats")
    length = step.net.length(step.x, axis)
    each = constant(counts)
    if each.size not in (1, length) or each.min(initial=0) < 0:
        raise step.damaged_error(f"repeats {length} elements {str(counts)[:60]} times")
    step.net.room(int(np.broadcast_to(each, length).astype(object).sum()))
    return _pick(step, np.repeat(np.arange(length), each), axis)


def _take(step: Step) -> str:
    axis = axis_of(step, 2, None) if isinstance(argument(step, 0, "x"), str) else int(argument(step, 2, "axis") or 0)
    (table,) = promote(step, [argument(step, 0, "x")])
    length, index = step.net.length(table, axis), argument(step, 1, "indices")
    if isinstance(index, str):
        index = step.net.add("FloorMod", [step.net.cast(index, INT32), step.net.ints(length, "length")])
        return step.net.add("GatherV2", [table, index, step.net.ints(axis, "axis")])
    places = constant(index)
    if (
        places.dtype.kind not in "iu"
        or places.ndim > 1
        or not (-length <= places.min(initial=0))
        or (places.max(initial=-length) >= length)
    ):
        raise UnsupportedOpError(f"it takes {str(index)[:60]} of {length} elements")
    made = step.net.take(table, [int(i) % length for i in places.reshape(-1)], axis)
    return made if places.ndim else step.net.squeeze(made, [axis])


def _take_along_axis(step: Step) -> str:
    b, axis = step.net, axis_of(step, 2, None)
    x, (index,) = argument(step, 0, "x"), promote(step, [argument(step, 1, "indices")])
    return moved_back(b, gather_elements(b, last(b, x, axis), last(b, index, axis)), axis)


def _split(step: Step) -> list[str]:
    axis, said = axis_of(step, 2, 0), argument(step, 1, "indices_or_sections")
    length = step.net.length(step.x, axis)
    if isinstance(said, int):
        if not 1 <= said <= length or length % said:
            raise step.damaged_error(f"splits {length} elements into {said} parts")
        said = range(length // said, length, length // said)
    ends = [0, *(int(n) for n in said), length]
    if sorted(ends) != ends:
        raise UnsupportedOpError(f"it splits at {str(ends[1:-1])[:60]} of {length} elements")
    return [step.net.slice(step.x, axis, a, z) for a, z in pairwise(ends)]


def _unstack(step: Step) -> list[str]:
    axis, count = axis_of(step, 2, 0), argument(step, 1, "num")
    length = step.net.length(step.x, axis)
    if count not in (None, length):
        raise step.damaged_error(f"unstacks {length} elements as {count}")
    step.net.room(length)
    return [step.net.slice(step.x, axis, i, i + 1, dropped=True) for i in range(length)]


# ------------------------------------------------------------------ more elements


def _pad(step: Step) -> str:
    b, mode = step.net, step.get("mode", "constant")
    pairs = [(int(a), int(z)) for a, z in step.get("pad_width")]
    pairs = pairs * step.rank if len(pairs) == 1 else pairs
    if len(pairs) != step.rank or min(map(min, pairs)) < 0:
        raise step.damaged_error(f"pads {step.rank} axes by {str(pairs)[:60]}")
    fill = argument(step, 1, "constant_values")
    if mode == "constant":
        return b.pad(step.x, pairs, None if fill is None else float(constant(fill).item()))
    if mode not in _MIRRORS:
        raise UnsupportedOpError(f"its mode is {str(mode)[:60]!r}")
    value = step.x
    for axis, pair in enumerate(pairs):
        if any(pair):
            length = b.length(value, axis)
            b.room(length + sum(pair))
            value = b.take(value, np.pad(np.arange(length), pair, mode=mode).tolist(), axis)
    return value


def _tile(step: Step) -> str:
    said = argument(step, 1, "repeats")
    counts: list[int] = [int(n) for n in ([said] if isinstance(said, int) else said)]
    if len(counts) > step.rank or min(counts, default=1) < 1:
        raise UnsupportedOpError(f"it repeats {step.rank} axes {str(counts)[:60]} times")
    return step.net.add("Tile", [step.x, step.net.ints([1] * (step.rank - len(counts)) + counts, "repeats")])


def _triangle(step: Step, *, lower: bool) -> str:
    """The elements of the last two axes up to a diagonal, or from it on; zeros elsewhere."""
    b, k = step.net, int(argument(step, 1, "k", 0))
    rows, columns = b.length(step.x, -2), b.length(step.x, -1)
    b.room(rows * columns)
    whole = np.ones((rows, columns), b.dtype(step.x))
    return b.add("Mul", [step.x, b.const(np.tril(whole, k) if lower else np.triu(whole, k), "triangle")])


def _differences(step: Step) -> str:
    """Each element of an axis less the one before, ``n`` times."""
    b, value = step.net, step.x
    axis, count = axis_of(step, 2, -1), int(argument(step, 1, "n", 1))
    if not 0 <= count < b.length(value, axis):
        raise UnsupportedOpError(f"it takes differences {count} times")
    for _ in range(count):
        value = b.add("Sub", [b.slice(value, axis, 1, None), b.slice(value, axis, None, -1)])
    return value


def _one_hot(step: Step) -> str:
    axis = int(argument(step, 2, "axis", -1))
    dtype = named_dtype(step.get("dtype") or "float32")
    return one_hot(step, step.x, int(argument(step, 1, "num_classes")), axis, dtype)


def one_hot(step: Step, index: str, classes: int, axis: int, dtype: Any) -> str:
    """1 at an index along a new axis, else 0; all 0 where it is out of range."""
    b = step.net
    on, off = (b.const(np.array(n, dtype), "level") for n in (1, 0))
    rank = b.rank(index)
    axis = -1 if axis == rank else axis
    return b.add("OneHot", [b.cast(index, INT32), b.ints(classes, "classes"), on, off], axis=axis)


OPERATIONS: Mapping[str, Translate] = {
    "Concatenate": _concatenate,
    "Stack": _stack,
    "Reshape": _reshape,
    "GetItem": _item,
    "Transpose": _transpose,
    "Swapaxes": _swap_axes,
    "Moveaxis": _move_axes,
    "Squeeze": _squeeze,
    "ExpandDims": _expand_dims,
    "Flip": _flip,
    "Roll": _roll,
    "Repeat": _repeat,
    "Take": _take,
    "TakeAlongAxis": _take_along_axis,
    "Split": _split,
    "Unstack": _unstack,
    "Pad": _pad,
    "Tile": _tile,
    "Tril": lambda s: _triangle(s, lower=True),
    "Triu": lambda s: _triangle(s, lower=False),
    "Diff": _differences,
    "OneHot": _one_hot,
}
