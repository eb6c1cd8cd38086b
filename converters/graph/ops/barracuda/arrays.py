"""Ops that move numbers: shapes, joins, cuts, looking up, repeating.

What is joined or cut along the channels becomes no layer until something needs it as one tensor: the part of a memory
that an LSTM reads is then the memory itself, not a slice of a slice (which Barracuda up to 2.0 refuses).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from msgspec.structs import replace

from export_model.converters.graph.nodes import ref
from export_model.converters.graph.ops.barracuda.base import NONE, Nn
from export_model.converters.graph.ops.barracuda.builder import NnBuilder
from export_model.converters.graph.ops.barracuda.values import Axes, Value, rows_first, usual_axes
from export_model.converters.graph.ops.barracuda.vocabulary import C, H, LayerType, N, W
from export_model.converters.graph.types import BATCH, Dim

#: What is refused, and why.
_CUTS_AGENTS = "it cuts agents out of the batch", "a policy answers for every agent"
_MIXED = "the numbers of one agent stay in one row of a .nn"
#: Operands of a layer that joins a tensor with itself.
_MOST_JOINED = 1 << 12


# ------------------------------------------------------------------ shapes


def same(b: NnBuilder, args: Sequence[Value]) -> Value:
    """The input itself."""
    return args[0]


def reshape(b: NnBuilder, args: Sequence[Value]) -> Value:
    """Reshape, Squeeze and ExpandDims: the elements in their order in another shape."""
    return reshape_value(b, b.flatten_if_due(args[0]), b.shape_of(b.node.name))


def reshape_value(b: NnBuilder, value: Value, shape: tuple[Dim, ...]) -> Value:
    """``value``'s elements in order in ``shape``."""
    if [d for d in value.shape if d != 1] == [d for d in shape if d != 1]:
        places = iter(a for a, d in zip(value.axes, value.shape, strict=True) if d != 1)
        return Value(shape, tuple(None if d == 1 else next(places) for d in shape), value.pieces)
    axes = _usual(b, shape)
    mixed = not (value.by_rows and rows_first(shape)) or (BATCH in value.shape) != (BATCH in shape)
    if mixed or value.size != math.prod(d for d in shape if isinstance(d, int)):
        raise b.nn_error(f"{list(value.shape)} to {list(shape)}", _MIXED)
    if not value.in_order and len(shape) == 2 and shape[0] == BATCH:
        return Value(shape, axes, flat_of=value)
    value = b.in_usual_place(value)
    wanted = Value(shape, axes)
    if wanted.dims == value.dims:
        return replace(value, shape=shape, axes=axes)
    name = b.stored_name(value)
    if wanted.dims[H] == wanted.dims[W] == 1:
        return b.layer_value(b.layer(LayerType.FLATTEN, [name], wanted.dims), shape, axes)
    return b.layer_value(b.layer(LayerType.RESHAPE, [name], wanted.dims, pool=wanted.dims), shape, axes)


def as_row(b: NnBuilder, value: Value) -> Value:
    """A tensor as [B, size]."""
    if value.array is not None:
        shape: tuple[Dim, ...] = (BATCH, value.size)
        return write_constant(b, Value(shape, array=value.array.reshape(1, -1)), (N, C))
    value = b.flatten_if_due(value)
    flat = reshape_value(b, value, (BATCH, value.size)) if value.shape != (BATCH, value.size) else value
    return b.flatten_if_due(flat)


def _usual(b: NnBuilder, shape: tuple[Dim, ...]) -> Axes:
    axes = usual_axes(shape)
    if axes is None:
        raise b.nn_error(f"a tensor of shape {list(shape)}", "the batch comes first in a .nn, and three axes more")
    return axes


def transpose(b: NnBuilder, args: Sequence[Value]) -> Value:
    """The axes stay where they lie; the graph counts them in another order."""
    value = b.flatten_if_due(args[0])
    order = [int(i) for i in b.constant_operand(1, "the order of the axes")]
    return replace(value, shape=tuple(value.shape[i] for i in order), axes=tuple(value.axes[i] for i in order))


