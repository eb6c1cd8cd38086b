"""Shapes, joining, cutting, gathering, reducing, drawing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from export_model.converters.formats.litert.importer.elementwise import add_activation
from export_model.converters.formats.litert.importer.importer import LiteRTImporter
from export_model.converters.formats.litert.importer.operator import LiteRTOp, Translate
from export_model.converters.graph.nn import choosing as nn
from export_model.converters.graph.nodes import ref
from export_model.converters.graph.types import INT32

_REDUCTIONS = {
    "MEAN": "Mean",
    "SUM": "Sum",
    **{f"REDUCE_{op.upper()}": op for op in ("All", "Any", "Max", "Min", "Prod")},
}


def _reshape(op: LiteRTOp, net: LiteRTImporter) -> str:
    """The shape is an operand, or (in files from before there was one) an option, in which [0] is a scalar's."""
    target = op.get(1)
    if target is None:
        lengths = op.integers("new_shape")
        target = net.ints([] if lengths == [0] else lengths, "to")
    known, shape = net.constant(target), net.type_of(op.need(0)).shape
    if known is not None and shape is not None and known.tolist() == [-1 if isinstance(d, str) else d for d in shape]:
        return op.need(0)  # a copy
    if known is not None and net.is_unnamed(target):  # as simplify names it
        target = net.ints(known.tolist(), "to")
    return net.add("Reshape", [op.need(0), target])


def _squeeze(op: LiteRTOp, net: LiteRTImporter) -> str:
    return net.add("Squeeze", [op.need(0)], squeeze_dims=tuple(op.integers("squeeze_dims")))


def _axis(op: LiteRTOp, net: LiteRTImporter, position: int) -> int:
    value = net.needed_constant(op.need(position), "its axis").reshape(-1)
    if value.size != 1:
        raise op.refusal(f"it has {value.size} axes in place of one")
    return int(value[0])


def _reverse(op: LiteRTOp, net: LiteRTImporter) -> str:
    x = op.need(0)
    axes = {net.axis(x, int(a)) for a in net.needed_constant(op.need(1), "its axes").reshape(-1)}
    for axis in sorted(axes):
        x = net.slice(x, axis, None, None, -1)
    return x


def _expand_dims(op: LiteRTOp, net: LiteRTImporter) -> str:
    return net.add("ExpandDims", [op.need(0), net.ints(_axis(op, net, 1), "axis")])


def _concat(op: LiteRTOp, net: LiteRTImporter) -> str:
    parts, axis = op.operands(), op.integer("axis")
    value = net.add("ConcatV2", [*parts, net.ints(axis, "axis")]) if len(parts) > 1 else parts[0]
    return add_activation(op, net, value)


def _pack(op: LiteRTOp, net: LiteRTImporter) -> str:
    return net.add("Pack", op.operands(), axis=op.integer("axis"))


def _several(node: str, count: int) -> list[str]:
    return [ref(node, i) for i in range(count)]


def _unpack(op: LiteRTOp, net: LiteRTImporter) -> list[str]:
    count = len(op.dtypes)
    return _several(net.add("Unpack", [op.need(0)], num=count, axis=op.integer("axis")), count)


def _split(op: LiteRTOp, net: LiteRTImporter) -> list[str]:
    count = len(op.dtypes)
    return _several(net.add("Split", [op.need(0), op.need(1)], num_split=count), count)


def _split_v(op: LiteRTOp, net: LiteRTImporter) -> list[str]:
    count = len(op.dtypes)
    return _several(net.add("SplitV", op.operands(), num_split=count), count)


def _slice(op: LiteRTOp, net: LiteRTImporter) -> str:
    return net.add("Slice", op.operands())


def _strided_slice(op: LiteRTOp, net: LiteRTImporter) -> str:
    """With ``offset`` an end is counted from its beginning."""
    x, begin, end, strides = op.operands()
    if op.flag("offset"):
        first, count = (net.needed_constant(r, "the bounds of a slice") for r in (begin, end))
        end = net.ints((first.astype(np.int64) + count).tolist(), "end")
    masks: dict[str, Any] = {
        f"{k}_mask": op.integer(f"{k}_mask") for k in ("begin", "end", "ellipsis", "new_axis", "shrink_axis")
    }
    return net.add("StridedSlice", [x, begin, end, strides], **masks)


def _gather(op: LiteRTOp, net: LiteRTImporter) -> str:
    if op.integer("batch_dims"):
        raise op.refusal("it looks up rows of each row (batch_dims)")
    return net.add("GatherV2", [op.need(0), op.need(1), net.ints(op.integer("axis"), "axis")])


