"""ONNX ops that join, cut and pad arrays, and that choose elements of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, cast

import numpy as np

from export_model.converters.formats.onnx.importer.importer import Importer
from export_model.converters.formats.onnx.importer.node import Op, Translate
from export_model.converters.graph.types import INT32, INT64, Dim

#: Beyond this an index means "to the end", in the 32-bit numbers that all targets have.
_END = 2**31 - 1


# ------------------------------------------------------------------ joining and cutting


def _concat(op: Op, net: Importer) -> str:
    parts = [op.need(i) for i in range(len(op.inputs))]
    return net.concat(parts, op.integer("axis", 1))


def _split(op: Op, net: Importer) -> list[str | None]:
    """The parts of a tensor, by the lengths that the op gives.

    They are an attribute before opset 13, an input from there on; without them the parts are equal (the last one
    shorter from opset 18 on).
    """
    x = op.need(0)
    axis = net.axis(x, op.integer("axis", 0))
    operand = op.get(1)
    sizes = op.integers("split") if op.opset < 13 else None
    if operand is not None and op.opset >= 13:
        sizes = tuple(int(s) for s in net.needed_constant(operand, "the list of lengths").reshape(-1))
    if sizes is None:
        count = op.integer("num_outputs", len(op.outputs))
        if not 1 <= count <= len(op.outputs):
            raise op.op_error(f"it cuts into {count} parts for {len(op.outputs)} outputs", "the model is damaged")
        length = net.length(x, axis)
        each = -(-length // count)
        sizes = tuple(min(each, length - i * each) for i in range(count))
    if min(sizes) < 0:
        raise op.op_error(f"it cuts into lengths {list(sizes)}", "the model is damaged")
    if len(sizes) == 1:
        return [x]
    split = net.add("SplitV", [x, net.ints(sizes, "sizes"), net.ints(axis, "axis")], num_split=len(sizes))
    return [split if i == 0 else f"{split}:{i}" for i in range(len(sizes))]


def _slice(op: Op, net: Importer) -> str:
    """Bounds: attributes before opset 10, inputs from there on."""
    x = op.need(0)
    if op.opset < 10:
        starts, ends = op.integers("starts", ()) or (), op.integers("ends", ()) or ()
        given = op.integers("axes")
        steps: tuple[int, ...] = (1,) * len(starts)
    else:
        operands = [op.need(1), op.need(2), *(op.get(i) for i in (3, 4))]
        values = [None if o is None else net.constant(o) for o in operands]
        if any(o is not None and v is None for o, v in zip(operands, values, strict=True)):
            return _dynamic_slice(op, net, x)
        numbers = [None if v is None else tuple(int(n) for n in v.reshape(-1)) for v in values]
        starts, ends = numbers[0] or (), numbers[1] or ()
        given, steps = numbers[2], numbers[3] or (1,) * len(starts)
    axes = [net.axis(x, a) for a in (range(len(starts)) if given is None else given)]
    if not len(starts) == len(ends) == len(axes) == len(steps) or 0 in steps:
        raise op.op_error("its bounds do not fit together", "the model is damaged")
    return _strided_slice(net, x, {a: b for a, *b in zip(axes, starts, ends, steps, strict=True)}, net.type_of(x).shape)


def _strided_slice(net: Importer, x: str, bounds: Mapping[int, Sequence[int]], shape: Sequence[Dim] | None) -> str:
    """A strided slice over the axes up to the last one that is cut; a bound at or beyond an end is left open."""
    count = max(bounds, default=-1) + 1
    begin, end, steps = [0] * count, [0] * count, [1] * count
    begin_mask = end_mask = 0
    for axis in range(count):
        start, stop, step = bounds.get(axis, (0, _END, 1))
        length = None if shape is None else shape[axis]
        steps[axis] = step
        first = 0 if step > 0 else _END
        if isinstance(length, int):
            start, stop = (min(max(v, -length - 1), length) for v in (start, stop))
            first = 0 if step > 0 else length
            if step > 0 and start < 0:
                start = max(start + length, 0)
        if start == first or (step < 0 and start >= _END):
            begin_mask |= 1 << axis
        else:
            begin[axis] = start
        whole = stop >= _END or (isinstance(length, int) and stop >= length)
        if whole if step > 0 else stop < -_END or (isinstance(length, int) and stop < -length):
            end_mask |= 1 << axis
        else:
            end[axis] = stop
    operands = [net.ints(v, n) for v, n in ((begin, "begin"), (end, "end"), (steps, "steps"))]
    return net.add("StridedSlice", [x, *operands], begin_mask=begin_mask, end_mask=end_mask)


def _dynamic_slice(op: Op, net: Importer, x: str) -> str:
    """Bounds that are computed (from shapes, as a rule): the passes fold them once the lengths are known."""
    axes_at, steps_at = op.get(3), op.get(4)
    starts, ends = net.shape_operand(op.need(1)), net.shape_operand(op.need(2))
    count = net.length(starts, 0)
    axes = [int(a) for a in net.needed_constant(axes_at, "the list of axes").reshape(-1)] if axes_at else range(count)
    steps = [int(s) for s in net.needed_constant(steps_at, "the steps").reshape(-1)] if steps_at else [1] * count
    order = [net.axis(x, a) for a in axes]
    width = max(order) + 1
    zero = net.ints(0, "zero")

    def spread(vector: str) -> str:
        cells = [net.element(vector, order.index(i)) if i in order else zero for i in range(width)]
        return net.add("Pack", cells, axis=0)

    mask = sum(1 << i for i in range(width) if i not in order)
    strides = net.ints([steps[order.index(i)] if i in order else 1 for i in range(width)], "steps")
    return net.add("StridedSlice", [x, spread(starts), spread(ends), strides], begin_mask=mask, end_mask=mask)


def _gather(op: Op, net: Importer) -> str:
    """Indices may be negative, which TensorFlow's Gather does not take."""
    x, indices = op.need(0), op.need(1)
    axis = net.axis(x, op.integer("axis", 0))
    length = net.shape(x)[axis]
    value = net.constant(indices)
    if value is not None and isinstance(length, int) and ((value < -length) | (value >= length)).any():
        raise op.op_error(f"it takes an element that an axis of {length} does not have")
    if value is not None and value.ndim == 0 and (isinstance(length, int) or int(value) >= 0):
        index = int(value) % length if isinstance(length, int) else int(value)
        return net.slice(x, axis, index, index + 1, dropped=True)
    if value is not None:
        if (value < 0).any() and not isinstance(length, int):
            raise op.op_error("its indices count from the end of an axis whose length is not known")
        plain = value if not isinstance(length, int) else np.where(value < 0, value + length, value)
        indices = net.const(plain.astype(INT32), "indices")
    elif isinstance(length, int):
        indices = net.add("FloorMod", [net.cast(indices, INT32), net.ints(length, "length")])
    return net.add("GatherV2", [x, indices, net.ints(axis, "axis")])


