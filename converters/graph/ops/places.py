"""Where elements are, and elements put at places.

onnx-tf writes every Reshape with both (``onnx_tf/handlers/backend/reshape.py``: lengths that ONNX says by 0 are found,
gathered and scattered); of a shape vector with symbols they are folded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.arrays import target_dims
from export_model.converters.graph.ops.base import Attr, OnnxBuilder, OpDef, as_int64, not_constant, type_attr
from export_model.converters.graph.ops.litert.arrays import sparse_to_dense
from export_model.converters.graph.ops.litert.base import builtin
from export_model.converters.graph.ops.loops import arrays as loops
from export_model.converters.graph.ops.rewriting import GraphBuilder
from export_model.converters.graph.types import INT64, Symbols, TensorType
from export_model.signatures.errors import UnsupportedOpError


def _infer_where(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    rank = args[0].rank
    return [TensorType(INT64, None if rank is None else (symbols.fresh(), rank))]


def _lower_where(node: Node, builder: OnnxBuilder) -> Any:
    return builder.emit("Transpose", [builder.emit("NonZero", [builder.value(node.inputs[0])])], perm=[1, 0])


def _tfjs_where(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    raise UnsupportedOpError(
        f"cannot convert Where (node {node.name!r}): its condition is computed while the graph runs",
        issues=[(node.name, node.op)],
        why="only then is known how many places it finds, which a TensorFlow.js model that runs at once cannot do",
        fix="choose with tf.where(condition, a, b), which keeps the shape, or leave the format out: --to",
    )


def _sparse_to_dense(
    node: Node, places: np.ndarray, shape: np.ndarray, values: np.ndarray, default: np.ndarray
) -> np.ndarray:
    """Places outside the result are an error, and with ``validate_indices`` those out of order or twice."""
    dense = np.full([int(d) for d in shape.reshape(-1)], default, values.dtype)
    rows = places.reshape(-1, 1 if places.ndim < 2 else places.shape[1])
    if rows.size and rows.min() < 0:
        raise IndexError(f"place {rows.min()} is out of bounds: TensorFlow does not count from the end")
    flat = np.ravel_multi_index(tuple(rows.T), dense.shape) if rows.size else np.zeros(0, np.int64)
    if node.attrs["validate_indices"] and (np.diff(flat) <= 0).any():
        raise IndexError("the places are out of order, or one is named twice")
    dense.reshape(-1)[flat] = values
    return dense


def _infer_sparse_to_dense(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    dims = target_dims(args[1], symbols)
    return [TensorType(args[2].dtype, None if dims is None else tuple(dims))]


def _lower_sparse_to_dense(node: Node, builder: OnnxBuilder) -> Any:
    """ScatterElements along one axis, since Barracuda 2.3.1 and 3.0.0 misread ScatterND (ScatterND_01)."""
    kinds = [builder.type_of(r) for r in node.inputs]
    if kinds[0].rank is None or kinds[2].rank is None or kinds[1].shape is None:
        raise not_constant(node, "the rank of its places")
    places = as_int64(node, builder, 0) if kinds[0].rank < 2 else _matrix(node, builder, kinds[0])
    line = builder.const(np.array([-1], np.int64), "shape")
    shape = as_int64(node, builder, 1)
    one_axis = kinds[0].rank < 2 or kinds[1].shape == (1,)
    if not one_axis:  # a place has a number for each axis
        places = builder.emit("GatherND", [_element_numbers(node, builder, kinds[1], shape), places])
    flat = builder.emit("Reshape", [places, line])
    values = builder.emit("Expand", [builder.value(node.inputs[2]), builder.emit("Shape", [flat])])
    base = builder.emit("Expand", [builder.value(node.inputs[3]), shape])
    if one_axis:
        return builder.emit("ScatterElements", [base, flat, values])
    base = builder.emit("Reshape", [base, line])
    return builder.emit("Reshape", [builder.emit("ScatterElements", [base, flat, values]), shape])


def _element_numbers(node: Node, builder: OnnxBuilder, kind: TensorType, shape: str) -> str:
    """A tensor of the result's shape that says of each element which it is, row by row."""
    if kind.constant is not None:
        sizes = [int(n) for n in kind.constant.reshape(-1)]
        return builder.const(np.arange(np.prod(sizes), dtype=np.int64).reshape(sizes), "numbers")
    ends = [builder.const(np.array(n, np.int64), "range") for n in (0, 1)]
    count = builder.emit("ReduceProd", [shape], keepdims=0)
    return builder.emit("Reshape", [builder.emit("Range", [ends[0], count, ends[1]]), shape])


def _matrix(node: Node, builder: OnnxBuilder, kind: TensorType) -> str:
    value = builder.value(node.inputs[0])
    return value if kind.dtype == INT64 else builder.emit("Cast", [value], to=INT64)


OPS = (
    OpDef(
        "Where",
        _infer_where,
        lambda node, x: np.argwhere(x != 0),
        _lower_where,
        (type_attr(),),
        tfjs=_tfjs_where,
        litert=builtin("WHERE"),
        loops=loops.places_found,
        precision="exact",
    ),
    OpDef(
        "SparseToDense",
        _infer_sparse_to_dense,
        _sparse_to_dense,
        _lower_sparse_to_dense,
        (type_attr("T", "in:2"), type_attr("Tindices", "in:0"), Attr("validate_indices", "bool", True)),
        litert=sparse_to_dense,
        loops=loops.sparse_to_dense,
        precision="exact",
    ),
)