def _gather_nd(op: LiteRTOp, net: LiteRTImporter) -> str:
    """Of one index each, as rows are looked up."""
    x, indices = op.need(0), op.need(1)
    if net.length(indices, -1) != 1:
        raise op.refusal("an index of it has several numbers")
    return net.add("GatherV2", [x, net.squeeze(indices, [net.rank(indices) - 1]), net.ints(0, "axis")])


def _transpose(op: LiteRTOp, net: LiteRTImporter) -> str:
    return net.add("Transpose", op.operands())


def _tile(op: LiteRTOp, net: LiteRTImporter) -> str:
    return net.add("Tile", op.operands())


def _broadcast(op: LiteRTOp, net: LiteRTImporter) -> str:
    return net.add("BroadcastTo", op.operands())


def _shape(op: LiteRTOp, net: LiteRTImporter) -> str:
    return net.add("Shape", [op.need(0)], out_type=op.dtypes[0])


def _rank(op: LiteRTOp, net: LiteRTImporter) -> str:
    return net.const(np.array(net.rank(op.need(0)), INT32), "rank")


def _range(op: LiteRTOp, net: LiteRTImporter) -> str:
    return net.add("Range", op.operands())


def _reduction(kind: str) -> Translate:
    return lambda op, net: net.add(kind, [op.need(0), op.need(1)], keep_dims=op.flag("keep_dims"))


def _arg(kind: str) -> Translate:
    return lambda op, net: net.add(kind, [op.need(0), net.ints(_axis(op, net, 1), "axis")], output_type=op.dtypes[0])


def _one_hot(op: LiteRTOp, net: LiteRTImporter) -> str:
    return net.add("OneHot", op.operands(), axis=op.integer("axis"))


def _where(op: LiteRTOp, net: LiteRTImporter) -> str:
    return net.add("Where", [op.need(0)])


def _sparse_to_dense(op: LiteRTOp, net: LiteRTImporter) -> str:
    return net.add("SparseToDense", op.operands(), validate_indices=False)


def _top_k(op: LiteRTOp, net: LiteRTImporter) -> list[str]:
    count = net.needed_constant(op.need(1), "the number of elements").reshape(-1)
    best, place = nn.top_k(net, op.need(0), int(count[0]))
    return [best, net.cast(place, op.dtypes[1])]


def _cumulative_sum(op: LiteRTOp, net: LiteRTImporter) -> str:
    axis = net.axis(op.need(0), _axis(op, net, 1))
    x = nn.last(net, op.need(0), axis)
    return nn.moved_back(net, nn.cumulate(net, x, exclusive=op.flag("exclusive"), reverse=op.flag("reverse")), axis)


def _sampler(kind: str) -> Translate:
    return lambda op, net: net.add(kind, [op.need(0)], dtype=op.dtypes[0])


def _multinomial(op: LiteRTOp, net: LiteRTImporter) -> str:
    return net.add("Multinomial", op.operands(), output_dtype=op.dtypes[0])


OPS: Mapping[str, Translate] = {
    **{kind: _reduction(op) for kind, op in _REDUCTIONS.items()},
    "ARG_MAX": _arg("ArgMax"),
    "ARG_MIN": _arg("ArgMin"),
    "BROADCAST_TO": _broadcast,
    "CONCATENATION": _concat,
    "CUMSUM": _cumulative_sum,
    "EXPAND_DIMS": _expand_dims,
    "GATHER": _gather,
    "GATHER_ND": _gather_nd,
    "MULTINOMIAL": _multinomial,
    "ONE_HOT": _one_hot,
    "PACK": _pack,
    "RANDOM_STANDARD_NORMAL": _sampler("RandomStandardNormal"),
    "RANDOM_UNIFORM": _sampler("RandomUniform"),
    "RANGE": _range,
    "RANK": _rank,
    "RESHAPE": _reshape,
    "REVERSE_V2": _reverse,
    "SHAPE": _shape,
    "SLICE": _slice,
    "SPARSE_TO_DENSE": _sparse_to_dense,
    "SPLIT": _split,
    "SPLIT_V": _split_v,
    "SQUEEZE": _squeeze,
    "STRIDED_SLICE": _strided_slice,
    "TILE": _tile,
    "TOPK_V2": _top_k,
    "TRANSPOSE": _transpose,
    "UNPACK": _unpack,
    "WHERE": _where,
}
