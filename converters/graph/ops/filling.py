"""Making arrays by rule: fill, broadcast, tile, range, one-hot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.arrays import target_dims
from export_model.converters.graph.ops.barracuda import arrays as nn
from export_model.converters.graph.ops.barracuda import decompositions
from export_model.converters.graph.ops.barracuda.base import FIRST, NONE, Nn
from export_model.converters.graph.ops.base import (
    Attr,
    OnnxBuilder,
    OpDef,
    by_shape,
    constant_input,
    direct,
    emit_unsqueeze,
    insert_axis,
    not_constant,
    require_constant,
    same_as,
    shape_error,
    type_attr,
)
from export_model.converters.graph.ops.litert import arrays as litert
from export_model.converters.graph.ops.litert.base import builtin
from export_model.converters.graph.ops.litert.elementwise import full_like
from export_model.converters.graph.ops.loops import arrays as loops
from export_model.converters.graph.ops.loops.elementwise import full_of
from export_model.converters.graph.ops.older import broadcast_to
from export_model.converters.graph.ops.rewriting import GraphBuilder
from export_model.converters.graph.types import INT32, Dim, Symbols, TensorType, broadcast, product

T = type_attr()


def _fill(node: Node, dims: np.ndarray, value: np.ndarray) -> np.ndarray:
    return np.full([int(d) for d in dims], value, value.dtype)


def _infer_fill(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    dims = target_dims(args[0], symbols)
    return [TensorType(args[1].dtype, None if dims is None else tuple(dims))]


def _infer_broadcast_to(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    dims = target_dims(args[1], symbols)
    return [TensorType(args[0].dtype, None if dims is None else broadcast(args[0].shape, tuple(dims), symbols))]


def _tile(node: Node, x: np.ndarray, multiples: np.ndarray) -> np.ndarray:
    return np.tile(x, [int(m) for m in multiples])


@by_shape
def _infer_tile(node: Node, args: Sequence[TensorType], shape: tuple[Dim, ...], symbols: Symbols) -> Sequence[Dim]:
    multiples = target_dims(args[1], symbols) or [symbols.fresh()] * len(shape)
    return [product((d, m), symbols) for d, m in zip(shape, multiples, strict=True)]


def _range(node: Node, start: np.ndarray, limit: np.ndarray, delta: np.ndarray) -> np.ndarray:
    return np.asarray(np.arange(start.item(), limit.item(), delta.item())).astype(start.dtype)


def _infer_range(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    """The length alone: the values are folded where they are few (shapes.py)."""
    known = [a.constant for a in args]
    if any(v is None for v in known):
        return [TensorType(args[0].dtype, (symbols.fresh(),))]
    start, limit, delta = (v.item() for v in known if v is not None)
    if delta == 0 or not all(map(math.isfinite, (start, limit, delta))):
        raise ValueError(f"from {start} to {limit} in steps of {delta}")
    return [TensorType(args[0].dtype, (max(0, math.ceil((limit - start) / delta)),))]


def _one_hot(node: Node, indices: np.ndarray, depth: np.ndarray, on: np.ndarray, off: np.ndarray) -> np.ndarray:
    axis = int(node.attrs["axis"])
    hot = indices[..., None] == np.arange(int(depth))
    return np.moveaxis(np.where(hot, on, off).astype(on.dtype), -1, axis if axis >= 0 else -1)


def _infer_one_hot(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    shape = args[0].shape
    if shape is None:
        return [TensorType(args[2].dtype, None)]
    depth, axis = int(require_constant(node, args, 1, "a depth")), int(node.attrs["axis"])
    if axis < -1:  # TensorFlow counts none from the end but the last
        raise shape_error(node, args, f"its axis must be from -1 to {len(shape)}, and is {axis}")
    return [TensorType(args[2].dtype, insert_axis(shape, axis, depth))]


def _depth(node: Node, args: Sequence[TensorType]) -> int | None:
    depth = args[1].constant
    return None if depth is None else int(depth)


def _lower_one_hot(node: Node, builder: OnnxBuilder) -> Any:
    """ONNX's OneHot wraps negative indices round where TensorFlow gives a row of off-values: compare instead."""
    depth = int(constant_input(node, builder, 1, "a depth"))
    kind = builder.type_of(node.inputs[0])
    if kind.rank is None:
        raise not_constant(node, "the rank of its indices")
    axis = int(node.attrs["axis"])
    axis = kind.rank if axis < 0 else axis
    classes = np.arange(depth, dtype=kind.dtype).reshape([depth if i == axis else 1 for i in range(kind.rank + 1)])
    index = emit_unsqueeze(builder, builder.value(node.inputs[0]), [axis], insert_axis(kind.shape, axis))
    hot = builder.emit("Equal", [index, builder.const(classes, "classes")])
    on, off = (builder.type_of(r).constant for r in node.inputs[2:])
    if on is not None and off is not None and on.size == off.size == 1 and (on.item(), off.item()) == (1, 0):
        return builder.emit("Cast", [hot], to=on.dtype)
    return builder.emit("Where", [hot, builder.value(node.inputs[2]), builder.value(node.inputs[3])])


