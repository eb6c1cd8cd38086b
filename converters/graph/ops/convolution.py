"""Convolutions, pooling and padding, all NHWC (graphs written NCHW are turned round by the canonicalise pass)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from msgspec.structs import replace

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.activations import (
    FUSED,
    LITERT_OPERATORS,
    LOOPS,
    NN_KINDS,
    apply_activations,
    lower_activated,
)
from export_model.converters.graph.ops.barracuda import arrays as nn_arrays
from export_model.converters.graph.ops.barracuda import layers as nn
from export_model.converters.graph.ops.barracuda.base import FIRST, Nn
from export_model.converters.graph.ops.barracuda.vocabulary import LayerType
from export_model.converters.graph.ops.base import (
    REQUIRED,
    Attr,
    Kernel,
    Lower,
    OnnxBuilder,
    OpDef,
    by_shape,
    constant_input,
    require_constant,
    shape_error,
    type_attr,
)
from export_model.converters.graph.ops.litert.base import Litert
from export_model.converters.graph.ops.litert.layers import conv2d, depthwise, pad, pool
from export_model.converters.graph.ops.loops import arrays
from export_model.converters.graph.ops.loops import layers as loops
from export_model.converters.graph.ops.loops.layers import window_padding
from export_model.converters.graph.ops.rewriting import GraphBuilder
from export_model.converters.graph.types import INT32, Dim, Symbols, TensorType
from export_model.signatures.errors import UnsupportedOpError

T = type_attr()
_TO_NCHW, _TO_NHWC = [0, 3, 1, 2], [0, 2, 3, 1]
_TO_OIHW = (3, 2, 0, 1)


def _spatial(node: Node, window: Sequence[int]) -> tuple[tuple[int, int], tuple[int, int], tuple[int, int]]:
    """(strides, dilations, dilated window) over height and width."""
    strides, dilations = node.attrs["strides"], node.attrs.get("dilations", (1, 1, 1, 1))
    grown = tuple((k - 1) * d + 1 for k, d in zip(window, dilations[1:3], strict=True))
    return (strides[1], strides[2]), (dilations[1], dilations[2]), (grown[0], grown[1])


def _patches(node: Node, x: np.ndarray, window: tuple[int, int], fill: float) -> np.ndarray:
    """[B, H', W', kh, kw, C] windows of an NHWC image, a view on the padded image."""
    strides, dilations, grown = _spatial(node, window)
    pads = [(0, 0)]
    for size, span, stride in zip(x.shape[1:3], grown, strides, strict=True):
        _, before, after = window_padding(size, span, stride, node.attrs["padding"])
        pads.append((before, after))
    padded = np.pad(x, [*pads, (0, 0)], constant_values=fill)
    view = np.lib.stride_tricks.sliding_window_view(padded, grown, axis=(1, 2))
    view = view[:, :: strides[0], :: strides[1], :, :: dilations[0], :: dilations[1]]
    return np.moveaxis(view, 3, 5)


def _conv2d(node: Node, x: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    patches = _patches(node, x, kernel.shape[:2], 0.0)
    rows = patches.reshape(-1, int(np.prod(kernel.shape[:3]))).astype(np.float64)
    with np.errstate(all="ignore"):
        result = rows @ kernel.reshape(-1, kernel.shape[3]).astype(np.float64)
    return np.asarray(result.reshape(*patches.shape[:3], kernel.shape[3])).astype(x.dtype)


def _fused_conv2d(node: Node, x: np.ndarray, kernel: np.ndarray, bias: np.ndarray) -> np.ndarray:
    return apply_activations(node, np.asarray(_conv2d(node, x, kernel) + bias))


def _depthwise(node: Node, x: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    patches = _patches(node, x, kernel.shape[:2], 0.0).astype(np.float64)
    with np.errstate(all="ignore"):
        result = np.einsum("bhwijc,ijcm->bhwcm", patches, kernel.astype(np.float64))
    return np.asarray(result.reshape(*result.shape[:3], -1)).astype(x.dtype)


def _window_of(node: Node, args: Sequence[TensorType]) -> tuple[tuple[Dim, ...], tuple[int, int], Dim]:
    """(image shape, window, result channels) of a node, checked."""
    image = args[0].shape
    if image is None or len(image) != 4:
        raise shape_error(node, args, "an image has four axes: batch, height, width, channels")
    if "ksize" in node.attrs:
        window = node.attrs["ksize"]
        if window[0] != 1 or window[3] != 1:
            raise shape_error(node, args, "pooling over batch or channels is not supported")
        return image, (window[1], window[2]), image[3]
    kernel = args[1].shape
    if kernel is None or len(kernel) != 4 or not all(isinstance(k, int) for k in kernel):
        raise shape_error(node, args, "the kernel's shape must be known and have four axes")
    height, width, channels, last = (int(k) for k in kernel)
    if isinstance(image[3], int) and image[3] != channels:
        raise shape_error(node, args, f"the image has {image[3]} channels, the kernel takes {channels}")
    return image, (height, width), channels * last if node.op == "DepthwiseConv2dNative" else last


def _infer_window(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    image, window, channels = _window_of(node, args)
    strides, _, grown = _spatial(node, window)
    spatial: list[Dim] = []
    for size, span, stride in zip(image[1:3], grown, strides, strict=True):
        if isinstance(size, str):
            spatial.append(symbols.fresh())
            continue
        result = window_padding(size, span, stride, node.attrs["padding"])[0]
        if result < 1:
            raise shape_error(node, args, f"a window of {span} does not fit into {size}")
        spatial.append(result)
    return [TensorType(args[0].dtype, (image[0], *spatial, channels))]


def _lower_window(node: Node, builder: OnnxBuilder, onnx_op: str, inputs: list[str], **attributes: Any) -> Any:
    """Frame an ONNX window op with the transposes that its NCHW layout needs."""
    window = attributes["kernel_shape"]
    strides, dilations, grown = _spatial(node, window)
    image = builder.type_of(node.inputs[0]).shape
    assert image is not None
    attributes["strides"] = list(strides)
    if onnx_op == "Conv":
        attributes["dilations"] = list(dilations)
    if node.attrs["padding"] == "SAME":
        by_one = [n if s > 1 else 1 for n, s in zip(image[1:3], strides, strict=True)]  # which pads all sizes alike
        if all(isinstance(size, int) for size in by_one):
            pads = [window_padding(int(by_one[i]), grown[i], strides[i], "SAME")[1:] for i in range(2)]
            attributes["pads"] = [pads[0][0], pads[1][0], pads[0][1], pads[1][1]]
        elif max(dilations) > 1:  # auto_pad takes no dilations in onnxruntime
            raise _unknown_size_error(node)
        else:
            attributes["auto_pad"] = "SAME_UPPER"
    value = builder.emit("Transpose", [builder.value(node.inputs[0])], perm=_TO_NCHW)
    value = builder.emit(onnx_op, [value, *inputs], **attributes)
    return builder.emit("Transpose", [value], perm=_TO_NHWC)


def _unknown_size_error(node: Node) -> UnsupportedOpError:
    return UnsupportedOpError(
        f"cannot convert {node.op} (node {node.name!r}) with strides, dilations and SAME padding of images of any size",
        issues=[(node.name, node.op)],
        why="how much is padded follows from the size",
        fix="build the network for one size, or pad before the convolution, and give it VALID padding",
    )


def _lower_conv2d(node: Node, builder: OnnxBuilder) -> Any:
    kernel = constant_input(node, builder, 1, "a kernel")
    weights = builder.const(np.ascontiguousarray(kernel.transpose(_TO_OIHW)), "kernel")
    builder.holds(weights, node.inputs[1], _TO_OIHW)
    inputs = [weights] + [builder.value(r) for r in node.inputs[2:]]
    value = _lower_window(node, builder, "Conv", inputs, kernel_shape=list(kernel.shape[:2]))
    return lower_activated(node, value, builder)


def _lower_depthwise(node: Node, builder: OnnxBuilder) -> Any:
    kernel = constant_input(node, builder, 1, "a kernel")
    height, width, channels, multiplier = kernel.shape
    grouped = kernel.transpose(2, 3, 0, 1).reshape(channels * multiplier, 1, height, width)
    weights = builder.const(np.ascontiguousarray(grouped), "kernel")
    return _lower_window(node, builder, "Conv", [weights], kernel_shape=[height, width], group=channels)


def _tfjs_convolution(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    """Write a convolution as TensorFlow.js computes it.

    A SAME one whose windows leave a rest, which is less than nothing to pad, becomes Pad and a VALID one: on wasm it
    gives zeros. So does one of strides and dilations, which TensorFlow.js refuses; it reads every n-th pixel only.
    """
    strides, dilations = (node.attrs[key][1:3] for key in ("strides", "dilations"))
    both = max(strides) > 1 and max(dilations) > 1
    pads = _pads(node, types, always=both)
    if pads is not None:
        amounts = builder.const(np.array([(0, 0), *pads, (0, 0)], INT32), f"{node.name}/pads")
        padded = builder.add("Pad", [node.inputs[0], amounts], f"{node.name}/pad")
        node = replace(node, inputs=(padded, *node.inputs[1:]), attrs={**node.attrs, "padding": "VALID"})
    if not both:
        return node
    if node.attrs["padding"] != "VALID":
        raise _unknown_size_error(node)
    shared = [math.gcd(*pair) for pair in zip(strides, dilations, strict=True)]
    strides, dilations = ([n // s for n, s in zip(each, shared, strict=True)] for each in (strides, dilations))
    image = _every(builder, node.inputs[0], shared, f"{node.name}/read")
    both = max(strides) > 1 and max(dilations) > 1  # they share no more divisor: all results, then every n-th of them
    attrs = {**node.attrs, "strides": (1, *((1, 1) if both else strides), 1), "dilations": (1, *dilations, 1)}
    if not both:
        return replace(node, inputs=(image, *node.inputs[1:]), attrs=attrs)
    whole = builder.add(node.op, [image, *node.inputs[1:]], f"{node.name}/whole", node.origin, **attrs)
    return Node(node.name, "StridedSlice", (whole, *_steps(builder, strides, node.name)), _ALL, origin=node.origin)


def _pads(node: Node, types: Mapping[str, TensorType], *, always: bool) -> list[tuple[int, int]] | None:
    """What a SAME convolution pads, where its sizes are known and its windows leave a rest, or ``always``."""
    image, kernel = types[node.inputs[0]].shape, types[node.inputs[1]].shape
    if node.attrs["padding"] != "SAME" or image is None or kernel is None:
        return None
    pads, rest = [], always
    for size, span, stride, dilation in zip(
        image[1:3], kernel[:2], node.attrs["strides"][1:3], node.attrs["dilations"][1:3], strict=True
    ):
        if not isinstance(size, int) or not isinstance(span, int):
            return None
        window = (span - 1) * dilation + 1
        count, before, after = window_padding(size, window, stride, "SAME")
        rest |= (count - 1) * stride + window < size
        pads.append((before, after))
    return pads if rest else None


_ALL = {"begin_mask": 0b1111, "end_mask": 0b1111, "ellipsis_mask": 0, "new_axis_mask": 0, "shrink_axis_mask": 0}


def _every(builder: GraphBuilder, image: str, steps: Sequence[int], name: str) -> str:
    """Every n-th row and column of an NHWC image."""
    if set(steps) == {1}:
        return image
    return builder.add("StridedSlice", [image, *_steps(builder, steps, name)], name, None, **_ALL)


def _steps(builder: GraphBuilder, steps: Sequence[int], name: str) -> list[str]:
    zeros, all_steps = np.zeros(4, INT32), np.array((1, *steps, 1), INT32)
    return [builder.const(a, f"{name}/{k}") for k, a in (("begin", zeros), ("end", zeros), ("steps", all_steps))]


def _lower_pool(onnx_op: str) -> Any:
    def lower(node: Node, builder: OnnxBuilder) -> Any:
        return _lower_window(node, builder, onnx_op, [], kernel_shape=list(node.attrs["ksize"][1:3]))

    return lower


def _max_pool(node: Node, x: np.ndarray) -> np.ndarray:
    window = node.attrs["ksize"][1:3]
    return np.asarray(_patches(node, x, window, -np.inf).max(axis=(3, 4))).astype(x.dtype)


def _avg_pool(node: Node, x: np.ndarray) -> np.ndarray:
    """Elements of the padding do not count (TensorFlow's rule)."""
    window = node.attrs["ksize"][1:3]
    total = _patches(node, x.astype(np.float64), window, 0.0).sum(axis=(3, 4))
    count = _patches(node, np.ones(x.shape, np.float64), window, 0.0).sum(axis=(3, 4))
    return np.asarray(total / count).astype(x.dtype)


# ------------------------------------------------------------------ padding


def _pad(node: Node, x: np.ndarray, paddings: np.ndarray, value: np.ndarray | None = None) -> np.ndarray:
    fill = 0 if value is None else value
    return np.pad(x, [(int(a), int(b)) for a, b in paddings], constant_values=fill)


@by_shape
def _infer_pad(node: Node, args: Sequence[TensorType], shape: tuple[Dim, ...], symbols: Symbols) -> Sequence[Dim]:
    paddings = require_constant(node, args, 1, "paddings")
    if paddings.shape != (len(shape), 2):
        raise shape_error(node, args, "paddings must hold a pair for each axis")
    dims: list[Dim] = []
    for size, (before, after) in zip(shape, paddings.tolist(), strict=True):
        both = before + after
        dims.append(size + both if isinstance(size, int) else size if both == 0 else symbols.fresh())
    return dims


def _lower_pad(node: Node, builder: OnnxBuilder) -> Any:
    paddings = constant_input(node, builder, 1, "paddings")
    inputs = [builder.value(node.inputs[0]), builder.const(paddings.T.reshape(-1).astype(np.int64), "pads")]
    if len(node.inputs) > 2:
        inputs.append(builder.value(node.inputs[2]))
    return builder.emit("Pad", inputs)


_STRIDES = Attr("strides", "int", REQUIRED)
_PADDING = Attr("padding", "str", REQUIRED)
_FORMAT = Attr("data_format", "str", "NHWC")
# An EXPLICIT padding is split off as a Pad node by the reader (frozen_graph/reader.py), so none is left here.
_EXPLICIT = Attr("explicit_paddings", "int", (), since="1.14", supported=False)
_DILATIONS = Attr("dilations", "int", (1, 1, 1, 1), since="1.7")
_CUDNN = Attr("use_cudnn_on_gpu", "bool", True)

_CONV = (T, _STRIDES, _PADDING, _FORMAT, _DILATIONS, _EXPLICIT)
_POOL = (T, Attr("ksize", "int", REQUIRED), _STRIDES, _PADDING, _FORMAT, _EXPLICIT)
_CONV2D = partial(conv2d, known=LITERT_OPERATORS)
_CONVOLUTION = partial(loops.convolution, known=LOOPS)


def _convolution(
    name: str, kernel: Kernel, lower: Lower, attrs: Sequence[Attr], litert: Litert, **traits: Any
) -> OpDef:
    traits |= {"litert": litert, "foldable": False, "precision": "summed", "layer": "convolution"}
    return OpDef(name, _infer_window, kernel, lower, (*_CONV, *attrs), **traits)


OPS = (
    _convolution(
        "Conv2D",
        _conv2d,
        _lower_conv2d,
        [_CUDNN],
        _CONV2D,
        nn=Nn(nn.conv2d),
        loops=_CONVOLUTION,
        tfjs=_tfjs_convolution,
        fused="_FusedConv2D",
    ),
    _convolution(
        "_FusedConv2D",
        _fused_conv2d,
        _lower_conv2d,
        [_CUDNN, *FUSED],
        _CONV2D,
        nn=nn.with_activations(nn.conv2d, NN_KINDS),
        loops=_CONVOLUTION,
        since="1.13",
    ),
    _convolution(
        "DepthwiseConv2dNative",
        _depthwise,
        _lower_depthwise,
        [],
        depthwise,
        nn=Nn(nn.depthwise),
        loops=loops.depthwise,
        tfjs=_tfjs_convolution,
    ),
    OpDef(
        "MaxPool",
        _infer_window,
        _max_pool,
        _lower_pool("MaxPool"),
        _POOL,
        nn=nn.pool(LayerType.MAX_POOL2D),
        litert=pool("MAX_POOL_2D"),
        loops=loops.pool("max"),
        precision="exact",
        layer="pool",
    ),
    OpDef(
        "AvgPool",
        _infer_window,
        _avg_pool,
        _lower_pool("AveragePool"),
        _POOL[:-1],
        nn=nn.pool(LayerType.AVG_POOL2D),
        litert=pool("AVERAGE_POOL_2D"),
        loops=loops.pool("sum"),
        precision="summed",
        layer="pool",
    ),
    *(
        OpDef(
            name,
            _infer_pad,
            _pad,
            _lower_pad,
            (T, type_attr("Tpaddings", "in:1")),
            nn=Nn(nn_arrays.pad, FIRST),
            litert=pad,
            loops=arrays.pad,
            precision="exact",
        )
        for name in ("Pad", "PadV2")
    ),
)
