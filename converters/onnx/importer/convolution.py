"""Convolutions and pools. ONNX has channels first; inside they are computed NHWC, between two transposes.

The transposes of neighbouring layers cancel (converters/graph/passes/transposes.py). A padding that is TensorFlow's
SAME is written so; another one is a Pad of its own, because TF 1.x has no explicit paddings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from converters.graph.ops.convolution import window_padding
from converters.graph.types import FLOAT32
from converters.onnx.importer.importer import Importer
from converters.onnx.importer.node import Op, Translate
from converters.onnx.importer.slicing import padded

_TO_NHWC, _TO_NCHW = (0, 2, 3, 1), (0, 3, 1, 2)
_IMAGE = 4
_MAX_GROUPS = 256
Pairs = tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class _Window:
    """A sliding window over height and width; ``pads`` are None where ``auto_pad`` names them."""

    size: tuple[int, ...]
    strides: tuple[int, ...]
    dilations: tuple[int, ...]
    pads: Pairs | None
    auto_pad: str
    ceil: bool = False

    @property
    def span(self) -> tuple[int, ...]:
        """What the window covers, its dilation counted in."""
        return tuple((k - 1) * d + 1 for k, d in zip(self.size, self.dilations, strict=True))


def _window(op: Op, net: Importer, x: str, size: Sequence[int]) -> _Window:
    spatial = net.rank(x) - 2
    if spatial not in (1, 2):
        raise op.refused(f"it works on {spatial} spatial axes", "policies see images and rows of pixels")
    if len(size) != spatial:
        raise op.refused(f"its window {list(size)} does not fit {spatial} spatial axes", "the model is damaged")
    ones = (1,) * spatial
    strides, dilations = op.integers("strides", ones) or ones, op.integers("dilations", ones) or ones
    pads = op.integers("pads", (0,) * (2 * spatial)) or (0,) * (2 * spatial)
    auto_pad = op.text("auto_pad", "NOTSET")
    fitting = len(strides) == len(dilations) == spatial and len(pads) == 2 * spatial
    if not fitting or min(*size, *strides, *dilations) < 1:
        raise op.refused("its window, strides, dilations and pads do not fit together", "the model is damaged")
    pairs = tuple(zip(pads[:spatial], pads[spatial:], strict=True))
    if auto_pad == "VALID":
        pairs, auto_pad = ((0, 0),) * spatial, "NOTSET"
    if spatial == 1:  # a row of pixels is an image of height 1
        size, strides, dilations, pairs = (1, *size), (1, *strides), (1, *dilations), ((0, 0), *pairs)
    ceil = bool(op.integer("ceil_mode", 0))
    return _Window(tuple(size), strides, dilations, pairs if auto_pad == "NOTSET" else None, auto_pad, ceil)


def _image(op: Op, net: Importer, x: str) -> str:
    """NCHW (or NCW) as NHWC."""
    return net.transpose(net.expand_dims(x, 2) if net.rank(x) == _IMAGE - 1 else x, _TO_NHWC)


def _back(op: Op, net: Importer, value: str) -> str:
    result = net.transpose(value, _TO_NCHW)
    return net.squeeze(result, [2]) if net.rank(op.need(0)) == _IMAGE - 1 else result


def _resolved(op: Op, net: Importer, image: str, window: _Window) -> Pairs:
    """The paddings of height and width as numbers, for an NHWC image."""
    if window.pads is not None:
        return window.pads if not window.ceil else _ceiled(op, net, image, window, window.pads)
    pairs = []
    for axis, (span, stride) in enumerate(zip(window.span, window.strides, strict=True)):
        _, before, after = window_padding(net.length(image, axis + 1), span, stride, "SAME")
        pairs.append((before, after) if window.auto_pad == "SAME_UPPER" else (after, before))
    return tuple(pairs)


def _ceiled(op: Op, net: Importer, image: str, window: _Window, pads: Pairs) -> Pairs:
    """``ceil_mode`` as more padding at the end; a window that would begin in it is left out (opset 19)."""
    pairs = []
    for axis, ((before, after), span, stride) in enumerate(zip(pads, window.span, window.strides, strict=True)):
        length = net.length(image, axis + 1)
        count = -(-(length + before + after - span) // stride) + 1
        if (count - 1) * stride >= length + before:
            count -= 1
        pairs.append((before, max(after, (count - 1) * stride + span - length - before)))
    return tuple(pairs)


def _is_same(net: Importer, image: str, window: _Window, pairs: Pairs) -> bool:
    """Whether paddings are the ones of TensorFlow's SAME."""
    shape = net.type_of(image).shape
    if window.auto_pad == "SAME_UPPER":
        return True
    if shape is None or not all(isinstance(n, int) for n in shape[1:3]):
        return False
    wanted = [
        window_padding(int(n), span, stride, "SAME")[1:]
        for n, span, stride in zip(shape[1:3], window.span, window.strides, strict=True)
    ]
    return list(pairs) == wanted