def _pad(op: Op, net: Importer) -> str:
    """Paddings: an attribute before opset 11, inputs from there on (with axes from 18 on)."""
    x, mode = op.need(0), op.text("mode", "constant")
    rank = net.rank(x)
    fill: str | None
    if op.opset < 11:
        pads = op.integers("pads", ()) or ()
        number = op.number("value", 0.0)
        fill = None if number == 0 else net.number(x, number)
        axes = list(range(rank))
    else:
        pads = tuple(int(p) for p in net.needed_constant(op.need(1), "the padding").reshape(-1))
        fill, operand = op.get(2), op.get(3)
        axes = list(range(rank))
        if operand is not None:
            given = net.needed_constant(operand, "the list of axes").reshape(-1)
            axes = [net.axis(x, int(a)) for a in given]
    if len(pads) != 2 * len(axes):
        raise op.op_error("it does not give two paddings for each axis", "the model is damaged")
    pairs = dict(zip(axes, zip(pads[: len(axes)], pads[len(axes) :], strict=True), strict=True))
    if mode in ("reflect", "edge", "wrap"):
        for axis in (a for a in axes if any(pairs[a])):
            x = net.take(x, _padded_indices(op, net, net.length(x, axis), pairs[axis], mode), axis)
        return x
    if mode != "constant":
        raise op.op_error(f"mode {mode!r}", "the model is damaged")
    return net.pad(x, [pairs.get(i, (0, 0)) for i in range(rank)], fill)


def _padded_indices(op: Op, net: Importer, length: int, pair: tuple[int, int], mode: str) -> list[int]:
    """Which elements of an axis stand where once it is padded with its own; a negative padding cuts off."""
    before, after = (max(n, 0) for n in pair)
    if not length:
        raise op.op_error("it pads an axis of no elements with its own", "the model is damaged")
    net.room(before + length + after)
    cut = np.arange(length)[max(-pair[0], 0) : length - max(-pair[1], 0)]
    padded: list[int] = np.pad(cut, (before, after), mode=cast(Literal["reflect", "edge", "wrap"], mode)).tolist()
    return padded


# ------------------------------------------------------------------ indices


def _one_hot(op: Op, net: Importer) -> str:
    """Indices down to -depth count from the end; TensorFlow gives them a row of off-values."""
    indices, depth_at, values = op.need(0), op.need(1), op.need(2)
    depth = int(net.needed_constant(depth_at, "the depth").reshape(-1)[0])
    index = net.cast(indices, INT32)
    negative = net.cast(net.add("Less", [index, net.ints(0, "zero")]), INT32)
    index = net.add("Add", [index, net.add("Mul", [negative, net.ints(depth, "depth")])])
    off, on = (net.element(values, i) for i in range(2))
    rank = net.rank(indices)
    axis = net.axis_of(op.integer("axis", -1), rank + 1)
    return net.add("OneHot", [index, net.ints(depth, "depth"), on, off], axis=-1 if axis == rank else axis)


def _trilu(op: Op, net: Importer) -> str:
    """The upper or lower triangle of the last two axes."""
    x, operand = op.need(0), op.get(1)
    k = 0 if operand is None else int(net.needed_constant(operand, "the diagonal").reshape(-1)[0])
    rows, columns = net.length(x, -2), net.length(x, -1)
    net.room(rows * columns)
    whole = np.ones((rows, columns), bool)
    mask = np.triu(whole, k) if op.integer("upper", 1) else np.tril(whole, k)
    return net.where(net.const(mask, "triangle"), x, net.add("ZerosLike", [x]))


def _non_zero(op: Op, net: Importer) -> str:
    """Of a constant only (older exporters write torch.arange so): how many there are decides the shape."""
    value = net.needed_constant(op.need(0), "what it looks at")
    return net.const(np.array(np.nonzero(value), INT64), "indices")


OPS: Mapping[str, Translate] = {
    "Concat": _concat,
    "Split": _split,
    "Slice": _slice,
    "Gather": _gather,
    "Pad": _pad,
    "OneHot": _one_hot,
    "Trilu": _trilu,
    "NonZero": _non_zero,
}
