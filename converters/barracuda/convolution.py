"""Layers that slide over an image: convolutions, pools, borders, enlarging; and its normalisation.

A ``.nn`` gives strides and pools as [width, height], pads as [left, top, right, bottom]. A first pad of −1 stands for
TensorFlow's SAME, −2 for the same with the odd element of padding in front.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from converters.barracuda.dense import biased
from converters.barracuda.layer_builder import LayerBuilder, Value
from converters.barracuda.vocabulary import LayerType
from converters.graph.ops.convolution import window_padding

_SAME, _SAME_LOWER = -1, -2
#: What Unity's maximum starts from; a border of it never wins.
_LOWEST = float(np.finfo(np.float32).min)
#: Stands for the smallest float that Unity adds where no epsilon is given (1.4e-45, which runtimes flush to zero).
_TINY = float(np.finfo(np.float32).tiny)


@dataclass(frozen=True, slots=True)
class _Window:
    """A window over (height, width): its size, its steps, what is padded before and after."""

    size: tuple[int, int]
    stride: tuple[int, int]
    before: tuple[int, int]
    after: tuple[int, int]
    same: bool

    def length(self, axis: int, length: int) -> int:
        """The result's length on an axis (0 height, 1 width) of an image of ``length``."""
        return (length + self.before[axis] + self.after[axis] - self.size[axis]) // self.stride[axis] + 1


def _window(b: LayerBuilder, x: Value, size: tuple[int, int], stride: Sequence[int]) -> _Window:
    """The window of the current layer over an image; ``size`` is (height, width). Raises GraphError."""
    if len(stride) != 2 or min(stride) < 1 or min(size) < 1:
        raise b.damaged(f"a window of {list(size)} with strides {list(stride)}", "both have two numbers above 0")
    if stride[0] != stride[1]:
        b.note(
            f"layer {b.layer.name} has the strides {list(stride)}: read as [width, height], as Unity does; "
            "ML-Agents' converter wrote [height, width]"
        )
    steps = (stride[1], stride[0])
    pad = tuple(b.layer.pad) or (0, 0, 0, 0)
    same = pad[0] == _SAME
    if pad[0] in (_SAME, _SAME_LOWER):
        pads = [window_padding(x.shape[1:3][i], size[i], steps[i], "SAME")[1:] for i in (0, 1)]
        if not same:
            pads = [(after, before) for before, after in pads]
    elif len(pad) == 4 and min(pad) >= 0:
        pads = [(pad[1], pad[3]), (pad[0], pad[2])]
    else:
        raise b.unsupported(f"the pads are {list(pad)}", "four lengths from 0 on, −1 (SAME) and −2 are known")
    window = _Window(size, steps, (pads[0][0], pads[1][0]), (pads[0][1], pads[1][1]), same)
    b.sized(*(length + sum(p) for length, p in zip(x.shape[1:3], pads, strict=True)), x.c)
    if min(window.length(0, x.h), window.length(1, x.w)) < 1:
        raise b.damaged(f"a window of {list(size)} over {list(x.shape)}", "the window is larger than the image")
    return window


def _slide(b: LayerBuilder, op: str, x: Value, window: _Window, kernel: str | None, fill: float) -> str:
    """A window op: SAME where it is, else VALID over an image that is padded with ``fill`` first."""
    data, padding = b.as_image(x), "SAME" if window.same else "VALID"
    if not window.same and any(window.before + window.after):
        pads = [[0, 0], *([lo, hi] for lo, hi in zip(window.before, window.after, strict=True)), [0, 0]]
        data = padded(b, data, pads, fill)
    strides = (1, *window.stride, 1)
    if kernel is None:
        return b.add(op, [data], ksize=(1, *window.size, 1), strides=strides, padding=padding)
    return b.add(op, [data, kernel], strides=strides, padding=padding)


def padded(b: LayerBuilder, x: str, pads: Sequence[Sequence[int]], fill: float) -> str:
    """``x`` with ``pads`` (a pair per axis) of ``fill`` around it."""
    operand = b.ints(pads, "pads")
    return b.add("Pad", [x, operand]) if fill == 0 else b.add("PadV2", [x, operand, b.floats(fill, "fill")])


# ------------------------------------------------------------------ convolutions


