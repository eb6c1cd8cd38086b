"""ONNX reductions in forms that every importer reads.

Barracuda 1.4 to 2.3.1 takes the axes of a reduction from its attribute alone and sums over the batch where they are an
input, as those of ReduceSum are since opset 13 and of the others since 18 (measured: ReduceSum_10 to _15, ReduceMean_04
of Unity's importers). A sum over the last axis is therefore a product with a column of ones, which onnxruntime computes
as fast; over other axes it is the mean times the count.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from converters.graph.ops.base import OnnxBuilder, squeezed
from converters.graph.types import Dim, TensorType


def reduced(
    builder: OnnxBuilder, onnx_op: str, value: str, kind: TensorType, axes: Sequence[int], keepdims: bool
) -> str:
    """``value``, of type ``kind``, reduced by ``onnx_op`` over ``axes`` (sorted, counted from the front)."""
    if not axes:
        return value
    if onnx_op == "ReduceSum":
        return _summed(builder, value, kind, axes, keepdims)
    if builder.opset >= 18:
        axes_value = builder.const(np.array(axes, np.int64), "axes")
        result: str = builder.emit(onnx_op, [value, axes_value], keepdims=int(keepdims))
    else:
        result = builder.emit(onnx_op, [value], axes=[int(a) for a in axes], keepdims=int(keepdims))
    return result


def _summed(builder: OnnxBuilder, value: str, kind: TensorType, axes: Sequence[int], keepdims: bool) -> str:
    assert kind.shape is not None
    if builder.opset < 13:
        summed: str = builder.emit("ReduceSum", [value], axes=[int(a) for a in axes], keepdims=int(keepdims))
        return summed
    shape, last = list(kind.shape), len(kind.shape) - 1
    lengths = [n for n in (shape[a] for a in axes) if isinstance(n, int)]
    if list(axes) != [last] and kind.dtype.kind == "f" and len(lengths) == len(axes) and builder.opset < 18:
        mean = reduced(builder, "ReduceMean", value, kind, axes, keepdims)
        counted: str = builder.emit("Mul", [mean, builder.const(np.array(math.prod(lengths), kind.dtype), "count")])
        return counted
    for axis in axes:
        value = _column(builder, value, shape, axis, kind.dtype)
        shape[axis] = 1
    if keepdims:
        return value
    return squeezed(builder, value, axes, [d for i, d in enumerate(shape) if i not in axes])


def _column(builder: OnnxBuilder, value: str, shape: Sequence[Dim], axis: int, dtype: np.dtype) -> str:
    """The sum over one axis, which is kept with length 1: the axis goes last and is multiplied with ones."""
    last, length = len(shape) - 1, shape[axis]
    if isinstance(length, int):
        ones = builder.const(np.ones((length, 1), dtype), "ones")
    else:
        index = builder.const(np.array([axis], np.int64), "axis")
        rows = builder.emit("Gather", [builder.emit("Shape", [value]), index], axis=0)
        column = builder.emit("Concat", [rows, builder.const(np.ones(1, np.int64), "one")], axis=0)
        ones = builder.emit("ConstantOfShape", [column], value=np.ones(1, dtype))
    order = [*(i for i in range(last + 1) if i != axis), axis]
    if axis != last:
        value = builder.emit("Transpose", [value], perm=order)
    value = builder.emit("MatMul", [value, ones])
    if axis != last:
        value = builder.emit("Transpose", [value], perm=[int(i) for i in np.argsort(order)])
    return value
