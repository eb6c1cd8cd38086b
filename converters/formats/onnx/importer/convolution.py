"""Convolutions and pools. ONNX has channels first; inside they are computed NHWC, between two transposes.

The transposes of neighbouring layers cancel (converters/compiler/passes/transposes.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from msgspec.structs import replace

from export_model.converters.formats.onnx.importer.importer import Importer
from export_model.converters.formats.onnx.importer.node import Op, Translate
from export_model.converters.graph.nn import convolution as nn
from export_model.converters.graph.nn import pooling
from export_model.converters.graph.nn.convolution import Pair, Window

_TO_NHWC, _TO_NCHW = (0, 2, 3, 1), (0, 3, 1, 2)
_IMAGE = 4


def _image(net: Importer, x: str) -> str:
    """NCHW (or NCW, a row of pixels: an image of height 1) as NHWC."""
    return net.transpose(net.expand_dims(x, 2) if net.rank(x) == _IMAGE - 1 else x, _TO_NHWC)


def _back(op: Op, net: Importer, value: str) -> str:
    result = net.transpose(value, _TO_NCHW)
    return net.squeeze(result, [2]) if net.rank(op.need(0)) == _IMAGE - 1 else result


def _window(op: Op, net: Importer, size: Sequence[int]) -> Window:
    """The window over the first input; what auto_pad and ceil_mode ask for stands in ``_resolve_padding``."""
    spatial = net.rank(op.need(0)) - 2
    if spatial not in (1, 2):
        raise op.op_error(f"it works on {spatial} spatial axes", "policies see images and rows of pixels")
    if len(size) != spatial:
        raise op.op_error(f"its window {list(size)} does not fit {spatial} spatial axes", "the model is damaged")
    ones = (1,) * spatial
    strides, dilations = op.integers("strides", ones) or ones, op.integers("dilations", ones) or ones
    pads = op.integers("pads", (0,) * (2 * spatial)) or (0,) * (2 * spatial)
    fitting = len(strides) == len(dilations) == spatial and len(pads) == 2 * spatial
    if not fitting or min(*size, *strides, *dilations) < 1:
        raise op.op_error("its window, strides, dilations and pads do not fit together", "the model is damaged")
    pairs = tuple(zip(pads[:spatial], pads[spatial:], strict=True))
    if op.text("auto_pad", "NOTSET") != "NOTSET":
        pairs = ((0, 0),) * spatial
    if spatial == 1:
        size, strides, dilations, pairs = (1, *size), (1, *strides), (1, *dilations), ((0, 0), *pairs)
    return Window((size[0], size[1]), (strides[0], strides[1]), (dilations[0], dilations[1]), (pairs[0], pairs[1]))


def _resolve_padding(op: Op, net: Importer, image: str, window: Window, *, plainly: bool = False) -> Window:
    """With the paddings that auto_pad and ceil_mode name, for an NHWC image; ``plainly``: SAME as numbers, too."""
    padding = op.text("auto_pad", "NOTSET")
    if padding == "SAME_UPPER" and not plainly:
        return replace(window, same=True)
    if padding in ("SAME_UPPER", "SAME_LOWER"):
        top, left = window.same_pads([net.length(image, axis) for axis in (1, 2)])
        return replace(window, pads=(top, left) if padding == "SAME_UPPER" else (top[::-1], left[::-1]))
    return _pad_for_ceil(net, image, window) if op.integer("ceil_mode", 0) else window


def _pad_for_ceil(net: Importer, image: str, window: Window) -> Window:
    """``ceil_mode`` as more padding at the end; a window that would begin in it is left out (opset 19)."""
    pairs: list[Pair] = []
    for axis, ((before, after), span, stride) in enumerate(zip(window.pads, window.span, window.strides, strict=True)):
        length = net.length(image, axis + 1)
        count = -(-(length + before + after - span) // stride) + 1
        if (count - 1) * stride >= length + before:
            count -= 1
        pairs.append((before, max(after, (count - 1) * stride + span - length - before)))
    return replace(window, pads=(pairs[0], pairs[1]))


# ------------------------------------------------------------------ convolutions


def _kernel(op: Op, net: Importer) -> np.ndarray:
    kernel = net.needed_constant(op.need(1), "the kernel")
    return kernel[:, :, None, :] if kernel.ndim == _IMAGE - 1 else kernel


def _add_bias(op: Op, net: Importer, value: str) -> str:
    bias = op.get(2)
    return value if bias is None else net.add("BiasAdd", [value, bias])


def _conv(op: Op, net: Importer) -> str:
    """By a kernel [out, in per group, height, width]."""
    kernel = _kernel(op, net).transpose(2, 3, 1, 0)
    window = _window(op, net, [int(k) for k in net.shape(op.need(1))[2:]])
    image = _image(net, op.need(0))
    window = _resolve_padding(op, net, image, window)
    return _back(op, net, _add_bias(op, net, nn.conv2d(net, image, kernel, window, op.integer("group", 1))))


def _conv_transpose(op: Op, net: Importer) -> str:
    """By a kernel [in, out per group, height, width]."""
    kernel = _kernel(op, net).transpose(2, 3, 0, 1)
    window = _window(op, net, [int(k) for k in net.shape(op.need(1))[2:]])
    if op.text("auto_pad", "NOTSET") not in ("NOTSET", "VALID") or "output_shape" in op.attrs:
        raise op.op_error("its padding follows from the size of its result", "give pads and output_padding instead")
    image = _image(net, op.need(0))
    given = op.integers("output_padding") or ()
    extra = (*(0,) * (2 - len(given)), *given)
    value = nn.conv2d_transposed(net, image, kernel, window, (extra[0], extra[1]), op.integer("group", 1))
    return _back(op, net, _add_bias(op, net, value))


# ------------------------------------------------------------------ pools


def _max_pool(op: Op, net: Importer) -> list[str | None]:
    """The indices of the largest elements (the second output) are not made."""
    window = _window(op, net, op.integers("kernel_shape") or ())
    image = _image(net, op.need(0))
    window = _resolve_padding(op, net, image, window)
    return [_back(op, net, pooling.max_pool(net, image, window)), None]


def _average_pool(op: Op, net: Importer) -> str:
    """The padding counts only with ``count_include_pad``; what ceil_mode adds at the end never does."""
    window = _window(op, net, op.integers("kernel_shape") or ())
    image = _image(net, op.need(0))
    counted = bool(op.integer("count_include_pad", 0))
    padded = _resolve_padding(op, net, image, window, plainly=counted)
    counts = window.pads if op.text("auto_pad", "NOTSET") == "NOTSET" else padded.pads
    return _back(op, net, pooling.average_pool(net, image, padded, counts if counted else None))


def _lp_pool(op: Op, net: Importer) -> str:
    """(Σ|x|^p)^(1/p) under each window; the padding is zeros, whatever it counts as."""
    power = float(op.integer("p", 2))
    window = _window(op, net, op.integers("kernel_shape") or ())
    image = _image(net, net.add("Abs", [op.need(0)]))
    raised = net.add("Pow", [image, net.number(image, power)])
    padded = _resolve_padding(op, net, raised, window, plainly=True)
    mean = pooling.average_pool(net, raised, padded, padded.pads)
    total = net.add("Mul", [mean, net.number(mean, window.size[0] * window.size[1])])
    return _back(op, net, net.add("Pow", [total, net.number(total, 1 / power)]))


def _global_lp_pool(op: Op, net: Importer) -> str:
    x, power = op.need(0), float(op.integer("p", 2))
    raised = net.add("Pow", [net.add("Abs", [x]), net.number(x, power)])
    total = net.reduce("Sum", raised, range(2, net.rank(x)), keep=True)
    return net.add("Pow", [total, net.number(total, 1 / power)])


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
    "LpPool": _lp_pool,
    "GlobalLpPool": _global_lp_pool,
    "GlobalAveragePool": _global("Mean"),
    "GlobalMaxPool": _global("Max"),
}