def conv2d(b: LayerBuilder, args: Sequence[Value]) -> Value:
    """K [height, width, in, out] over an image, plus a bias of out."""
    x, kernel, bias = args
    array = _kernel(b, kernel)
    if array.shape[2] != x.c or bias.size != array.shape[3]:
        raise _channels(b, x, kernel, bias)
    window = _window(b, x, array.shape[:2], b.layer.stride)
    product = _slide(b, "Conv2D", x, window, b.as_image(kernel), 0)
    return _image_of(b, x, window, biased(b, product, bias), array.shape[3])


def depthwise(b: LayerBuilder, args: Sequence[Value]) -> Value:
    """A kernel [height, width, 1, C] that keeps the channels apart; TensorFlow's is [height, width, C, 1]."""
    x, kernel, bias = args
    array = _kernel(b, kernel)
    if array.shape[2] != 1:
        raise b.unsupported(f"a kernel of shape {list(array.shape)}", "Unity knows one result per channel")
    if array.shape[3] != x.c or bias.size != array.shape[3]:
        raise _channels(b, x, kernel, bias)
    window = _window(b, x, array.shape[:2], b.layer.stride)
    turned = b.floats(array.transpose(0, 1, 3, 2), "kernel")
    product = _slide(b, "DepthwiseConv2dNative", x, window, turned, 0)
    return _image_of(b, x, window, biased(b, product, bias), array.shape[3])


def conv2d_trans(b: LayerBuilder, args: Sequence[Value]) -> Value:
    """A transposed convolution: zeros between the pixels, a border, and a plain convolution with K turned round.

    ``pool`` is the output adjustment [width, height]; where it is empty, Unity takes (in + pads − kernel) mod stride.
    """
    x, kernel, bias = args
    array = _kernel(b, kernel)
    if array.shape[2] != x.c:
        raise b.unsupported(
            f"a kernel of shape {list(array.shape)} for {x.c} channels",
            "the converters of ML-Agents 0.7 and 0.8 wrote [height, width, out, in], which Unity cannot run",
        )
    if bias.size != array.shape[3]:
        raise _channels(b, x, kernel, bias)
    size = (int(array.shape[0]), int(array.shape[1]))
    stride, pad, adjust = b.layer.stride, tuple(b.layer.pad), tuple(b.layer.pool)
    if len(stride) != 2 or min(stride) < 1 or stride[0] != stride[1]:
        raise b.unsupported(f"the strides {list(stride)}", "Unity takes the width's stride for both axes")
    if pad[:1] in ((_SAME,), (_SAME_LOWER,)):
        window = _window(b, x, size, stride)
        pad = (window.before[1], window.before[0], window.after[1], window.after[0])
    if len(pad) != 4 or min(pad) < 0 or pad[:2] != pad[2:]:
        raise b.unsupported(f"the pads {list(pad)}", "Unity runs pads that are equal on both sides alone")
    step = stride[0]
    lengths, borders = [], []
    for axis, length in enumerate(x.shape[1:3]):
        low, extent = pad[1 - axis], size[axis]
        given = adjust[1 - axis] if len(adjust) == 2 else (length + 2 * low - extent) % step
        result = (length - 1) * step - 2 * low + extent + given
        before = extent - 1 - low
        # Of the image with zeros between its pixels, ``before`` is added (or cut off) in front, the rest behind.
        borders.append((before, result + extent - 1 - before - ((length - 1) * step + 1)))
        lengths.append(result)
    if min(lengths) < 1:
        raise b.damaged(f"a result of {lengths}", "pads and adjustment leave nothing of the image")
    b.sized(
        *(max(step * length, r) + sum(map(abs, f)) for length, r, f in zip(x.shape[1:3], lengths, borders, strict=True))
    )
    spread = _spread(b, x, step)
    framed = _framed(b, spread, [1 + (length - 1) * step for length in x.shape[1:3]], borders)
    turned = b.floats(array[::-1, ::-1], "kernel")
    product = b.add("Conv2D", [framed, turned], strides=(1, 1, 1, 1), padding="VALID")
    shape = (x.n, lengths[0], lengths[1], int(array.shape[3]))
    return b.shaped(biased(b, product, bias), shape) if shape[1:3] == (1, 1) else Value(biased(b, product, bias), shape)