# ------------------------------------------------------------------ joining and cutting


def concat(b: NnBuilder, args: Sequence[Value]) -> Value:
    """Tensors one after the other."""
    axis = int(b.constant_operand(len(b.node.inputs) - 1, "the axis"))
    return join_along(b, args, axis, b.shape_of(b.node.name))


def pack(b: NnBuilder, args: Sequence[Value]) -> Value:
    """Tensors side by side on a new axis."""
    shape = b.shape_of(b.node.name)
    axis = int(b.node.attrs["axis"]) % len(shape)
    one = tuple(1 if i == axis else d for i, d in enumerate(shape))
    return join_along(b, [_insert_axis(v, axis, one) for v in args], axis, shape)


def _insert_axis(value: Value, axis: int, shape: tuple[Dim, ...]) -> Value:
    if value.array is not None:
        return Value(shape, array=np.expand_dims(value.array, axis))
    axes = list(value.axes)
    axes.insert(axis, None)
    return replace(value, shape=shape, axes=tuple(axes))


def join_along(b: NnBuilder, values: Sequence[Value], axis: int, shape: tuple[Dim, ...]) -> Value:
    """``values`` along ``axis`` of the graph."""
    axis %= len(shape)
    values = [b.flatten_if_due(v) for v in values if 0 not in v.shape]
    if len(values) == 1:
        return values[0]
    if any(v.shape[axis] == BATCH for v in values):
        raise b.nn_error("it joins along the batch", _MIXED)
    axes = _join_axes(values, axis, shape) or _usual(b, shape)
    place = axes[axis]
    parts = []
    for value in values:
        own = tuple(axes[i] if i == axis or d != 1 else None for i, d in enumerate(value.shape))
        if value.array is not None:
            value = write_constant(b, value, own)
        parts.append(_move_axes(b, value, own))
    result = Value(shape, axes)
    if place == C and all(p.dims[:3] == result.dims[:3] for p in parts):
        return b.join([replace(p, axes=axes) for p in parts], shape)
    if any(_off_axis(p.dims, place) != _off_axis(result.dims, place) for p in parts) or place is None:
        raise b.nn_error(f"tensors of shapes {[list(v.shape) for v in values]}", "their other axes differ")
    name = b.layer(LayerType.CONCAT, [b.stored_name(p) for p in parts], result.dims, axis=place)
    return b.layer_value(name, shape, axes)


def _move_axes(b: NnBuilder, value: Value, axes: Axes) -> Value:
    """The same tensor under ``axes`` that lie in the same places; moved where they do not."""
    long = [(a, w) for a, w, d in zip(value.axes, axes, value.shape, strict=True) if d != 1]
    return replace(value, axes=axes) if all(a == w for a, w in long) else b.with_axes(value, axes)


def _off_axis(dims: Sequence[int], place: int | None) -> list[int]:
    return [d for i, d in enumerate(dims) if i != place]


def _join_axes(values: Sequence[Value], axis: int, shape: tuple[Dim, ...]) -> Axes | None:
    """The axes of the first operand that tells them all; None where they disagree."""
    axes: list[int | None] = [None] * len(shape)
    for value in values:
        if value.array is not None:
            continue
        for i, (place, length) in enumerate(zip(value.axes, value.shape, strict=True)):
            if length != 1 and axes[i] not in (None, place):
                return None
            axes[i] = place if length != 1 else axes[i]
    if axes[axis] is None:
        axes[axis] = next((a for a in (C, W, H) if a not in axes), None)
    taken = [a for a in axes if a is not None]
    fit = len(set(taken)) == len(taken) and all(a is not None or d == 1 for a, d in zip(axes, shape, strict=True))
    return tuple(axes) if fit else None


