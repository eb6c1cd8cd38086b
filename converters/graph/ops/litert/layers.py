"""Products, convolutions, pooling."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.litert.base import (
    NONE,
    Litert,
    LitertBuilder,
    Operator,
    Value,
    as_int32,
    litert_error,
)

#: The axes of a kernel as LiteRT has them.
_FIRST = (3, 0, 1, 2)
#: Activations that a fused op may carry, by the names of their ops.
Known = Mapping[str, Operator]


def matmul(node: Node, builder: LitertBuilder, *, known: Known) -> Value:
    """FULLY_CONNECTED where the matrix is a constant, which it has a row of for each result; else BATCH_MATMUL."""
    kinds = [builder.type_of(r) for r in node.inputs]
    flags = (("transpose_a", "adj_x"), ("transpose_b", "adj_y"))
    turned = [any(node.attrs.get(flag) for flag in both) for both in flags]
    weights = kinds[1].constant
    if weights is not None and weights.ndim == 2 and kinds[0].rank == 2 and not turned[0]:
        bias = builder.value(node.inputs[2]) if len(node.inputs) > 2 else NONE
        rows = builder.value(node.inputs[1]) if turned[1] else builder.const(weights.T, node.inputs[1], (1, 0))
        values = [builder.value(node.inputs[0]), rows, bias]
        return _emit_activated(node, builder, "FULLY_CONNECTED", values, known)
    value = builder.emit("BATCH_MATMUL", [builder.value(r) for r in node.inputs[:2]], adj_x=turned[0], adj_y=turned[1])
    if len(node.inputs) > 2:
        return _emit_activated(node, builder, "ADD", [value, builder.value(node.inputs[2])], known)
    return value


def _emit_activated(
    node: Node, builder: LitertBuilder, op: str, values: Sequence[Value], known: Known, **options: Any
) -> Value:
    """An operator and the activations that the fused op carries: the first as a part of it where it can be."""
    carried = [known[name] for name in node.attrs.get("fused_ops", ())[1:]]
    first = carried.pop(0).op if carried and carried[0].applied else ""
    value = builder.emit(op, values, activation=first, **options)
    for function in carried:
        value = builder.emit(function.op, [value])
    return value


def _kernel(node: Node, builder: LitertBuilder) -> np.ndarray:
    kernel = builder.type_of(node.inputs[1]).constant
    if kernel is None:
        raise litert_error(node, "its kernel is computed while the graph runs")
    return kernel


def _windows(node: Node) -> dict[str, Any]:
    strides, (down, across) = node.attrs["strides"], node.attrs.get("dilations", (1, 1, 1, 1))[1:3]
    found = {"padding": node.attrs["padding"], "stride_h": int(strides[1]), "stride_w": int(strides[2])}
    return {**found, "dilation_h_factor": int(down), "dilation_w_factor": int(across)}


def _emit_convolution(
    node: Node,
    builder: LitertBuilder,
    op: str,
    weights: np.ndarray,
    known: Known,
    axes: Sequence[int] = (),
    **options: Any,
) -> Value:
    """Its operator asks for a bias: a policy's layer without one is given zeros."""
    if len(node.inputs) > 2:
        bias = builder.value(node.inputs[2])
    else:
        bias = builder.const(np.zeros(weights.shape[0 if op == "CONV_2D" else -1], weights.dtype), own=True)
    kernel = builder.const(weights, node.inputs[1] if axes else "", axes)
    values = [builder.value(node.inputs[0]), kernel, bias]
    return _emit_activated(node, builder, op, values, known, **_windows(node), **options)


def conv2d(node: Node, builder: LitertBuilder, *, known: Known) -> Value:
    """CONV_2D, whose kernel begins with the results' axis."""
    return _emit_convolution(node, builder, "CONV_2D", _kernel(node, builder).transpose(_FIRST), known, _FIRST)


def depthwise(node: Node, builder: LitertBuilder) -> Value:
    """DEPTHWISE_CONV_2D."""
    kernel = _kernel(node, builder)
    weights = kernel.reshape(1, *kernel.shape[:2], -1)
    return _emit_convolution(node, builder, "DEPTHWISE_CONV_2D", weights, {}, depth_multiplier=kernel.shape[3])


def pool(op: str) -> Litert:
    """A pooling operator."""

    def lower(node: Node, builder: LitertBuilder) -> Value:
        height, width = node.attrs["ksize"][1:3]
        options = {k: v for k, v in _windows(node).items() if not k.startswith("dilation")}
        return builder.emit(
            op, [builder.value(node.inputs[0])], filter_height=int(height), filter_width=int(width), **options
        )

    return lower


def pad(node: Node, builder: LitertBuilder) -> Value:
    """PAD with zeros, PADV2 with a number."""
    values = [builder.value(node.inputs[0]), as_int32(builder, node.inputs[1])]
    if len(node.inputs) > 2:
        return builder.emit("PADV2", [*values, builder.value(node.inputs[2])])
    return builder.emit("PAD", values)
