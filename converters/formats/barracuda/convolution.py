"""Layers that slide over an image: convolutions, pools, borders, enlarging; and its normalisation.

A ``.nn`` gives strides and pools as [width, height], pads as [left, top, right, bottom]. A first pad of −1 stands for
TensorFlow's SAME, −2 for the same with the odd element of padding in front.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from export_model.converters.formats.barracuda.dense import add_bias
from export_model.converters.formats.barracuda.layer_builder import LayerBuilder, NnValue
from export_model.converters.graph.nn import convolution as nn
from export_model.converters.graph.nn import normalisation, pooling
from export_model.converters.graph.ops.barracuda.vocabulary import LayerType

_SAME, _SAME_LOWER = -1, -2
#: What Unity's maximum starts from; a border of it never wins.
_LOWEST = float(np.finfo(np.float32).min)
#: Stands for the smallest float that Unity adds where no epsilon is given (1.4e-45, which runtimes flush to zero).
_TINY = float(np.finfo(np.float32).tiny)


def _window(b: LayerBuilder, x: NnValue, size: tuple[int, int], stride: Sequence[int]) -> nn.Window:
    """The window of the current layer over an image; ``size`` is (height, width). Raises GraphError."""
    if len(stride) != 2 or min(stride) < 1 or min(size) < 1:
        raise b.damaged_error(f"a window of {list(size)} with strides {list(stride)}", "both have two numbers above 0")
    if stride[0] != stride[1]:
        b.note(
            f"layer {b.layer.name} has the strides {list(stride)}: read as [width, height], as Unity does; "
            "ML-Agents' converter wrote [height, width]"
        )
    window = nn.Window((int(size[0]), int(size[1])), (stride[1], stride[0]))
    pad = tuple(b.layer.pad) or (0, 0, 0, 0)
    if pad[0] in (_SAME, _SAME_LOWER):
        top, left = window.same_pads(x.shape[1:3])
        same = pad[0] == _SAME
        window = replace(window, pads=(top, left) if same else (top[::-1], left[::-1]), same=same)
    elif len(pad) == 4 and min(pad) >= 0:
        window = replace(window, pads=((pad[1], pad[3]), (pad[0], pad[2])))
    else:
        raise b.unsupported_error(f"the pads are {list(pad)}", "four lengths from 0 on, −1 (SAME) and −2 are known")
    b.check_size(*(length + sum(pair) for length, pair in zip(x.shape[1:3], window.pads, strict=True)), x.c)
    if min(window.lengths(x.shape[1:3])) < 1:
        raise b.damaged_error(f"a window of {list(size)} over {list(x.shape)}", "the window is larger than the image")
    return window


# ------------------------------------------------------------------ convolutions


def conv2d(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """K [height, width, in, out] over an image, plus a bias of out."""
    x, kernel, bias = args
    array = _kernel(b, kernel)
    if array.shape[2] != x.c or bias.size != array.shape[3]:
        raise _channels(b, x, kernel, bias)
    window = _window(b, x, array.shape[:2], b.layer.stride)
    product = nn.conv2d(b, b.as_image(x), b.as_image(kernel), window)
    return _image_of(b, x, window, add_bias(b, product, bias), array.shape[3])


def depthwise(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """A kernel [height, width, 1, C] that keeps the channels apart."""
    x, kernel, bias = args
    array = _kernel(b, kernel)
    if array.shape[2] != 1:
        raise b.unsupported_error(f"a kernel of shape {list(array.shape)}", "Unity knows one result per channel")
    if array.shape[3] != x.c or bias.size != array.shape[3]:
        raise _channels(b, x, kernel, bias)
    window = _window(b, x, array.shape[:2], b.layer.stride)
    product = nn.conv2d(b, b.as_image(x), array, window, x.c)
    return _image_of(b, x, window, add_bias(b, product, bias), array.shape[3])


def conv2d_trans(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """A transposed convolution by K [height, width, in, out].

    ``pool`` is the output adjustment [width, height]; where it is empty, Unity takes (in + pads − kernel) mod stride.
    """
    x, kernel, bias = args
    array = _kernel(b, kernel)
    if array.shape[2] != x.c:
        raise b.unsupported_error(
            f"a kernel of shape {list(array.shape)} for {x.c} channels",
            "the converters of ML-Agents 0.7 and 0.8 wrote [height, width, out, in], which Unity cannot run",
        )
    if bias.size != array.shape[3]:
        raise _channels(b, x, kernel, bias)
    stride, adjust = b.layer.stride, tuple(b.layer.pool)
    if len(stride) != 2 or min(stride) < 1 or stride[0] != stride[1]:
        raise b.unsupported_error(f"the strides {list(stride)}", "Unity takes the width's stride for both axes")
    window = replace(_window(b, x, array.shape[:2], stride), same=False)
    if any(before != after for before, after in window.pads):
        raise b.unsupported_error(f"the pads {list(b.layer.pad)}", "Unity runs pads that are equal on both sides alone")
    step, extra, lengths = stride[0], [], []
    for axis, length in enumerate(x.shape[1:3]):
        around = sum(window.pads[axis]) - window.size[axis]
        extra.append(adjust[1 - axis] if len(adjust) == 2 else (length + around) % step)
        lengths.append((length - 1) * step - around + extra[axis])
    if min(lengths) < 1:
        raise b.damaged_error(f"a result of {lengths}", "pads and adjustment leave nothing of the image")
    b.check_size(*(step * length + 2 * size for length, size in zip(x.shape[1:3], window.size, strict=True)), x.c)
    b.check_size(*lengths, array.shape[3])
    product = add_bias(b, nn.conv2d_transposed(b, b.as_image(x), array, window, (extra[0], extra[1])), bias)
    shape = (x.n, lengths[0], lengths[1], int(array.shape[3]))
    return b.as_shape(product, shape) if shape[1:3] == (1, 1) else NnValue(product, shape)


def _kernel(b: LayerBuilder, kernel: NnValue) -> np.ndarray:
    if kernel.constant is None:
        raise b.unsupported_error("its kernel is computed", "kernels are constants in every target")
    return kernel.constant


def _channels(b: LayerBuilder, x: NnValue, kernel: NnValue, bias: NnValue) -> Exception:
    return b.damaged_error(
        f"{x.c} channels, a kernel of shape {list(kernel.shape)}, a bias of {bias.size}",
        "the kernel [height, width, in, out] does not fit to them",
    )


def _image_of(b: LayerBuilder, x: NnValue, window: nn.Window, reference: str, channels: int) -> NnValue:
    shape = (x.n, *window.lengths(x.shape[1:3]), channels)
    return b.as_shape(reference, shape) if shape[1:3] == (1, 1) else NnValue(reference, shape)


# ------------------------------------------------------------------ pools


def pool(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """The maximum or the mean of each window; what is padded does not count."""
    (x,) = args
    if len(b.layer.pool) != 2:
        raise b.damaged_error(f"the window is {list(b.layer.pool)}", "it must be [width, height]")
    window = _window(b, x, (b.layer.pool[1], b.layer.pool[0]), b.layer.stride)
    image = b.as_image(x)
    if b.layer.type == LayerType.MAX_POOL2D:
        return _image_of(b, x, window, pooling.max_pool(b, image, window, _LOWEST), x.c)
    return _image_of(b, x, window, pooling.average_pool(b, image, window), x.c)


def global_pool(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """The maximum or the mean of all pixels, per channel: [N, 1, 1, C]."""
    (x,) = args
    if x.rank != 4:
        return x
    op = "Max" if b.layer.type == LayerType.GLOBAL_MAX_POOL2D else "Mean"
    reduced = b.add(op, [x.reference, b.ints([1, 2], "axes")], keep_dims=False)
    return b.rows(reduced, x.n, x.c)


# ------------------------------------------------------------------ borders and sizes


def border(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """A border around the image: of ``beta``, or made of its own pixels; a negative one cuts pixels off."""
    (x,) = args
    pad = tuple(b.layer.pad)
    if len(pad) == 4:
        pad = (pad[0], pad[1], 0, pad[2], pad[3], 0)
    if len(pad) != 6:
        raise b.damaged_error(f"the border is {list(b.layer.pad)}", "it has four or six lengths")
    pairs = [(0, 0), (pad[1], pad[4]), (pad[0], pad[3]), (pad[2], pad[5])]
    n, *lengths = x.shape
    h, w, c = (length + low + high for length, (low, high) in zip(lengths, pairs[1:], strict=True))
    if min(h, w, c) < 1:
        raise b.damaged_error(f"a border of {list(pad)} around {list(x.shape)}", "nothing is left of the image")
    b.check_size(h, w, c)
    if b.layer.type == LayerType.BORDER2D:
        return b.as_shape(b.pad(b.as_image(x), pairs, b.layer.beta), (n, h, w, c))
    data = b.as_image(x)
    for axis, (low, high) in enumerate(pairs):
        if (low, high) == (0, 0):
            continue
        index = np.arange(-low, lengths[axis - 1] + high)
        data = b.take(data, _mirror_index(b.layer.type, index, lengths[axis - 1]).tolist(), axis)
    return b.as_shape(data, (n, h, w, c))


def _mirror_index(kind: int, index: np.ndarray, length: int) -> np.ndarray:
    """Which pixel stands at ``index`` of an axis, in front of 0 and behind the last."""
    last = length - 1
    if kind == LayerType.PAD2D_REFLECT:
        index = np.where(index < 0, -index, np.where(index > last, 2 * last - index, index))
    elif kind == LayerType.PAD2D_SYMMETRIC:
        index = np.where(index < 0, -index - 1, np.where(index > last, 2 * last - index + 1, index))
    return np.asarray(np.clip(index, 0, last))


def upsample(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """Every pixel ``pool`` = [width, height] times; the factors may come as a constant [N, H, W, C] instead."""
    factors: Sequence[int] = b.layer.pool
    if not factors and len(args) == 2 and args[1].constant is not None and args[1].constant.size == 4:
        _, down, across, _ = b.whole(args[1].constant)
        factors = (across, down)
    if len(factors) != 2 or min(factors) < 1:
        raise b.unsupported_error(
            f"the factors are {list(factors)}",
            "ML-Agents' converter made an Upsample2D of every Resize and wrote no factors; Unity cannot run it either",
        )
    if b.layer.axis > 0:
        raise b.unsupported_error("it interpolates between pixels", "only the nearest pixel is translated")
    x = args[0]
    n, h, w, c = x.shape
    b.check_size(h, factors[1], w, factors[0], c)
    data = b.as_image(x)
    for axis, (length, factor) in enumerate(((h, factors[1]), (w, factors[0])), start=1):
        if factor > 1:
            data = b.take(data, np.arange(length).repeat(factor).tolist(), axis)
    return b.as_shape(data, (n, h * factors[1], w * factors[0], c))


def normalization(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """Instance normalisation: (x − mean) / √(variance + beta)·S + B, mean and variance over each channel's pixels."""
    x, scale, bias = args
    if b.layer.axis not in (-1, 3, 7):
        raise b.unsupported_error(f"the axis is {b.layer.axis}", "only the channels' axis is known")
    if scale.size != x.c or bias.size != x.c:
        raise b.damaged_error(f"{x.c} channels, {scale.size} scales, {bias.size} biases", "they must be equal")
    epsilon = b.layer.beta or _TINY
    made = normalisation.instance(b, b.as_image(x), b.as_vector(scale), b.as_vector(bias), epsilon, channels=3)
    return b.as_shape(made, x.shape)