def write_constant(b: NnBuilder, value: Value, axes: Axes) -> Value:
    """A constant that has a row per agent as a tensor: a layer whose weights are 0 and whose bias it is."""
    assert value.array is not None
    if BATCH not in value.shape:
        name = b.constant(b.place_constant(value.array, axes))
        return b.layer_value(name, value.shape, axes)
    wanted = Value(value.shape, axes)
    flat = b.place_constant(value.array, axes).reshape(-1)
    name = b.constant_rows(flat, "rows")
    if wanted.dims != b.dims_of(name):
        name = b.layer(LayerType.RESHAPE, [name], wanted.dims, pool=wanted.dims, label="shaped")
    return b.layer_value(name, value.shape, axes)


def split(axis_at: int) -> Nn:
    """Split and SplitV: pieces one after the other along the axis that an operand says."""

    def lower(b: NnBuilder, args: Sequence[Value]) -> tuple[Value, ...]:
        value = b.flatten_if_due(args[0])
        axis = int(b.constant_operand(axis_at, "the axis")) % len(value.shape)
        start, results = 0, []
        for index in range(int(b.node.attrs["num_split"])):
            length = b.shape_of(ref(b.node.name, index))[axis]
            assert isinstance(length, int)
            results.append(take_range(b, value, axis, start, start + length))
            start += length
        return tuple(results)

    return Nn(lower)


def unpack(b: NnBuilder, args: Sequence[Value]) -> tuple[Value, ...]:
    """One tensor for each element of an axis, which is gone."""
    value = b.flatten_if_due(args[0])
    axis = int(b.node.attrs["axis"]) % len(value.shape)
    parts = [take_range(b, value, axis, i, i + 1) for i in range(int(b.node.attrs["num"]))]
    return tuple(_drop_axes(p, [axis]) for p in parts)


def take_range(b: NnBuilder, value: Value, axis: int, start: int, stop: int) -> Value:
    """Elements ``start`` to ``stop`` of an axis."""
    length = value.shape[axis]
    shape = tuple(stop - start if i == axis else d for i, d in enumerate(value.shape))
    if (start, stop) == (0, length):
        return value
    if length == BATCH:
        raise b.nn_error(*_CUTS_AGENTS)
    place = value.axes[axis]
    assert place is not None
    axes = tuple(None if i == axis and stop - start == 1 else a for i, a in enumerate(value.axes))
    if place == C:
        return replace(b.cut(value, start, stop, shape), axes=axes)
    pad, pool = [0, 0, 0, 0], [0, 0, 0, 0]
    pad[place], pool[place] = start, stop
    dims = list(value.dims)
    dims[place] = stop - start
    n, h, w, c = dims
    name = b.layer(
        LayerType.STRIDED_SLICE, [b.stored_name(value)], (n, h, w, c),
        pad=tuple(pad), pool=tuple(pool), stride=(1, 1, 1, 1), label="part",
    )  # fmt: skip
    return b.layer_value(name, shape, axes)


def _drop_axes(value: Value, axes: Sequence[int]) -> Value:
    """Without axes of length 1."""
    keep = [i for i in range(len(value.shape)) if i not in axes]
    return replace(value, shape=tuple(value.shape[i] for i in keep), axes=tuple(value.axes[i] for i in keep))


def slice_(b: NnBuilder, args: Sequence[Value]) -> Value:
    """Slice: a beginning and a size for each axis."""
    value = b.flatten_if_due(args[0])
    begin, size = (b.constant_operand(i, "the bounds of a slice").tolist() for i in (1, 2))
    for axis, (first, count) in enumerate(zip(begin, size, strict=True)):
        length = value.shape[axis]
        if isinstance(length, str):
            if first != 0 or count != -1:
                raise b.nn_error(*_CUTS_AGENTS)
            continue
        value = take_range(b, value, axis, int(first), length if count == -1 else int(first) + int(count))
    return value


def strided_slice(steps_of: Callable[..., Sequence[tuple[Any, ...]]]) -> Nn:
    """StridedSlice: bounds, new axes and axes that are dropped; steps other than 1 take element by element."""
    return Nn(partial(_take_steps, steps_of=steps_of))


