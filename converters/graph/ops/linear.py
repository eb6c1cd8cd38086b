"""Matrix products, bias, and both in one with activations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.activations import (
    FUSED,
    LITERT_OPERATORS,
    LOOPS,
    NN_KINDS,
    apply_activations,
    lower_activated,
)
from export_model.converters.graph.ops.barracuda import layers as nn
from export_model.converters.graph.ops.barracuda.base import Nn
from export_model.converters.graph.ops.barracuda.elementwise import pair
from export_model.converters.graph.ops.barracuda.vocabulary import LayerType
from export_model.converters.graph.ops.base import (
    Attr,
    Kernel,
    Lower,
    OnnxBuilder,
    OpDef,
    direct,
    plain,
    require_one_dtype,
    shape_error,
    type_attr,
)
from export_model.converters.graph.ops.litert.base import builtin
from export_model.converters.graph.ops.litert.layers import matmul as litert_matmul
from export_model.converters.graph.ops.loops import layers as loops
from export_model.converters.graph.ops.loops.base import simple
from export_model.converters.graph.types import BOOL, Symbols, TensorType, broadcast

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
    """The product in float64; of a large matrix a piece at a time, as it lies in memory.

    So the matrix is never held in twice its bytes (which takes longer, too).
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


def _dense(name: str, kernel: Kernel, lower: Lower, attrs: Sequence[Attr], **traits: Any) -> OpDef:
    attrs = (T, *attrs)
    return OpDef(
        name,
        _infer_matmul,
        kernel,
        lower,
        attrs,
        litert=partial(litert_matmul, known=LITERT_OPERATORS),
        loops=partial(loops.matmul, known=LOOPS),
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
    _dense(
        "MatMul",
        matmul,
        _lower_matmul,
        (*_TRANSPOSED, *_GRADIENT),
        nn=Nn(nn.matmul, takes_images=True),
        fused="_FusedMatMul",
    ),
    _dense(
        "BatchMatMul", matmul, _lower_matmul, _ADJOINED, nn=Nn(nn.matmul), spellings=("BatchMatMulV2", "BatchMatMulV3")
    ),
    _dense(
        "_FusedMatMul",
        _fused_matmul,
        _lower_fused_matmul,
        (*_TRANSPOSED, *FUSED),
        nn=nn.with_activations(nn.matmul, NN_KINDS, takes_images=True),
        since="1.15",
    ),
    OpDef(
        "BiasAdd",
        _infer_bias_add,
        plain(np.add),
        direct("Add"),
        (T, Attr("data_format", "str", "NHWC")),
        nn=pair(LayerType.ADD),
        litert=builtin("ADD"),
        loops=simple("add"),
    ),
)