def _spread(b: LayerBuilder, x: Value, step: int) -> str:
    """The image with ``step`` − 1 zeros after every pixel of both axes, as [N, H·step, W·step, C]."""
    data = b.as_image(x)
    if step == 1:
        return data
    n, h, w, c = x.shape
    rows = -1 if n is None else n
    gaps = [[0, 0], [0, 0], [0, step - 1], [0, 0]]
    data = b.add("Reshape", [data, b.ints([rows, h, 1, w * c], "lines")], name="lines")
    data = padded(b, data, gaps, 0)
    data = b.add("Reshape", [data, b.ints([rows, h * step * w, 1, c], "pixels")], name="pixels")
    data = padded(b, data, gaps, 0)
    return b.add("Reshape", [data, b.ints([rows, h * step, w * step, c], "spread")], name="spread")


def _framed(b: LayerBuilder, x: str, lengths: Sequence[int], borders: Sequence[tuple[int, int]]) -> str:
    """An image cut to ``lengths``, and then given borders of zeros; a negative border cuts more off."""
    begin = [0, *(max(-low, 0) for low, _ in borders), 0]
    end = [0, *(length - max(-high, 0) for length, (_, high) in zip(lengths, borders, strict=True)), 0]
    operands = [b.ints(begin, "begin"), b.ints(end, "end"), b.ints([1, 1, 1, 1], "steps")]
    cut = b.add("StridedSlice", [x, *operands], begin_mask=0b1001, end_mask=0b1001)
    pads = [[0, 0], *([max(low, 0), max(high, 0)] for low, high in borders), [0, 0]]
    return padded(b, cut, pads, 0) if any(map(any, pads)) else cut


def _kernel(b: LayerBuilder, kernel: Value) -> np.ndarray:
    if kernel.constant is None:
        raise b.unsupported("its kernel is computed", "kernels are constants in every target")
    return kernel.constant


def _channels(b: LayerBuilder, x: Value, kernel: Value, bias: Value) -> Exception:
    return b.damaged(
        f"{x.c} channels, a kernel of shape {list(kernel.shape)}, a bias of {bias.size}",
        "the kernel [height, width, in, out] does not fit to them",
    )


def _image_of(b: LayerBuilder, x: Value, window: _Window, reference: str, channels: int) -> Value:
    shape = (x.n, window.length(0, x.h), window.length(1, x.w), channels)
    return b.shaped(reference, shape) if shape[1:3] == (1, 1) else Value(reference, shape)


# ------------------------------------------------------------------ pools


def pool(b: LayerBuilder, args: Sequence[Value]) -> Value:
    """The maximum or the mean of each window; what is padded does not count."""
    (x,) = args
    if len(b.layer.pool) != 2:
        raise b.damaged(f"the window is {list(b.layer.pool)}", "it must be [width, height]")
    size = (b.layer.pool[1], b.layer.pool[0])
    window = _window(b, x, size, b.layer.stride)
    if b.layer.type == LayerType.MAX_POOL2D:
        return _image_of(b, x, window, _slide(b, "MaxPool", x, window, None, _LOWEST), x.c)
    mean = _slide(b, "AvgPool", x, window, None, 0)
    counts = [_counts(window, i, length) for i, length in enumerate(x.shape[1:3])]
    if not window.same and any((c != size[i]).any() for i, c in enumerate(counts)):
        factor = size[0] * size[1] / np.outer(*counts)
        mean = b.add("Mul", [mean, b.floats(factor[None, :, :, None], "share")])
    return _image_of(b, x, window, mean, x.c)


def _counts(window: _Window, axis: int, length: int) -> np.ndarray:
    """How many elements of the image each window holds along an axis."""
    start = np.arange(window.length(axis, length)) * window.stride[axis] - window.before[axis]
    stop = np.minimum(start + window.size[axis], length)
    return np.asarray(np.maximum(stop - np.maximum(start, 0), 1))


def global_pool(b: LayerBuilder, args: Sequence[Value]) -> Value:
    """The maximum or the mean of all pixels, per channel: [N, 1, 1, C]."""
    (x,) = args
    if x.rank != 4:
        return x
    op = "Max" if b.layer.type == LayerType.GLOBAL_MAX_POOL2D else "Mean"
    reduced = b.add(op, [x.reference, b.ints([1, 2], "axes")], keep_dims=False)
    return b.rows(reduced, x.n, x.c)


# ------------------------------------------------------------------ borders and sizes