def _framed(op: Op, net: Importer, image: str, window: _Window, fill: str | None = None) -> tuple[str, str]:
    """(image, TensorFlow's padding): padded by a node of its own unless it is SAME or VALID."""
    if window.auto_pad == "SAME_UPPER":
        return image, "SAME"
    pairs = _resolved(op, net, image, window)
    if not any(a or b for a, b in pairs):
        return image, "VALID"
    if _is_same(net, image, window, pairs):
        return image, "SAME"
    return padded(op, net, image, [(0, 0), *pairs, (0, 0)], fill), "VALID"


# ------------------------------------------------------------------ convolutions


def _kernel(op: Op, net: Importer) -> np.ndarray:
    kernel = net.needed_constant(op.need(1), "the kernel")
    return kernel[:, :, None, :] if kernel.ndim == _IMAGE - 1 else kernel


def _conv(op: Op, net: Importer) -> str:
    kernel = _kernel(op, net)
    size = net.shape(op.need(1))[2:]
    window = _window(op, net, op.need(0), [int(k) for k in size])
    image, padding = _framed(op, net, _image(op, net, op.need(0)), window)
    value = _convolved(op, net, image, kernel, window, padding)
    return _back(op, net, _biased(op, net, value))


def _biased(op: Op, net: Importer, value: str) -> str:
    bias = op.get(2)
    return value if bias is None else net.add("BiasAdd", [value, bias])


