"""Ops that sum: matrix products, convolutions, pools, reductions, softmax; and the noise of a policy.

A sum over a row is a Dense layer of ones, and not Barracuda's ReduceSum: 1.1 leaves the whole model at a reduction
over one number (a branch of one action), and a Dense is the layer that nothing goes wrong in.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from export_model.converters.graph.ops.barracuda.base import FIRST, NONE, Nn
from export_model.converters.graph.ops.barracuda.builder import NnBuilder
from export_model.converters.graph.ops.barracuda.elementwise import apply_activation
from export_model.converters.graph.ops.barracuda.values import Value
from export_model.converters.graph.ops.barracuda.vocabulary import Activation, C, LayerType, N
from export_model.converters.graph.types import BATCH

#: A first pad of −1 is TensorFlow's SAME.
_SAME = (-1,)


# ------------------------------------------------------------------ products


def with_activations(
    one: Callable[[NnBuilder, Sequence[Value]], Value], kinds: Mapping[str, Activation], *, takes_images: bool = False
) -> Nn:
    """A product or convolution with its bias, and the activations behind it, by the names of their ops."""

    def lower(b: NnBuilder, args: Sequence[Value]) -> Value:
        value = one(b, args)
        for name in b.node.attrs["fused_ops"][1:]:
            value = apply_activation(b, value, kinds[name], label=name)
        return value

    return Nn(lower, takes_images=takes_images)


def matmul(b: NnBuilder, args: Sequence[Value]) -> Value:
    """A row per agent times a constant matrix, plus a bias where it is fused."""
    x, kernel = args[0], args[1].array
    attrs = b.node.attrs
    if kernel is None or x.array is not None or attrs.get("transpose_a") or attrs.get("adj_x") or kernel.ndim != 2:
        raise b.nn_error(
            "one of its operands has more rows than one per agent, or both are computed",
            "version 16 of the format has products with constant matrices alone (Barracuda has others from 2.0 on)",
        )
    if attrs.get("transpose_b") or attrs.get("adj_y"):
        kernel = kernel.T
    bias = _bias(args, kernel.shape[1])
    if len(x.shape) != 2 or x.shape[0] != BATCH:
        return _last_axis(b, x, kernel, bias)
    if x.flat_of is not None:
        name, kernel = _flatten_image(b, x.flat_of, kernel)
    else:
        name = b.rows(x)
    return b.result(b.dense(name, kernel, bias))


def _flatten_image(b: NnBuilder, image: Value, kernel: np.ndarray) -> tuple[str, np.ndarray]:
    """An image flattened as it lies in the file, and the matrix with its rows in that order."""
    lengths = [1 if isinstance(d, str) else d for d in image.shape]
    counted = np.arange(image.size, dtype=np.int64).reshape(lengths)
    places = b.place_constant(counted, image.axes).reshape(-1).astype(np.int64)
    name = b.stored_name(image)
    flat = b.layer(LayerType.FLATTEN, [name], (b.dims_of(name)[N], 1, 1, image.size), label="flat")
    b.made_up(kernel.size)
    return flat, kernel[places]


def _last_axis(b: NnBuilder, x: Value, kernel: np.ndarray, bias: np.ndarray) -> Value:
    """A product over the last of several axes (torch's Linear on sequences): a convolution by one pixel."""
    if BATCH not in x.shape or not x.in_order:
        raise b.nn_error(f"a tensor of shape {list(x.shape)} times a matrix", "a row per agent can be multiplied")
    value = b.in_usual_place(x)
    n, h, w, c = value.dims
    if c != kernel.shape[0]:
        raise b.nn_error(
            f"a tensor of shape {list(x.shape)} times a matrix", "its last axis has length 1 or is the batch"
        )
    name = b.layer(
        LayerType.CONV2D, [b.stored_name(value)], (n, h, w, kernel.shape[1]), stride=(1, 1),
        data=[("kernel", kernel.reshape(1, 1, *kernel.shape)), ("bias", bias.reshape(1, 1, 1, -1))],
    )  # fmt: skip
    shape = b.shape_of(b.node.name)
    return b.layer_value(name, shape, (*value.axes[:-1], None if shape[-1] == 1 else C))


# ------------------------------------------------------------------ windows


def conv2d(b: NnBuilder, args: Sequence[Value]) -> Value:
    """A convolution; a dilated kernel is written with its zeros."""
    kernel = _kernel(b, args[1])
    return _convolve(b, args[0], kernel, _bias(args, kernel.shape[3]), LayerType.CONV2D)


def _kernel(b: NnBuilder, value: Value) -> np.ndarray:
    if value.array is None:
        raise b.nn_error("its kernel is computed", "the kernels of a .nn are constants")
    return value.array


def _bias(args: Sequence[Value], length: int) -> np.ndarray:
    """The constant that a fused product or convolution adds, else zeros."""
    bias = args[2].array if len(args) > 2 else np.zeros(length, np.float32)
    assert bias is not None
    return bias


def depthwise(b: NnBuilder, args: Sequence[Value]) -> Value:
    """A convolution of every channel by itself; several results per channel become a full kernel with zeros."""
    kernel = _kernel(b, args[1])
    height, width, channels, many = kernel.shape
    bias = np.zeros(channels * many, np.float32)
    if many == 1:
        return _convolve(b, args[0], kernel.transpose(0, 1, 3, 2), bias, LayerType.DEPTHWISE_CONV2D)
    b.made_up(kernel.size * channels)
    full = np.zeros((height, width, channels, channels * many), np.float32)
    for channel in range(channels):
        full[:, :, channel, channel * many : (channel + 1) * many] = kernel[:, :, channel]
    return _convolve(b, args[0], full, bias, LayerType.CONV2D)


def _convolve(b: NnBuilder, x: Value, kernel: np.ndarray, bias: np.ndarray, kind: LayerType) -> Value:
    down, across = b.node.attrs.get("dilations", (1, 1, 1, 1))[1:3]
    if (down, across) != (1, 1):
        height, width, *rest = kernel.shape
        shape = ((height - 1) * down + 1, (width - 1) * across + 1, *rest)
        b.made_up(math.prod(shape))
        grown = np.zeros(shape, np.float32)
        grown[::down, ::across] = kernel
        kernel = grown
    data = [("kernel", kernel), ("bias", bias.reshape(1, 1, 1, -1))]
    return _window(b, x, kind, data)


def pool(kind: LayerType) -> Nn:
    """The largest or the mean of each window."""

    def lower(b: NnBuilder, args: Sequence[Value]) -> Value:
        height, width = (int(k) for k in b.node.attrs["ksize"][1:3])
        return _window(b, args[0], kind, [], pool=(width, height))

    return Nn(lower)


def _window(
    b: NnBuilder, x: Value, kind: LayerType, data: Sequence[tuple[str, np.ndarray]], pool: tuple[int, ...] = ()
) -> Value:
    image = b.with_axes(b.flatten_if_due(x), (0, 1, 2, 3))
    shape = b.shape_of(b.node.name)
    result = Value(shape, (0, 1, 2, 3))
    down, across = (int(s) for s in b.node.attrs["strides"][1:3])
    name = b.layer(
        kind, [b.stored_name(image)], result.dims, data=data, stride=(across, down), pool=pool,
        pad=_SAME if b.node.attrs["padding"] == "SAME" else (0, 0, 0, 0),
    )  # fmt: skip
    return b.layer_value(name, shape, (0, 1, 2, 3))


# ------------------------------------------------------------------ reductions


def reduction(kind: LayerType) -> Nn:
    """Sum, mean, largest, smallest, product: over everything that an agent has, over the channels, or over an image."""
    return Nn(partial(_reduce, kind=kind), FIRST)


def _reduce(b: NnBuilder, args: Sequence[Value], *, kind: LayerType) -> Value:
    value, shape = b.flatten_if_due(args[0]), b.shape_of(b.node.name)
    axes = {int(a) % len(value.shape) for a in np.atleast_1d(b.constant_operand(1, "the axes"))}
    long = [i for i in axes if value.shape[i] != 1]
    if any(value.shape[i] == BATCH for i in long):
        raise b.nn_error("it reduces over the batch", "an agent's action would depend on the other agents")
    left = [i for i, d in enumerate(value.shape) if d not in (1, BATCH) and i not in axes]
    keep = bool(b.node.attrs["keep_dims"])
    kept = [i for i in range(len(value.shape)) if keep or i not in axes]
    places = tuple(None if i in axes else value.axes[i] for i in kept)
    name = b.stored_name(value)
    if long:
        name = _reduce_places(b, kind, value, name, [value.axes[i] for i in long], whole=not left)
    return b.layer_value(name, shape, places)


def _reduce_places(
    b: NnBuilder, kind: LayerType, value: Value, name: str, places: Sequence[int | None], *, whole: bool
) -> str:
    reduced = None
    if kind in (LayerType.REDUCE_SUM, LayerType.REDUCE_MEAN):
        reduced = _sum(b, value, name, places, whole=whole, mean=kind is LayerType.REDUCE_MEAN)
    elif kind is LayerType.REDUCE_MAX and C not in places:
        reduced = _pool_places(b, LayerType.MAX_POOL2D, value, name, places)[0]
    elif whole and len(places) > 1:
        n, h, w, c = value.dims
        flat = b.layer(LayerType.FLATTEN, [name], (n, 1, 1, h * w * c), label="flat")
        reduced = b.layer(kind, [flat], (n, 1, 1, 1))
    elif places == [C]:
        reduced = b.layer(kind, [name], (*value.dims[:3], 1))
    if reduced is None:
        what = f"a {b.node.op} of {list(value.shape)} over part of the image"
        raise b.nn_error(what, "version 16 reduces over the channels")
    return reduced


def _sum(b: NnBuilder, value: Value, name: str, places: Sequence[int | None], *, whole: bool, mean: bool) -> str | None:
    """A sum or mean: a product with ones, or a pool; None where it is over channels and part of the image."""
    n, h, w, c = value.dims
    width = h * w * c
    if whole:
        b.made_up(width)
        return b.dense(name, np.full((width, 1), 1 / width if mean else 1.0), np.zeros(1))
    # All pixels of each channel: what is left of the image is one.
    if C not in places and all(length == 1 or place in places for place, length in ((1, h), (2, w))):
        pooled = b.layer(LayerType.GLOBAL_AVG_POOL2D, [name], (n, 1, 1, c), label="" if mean else "mean")
        return pooled if mean else b.scale(pooled, h * w)
    if places == [C]:
        kernel = np.full((1, 1, c, 1), 1 / c if mean else 1.0)
        data = [("kernel", kernel), ("bias", np.zeros((1, 1, 1, 1)))]
        return b.layer(LayerType.CONV2D, [name], (n, h, w, 1), stride=(1, 1), data=data)
    if C in places:
        return None
    pooled, count = _pool_places(b, LayerType.AVG_POOL2D, value, name, places)
    return pooled if mean else b.scale(pooled, count)


def _pool_places(
    b: NnBuilder, kind: LayerType, value: Value, name: str, places: Sequence[int | None]
) -> tuple[str, int]:
    """(a pool over all rows, all columns or both of an image, over how many pixels)."""
    n, h, w, c = value.dims
    down, across = (h if 1 in places else 1), (w if 2 in places else 1)
    dims, size = (n, h // down, w // across, c), (across, down)
    return b.layer(kind, [name], dims, pool=size, stride=size, label="pooled"), down * across


def softmax(kind: Activation) -> Nn:
    """Softmax and its logarithm, over a row."""

    def lower(b: NnBuilder, args: Sequence[Value]) -> Value:
        value = args[0]
        if sum(d not in (1, BATCH) for d in value.shape) > 1 or (value.size > 1 and value.shape[-1] == 1):
            raise b.nn_error(f"a tensor of shape {list(value.shape)}", "Barracuda up to 1.4 takes a whole row")
        x = b.flatten_if_due(value)
        return b.layer_value(b.activation(kind, b.rows(x)), x.shape, x.axes)

    return Nn(lower)


def arg_best(kind: LayerType) -> Nn:
    """ArgMax and ArgMin: the first class of a row that scores highest, or lowest; ``kind`` tells that score.

    Of layers that every Barracuda has (ArgMax is one from 1.4 on): the place of the one that is as large as the
    largest, and before which there is no other.
    """
    return Nn(partial(_first_best, kind=kind), FIRST)


def _first_best(b: NnBuilder, args: Sequence[Value], *, kind: LayerType) -> Value:
    value = b.flatten_if_due(args[0])
    axis = int(b.constant_operand(1, "the axis").reshape(())) % len(value.shape)
    width, row = value.size, [i for i, d in enumerate(value.shape) if d not in (1, BATCH)]
    if BATCH not in value.shape or (width > 1 and row != [axis]):
        raise b.nn_error(f"the best of {list(value.shape)} along axis {axis}", "it takes one row of scores per agent")
    x = b.rows(value)
    if width == 1:
        return b.result(b.constant_rows(np.zeros(1, np.float32), "only"))
    pairs = b.table(width, width)
    top = b.layer(kind, [x], (b.dims_of(x)[N], 1, 1, 1), label="top")
    best = b.two(LayerType.EQUAL, x, b.spread(top, width), "is_best")
    before = b.dense(best, np.triu(np.ones(pairs), 1), np.zeros(width), "before")
    first = b.activation(Activation.RELU, b.two(LayerType.SUB, best, before, "after_none"), label="first")
    return b.result(b.dense(first, np.arange(width).reshape(-1, 1), np.zeros(1)))


# ------------------------------------------------------------------ chance


def drawn_class(b: NnBuilder, args: Sequence[Value]) -> Value:
    """A class of each row, drawn by its log-probabilities."""
    count = int(b.constant_operand(1, "the number of draws").reshape(()))
    x = b.rows(b.flatten_if_due(args[0]))
    name = b.layer(LayerType.MULTINOMIAL, [x], (b.dims_of(x)[N], 1, 1, count), pool=(count,))
    return b.layer_value(name, b.shape_of(b.node.name), (N, None if count == 1 else C))


def random(kind: LayerType) -> Nn:
    """Noise of the shape of a tensor that is there, as the trainers' converter writes it; not seeded."""
    return Nn(partial(_draw, kind=kind), NONE)


def _draw(b: NnBuilder, args: Sequence[Value], *, kind: LayerType) -> Value:
    shape = b.shape_of(b.node.name)
    flat = (BATCH, math.prod(d for d in shape if isinstance(d, int)))
    if shape[:1] != (BATCH,) or len(shape) != 2:
        raise b.nn_error(f"it draws a tensor of shape {list(shape)}", "a row of numbers per agent can be drawn")
    dims = (-1, 1, 1, flat[1])
    like = b.like(dims)
    if like is None:
        like = b.constant_rows(np.zeros(flat[1], np.float32), "like")
    return b.layer_value(b.layer(kind, [like], dims), shape, (0, None if flat[1] == 1 else C))