def _tfjs_one_hot(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    """OneHot as TensorFlow.js has it: on and off are applied after a cast, off + hot·(on − off).

    It has OneHot over the last axis alone, of no depth of 1, and on wasm of int32 values only (floats come out as bit
    patterns).
    """
    indices, depth, on, off = node.inputs
    on_value, off_value = types[on].constant, types[off].constant
    dtype = types[on].dtype
    one = builder.const(np.array(1, INT32), f"{node.name}/one")
    zero = builder.const(np.array(0, INT32), f"{node.name}/zero")
    size = types[depth].constant
    if size is not None and int(size) < 2:  # tfjs refuses a depth of 1
        last = builder.const(np.array(-1, INT32), f"{node.name}/last")
        index = builder.add("ExpandDims", [indices, last], f"{node.name}/index")
        only = builder.const(np.zeros((), types[indices].dtype), f"{node.name}/only")
        equal = builder.add("Equal", [index, only], f"{node.name}/equal")
        hot = builder.add("Cast", [equal], f"{node.name}/hot", DstT=INT32)
    else:
        hot = builder.add("OneHot", [indices, depth, one, zero], f"{node.name}/hot", axis=-1)
    axis, rank = int(node.attrs["axis"]), types[node.name].rank
    if axis >= 0 and rank is not None and axis != rank - 1:
        order = [*range(axis), rank - 1, *range(axis, rank - 1)]
        hot = builder.add(
            "Transpose", [hot, builder.const(np.array(order, INT32), f"{node.name}/perm")], f"{node.name}/moved"
        )
    if on_value is not None and off_value is not None and on_value == 1 and off_value == 0:
        return Node(node.name, "Cast", (hot,), {"DstT": dtype, "Truncate": False}, origin=node.origin)
    scaled = builder.add("Cast", [hot], f"{node.name}/cast", DstT=dtype)
    width = builder.add("Sub", [on, off], f"{node.name}/width")
    product = builder.add("Mul", [scaled, width], f"{node.name}/scaled")
    return Node(node.name, "Add", (product, off), origin=node.origin)


def _lower_zeros_like(node: Node, builder: OnnxBuilder) -> Any:
    dtype = builder.type_of(node.inputs[0]).dtype
    shape = builder.emit("Shape", [builder.value(node.inputs[0])])
    return builder.emit("Expand", [builder.const(np.zeros((), dtype), "zero"), shape])


def _lower_ones_like(node: Node, builder: OnnxBuilder) -> Any:
    dtype = builder.type_of(node.inputs[0]).dtype
    shape = builder.emit("Shape", [builder.value(node.inputs[0])])
    return builder.emit("Expand", [builder.const(np.ones((), dtype), "one"), shape])


OPS = (
    OpDef(
        "Fill",
        _infer_fill,
        _fill,
        direct("Expand", 1, 0, shape_at=0),
        (type_attr("T", "in:1"), Attr("index_type", "type", INT32, since="1.7")),
        nn=Nn(nn.fill, NONE),
        litert=litert.fill,
        loops=loops.broadcast_operand(1),
        precision="exact",
    ),
    OpDef(
        "BroadcastTo",
        _infer_broadcast_to,
        lambda node, x, dims: np.asarray(np.broadcast_to(x, [int(d) for d in dims]), order="C"),
        attrs=(T, type_attr("Tidx", "in:1")),
        older=broadcast_to,
        nn=Nn(nn.broadcast_to),
        moves="repeat",
    ),
    OpDef(
        "Tile",
        _infer_tile,
        _tile,
        direct("Tile", shape_at=1),
        (T, type_attr("Tmultiples", "in:1")),
        nn=Nn(nn.tile),
        litert=litert.tile,
        loops=loops.tile,
        moves="repeat",
    ),
    OpDef(
        "Range",
        _infer_range,
        _range,
        direct("Range"),
        (type_attr("Tidx"),),
        litert=builtin("RANGE"),
        loops=loops.range_,
    ),
    OpDef(
        "OneHot",
        _infer_one_hot,
        _one_hot,
        _lower_one_hot,
        (type_attr("T", "in:2"), type_attr("TI"), Attr("axis", "int", -1)),
        tfjs=_tfjs_one_hot,
        barracuda=decompositions.ONE_HOT,
        nn=Nn(None, FIRST, why="it takes a row of indices per agent, and gives the classes on the last axis"),
        litert=litert.one_hot,
        loops=loops.one_hot,
        precision="exact",
        looks_up=0,
        table_size=_depth,
    ),
    OpDef(
        "ZerosLike",
        same_as(0, count=1),
        lambda node, x: np.zeros_like(x),
        _lower_zeros_like,
        (T,),
        barracuda=decompositions.ZEROS_LIKE,
        elementwise=True,
        precision="exact",
        full_of=0,
        loops=full_of(0),
        nn=nn.full_like(0),
        litert=full_like(0),
    ),
    OpDef(
        "OnesLike",
        same_as(0, count=1),
        lambda node, x: np.ones_like(x),
        _lower_ones_like,
        (T,),
        elementwise=True,
        precision="exact",
        full_of=1,
        loops=full_of(1),
        nn=nn.full_like(1),
        litert=full_like(1),
    ),
)
