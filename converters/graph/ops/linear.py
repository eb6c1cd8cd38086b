"""Matrix products, bias, reductions, softmax, argmax."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np

from converters.graph.nodes import Node
from converters.graph.ops import elementwise
from converters.graph.ops.base import (
    Attr,
    Kernel,
    Lower,
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
    plain,
    require_constant,
    require_one_dtype,
    same_as,
    shape_error,
    type_attr,
)
from converters.graph.ops.litert.base import LitertBuilder, as_int32, builtin, ints, litert_error
from converters.graph.ops.litert.layers import matmul as litert_matmul
from converters.graph.ops.loops import layers as loops
from converters.graph.ops.loops.base import simple
from converters.graph.types import BOOL, INT32, INT64, Dim, Symbols, TensorType, broadcast

T = type_attr()
#: Elements of a matrix from which on it is made float64 in pieces, and those of a piece, which fits into caches.
_LARGE, _AT_ONCE = 1 << 22, 1 << 16


def matmul(node: Node, a: np.ndarray, b: np.ndarray, *, squared: bool = False) -> np.ndarray:
    """The product in float64, rounded; ``squared``: of what the operands are when squared, in their own dtype."""
    if node.attrs.get("transpose_a") or node.attrs.get("adj_x"):
        a = np.swapaxes(a, -1, -2)
    if node.attrs.get("transpose_b") or node.attrs.get("adj_y"):
        b = np.swapaxes(b, -1, -2)
    with np.errstate(all="ignore"):
        if a.dtype.kind != "f":
            return np.asarray(a @ b)
        left = np.square(a) if squared else a
        return _product(left.astype(np.float64), b, _square if squared else _same).astype(a.dtype)


def _same(part: np.ndarray) -> np.ndarray:
    return part.astype(np.float64)


def _square(part: np.ndarray) -> np.ndarray:
    squares: np.ndarray = np.square(part)
    return squares.astype(np.float64)


def _product(a: np.ndarray, b: np.ndarray, wide: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """In float64; of a large matrix a piece at a time, as it lies in memory: it is never held in twice its bytes
    (which takes longer, too).
    """
    if b.size <= _LARGE or b.ndim > 2:
        return np.asarray(a @ wide(b))
    if b.strides[0] < b.strides[1]:  # transposed
        step = max(1, _AT_ONCE // len(b))
        columns = [a @ wide(b[:, i : i + step]) for i in range(0, b.shape[1], step)]
        return np.concatenate(columns, axis=-1)
    step = max(1, _AT_ONCE // b.shape[1])
    total = np.zeros((*a.shape[:-1], b.shape[1]))
    for i in range(0, len(b), step):
        total += a[..., i : i + step] @ wide(b[i : i + step])
    return total


def _infer_matmul(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    require_one_dtype(node, args[:2])
    a, b = args[0].shape, args[1].shape
    if BOOL in (args[0].dtype, args[1].dtype):
        raise shape_error(node, args, f"a product of {args[0].dtype} and {args[1].dtype}; it takes numbers")
    if a is None or b is None:
        return [TensorType(args[0].dtype, (symbols.fresh(), symbols.fresh()) if node.op == "MatMul" else None)]
    if len(a) < 2 or len(b) < 2 or (node.op == "MatMul" and (len(a), len(b)) != (2, 2)):
        raise shape_error(node, args, "a matrix product takes matrices")
    if node.attrs.get("transpose_a") or node.attrs.get("adj_x"):
        a = (*a[:-2], a[-1], a[-2])
    if node.attrs.get("transpose_b") or node.attrs.get("adj_y"):
        b = (*b[:-2], b[-1], b[-2])
    if isinstance(a[-1], int) and isinstance(b[-2], int) and a[-1] != b[-2]:
        raise shape_error(node, args, f"the inner lengths {a[-1]} and {b[-2]} differ")
    try:
        batch = broadcast(a[:-2], b[:-2], symbols)
    except ValueError as error:
        raise shape_error(node, args, str(error)) from error
    assert batch is not None
    return [TensorType(args[0].dtype, (*batch, a[-2], b[-1]))]


def _lower_matmul(node: Node, builder: OnnxBuilder) -> Any:
    values = []
    for position, flags in enumerate((("transpose_a", "adj_x"), ("transpose_b", "adj_y"))):
        value = builder.value(node.inputs[position])
        if any(node.attrs.get(flag) for flag in flags):
            constant = builder.type_of(node.inputs[position]).constant
            rank = builder.type_of(node.inputs[position]).rank or 2
            if constant is not None:
                value = builder.const(np.swapaxes(constant, -1, -2), "weights")
            else:
                value = builder.emit("Transpose", [value], perm=[*range(rank - 2), rank - 1, rank - 2])
        values.append(value)
    return builder.emit("MatMul", values)


def _infer_bias_add(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    if len(args) != 2:
        raise shape_error(node, args, "it takes 2 inputs")
    require_one_dtype(node, args)
    x, bias = args[0].shape, args[1].shape
    if x is not None and bias is not None:
        last = x[-1] if x else None
        if len(bias) != 1 or (isinstance(last, int) and isinstance(bias[0], int) and last != bias[0]):
            raise shape_error(node, args, "a bias has one element per channel")
    return [TensorType(args[0].dtype, x)]


#: What a fused op has beside the attributes of the plain one.
FUSED = (Attr("num_args", "int", 1), Attr("fused_ops", "str"), Attr("epsilon", "float", 0.0001))


def apply_activations(node: Node, x: np.ndarray) -> np.ndarray:
    """A product and its bias, then the activations that the fused op carries."""
    for name in node.attrs["fused_ops"][1:]:
        kernel = next(op.kernel for op in elementwise.OPS if op.name == name)
        assert kernel is not None
        x = np.asarray(kernel(Node(name, name), x))
    return x


def lower_activated(node: Node, value: str, builder: OnnxBuilder) -> str:
    """``apply_activations`` in ONNX, which calls the activations as TensorFlow does but has no Relu6."""
    for name in node.attrs.get("fused_ops", ())[1:]:
        if name == "Relu6":
            low, high = (builder.const(np.array(bound, np.float32), "bound") for bound in (0, 6))
            value = builder.emit("Min", [builder.emit("Max", [value, low]), high])
        else:
            value = builder.emit(name, [value])
    return value


def _fused_matmul(node: Node, a: np.ndarray, b: np.ndarray, bias: np.ndarray) -> np.ndarray:
    with np.errstate(all="ignore"):
        return apply_activations(node, matmul(node, a, b) + bias)


def _lower_fused_matmul(node: Node, builder: OnnxBuilder) -> Any:
    """Gemm where the matrix is a constant: with a computed one Barracuda drops the bias (Gemm_10, Gemm_11)."""
    if builder.type_of(node.inputs[1]).constant is None:
        value = builder.emit("Add", [_lower_matmul(node, builder), builder.value(node.inputs[2])])
    else:
        value = builder.emit(
            "Gemm",
            [builder.value(r) for r in node.inputs],
            transA=int(bool(node.attrs.get("transpose_a"))),
            transB=int(bool(node.attrs.get("transpose_b"))),
        )
    return lower_activated(node, value, builder)


# ------------------------------------------------------------------ reductions


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
    name: str, function: Callable[..., Any], onnx_op: str, precision: Precision, litert_op: str, **traits: Any
) -> OpDef:
    attrs: tuple[Attr, ...] = (Attr("keep_dims", "bool", False), type_attr("Tidx", "in:1"))
    if name not in ("All", "Any"):
        attrs = (T, *attrs)
    kernel = _reduction(function, wide=precision != "exact")
    lower, litert = _lower_reduction(onnx_op), _litert_reduction(litert_op)
    return OpDef(name, _infer_reduction, kernel, lower, attrs, litert=litert, precision=precision, **traits)


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
_CHOICES: tuple[tuple[str, Callable[..., Any], str, Literal["largest", "smallest"]], ...] = (
    ("ArgMax", np.argmax, "ARG_MAX", "largest"),
    ("ArgMin", np.argmin, "ARG_MIN", "smallest"),
)


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


def _dense(name: str, kernel: Kernel, lower: Lower, attrs: Sequence[Attr], **traits: Any) -> OpDef:
    attrs = (T, *attrs)
    return OpDef(
        name,
        _infer_matmul,
        kernel,
        lower,
        attrs,
        litert=litert_matmul,
        loops=loops.matmul,
        foldable=False,
        precision="summed",
        layer="dense",
        **traits,
    )


_TRANSPOSED = (Attr("transpose_a", "bool", False), Attr("transpose_b", "bool", False))
# Written by TF 2.16 and later; marks products that belong to a gradient, which changes nothing here.
_GRADIENT = (Attr("grad_a", "bool", False, since="2.16"), Attr("grad_b", "bool", False, since="2.16"))
_ADJOINED = (Attr("adj_x", "bool", False), Attr("adj_y", "bool", False))

OPS = (
    _dense("MatMul", matmul, _lower_matmul, (*_TRANSPOSED, *_GRADIENT), fused="_FusedMatMul"),
    _dense("BatchMatMul", matmul, _lower_matmul, _ADJOINED, spellings=("BatchMatMulV2", "BatchMatMulV3")),
    _dense("_FusedMatMul", _fused_matmul, _lower_fused_matmul, (*_TRANSPOSED, *FUSED), since="1.15"),
    OpDef(
        "BiasAdd",
        _infer_bias_add,
        plain(np.add),
        direct("Add"),
        (T, Attr("data_format", "str", "NHWC")),
        litert=builtin("ADD"),
        loops=simple("add"),
    ),
    _reduce("Sum", np.sum, "ReduceSum", "summed", "SUM", loops=loops.reduction("sum")),
    _reduce("Mean", _mean, "ReduceMean", "rounded", "MEAN", takes="mean", loops=loops.reduction("sum", mean=True)),
    _reduce("Prod", np.prod, "ReduceProd", "rounded", "REDUCE_PROD", loops=loops.reduction("product")),
    _reduce("Max", np.max, "ReduceMax", "exact", "REDUCE_MAX", takes="largest", loops=loops.reduction("max")),
    _reduce("Min", np.min, "ReduceMin", "exact", "REDUCE_MIN", loops=loops.reduction("min")),
    _reduce("All", np.all, "ReduceMin", "exact", "REDUCE_ALL", loops=loops.truth("min")),
    _reduce("Any", np.any, "ReduceMax", "exact", "REDUCE_ANY", loops=loops.truth("max")),
    *(
        OpDef(
            name,
            _infer_arg,
            _arg(function),
            _lower_arg(name),
            _ARG_ATTRS,
            litert=_litert_arg(operator),
            loops=loops.arg("first largest" if chosen == "largest" else "first smallest"),
            precision="exact",
            chooses=chosen,
        )
        for name, function, operator, chosen in _CHOICES
    ),
    OpDef(
        "Softmax",
        same_as(0),
        lambda node, x: softmax64(x).astype(x.dtype),
        direct("Softmax", axis=-1),
        (T,),
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
        litert=builtin("LOG_SOFTMAX"),
        loops=loops.softmax(log=True),
        precision="approximate",
        activation="softmax",
    ),
)


def _emit_reduction(
    builder: OnnxBuilder, onnx_op: str, value: str, kind: TensorType, axes: Sequence[int], keepdims: bool
) -> str:
    """``value``, of type ``kind``, reduced by ``onnx_op`` over ``axes`` (sorted, counted from the front), in forms that
    every importer reads.

    Barracuda 1.4 to 2.3.1 takes the axes of a reduction from its attribute alone and sums over the batch where they are
    an input, as those of ReduceSum are since opset 13 and of the others since 18 (measured: ReduceSum_10 to _15,
    ReduceMean_04 of Unity's importers). A sum over the last axis is therefore a product with a column of ones, which
    onnxruntime computes as fast; over other axes it is the mean times the count.
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
