"""Reductions, the place of the best, softmax."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.barracuda import layers as nn
from export_model.converters.graph.ops.barracuda.vocabulary import Activation, LayerType
from export_model.converters.graph.ops.base import (
    Attr,
    OnnxBuilder,
    OpDef,
    Precision,
    axes_within,
    axis_within,
    by_shape,
    constant_input,
    direct,
    emit_squeeze,
    not_constant,
    require_constant,
    same_as,
    type_attr,
)
from export_model.converters.graph.ops.litert.base import LitertBuilder, as_int32, builtin, ints, litert_error
from export_model.converters.graph.ops.loops import layers as loops
from export_model.converters.graph.types import BOOL, INT32, INT64, Dim, Symbols, TensorType

T = type_attr()


def _axes(axes: np.ndarray, rank: int) -> tuple[int, ...]:
    return axes_within(np.atleast_1d(axes), rank)


def _mean(x: np.ndarray, axis: tuple[int, ...], keepdims: bool) -> np.ndarray:
    """As ``np.mean``, which warns in words where it is of nothing: a NaN."""
    if x.size:
        return np.asarray(np.mean(x, axis=axis, keepdims=keepdims))
    return np.asarray(np.sum(x, axis=axis, keepdims=keepdims) / np.float64(math.prod(x.shape[a] for a in axis)))


def _reduction(function: Callable[..., np.ndarray], *, wide: bool) -> Callable[..., np.ndarray]:
    def kernel(node: Node, x: np.ndarray, axes: np.ndarray) -> np.ndarray:
        work = x.astype(np.float64) if wide and x.dtype.kind == "f" else x
        chosen = _axes(axes, x.ndim)
        with np.errstate(all="ignore"):
            result = function(work, axis=chosen, keepdims=bool(node.attrs["keep_dims"])) if chosen else work
        return np.asarray(result).astype(x.dtype)

    return kernel


@by_shape
def _infer_reduction(node: Node, args: Sequence[TensorType], shape: tuple[Dim, ...], symbols: Symbols) -> Sequence[Dim]:
    keep = bool(node.attrs["keep_dims"])
    axes = _axes(require_constant(node, args, 1, "the axes to reduce over"), len(shape))
    return [1 if i in axes else d for i, d in enumerate(shape) if keep or i not in axes]


def _lower_reduction(onnx_op: str) -> Callable[[Node, OnnxBuilder], Any]:
    def lower(node: Node, builder: OnnxBuilder) -> Any:
        kind = builder.type_of(node.inputs[0])
        if kind.shape is None:
            raise not_constant(node, "an operand of a rank")
        axes = _axes(constant_input(node, builder, 1, "the axes to reduce over"), len(kind.shape))
        value = builder.value(node.inputs[0])
        keep = bool(node.attrs["keep_dims"])
        if kind.dtype == BOOL:  # ONNX does not reduce booleans
            value = builder.emit("Cast", [value], to=INT32)
            return builder.emit("Cast", [_emit_reduction(builder, onnx_op, value, kind, axes, keep)], to=BOOL)
        return _emit_reduction(builder, onnx_op, value, kind, axes, keep)

    return lower


def _litert_reduction(op: str) -> Callable[[Node, LitertBuilder], Any]:
    def lower(node: Node, builder: LitertBuilder) -> Any:
        rank, axes = builder.type_of(node.inputs[0]).rank, builder.type_of(node.inputs[1]).constant
        if axes is None or rank is None:
            raise litert_error(node, "the axes that it reduces over are computed while the graph runs")
        value, chosen = builder.value(node.inputs[0]), _axes(axes, rank)
        return (
            builder.emit(op, [value, ints(builder, *chosen)], keep_dims=bool(node.attrs["keep_dims"]))
            if chosen
            else value
        )

    return lower


def _reduce(
    name: str,
    function: Callable[..., Any],
    onnx_op: str,
    precision: Precision,
    litert_op: str,
    layer: LayerType,
    **traits: Any,
) -> OpDef:
    attrs: tuple[Attr, ...] = (Attr("keep_dims", "bool", False), type_attr("Tidx", "in:1"))
    if name not in ("All", "Any"):
        attrs = (T, *attrs)
    kernel = _reduction(function, wide=precision != "exact")
    lower, litert, layers = _lower_reduction(onnx_op), _litert_reduction(litert_op), nn.reduction(layer)
    return OpDef(name, _infer_reduction, kernel, lower, attrs, nn=layers, litert=litert, precision=precision, **traits)


def _arg(function: Callable[..., Any]) -> Callable[..., np.ndarray]:
    def kernel(node: Node, x: np.ndarray, axis: np.ndarray) -> np.ndarray:
        return np.asarray(function(x, axis=int(axis))).astype(node.attrs["output_type"])

    return kernel


def _infer_arg(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    shape = args[0].shape
    if shape is None:
        return [TensorType(node.attrs["output_type"], None)]
    axis = int(require_constant(node, args, 1, "an axis"))
    axis = axis_within(axis, len(shape))
    return [TensorType(node.attrs["output_type"], shape[:axis] + shape[axis + 1 :])]


def _lower_arg(onnx_op: str) -> Callable[[Node, OnnxBuilder], Any]:
    def lower(node: Node, builder: OnnxBuilder) -> Any:
        axis = int(constant_input(node, builder, 1, "an axis"))
        value = builder.emit(onnx_op, [builder.value(node.inputs[0])], axis=axis, keepdims=0)
        return value if node.attrs["output_type"] == INT64 else builder.emit("Cast", [value], to=INT32)

    return lower


def _litert_arg(op: str) -> Callable[[Node, LitertBuilder], Any]:
    def lower(node: Node, builder: LitertBuilder) -> Any:
        values = [builder.value(node.inputs[0]), as_int32(builder, node.inputs[1])]
        return builder.emit(op, values, output_type=node.attrs["output_type"])

    return lower


_ARG_ATTRS = (T, type_attr("Tidx", "in:1"), Attr("output_type", "type", INT64))
_CHOICES: tuple[tuple[str, Callable[..., Any], str, Literal["largest", "smallest"], LayerType], ...] = (
    ("ArgMax", np.argmax, "ARG_MAX", "largest", LayerType.REDUCE_MAX),
    ("ArgMin", np.argmin, "ARG_MIN", "smallest", LayerType.REDUCE_MIN),
)


def _emit_reduction(
    builder: OnnxBuilder, onnx_op: str, value: str, kind: TensorType, axes: Sequence[int], keepdims: bool
) -> str:
    """``value`` reduced by ``onnx_op``, in forms that every importer reads.

    ``value`` is of type ``kind``; ``axes`` are sorted, counted from the front. Barracuda 1.4 to 2.3.1 takes the axes of
    a reduction from its attribute alone and sums over the batch where they are an input, as those of ReduceSum are
    since opset 13 and of the others since 18 (measured: ReduceSum_10 to _15, ReduceMean_04 of Unity's importers). A sum
    over the last axis is therefore a product with a column of ones, which onnxruntime computes as fast; over other axes
    it is the mean times the count.
    """
    if not axes:
        return value
    if onnx_op == "ReduceSum":
        return _emit_sum(builder, value, kind, axes, keepdims)
    if builder.opset >= 18:
        return builder.emit(onnx_op, [value, builder.const(np.array(axes, np.int64), "axes")], keepdims=int(keepdims))
    return builder.emit(onnx_op, [value], axes=[int(a) for a in axes], keepdims=int(keepdims))


def _emit_sum(builder: OnnxBuilder, value: str, kind: TensorType, axes: Sequence[int], keepdims: bool) -> str:
    assert kind.shape is not None
    if builder.opset < 13:
        return builder.emit("ReduceSum", [value], axes=[int(a) for a in axes], keepdims=int(keepdims))
    shape, last = list(kind.shape), len(kind.shape) - 1
    lengths = [n for n in (shape[a] for a in axes) if isinstance(n, int)]
    if list(axes) != [last] and kind.dtype.kind == "f" and len(lengths) == len(axes) and builder.opset < 18:
        mean = _emit_reduction(builder, "ReduceMean", value, kind, axes, keepdims)
        return builder.emit("Mul", [mean, builder.const(np.array(math.prod(lengths), kind.dtype), "count")])
    for axis in axes:
        value = _column(builder, value, shape, axis, kind.dtype)
        shape[axis] = 1
    if keepdims:
        return value
    return emit_squeeze(builder, value, axes, [d for i, d in enumerate(shape) if i not in axes])


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


# ------------------------------------------------------------------ softmax


def softmax64(x: np.ndarray) -> np.ndarray:
    """Softmax over the last axis in float64."""
    wide = x.astype(np.float64)
    with np.errstate(all="ignore"):
        e = np.exp(wide - wide.max(axis=-1, keepdims=True))
        return np.asarray(e / e.sum(axis=-1, keepdims=True))


def _log_softmax(node: Node, x: np.ndarray) -> np.ndarray:
    wide = x.astype(np.float64)
    with np.errstate(all="ignore"):
        shifted = wide - wide.max(axis=-1, keepdims=True)
        return np.asarray(shifted - np.log(np.exp(shifted).sum(axis=-1, keepdims=True))).astype(x.dtype)


OPS = (
    _reduce("Sum", np.sum, "ReduceSum", "summed", "SUM", LayerType.REDUCE_SUM, loops=loops.reduction("sum")),
    _reduce(
        "Mean",
        _mean,
        "ReduceMean",
        "summed",
        "MEAN",
        LayerType.REDUCE_MEAN,
        takes="mean",
        loops=loops.reduction("sum", mean=True),
    ),
    _reduce(
        "Prod", np.prod, "ReduceProd", "rounded", "REDUCE_PROD", LayerType.REDUCE_PROD, loops=loops.reduction("product")
    ),
    _reduce(
        "Max",
        np.max,
        "ReduceMax",
        "exact",
        "REDUCE_MAX",
        LayerType.REDUCE_MAX,
        takes="largest",
        loops=loops.reduction("max"),
    ),
    _reduce("Min", np.min, "ReduceMin", "exact", "REDUCE_MIN", LayerType.REDUCE_MIN, loops=loops.reduction("min")),
    _reduce("All", np.all, "ReduceMin", "exact", "REDUCE_ALL", LayerType.REDUCE_MIN, loops=loops.truth("min")),
    _reduce("Any", np.any, "ReduceMax", "exact", "REDUCE_ANY", LayerType.REDUCE_MAX, loops=loops.truth("max")),
    *(
        OpDef(
            name,
            _infer_arg,
            _arg(function),
            _lower_arg(name),
            _ARG_ATTRS,
            nn=nn.arg_best(best),
            litert=_litert_arg(operator),
            loops=loops.arg("first largest" if chosen == "largest" else "first smallest"),
            precision="exact",
            chooses=chosen,
        )
        for name, function, operator, chosen, best in _CHOICES
    ),
    OpDef(
        "Softmax",
        same_as(0),
        lambda node, x: softmax64(x).astype(x.dtype),
        direct("Softmax", axis=-1),
        (T,),
        nn=nn.softmax(Activation.SOFTMAX),
        litert=builtin("SOFTMAX", beta=1.0),
        loops=loops.softmax(log=False),
        precision="approximate",
        activation="softmax",
        finite="always",
    ),
    OpDef(
        "LogSoftmax",
        same_as(0),
        _log_softmax,
        direct("LogSoftmax", axis=-1),
        (T,),
        nn=nn.softmax(Activation.LOG_SOFTMAX),
        litert=builtin("LOG_SOFTMAX"),
        loops=loops.softmax(log=True),
        precision="approximate",
        activation="softmax",
    ),
)