def _take_steps(b: NnBuilder, args: Sequence[Value], *, steps_of: Callable[..., Sequence[tuple[Any, ...]]]) -> Value:
    value = b.flatten_if_due(args[0])
    operands = [b.constant_operand(i, "the bounds of a slice").tolist() for i in (1, 2, 3)]
    axis, gone = 0, []
    for step in steps_of(b.node, len(value.shape), *operands):
        if step[0] == "new":
            shape = (*value.shape[:axis], 1, *value.shape[axis:])
            value = replace(value, shape=shape, axes=(*value.axes[:axis], None, *value.axes[axis:]))
            axis += 1
            continue
        length = value.shape[axis]
        if step[0] == "take":
            if isinstance(length, str):
                raise b.nn_error(*_CUTS_AGENTS)
            index = int(step[1]) % length
            value = take_range(b, value, axis, index, index + 1)
            gone.append(axis)
        elif isinstance(length, str):
            if step[1] not in (None, 0) or step[2] is not None or step[3] != 1:
                raise b.nn_error(*_CUTS_AGENTS)
        else:
            indices = list(range(*slice(step[1], step[2], step[3]).indices(length)))
            value = take_indices(b, value, axis, indices)
        axis += 1
    return _drop_axes(value, gone)


def take_indices(b: NnBuilder, value: Value, axis: int, indices: Sequence[int]) -> Value:
    """Elements of an axis in the order given."""
    if not indices:
        raise b.nn_error("it cuts nothing out", "a tensor of a .nn has at least one number per agent")
    if list(indices) == list(range(indices[0], indices[-1] + 1)):
        return take_range(b, value, axis, indices[0], indices[-1] + 1)
    parts = [take_range(b, value, axis, i, i + 1) for i in indices]
    shape = tuple(len(indices) if i == axis else d for i, d in enumerate(value.shape))
    return join_along(b, parts, axis, shape)


# ------------------------------------------------------------------ looking up


def gather(b: NnBuilder, args: Sequence[Value]) -> Value:
    """Elements of an axis by constant indices."""
    value, indices = args
    axis = 0 if len(b.node.inputs) < 3 else int(b.constant_operand(2, "the axis"))
    if indices.array is not None and value.array is None:
        value = b.flatten_if_due(value)
        axis %= len(value.shape)
        length = value.shape[axis]
        if indices.array.ndim > 1 or isinstance(length, str):
            raise b.nn_error(f"indices of shape {list(indices.array.shape)}", "a list of indices can be written")
        flat = [int(i) % length for i in indices.array.reshape(-1)]
        result = take_indices(b, value, axis, flat)
        return _drop_axes(result, [axis]) if indices.array.ndim == 0 else result
    raise b.nn_error("its indices are computed", "rows of a constant table by one number per agent can be written")


# ------------------------------------------------------------------ repeating, filling


def tile(b: NnBuilder, args: Sequence[Value]) -> Value:
    """The tensor several times along its axes."""
    value, shape = b.flatten_if_due(args[0]), b.shape_of(b.node.name)
    if value.array is not None:
        return _tile(b, value.array, shape)
    times = b.constant_operand(1, "the numbers of repetitions").tolist()
    for axis, count in enumerate(times):
        if count == 1:
            continue
        if value.shape[axis] == BATCH:
            raise b.nn_error("it repeats agents", "a policy answers once for every agent")
        longer = tuple(d * count if i == axis and isinstance(d, int) else d for i, d in enumerate(value.shape))
        value = join_along(b, _copies_of(b, value, count), axis, longer)
    assert value.shape == shape
    return value


def _copies_of(b: NnBuilder, value: Value, times: int) -> list[Value]:
    """A tensor as the operands of a layer that joins it with itself. Raises UnsupportedOpError."""
    if times > _MOST_JOINED:
        raise b.nn_error(
            f"it repeats a tensor {times} times", f"a layer that joins takes {_MOST_JOINED} operands, no more"
        )
    return [value] * times


