"""Convolutions and pools, over images [B, H, W, C] and sequences [B, T, C] (images of height 1)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from export_model.converters.formats.keras.layers.activations import apply_activation
from export_model.converters.formats.keras.layers.step import Step, Translate
from export_model.converters.graph.nn.convolution import Window, conv2d, conv2d_transposed
from export_model.converters.graph.nn.pooling import average_pool, max_pool
from export_model.signatures.errors import UnsupportedOpError

Pair = tuple[int, int]


def _pair(value: Any, axes: int) -> Pair:
    """A setting per axis as one for height and width. With strides of a sequence, both are the same."""
    numbers = [int(value)] * axes if isinstance(value, int) else [int(n) for n in value]
    if len(numbers) != axes:
        raise UnsupportedOpError(f"it says {numbers} for {axes} axes")
    return (numbers[0], numbers[-1])


def _window(step: Step, size_key: str, axes: int, size: Any = None) -> Window:
    """The layer's window; of a sequence the height is 1."""
    size = _pair(step.get(size_key) if size is None else size, axes)
    said = step.get("strides")
    strides = (size if "pool" in size_key else (1, 1)) if said is None else _pair(said, axes)
    dilations = _pair(step.get("dilation_rate") or 1, axes)
    padding = str(step.get("padding", "valid"))
    pads = ((0, 0), (0, 0))
    if padding == "causal" and axes == 1:
        pads = ((0, 0), ((size[1] - 1) * dilations[1], 0))
    elif padding not in ("same", "valid"):
        raise UnsupportedOpError(f"its padding is {padding!r}")
    if axes == 1:
        size = (1, size[1])
    return Window(size, strides, dilations, pads, padding == "same")


def _on_images(step: Step, axes: int, compute: Callable[[str], str]) -> str:
    """``compute`` on x as [B, H, W, C], its result as the layer lays it out."""
    b, x = step.net, step.x
    if step.rank != axes + 2:
        raise UnsupportedOpError(f"it is given {step.rank} axes")
    first = step.get("data_format") == "channels_first"
    if first:
        x = b.transpose(x, [0, *range(2, axes + 2), 1])
    value = compute(b.expand_dims(x, 1) if axes == 1 else x)
    value = b.squeeze(value, [1]) if axes == 1 else value
    return b.transpose(value, [0, axes + 1, *range(1, axes + 1)]) if first else value


def _kernel(step: Step, axes: int, *channels: int | None) -> np.ndarray:
    """The next weight as [height, width, …]."""
    size = _pair(step.get("kernel_size"), axes)
    array = step.take(*size[2 - axes :] if axes == 2 else size[1:], *channels)
    return array[None] if axes == 1 else array


def _conv(step: Step, axes: int) -> str:
    groups, filters = int(step.get("groups") or 1), int(step.get("filters"))

    def compute(image: str) -> str:
        kernel = _kernel(step, axes, step.net.length(image, 3) // max(groups, 1), filters)
        return step.add_bias(conv2d(step.net, image, kernel, _window(step, "kernel_size", axes), groups), filters)

    return apply_activation(step, _on_images(step, axes, compute))


def _depthwise(step: Step, axes: int) -> str:
    def compute(image: str) -> str:
        value = _each_channel(step, image, axes)
        return step.add_bias(value, step.net.length(value, 3))

    return apply_activation(step, _on_images(step, axes, compute))


def _each_channel(step: Step, image: str, axes: int) -> str:
    channels, multiplier = step.net.length(image, 3), int(step.get("depth_multiplier") or 1)
    kernel = _kernel(step, axes, channels, multiplier)
    kernel = kernel.reshape(*kernel.shape[:2], 1, channels * multiplier)
    return conv2d(step.net, image, kernel, _window(step, "kernel_size", axes), channels)


def _separable(step: Step, axes: int) -> str:
    filters = int(step.get("filters"))

    def compute(image: str) -> str:
        value = _each_channel(step, image, axes)
        pointwise = step.take(*[1] * axes, step.net.length(value, 3), filters)
        pointwise = pointwise.reshape(1, 1, *pointwise.shape[-2:])
        return step.add_bias(conv2d(step.net, value, pointwise, Window((1, 1))), filters)

    return apply_activation(step, _on_images(step, axes, compute))


def _conv_transpose(step: Step, axes: int) -> str:
    """Kernels are [height, width, out, in]. SAME makes stride times as many rows, the odd one cut off behind."""
    step.refuse_unless("output_padding", None)
    window = _window(step, "kernel_size", axes)
    if window.dilations != (1, 1):
        raise UnsupportedOpError("it is dilated")
    strides = (1, window.strides[1]) if axes == 1 else window.strides
    filters = int(step.get("filters"))
    pads, extra = [], []
    for size, stride in zip(window.size, strides, strict=True):
        over = max(size - stride, 0) if window.same else 0
        pads.append((over // 2, over - over // 2))
        extra.append(max(stride - size, 0))
    moved = Window(window.size, strides, (1, 1), (pads[0], pads[1]))

    def compute(image: str) -> str:
        kernel = np.swapaxes(_kernel(step, axes, filters, step.net.length(image, 3)), 2, 3)
        return step.add_bias(conv2d_transposed(step.net, image, kernel, moved, (extra[0], extra[1])), filters)

    return apply_activation(step, _on_images(step, axes, compute))


def _pool(step: Step, axes: int, pool: Callable[..., str]) -> str:
    window = _window(step, "pool_size", axes, step.get("pool_size", 2))
    return _on_images(step, axes, lambda image: pool(step.net, image, window))


def _global_pool(step: Step, kind: str) -> str:
    axes = step.rank - 2
    first = 2 if step.get("data_format") == "channels_first" else 1
    over: Sequence[int] = range(first, first + axes)
    return step.net.reduce(kind, step.x, over, keep=bool(step.get("keepdims", False)))


def _of_both(name: str, function: Callable[..., str], **settings: Any) -> dict[str, Translate]:
    """A layer over sequences and one over images."""
    return {name.replace("#", f"{axes}D"): partial(function, axes=axes, **settings) for axes in (1, 2)}


LAYERS: Mapping[str, Translate] = {
    **_of_both("Conv#", _conv),
    **_of_both("DepthwiseConv#", _depthwise),
    **_of_both("SeparableConv#", _separable),
    **_of_both("Conv#Transpose", _conv_transpose),
    **_of_both("MaxPooling#", _pool, pool=max_pool),
    **_of_both("AveragePooling#", _pool, pool=average_pool),
    **dict.fromkeys(("GlobalAveragePooling1D", "GlobalAveragePooling2D"), partial(_global_pool, kind="Mean")),
    **dict.fromkeys(("GlobalMaxPooling1D", "GlobalMaxPooling2D"), partial(_global_pool, kind="Max")),
}
