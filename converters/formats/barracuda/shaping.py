"""Layers that move numbers without changing them: reshape, transpose, join, cut, repeat.

Axes up to version 16 count N, H, W, C; from 17 on S, R, N, T, D, H, W, C, of which a policy uses the same four.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from export_model.converters.formats.barracuda.format import EIGHT_AXES
from export_model.converters.formats.barracuda.layer_builder import LayerBuilder, NnValue, Shape, with_length
from export_model.converters.graph.ops.barracuda.vocabulary import C, H, N, W
from export_model.converters.graph.types import INT32

_NAMES = "NHWC"
#: Positions of N, H, W, C in the eight-entry shapes of versions from 17 on: S, R, N, T, D, H, W, C.
_EIGHT = (2, 5, 6, 7)
#: Ends of a slice that mean "to the end" wherever it is.
_FAR = (1 << 31) - 1


def axis_of(b: LayerBuilder, axis: int) -> int:
    """An axis of the file as a position in N, H, W, C; −1 is C."""
    if -4 <= axis < 0:
        return axis + 4
    if b.version < EIGHT_AXES and 0 <= axis < 4:
        return axis
    if b.version >= EIGHT_AXES and axis in _EIGHT:
        return _EIGHT.index(axis)
    raise b.unsupported_error(f"the axis is {axis}", "the tensors of a policy have the axes N, H, W and C")


def flatten(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """[N, 1, 1, H·W·C]."""
    x = args[0]
    return x if x.rank != 4 else b.rows(b.as_matrix(x), x.n, x.size)


def reshape(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """The elements in order in the shape ``pool``: −1 is what is left, 0 the length it had.

    An empty ``pool`` takes the shape of the second input, or from 2.x on (``axis`` 1) the numbers in it.
    """
    x = args[0]
    if b.layer.pool:
        target = list(b.four(b.layer.pool))
    elif len(args) == 2 and b.layer.axis == 1 and args[1].constant is not None:
        numbers = b.whole(args[1].constant)
        if len(numbers) > 4:
            raise b.unsupported_error(f"the target is {numbers}", "more than four axes are not translated")
        target = [*numbers, *[1] * (4 - len(numbers))]
    elif len(args) == 2 and b.layer.axis != 1:
        target = [-1 if d is None else d for d in args[1].shape]
    else:
        raise b.unsupported_error("its shape is computed", "a shape must be known before the model runs")
    return b.as_shape(x.reference, _reshaped_shape(b, x, target), x.integer)


def _reshaped_shape(b: LayerBuilder, x: NnValue, target: list[int]) -> Shape:
    n, *lengths = x.shape
    wanted = [length if t == 0 else t for t, length in zip(target[1:], lengths, strict=True)]
    if [target[0], *wanted].count(-1) > 1 or min(target) < -1:
        raise b.damaged_error(f"the target is {target}", "it leaves more than one length open")
    known = math.prod(length for length in wanted if length != -1)
    rows = n if target[0] == 0 else target[0]
    if n is None and target[0] == 1:
        # Written for one agent; where the numbers of a row stay together, it serves any number of them.
        b.note(f"layer {b.layer.name} reshapes to a batch of 1 in the .nn; here it takes any batch")
    if n is None and target[0] in (-1, 0, 1):
        rows, total = None, x.size
    else:
        if rows == -1 and n is not None and known and n * x.size % known == 0:
            rows = n * x.size // known
        total = (n or 0) * x.size // rows if rows and (n or 0) * x.size % rows == 0 else -1
    if -1 in wanted and known and total % known == 0:
        wanted[wanted.index(-1)] = total // known
    h, w, c = wanted
    if min(wanted) < 1 or h * w * c != total:
        raise b.unsupported_error(
            f"{list(x.shape)} to {target}", "the numbers of one agent must stay in one row, or agents would be mixed"
        )
    return rows, h, w, c


def squeeze(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """Squeeze and Unsqueeze: no version of Barracuda runs them; where H and W are 1 nothing could move."""
    x = args[0]
    if x.rank == 4:
        raise b.unsupported_error(f"a tensor of shape {list(x.shape)}", "Barracuda never said where its axes go")
    return x


def transpose(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """Axis i of the result is axis ``pool[i]`` of the input."""
    x = args[0]
    order = tuple(b.layer.pool)
    if len(order) == 8:
        if any(order[i] != i for i in (0, 1, 3, 4)) or sorted(order) != list(range(8)):
            raise b.unsupported_error(
                f"the order is {list(order)}", "the tensors of a policy have the axes N, H, W and C"
            )
        order = tuple(_EIGHT.index(order[i]) for i in _EIGHT)
    if sorted(order) != [0, 1, 2, 3]:
        raise b.unsupported_error(f"the order is {list(order)}", "only the four axes N, H, W, C can be put in order")
    n, h, w, c = (x.shape[i] for i in order)
    if order[0] != N and x.n is None:
        raise b.unsupported_error(f"the order is {list(order)}", "it would turn agents into pixels or channels")
    turned = b.add("Transpose", [b.as_image(x), b.ints(list(order), "order")])
    return b.as_shape(turned, (n, int(h or 0), int(w or 0), int(c or 0)))


def concat(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """The inputs one after the other along an axis; the other lengths are equal."""
    axis = axis_of(b, b.layer.axis)
    if len(args) == 1:
        return args[0]
    if axis == N:
        raise b.unsupported_error("it joins along the batch", "the rows of a policy are its agents")
    shapes = [list(v.shape) for v in args]
    if any(s[:axis] + s[axis + 1 :] != shapes[0][:axis] + shapes[0][axis + 1 :] for s in shapes):
        raise b.damaged_error(f"the shapes are {shapes}", f"they may differ in {_NAMES[axis]} alone")
    total = sum(int(s[axis] or 0) for s in shapes)
    if axis == C and all(v.shape[1:3] == (1, 1) for v in args):
        join = b.ints(1, "axis")
        integers = [v.integer for v in args if v.integer is not None]
        integer = b.add("ConcatV2", [*integers, join], name="integers") if len(integers) == len(args) else None
        return b.rows(b.add("ConcatV2", [*(b.as_matrix(v) for v in args), join]), args[0].shape[N], total, integer)
    joined = b.add("ConcatV2", [*(b.as_image(v) for v in args), b.ints(axis, "axis")])
    return b.as_shape(joined, with_length(args[0].shape, axis, total))


# ------------------------------------------------------------------ cutting


def strided_slice(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """``pad`` to ``pool`` in steps of ``stride``, four (or eight) entries each."""
    x = args[0]
    starts, ends, steps = (_entries(b, v, d) for v, d in ((b.layer.pad, 0), (b.layer.pool, 0), (b.layer.stride, 1)))
    if (starts[N], ends[N]) not in ((0, 0), (0, _FAR)) or steps[N] != 1:
        raise b.unsupported_error(
            f"it cuts {starts[N]}:{ends[N]}:{steps[N]} out of the batch", "a policy answers for every agent"
        )
    cuts = [_cut(b, starts[i], ends[i], steps[i], int(x.shape[i] or 0), _NAMES[i]) for i in (H, W, C)]
    h, w, c = (len(range(*cut)) for cut in cuts)
    if cuts == [(0, length, 1) for length in x.shape[1:]]:
        return x
    shape = (x.n, h, w, c)
    if x.rank == 4:
        return b.as_shape(_strided_slice(b, x.reference, cuts, "part"), shape)
    if x.rank == 1:
        return b.as_shape(_strided_slice(b, b.as_matrix(x), cuts[2:], "part"), shape)
    integer = None if x.integer is None else _strided_slice(b, x.integer, cuts[2:], "integers")
    return NnValue(_strided_slice(b, x.reference, cuts[2:], "part"), shape, integer=integer)


def _strided_slice(b: LayerBuilder, x: str, cuts: Sequence[tuple[int, int, int]], label: str) -> str:
    """``x`` with its first axis whole and the others cut."""
    columns = [(0, 0, 1), *cuts]
    operands = [b.ints([cut[i] for cut in columns], part) for i, part in enumerate(("begin", "end", "steps"))]
    return b.add("StridedSlice", [x, *operands], name=label, begin_mask=1, end_mask=1)


def _entries(b: LayerBuilder, values: Sequence[int], default: int) -> list[int]:
    if len(values) == 8 and all(values[i] in (0, 1, default) for i in (0, 1, 3, 4)):
        return [values[i] for i in _EIGHT]
    if len(values) != 4:
        raise b.damaged_error(f"the bounds are {list(values)}", "they have four entries, or eight")
    return list(values)


def _cut(b: LayerBuilder, start: int, end: int, step: int, length: int, name: str) -> tuple[int, int, int]:
    """(first, behind the last, step) of an axis.

    0:0 is the whole axis, an end of 0 the end of the axis, a step of 0 the one element at the start.
    """
    first = length if start >= length else start % length if length else 0
    last = length if end >= length else end % length if length else 0
    text = f"{start}:{end}:{step} of the {length} elements of {name}"
    if first >= length:
        raise b.damaged_error(f"it cuts {text}", "that begins behind the end")
    if step == 0:
        return first, first + 1, 1
    if step < 0 or (start == end != 0):
        raise b.unsupported_error(f"it cuts {text}", "versions of Barracuda read that differently")
    if last == 0:
        last = length
    if last <= first:
        raise b.unsupported_error(
            f"it cuts {text}", "that is empty, or reaches behind the end in old versions of Barracuda"
        )
    count, rest = divmod(last - first, step)
    if rest:
        raise b.unsupported_error(
            f"it cuts {text}", f"the step does not divide the length: {count} or {count + 1} elements, by version"
        )
    return first, last, step


def gather(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """Elements along an axis: chosen by constants, or by a number per agent out of the rows of a constant table."""
    x, index = args
    axis = axis_of(b, b.layer.axis)
    if tuple(b.layer.pool)[1:] not in ((), (0,), (1,)):
        raise b.unsupported_error(f"indices of rank {b.layer.pool[1]}", "only a list of indices is translated")
    if index.constant is not None and axis != N:
        chosen = b.whole(index.constant)
        if not chosen or min(chosen) < 0 or max(chosen) >= int(x.shape[axis] or 0):
            raise b.damaged_error(
                f"the indices are {chosen}", f"there are {x.shape[axis]} elements along {_NAMES[axis]}"
            )
        return b.as_shape(b.take(b.as_image(x), chosen, axis), with_length(x.shape, axis, len(chosen)))
    if axis == N and x.n is not None and index.size == 1:
        numbers = index.integer or b.add("Cast", [index.reference], DstT=INT32)
        flat = b.add("Reshape", [numbers, b.ints([-1], "list")], name="list")
        found = b.add("GatherV2", [b.as_image(x), flat, b.ints(0, "axis")])
        return b.as_shape(found, (index.n, *x.shape[1:]))
    raise b.unsupported_error(
        f"indices of shape {list(index.shape)} along {_NAMES[axis]} of {list(x.shape)}",
        "indices must be constants, or one per agent into the rows of a constant table",
    )


# ------------------------------------------------------------------ repeating, and blocks


def tile(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """The tensor ``pool`` times along each axis."""
    return _repeat(b, args[0], b.four(b.layer.pool))


def expand(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """Axes of length 1 repeated to the lengths in ``pool``."""
    x = args[0]
    target = b.four(b.layer.pool)
    factors = []
    for length, wanted in zip(x.shape, target, strict=True):
        if wanted > 1 and length not in (1, wanted):
            raise b.damaged_error(f"{list(x.shape)} to {list(target)}", "only axes of length 1 are expanded")
        factors.append(wanted if wanted > 1 and length == 1 else 1)
    return _repeat(b, x, factors)


def _repeat(b: LayerBuilder, x: NnValue, factors: Sequence[int]) -> NnValue:
    if min(factors) < 1 or (factors[N] != 1 and x.n is None):
        raise b.unsupported_error(f"it repeats {list(factors)} times", "a policy has one row per agent")
    n, h, w, c = x.shape
    shape = (None if n is None else n * factors[N], h * factors[H], w * factors[W], c * factors[C])
    if shape == x.shape:
        return x
    b.check_size(*shape[1:])
    return b.as_shape(b.add("Tile", [b.as_image(x), b.ints(list(factors), "times")]), shape)


def depth_to_space(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """Blocks of ``pool`` = [width, height] pixels out of the channels; ``axis`` 0: block first, 1: channel first."""
    x = args[0]
    across, down = _block(b)
    n, h, w, c = x.shape
    if c % (across * down) or b.layer.axis not in (0, 1):
        raise b.damaged_error(
            f"blocks of {across}·{down} out of {c} channels, mode {b.layer.axis}", "they do not divide"
        )
    deep, data = c // (across * down), b.as_image(x)
    if b.layer.axis == 1:
        data = b.take(data, np.arange(c).reshape(deep, -1).T.reshape(-1).tolist(), C)
    rows = -1 if n is None else n
    split = b.add("Reshape", [data, b.ints([rows, h, w, down, across * deep], "blocks")], name="blocks")
    turned = b.add("Transpose", [split, b.ints([0, 1, 3, 2, 4], "order")])
    return b.as_shape(turned, (n, h * down, w * across, deep))


def space_to_depth(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """Blocks of ``pool`` = [width, height] pixels into the channels, row by row."""
    x = args[0]
    across, down = _block(b)
    n, h, w, c = x.shape
    if h % down or w % across:
        raise b.damaged_error(f"blocks of {across}·{down} of {list(x.shape)}", "they do not divide the image")
    rows = -1 if n is None else n
    blocks = b.ints([rows, h // down, down, w // across, across * c], "blocks")
    split = b.add("Reshape", [b.as_image(x), blocks], name="blocks")
    turned = b.add("Transpose", [split, b.ints([0, 1, 3, 2, 4], "order")])
    return b.as_shape(turned, (n, h // down, w // across, down * across * c))


def _block(b: LayerBuilder) -> tuple[int, int]:
    if len(b.layer.pool) != 2 or min(b.layer.pool) < 1:
        raise b.damaged_error(f"blocks of {list(b.layer.pool)}", "they have a width and a height")
    return b.layer.pool[0], b.layer.pool[1]