def _convolved(op: Op, net: Importer, image: str, kernel: np.ndarray, window: _Window, padding: str) -> str:
    """An NHWC image by a kernel [out, in per group, height, width]."""
    groups = op.integer("group", 1)
    attrs: dict[str, Any] = {
        "strides": (1, *window.strides, 1),
        "dilations": (1, *window.dilations, 1),
        "padding": padding,
    }
    out, each = kernel.shape[:2]
    if groups < 1 or groups > _MAX_GROUPS or out % groups:
        raise op.refused(f"it has {groups} groups for {out} channels", f"up to {_MAX_GROUPS} are written")
    equal = len(set(window.strides)) == 1 and set(window.dilations) == {1}  # TensorFlow's CPU kernel takes no others
    if groups == 1:
        return net.add("Conv2D", [image, net.const(kernel.transpose(2, 3, 1, 0), "kernel")], **attrs)
    if each == 1 and equal:
        shaped = kernel.reshape(groups, out // groups, *kernel.shape[2:]).transpose(2, 3, 0, 1)
        return net.add("DepthwiseConv2dNative", [image, net.const(shaped, "kernel")], **attrs)
    parts = []
    for group in range(groups):
        part = net.slice(image, 3, group * each, (group + 1) * each)
        chosen = kernel[group * out // groups : (group + 1) * out // groups]
        parts.append(net.add("Conv2D", [part, net.const(chosen.transpose(2, 3, 1, 0), "kernel")], **attrs))
    return net.concat(parts, 3)


def _conv_transpose(op: Op, net: Importer) -> str:
    """Zeros between the pixels, then a plain convolution with the kernel turned round: no target needs an op for it."""
    kernel = _kernel(op, net)  # [in, out per group, height, width]
    x = op.need(0)
    window = _window(op, net, x, [int(k) for k in net.shape(op.need(1))[2:]])
    if window.pads is None or "output_shape" in op.attrs:
        raise op.refused("its padding follows from the size of its result", "give pads and output_padding instead")
    image = _image(op, net, x)
    extra = op.integers("output_padding", (0,) * (net.rank(x) - 2)) or ()
    extra = (0,) * (2 - len(extra)) + tuple(extra)
    pairs = []
    for axis in range(2):
        stride, span, (before, after) = window.strides[axis], window.span[axis], window.pads[axis]
        image = _spread(op, net, image, axis + 1, stride)
        # the spread image ends with stride - 1 zeros that belong to no pixel
        pairs.append((span - 1 - before, span - 1 - after + extra[axis] - (stride - 1)))
    image = padded(op, net, image, [(0, 0), *pairs, (0, 0)])
    groups, channels = op.integer("group", 1), kernel.shape[0]
    if groups < 1 or channels % groups:
        raise op.refused(f"it has {groups} groups for {channels} channels", "the model is damaged")
    turned = kernel[:, :, ::-1, ::-1].reshape(groups, channels // groups, *kernel.shape[1:])
    turned = turned.transpose(0, 2, 1, 3, 4).reshape(-1, channels // groups, *kernel.shape[2:])
    plain = _Window(window.size, (1, 1), window.dilations, ((0, 0), (0, 0)), "NOTSET")
    return _back(op, net, _biased(op, net, _convolved(op, net, image, turned, plain, "VALID")))


def _spread(op: Op, net: Importer, image: str, axis: int, stride: int) -> str:
    """``stride`` - 1 zeros after each pixel of an axis, on three axes: what is before, the zeros, what is behind."""
    if stride == 1:
        return image
    shape = net.shape(image)
    behind = 1
    for i in range(axis + 1, _IMAGE):
        behind *= net.length(image, i)
    rows = net.reshape(image, (-1, 1, behind))
    wide = padded(op, net, rows, [(0, 0), (0, stride - 1), (0, 0)])
    return net.reshape(wide, (*shape[:axis], net.length(image, axis) * stride, *shape[axis + 1 :]))


# ------------------------------------------------------------------ pools


def _pool_attrs(window: _Window, padding: str) -> dict[str, Any]:
    return {"ksize": (1, *window.size, 1), "strides": (1, *window.strides, 1), "padding": padding}


def _max_pool(op: Op, net: Importer) -> list[str | None]:
    """The indices of the largest elements (the second output) are not made."""
    x = op.need(0)
    window = _window(op, net, x, op.integers("kernel_shape") or ())
    if set(window.dilations) != {1}:
        raise op.refused("its window is dilated", "no target has dilated pools")
    image = _image(op, net, x)
    image, padding = _framed(op, net, image, window, net.number(x, -np.inf))
    return [_back(op, net, net.add("MaxPool", [image], **_pool_attrs(window, padding))), None]


def _average_pool(op: Op, net: Importer) -> str:
    """The padding counts only with ``count_include_pad``; what ceil_mode adds at the end never does."""
    x = op.need(0)
    window = _window(op, net, x, op.integers("kernel_shape") or ())
    if set(window.dilations) != {1}:
        raise op.refused("its window is dilated", "no target has dilated pools")
    image = _image(op, net, x)
    pairs = _resolved(op, net, image, window) if window.auto_pad != "SAME_UPPER" else ((0, 0), (0, 0))
    counted = bool(op.integer("count_include_pad", 0))
    plain = window.auto_pad == "SAME_UPPER" or not any(a or b for a, b in pairs) or _is_same(net, image, window, pairs)
    if plain and not (counted and any(a or b for a, b in pairs)):
        _, padding = _framed(op, net, image, window)
        return _back(op, net, net.add("AvgPool", [image], **_pool_attrs(window, padding)))
    lengths = [net.length(image, axis) for axis in (1, 2)]
    given = window.pads if counted and window.pads is not None else pairs if counted else ((0, 0), (0, 0))
    counts = _counts(lengths, window, pairs, given)
    wide = padded(op, net, image, [(0, 0), *pairs, (0, 0)])
    mean = net.add("AvgPool", [wide], **_pool_attrs(window, "VALID"))
    factor = (window.size[0] * window.size[1] / counts).astype(FLOAT32)
    return _back(op, net, net.add("Mul", [mean, net.const(factor[None, :, :, None], "share")]))


def _counts(lengths: Sequence[int], window: _Window, pairs: Pairs, counted: Pairs) -> np.ndarray:
    """How many elements each window has that count: the image's, and the padding's in ``counted``."""
    sums = []
    for length, size, stride, (before, after), (first, last) in zip(
        lengths, window.size, window.strides, pairs, counted, strict=True
    ):
        line = np.zeros(before + length + after)
        line[before - first : before + length + last] = 1
        sums.append(np.lib.stride_tricks.sliding_window_view(line, size)[::stride].sum(axis=1))
    return np.maximum(np.outer(sums[0], sums[1]), 1)


def _global(kind: str) -> Translate:
    def function(op: Op, net: Importer) -> str:
        x = op.need(0)
        return net.reduce(kind, x, range(2, net.rank(x)), keep=True)

    return function


OPS: Mapping[str, Translate] = {
    "Conv": _conv,
    "ConvTranspose": _conv_transpose,
    "MaxPool": _max_pool,
    "AveragePool": _average_pool,
    "GlobalAveragePool": _global("Mean"),
    "GlobalMaxPool": _global("Max"),
}