def border(b: LayerBuilder, args: Sequence[Value]) -> Value:
    """A border around the image: of ``beta``, or made of its own pixels; a negative one cuts pixels off."""
    (x,) = args
    pad = tuple(b.layer.pad)
    if len(pad) == 4:
        pad = (pad[0], pad[1], 0, pad[2], pad[3], 0)
    if len(pad) != 6:
        raise b.damaged(f"the border is {list(b.layer.pad)}", "it has four or six lengths")
    pairs = [(0, 0), (pad[1], pad[4]), (pad[0], pad[3]), (pad[2], pad[5])]
    n, *lengths = x.shape
    h, w, c = (length + low + high for length, (low, high) in zip(lengths, pairs[1:], strict=True))
    if min(h, w, c) < 1:
        raise b.damaged(f"a border of {list(pad)} around {list(x.shape)}", "nothing is left of the image")
    b.sized(h, w, c)
    data = b.as_image(x)
    for axis, (low, high) in enumerate(pairs):
        if (low, high) == (0, 0):
            continue
        length = lengths[axis - 1]
        index = np.arange(-low, length + high)
        if b.layer.type == LayerType.BORDER2D:
            cut = [i for i in index.tolist() if 0 <= i < length]
            if len(cut) != length:
                data = taken(b, data, cut, axis)
            ends = [[0, 0], [0, 0], [0, 0], [0, 0]]
            ends[axis] = [max(low, 0), max(high, 0)]
            data = padded(b, data, ends, b.layer.beta) if any(ends[axis]) else data
        else:
            data = taken(b, data, _mirrored(b.layer.type, index, length).tolist(), axis)
    return b.shaped(data, (n, h, w, c))


def _mirrored(kind: int, index: np.ndarray, length: int) -> np.ndarray:
    """Which pixel stands at ``index`` of an axis, in front of 0 and behind the last."""
    last = length - 1
    if kind == LayerType.PAD2D_REFLECT:
        index = np.where(index < 0, -index, np.where(index > last, 2 * last - index, index))
    elif kind == LayerType.PAD2D_SYMMETRIC:
        index = np.where(index < 0, -index - 1, np.where(index > last, 2 * last - index + 1, index))
    return np.asarray(np.clip(index, 0, last))


def taken(b: LayerBuilder, x: str, index: Sequence[int], axis: int) -> str:
    """Elements ``index`` of an axis."""
    return b.add("GatherV2", [x, b.ints(list(index), "index"), b.ints(axis, "axis")])


def upsample(b: LayerBuilder, args: Sequence[Value]) -> Value:
    """Every pixel ``pool`` = [width, height] times; the factors may come as a constant [N, H, W, C] instead."""
    factors: Sequence[int] = b.layer.pool
    if not factors and len(args) == 2 and args[1].constant is not None and args[1].constant.size == 4:
        _, down, across, _ = b.whole(args[1].constant)
        factors = (across, down)
    if len(factors) != 2 or min(factors) < 1:
        raise b.unsupported(
            f"the factors are {list(factors)}",
            "ML-Agents' converter made an Upsample2D of every Resize and wrote no factors; Unity cannot run it either",
        )
    if b.layer.axis > 0:
        raise b.unsupported("it interpolates between pixels", "only the nearest pixel is translated")
    x = args[0]
    n, h, w, c = x.shape
    b.sized(h, factors[1], w, factors[0], c)
    data = b.as_image(x)
    for axis, (length, factor) in enumerate(((h, factors[1]), (w, factors[0])), start=1):
        if factor > 1:
            data = taken(b, data, np.arange(length).repeat(factor).tolist(), axis)
    return b.shaped(data, (n, h * factors[1], w * factors[0], c))


def normalization(b: LayerBuilder, args: Sequence[Value]) -> Value:
    """Instance normalisation: (x − mean) / √(variance + beta)·S + B, mean and variance over each channel's pixels."""
    x, scale, bias = args
    if b.layer.axis not in (-1, 3, 7):
        raise b.unsupported(f"the axis is {b.layer.axis}", "only the channels' axis is known")
    if scale.size != x.c or bias.size != x.c:
        raise b.damaged(f"{x.c} channels, {scale.size} scales, {bias.size} biases", "they must be equal")
    data, axes = b.as_image(x), b.ints([1, 2], "axes")
    mean = b.add("Mean", [data, axes], keep_dims=True)
    centred = b.add("Sub", [data, mean])
    variance = b.add("Mean", [b.add("Square", [centred]), axes], keep_dims=True)
    deviation = b.add("Sqrt", [b.add("Add", [variance, b.floats(b.layer.beta or _TINY, "epsilon")])])
    scaled = b.add("Mul", [b.add("RealDiv", [centred, deviation]), b.as_image(scale)])
    return b.shaped(b.add("Add", [scaled, b.as_image(bias)]), x.shape)
