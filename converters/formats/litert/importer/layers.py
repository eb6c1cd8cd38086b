"""Products, convolutions, pooling, padding."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from export_model.converters.formats.litert.importer.elementwise import add_activation
from export_model.converters.formats.litert.importer.importer import KERNELS, LiteRTImporter
from export_model.converters.formats.litert.importer.operator import LiteRTOp, Translate
from export_model.converters.formats.litert.schema import PADDINGS
from export_model.converters.graph.nn.convolution import Window, conv2d, conv2d_transposed, transposed_window
from export_model.converters.graph.nn.dilation import (
    Blocks,
    batch_to_space,
    blocks_of,
    convolve_dilated,
    space_to_batch,
)
from export_model.converters.graph.ops.blocks import find_convolution
from export_model.converters.graph.ops.transposed import result_lengths

_PADDING = {number: name for name, number in PADDINGS.items()}


def _fully_connected(op: LiteRTOp, net: LiteRTImporter) -> str:
    """Rows of the last axis (or of as many numbers as a result has weights), times a matrix with a row per result."""
    x, weights = op.need(0), op.need(1)
    if op.integer("weights_format"):
        raise op.refusal("its weights are shuffled, for a model that is quantised")
    turned = weights in net.kernels
    results, size = (net.length(weights, i) for i in ((1, 0) if turned else (0, 1)))
    shape = net.type_of(x).shape
    if shape is None or len(shape) != 2:
        x = net.reshape(x, [-1, size])
    value = _with_bias(op, net, net.add("MatMul", [x, weights], transpose_b=not turned))
    if op.flag("keep_num_dims") and shape is not None and len(shape) != 2:
        value = net.reshape(value, [*shape[:-1], results])
    return value


def _with_bias(op: LiteRTOp, net: LiteRTImporter, value: str) -> str:
    """The bias, unless it is one of zeros without a name, which a layer without one is given; then the activation."""
    bias = op.get(2)
    if bias is not None:
        number = net.constant(bias)
        added = number is None or number.any() or not net.is_unnamed(bias)
        value = net.add("BiasAdd", [value, bias]) if added else value
    return add_activation(op, net, value)


def _batch_matmul(op: LiteRTOp, net: LiteRTImporter) -> str:
    a, b = op.need(0), op.need(1)
    x_turned, y_turned = op.flag("adj_x"), op.flag("adj_y")
    if net.rank(a) == net.rank(b) == 2:
        return net.add("MatMul", [a, b], transpose_a=x_turned, transpose_b=y_turned)
    return net.add("BatchMatMul", [a, b], adj_x=x_turned, adj_y=y_turned)


def _windows(op: LiteRTOp, **more: Any) -> dict[str, Any]:
    padding = _PADDING.get(op.integer("padding"))
    if padding is None:
        raise op.refusal(f"its padding is {op.integer('padding')}, which is neither SAME nor VALID")
    return {"padding": padding, "strides": (1, op.integer("stride_h"), op.integer("stride_w"), 1), **more}


def _dilated_windows(op: LiteRTOp) -> dict[str, Any]:
    down, across = (op.integer(f"dilation_{side}_factor", 1) for side in ("h", "w"))
    return _windows(op, dilations=(1, down, across, 1))


def _conv2d(op: LiteRTOp, net: LiteRTImporter) -> str:
    image, kernel = op.need(0), op.need(1)
    if kernel not in net.kernels:
        kernel = net.transpose(kernel, KERNELS[op.kind])
    channels, taken = net.length(image, 3), net.length(kernel, 2)
    if channels == taken:
        return _with_bias(op, net, net.add("Conv2D", [image, kernel], **_dilated_windows(op)))
    if not taken or channels % taken:
        raise op.refusal(f"its image has {channels} channels, and a filter takes {taken}")
    attrs = _dilated_windows(op)
    height, width = (net.length(kernel, i) for i in range(2))
    window = Window((height, width), attrs["strides"][1:3], attrs["dilations"][1:3], same=attrs["padding"] == "SAME")
    return _with_bias(op, net, conv2d(net, image, kernel, window, channels // taken))


def _depthwise(op: LiteRTOp, net: LiteRTImporter) -> str:
    """A filter is [1, height, width, channels · multiplier] here."""
    image, kernel = op.need(0), net.needed_constant(op.need(1), "its kernel")
    _, height, width, results = kernel.shape
    channels = net.length(image, 3)
    if kernel.shape[0] != 1 or not channels or results % channels:
        raise op.refusal(f"its kernel {list(kernel.shape)} does not fit an image of {channels} channels")
    own = net.const(kernel.reshape(height, width, channels, results // channels), "kernel")
    return _with_bias(op, net, net.add("DepthwiseConv2dNative", [image, own], **_dilated_windows(op)))


def _conv_transpose(op: LiteRTOp, net: LiteRTImporter) -> str:
    """By filters [out, height, width, in]; the first operand is the size of the result."""
    weights, image = net.needed_constant(op.need(1), "its kernel").transpose(1, 2, 3, 0), op.need(2)
    result = result_lengths(net.producer, net.constant, op.need(0))
    attrs, lengths = _windows(op), [net.length(image, i) for i in (1, 2)]
    size, strides = (weights.shape[0], weights.shape[1]), attrs["strides"][1:3]
    window, extra = transposed_window(size, strides, lengths, result, same=attrs["padding"] == "SAME")
    value = conv2d_transposed(net, image, weights, window, extra)
    bias = op.get(3)
    return add_activation(op, net, value if bias is None else net.add("BiasAdd", [value, bias]))


def _blocks(op: LiteRTOp, net: LiteRTImporter) -> Blocks:
    return blocks_of(*(net.needed_constant(op.need(i), "its block") for i in (1, 2)))


def _space_to_batch(op: LiteRTOp, net: LiteRTImporter) -> str:
    blocks = _blocks(op, net)
    made = space_to_batch(net, op.need(0), blocks)
    net.blocks[net.position[made]] = op.need(0), blocks
    return made


def _batch_to_space(op: LiteRTOp, net: LiteRTImporter) -> str:
    """The dilated convolution that the blocks were made for; without one they are put together."""
    crops = _blocks(op, net)
    found = find_convolution(net.producer, op.need(0))
    at = -1 if found is None else net.position[found.rows.name]
    if found is None or at not in net.blocks:
        return batch_to_space(net, op.need(0), crops)
    x, blocks = net.blocks[at]
    return convolve_dilated(net, x, found.kernel, found.bias, blocks.without(crops), depthwise=found.depthwise)


def _pool(kind: str) -> Translate:
    def translate(op: LiteRTOp, net: LiteRTImporter) -> str:
        size = (1, op.integer("filter_height"), op.integer("filter_width"), 1)
        return add_activation(op, net, net.add(kind, [op.need(0)], **_windows(op, ksize=size)))

    return translate


def _pad(op: LiteRTOp, net: LiteRTImporter) -> str:
    operands = op.operands()
    paddings = net.needed_constant(operands[1], "the paddings").astype(np.int64)
    if (paddings < 0).any():
        raise op.refusal("it pads by less than nothing")
    return net.add("Pad" if len(operands) == 2 else "PadV2", operands)


OPS: Mapping[str, Translate] = {
    "AVERAGE_POOL_2D": _pool("AvgPool"),
    "BATCH_MATMUL": _batch_matmul,
    "BATCH_TO_SPACE_ND": _batch_to_space,
    "CONV_2D": _conv2d,
    "DEPTHWISE_CONV_2D": _depthwise,
    "FULLY_CONNECTED": _fully_connected,
    "MAX_POOL_2D": _pool("MaxPool"),
    "PAD": _pad,
    "PADV2": _pad,
    "SPACE_TO_BATCH_ND": _space_to_batch,
    "TRANSPOSE_CONV": _conv_transpose,
}
