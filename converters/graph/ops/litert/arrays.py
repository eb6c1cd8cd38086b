"""Shapes, joining, gathering, filling, drawing."""

from __future__ import annotations

import numpy as np

from export_model.converters.graph.nodes import Node, ref
from export_model.converters.graph.ops.litert.base import (
    Litert,
    LitertBuilder,
    Value,
    as_int32,
    emit_reshape,
    ints,
    litert_error,
    with_axis,
)
from export_model.converters.graph.types import FLOAT32, INT32, INT64, TensorType


def shape(node: Node, builder: LitertBuilder) -> Value:
    """SHAPE."""
    return builder.emit("SHAPE", [builder.value(node.inputs[0])], out_type=node.attrs["out_type"])


def size(node: Node, builder: LitertBuilder) -> Value:
    """The product of the shape."""
    rank, dtype = builder.type_of(node.inputs[0]).rank, node.attrs["out_type"]
    kind = TensorType(dtype, None if rank is None else (rank,))
    lengths = builder.emit("SHAPE", [builder.value(node.inputs[0])], kind, out_type=dtype)
    return builder.emit("REDUCE_PROD", [lengths, ints(builder, 0)])


def reshape(node: Node, builder: LitertBuilder) -> Value:
    """RESHAPE; to a scalar a SQUEEZE, as an empty shape is none to LiteRT."""
    value, target = builder.value(node.inputs[0]), builder.type_of(node.inputs[1])
    if target.shape == (0,):
        return builder.emit("SQUEEZE", [value])
    found = emit_reshape(builder, value, builder.result) if target.constant is None else None
    return builder.emit("RESHAPE", [value, as_int32(builder, node.inputs[1])]) if found is None else found


def expand_dims(node: Node, builder: LitertBuilder) -> Value:
    """RESHAPE, where the result's shape is known well enough."""
    axis = builder.type_of(node.inputs[1]).constant
    if axis is None:
        raise litert_error(node, "the axis that it puts in is computed while the graph runs")
    return with_axis(builder, builder.value(node.inputs[0]), builder.result, int(axis.reshape(())))


def transpose(node: Node, builder: LitertBuilder) -> Value:
    """TRANSPOSE; of a scalar nothing."""
    if builder.result.shape == ():
        return builder.value(node.inputs[0])
    return builder.emit("TRANSPOSE", [builder.value(node.inputs[0]), as_int32(builder, node.inputs[1])])


def concat(node: Node, builder: LitertBuilder) -> Value:
    """CONCATENATION."""
    axis, rank = builder.type_of(node.inputs[-1]).constant, builder.result.rank
    if axis is None or rank is None:
        raise litert_error(node, "the axis that it joins along is computed while the graph runs")
    values = [builder.value(r) for r in node.inputs[:-1]]
    return values[0] if len(values) == 1 else builder.emit("CONCATENATION", values, axis=int(axis) % rank)


def pack(node: Node, builder: LitertBuilder) -> Value:
    """PACK."""
    values = [builder.value(r) for r in node.inputs]
    axis = int(node.attrs["axis"])
    if axis < 0 and builder.result.rank is not None:
        axis += builder.result.rank
    if len(values) == 1:
        return with_axis(builder, values[0], builder.result, axis)
    return builder.emit("PACK", values, values_count=len(values), axis=axis)


def unpack(node: Node, builder: LitertBuilder) -> tuple[Value, ...]:
    """UNPACK."""
    count, axis = int(node.attrs["num"]), int(node.attrs["axis"])
    rank = builder.type_of(node.inputs[0]).rank
    kinds = [builder.type_of(ref(node.name, i)) for i in range(count)]
    return builder.emit_several(
        "UNPACK",
        [builder.value(node.inputs[0])],
        kinds,
        num=count,
        axis=axis if axis >= 0 or rank is None else axis + rank,
    )


def split(node: Node, builder: LitertBuilder) -> tuple[Value, ...]:
    """SPLIT: the axis first."""
    count = int(node.attrs["num_split"])
    axis, value = as_int32(builder, node.inputs[0]), builder.value(node.inputs[1])
    kinds = [builder.type_of(ref(node.name, i)) for i in range(count)]
    return (value,) if count == 1 else builder.emit_several("SPLIT", [axis, value], kinds, num_splits=count)


def split_v(node: Node, builder: LitertBuilder) -> tuple[Value, ...]:
    """SPLIT_V."""
    count = int(node.attrs["num_split"])
    values = [builder.value(node.inputs[0]), *(as_int32(builder, r) for r in node.inputs[1:])]
    kinds = [builder.type_of(ref(node.name, i)) for i in range(count)]
    return (values[0],) if count == 1 else builder.emit_several("SPLIT_V", values, kinds, num_splits=count)


def gather(node: Node, builder: LitertBuilder) -> Value:
    """GATHER."""
    axis = builder.type_of(node.inputs[2]).constant if len(node.inputs) > 2 else np.array(0)
    rank = builder.type_of(node.inputs[0]).rank
    if axis is None or rank is None:
        raise litert_error(node, "the axis that it looks up along is computed while the graph runs")
    return builder.emit("GATHER", [builder.value(r) for r in node.inputs[:2]], axis=int(axis) % rank)


def fill(node: Node, builder: LitertBuilder) -> Value:
    """FILL."""
    return builder.emit("FILL", [as_int32(builder, node.inputs[0]), builder.value(node.inputs[1])])


def tile(node: Node, builder: LitertBuilder) -> Value:
    """TILE."""
    return builder.emit("TILE", [builder.value(node.inputs[0]), as_int32(builder, node.inputs[1])])


def one_hot(node: Node, builder: LitertBuilder) -> Value:
    """ONE_HOT."""
    values = [builder.value(node.inputs[0]), as_int32(builder, node.inputs[1])]
    values += [builder.value(r) for r in node.inputs[2:]]
    return builder.emit("ONE_HOT", values, axis=int(node.attrs["axis"]))


def sparse_to_dense(node: Node, builder: LitertBuilder) -> Value:
    """SPARSE_TO_DENSE; its shape is of the dtype of the places."""
    places, shape, *values = node.inputs
    kind, dtype = builder.type_of(shape), builder.type_of(places).dtype
    sizes = builder.value(shape)
    if kind.constant is not None:
        sizes = builder.const(kind.constant.astype(dtype))
    elif kind.dtype != dtype:
        cast = TensorType(dtype, kind.shape)
        sizes = builder.emit("CAST", [sizes], cast, in_data_type=kind.dtype, out_data_type=dtype)
    return builder.emit("SPARSE_TO_DENSE", [builder.value(places), sizes, *(builder.value(r) for r in values)])


def random(op: str) -> Litert:
    """An operator that draws: with seeds of 0, otherwise in every run."""

    def lower(node: Node, builder: LitertBuilder) -> Value:
        if node.attrs["dtype"] != FLOAT32:
            raise litert_error(node, f"LiteRT's {op} draws float32 only")
        return builder.emit(op, [as_int32(builder, node.inputs[0])])

    return lower


def multinomial(node: Node, builder: LitertBuilder) -> Value:
    """MULTINOMIAL."""
    if node.attrs["output_dtype"] not in (INT32, INT64):
        raise litert_error(node, "LiteRT's MULTINOMIAL gives int32 or int64")
    return builder.emit("MULTINOMIAL", [builder.value(node.inputs[0]), as_int32(builder, node.inputs[1])])