def _tile(b: NnBuilder, array: np.ndarray, shape: tuple[Dim, ...]) -> Value:
    """A constant several times; once for every agent."""
    lengths = [(1 if isinstance(d, str) else d, n) for d, n in zip(shape, array.shape, strict=True)]
    if any(wanted % length for wanted, length in lengths):
        raise b.nn_error(f"a constant of shape {list(array.shape)} to {list(shape)}", _MIXED)
    b.made_up(math.prod(wanted for wanted, _ in lengths))
    return Value(shape, array=np.tile(array, [wanted // length for wanted, length in lengths]))


def broadcast_to(b: NnBuilder, args: Sequence[Value]) -> Value:
    """Axes of length 1 repeated."""
    value, shape = args[0], b.shape_of(b.node.name)
    if value.array is not None:
        return constant_of(b, value.array, shape)
    value = b.flatten_if_due(value)
    lead = len(shape) - len(value.shape)
    value = replace(value, shape=(*[1] * lead, *value.shape), axes=(*[None] * lead, *value.axes))
    for axis, (length, wanted) in enumerate(zip(value.shape, shape, strict=True)):
        if length == wanted:
            continue
        if not isinstance(wanted, int):
            raise b.nn_error("it repeats a row for every agent", "only a constant can be repeated so")
        longer = tuple(wanted if i == axis else d for i, d in enumerate(value.shape))
        value = join_along(b, _copies_of(b, value, wanted), axis, longer)
    return value


def fill(b: NnBuilder, args: Sequence[Value]) -> Value:
    """One number in a row per agent."""
    return constant_of(b, b.constant_operand(1, "what it fills with"), b.shape_of(b.node.name))


def full_like(number: int) -> Nn:
    """The same number in the shape of the operand."""

    def lower(b: NnBuilder, args: Sequence[Value]) -> Value:
        array = np.array(number, b.type_of(b.node.inputs[0]).dtype)
        return constant_of(b, array, b.shape_of(b.node.name))

    return Nn(lower, NONE)


def constant_of(b: NnBuilder, array: np.ndarray, shape: tuple[Dim, ...]) -> Value:
    """A constant broadcast to ``shape``; the batch counts as one row."""
    lengths = [1 if isinstance(d, str) else d for d in shape]
    b.made_up(math.prod(lengths))
    return Value(shape, array=np.broadcast_to(array, lengths))


def pad(b: NnBuilder, args: Sequence[Value]) -> Value:
    """A border around the image; numbers in front of or behind the channels are joined on."""
    value, shape = b.flatten_if_due(args[0]), b.shape_of(b.node.name)
    pairs = [(int(x), int(y)) for x, y in b.constant_operand(1, "the widths of the border").tolist()]
    number = 0.0
    if len(b.node.inputs) > 2:
        number = float(b.constant_operand(2, "the number that it fills with").reshape(()))
    edges = dict.fromkeys((H, W), (0, 0))
    for axis, (low, high) in enumerate(pairs):
        place = value.axes[axis]
        if (low, high) == (0, 0):
            continue
        if min(low, high) < 0 or value.shape[axis] == BATCH:
            raise b.nn_error(f"a border of {low} and {high} on axis {axis}", "borders are around the image")
        if place in (H, W) and len(shape) == 4:
            edges[place] = (low, high)
            continue
        parts = [value]
        for count, at in ((low, 0), (high, 2)):
            if count:
                lengths = tuple(count if i == axis else d for i, d in enumerate(value.shape))
                parts.insert(at, constant_of(b, np.array(number, np.float32), lengths))
        longer = tuple(d + low + high if i == axis and isinstance(d, int) else d for i, d in enumerate(value.shape))
        value = join_along(b, parts, axis, longer)
    if all(pair == (0, 0) for pair in edges.values()):
        return value
    n, h, w, c = value.dims
    (top, bottom), (left, right) = edges[H], edges[W]
    dims = (n, h + top + bottom, w + left + right, c)
    name = b.layer(LayerType.BORDER2D, [b.stored_name(value)], dims, pad=(left, top, right, bottom), beta=number)
    return b.layer_value(name, shape, value.axes)
