"""Joining and cutting: ConcatV2, Pack, Unpack, Split and SplitV.

Most kernels are structural: they also work on symbolic shape vectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.barracuda import arrays as nn
from export_model.converters.graph.ops.barracuda import decompositions
from export_model.converters.graph.ops.barracuda.base import Nn
from export_model.converters.graph.ops.base import (
    Attr,
    OnnxBuilder,
    OpDef,
    axis_within,
    constant_input,
    emit_unsqueeze,
    insert_axis,
    not_constant,
    require_constant,
    shape_error,
    type_attr,
)
from export_model.converters.graph.ops.litert import arrays as litert
from export_model.converters.graph.ops.loops import arrays as loops
from export_model.converters.graph.types import BATCH, Dim, Symbols, TensorType

T = type_attr()
#: Outputs that a Split or Unpack may have.
_MAX_PIECES = 1 << 16


def _concat(node: Node, *arrays: np.ndarray) -> np.ndarray:
    return np.concatenate(arrays[:-1], axis=int(arrays[-1]))


def _infer_concat(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    parts = args[:-1]
    axis = int(require_constant(node, args, len(args) - 1, "an axis"))
    known = [p.shape for p in parts if p.shape is not None]
    if len(known) < len(parts):
        if not known:
            return [TensorType(parts[0].dtype, None)]
        # A part of unknown rank: the others tell all but the joined axis.
        axis = axis_within(axis, len(known[0]))
        return [TensorType(parts[0].dtype, (*known[0][:axis], symbols.fresh(), *known[0][axis + 1 :]))]
    rank = len(known[0])
    if any(len(s) != rank for s in known):
        raise shape_error(node, args, "its parts are of different rank")
    axis = axis_within(axis, rank)
    dims = list(known[0])
    for shape in known[1:]:
        for i, (a, b) in enumerate(zip(dims, shape, strict=True)):
            if i != axis and a != b:
                if isinstance(a, int) and isinstance(b, int):
                    raise shape_error(node, args, f"axis {i} has lengths {a} and {b}")
                dims[i] = a if isinstance(a, int) or a == BATCH else b
    total: list[Dim] = [s[axis] for s in known]
    dims[axis] = (
        sum(d for d in total if isinstance(d, int)) if all(isinstance(d, int) for d in total) else symbols.fresh()
    )
    return [TensorType(parts[0].dtype, tuple(dims))]


def _lower_concat(node: Node, builder: OnnxBuilder) -> Any:
    axis = int(constant_input(node, builder, len(node.inputs) - 1, "an axis"))
    return builder.emit("Concat", [builder.value(r) for r in node.inputs[:-1]], axis=axis)


def _pack(node: Node, *arrays: np.ndarray) -> np.ndarray:
    return np.stack(arrays, axis=node.attrs["axis"])


def _infer_pack(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    # Scalars of unknown rank (an old sequence_length) packed with known scalars never get here.
    shape = next((a.shape for a in args if a.shape is not None), None)
    return [TensorType(args[0].dtype, insert_axis(shape, node.attrs["axis"], len(args)))]


def _lower_pack(node: Node, builder: OnnxBuilder) -> Any:
    axis = node.attrs["axis"]
    parts = [
        emit_unsqueeze(builder, builder.value(r), [axis], insert_axis(builder.type_of(r).shape, axis))
        for r in node.inputs
    ]
    return builder.emit("Concat", parts, axis=axis)


def _unpack(node: Node, x: np.ndarray) -> tuple[np.ndarray, ...]:
    axis, count = node.attrs["axis"], node.attrs["num"]
    if x.shape[axis] != count:
        raise ValueError(f"axis {axis} has the length {x.shape[axis]}, and {count} pieces are made of it")
    return tuple(np.take(x, i, axis=axis) for i in range(count))


def _pieces(node: Node, args: Sequence[TensorType], attribute: str) -> int:
    """How many outputs a node says it has; GraphError where no policy's node has as many."""
    count = int(node.attrs[attribute])
    if not 0 < count <= _MAX_PIECES:
        raise shape_error(node, args, f"it says that it makes {count} pieces; 1 to {_MAX_PIECES} are read")
    return count


def _infer_unpack(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    shape, axis, count = args[0].shape, node.attrs["axis"], _pieces(node, args, "num")
    if shape is None:
        return [TensorType(args[0].dtype, None)] * count
    axis = axis_within(axis, len(shape))
    if isinstance(shape[axis], int) and shape[axis] != count:
        raise shape_error(node, args, f"a length of {shape[axis]} does not come apart into {count}")
    return [TensorType(args[0].dtype, shape[:axis] + shape[axis + 1 :])] * count


def _lower_unpack(node: Node, builder: OnnxBuilder) -> Any:
    axis, value = node.attrs["axis"], builder.value(node.inputs[0])
    return tuple(
        builder.emit("Gather", [value, builder.const(np.array(i, np.int64), "index")], axis=axis)
        for i in range(node.attrs["num"])
    )


def _split_sizes(node: Node, length: Dim, args: Sequence[TensorType]) -> list[Dim]:
    if node.op == "SplitV":
        sizes: list[Dim] = [int(s) for s in require_constant(node, args, 1, "sizes").tolist()]
        if -1 in sizes:
            others = sum(int(s) for s in sizes if s != -1)
            sizes[sizes.index(-1)] = length - others if isinstance(length, int) else f"{length}-{others}"
        return sizes
    count = _pieces(node, args, "num_split")
    if isinstance(length, int) and length % count:
        raise shape_error(node, args, f"a length of {length} does not split into {count}")
    return [length // count if isinstance(length, int) else f"{length}/{count}"] * count


def _split(node: Node, axis: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.split(x, node.attrs["num_split"], axis=int(axis)))


def _split_v(node: Node, x: np.ndarray, sizes: np.ndarray, axis: np.ndarray) -> tuple[np.ndarray, ...]:
    lengths = sizes.tolist()
    if -1 in lengths:
        lengths[lengths.index(-1)] = x.shape[int(axis)] - sum(s for s in lengths if s != -1)
    return tuple(np.split(x, np.cumsum(lengths[:-1]), axis=int(axis)))


def _infer_split(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    data, axis_at = (args[1], 0) if node.op == "Split" else (args[0], 2)
    if data.shape is None:
        return [TensorType(data.dtype, None)] * _pieces(node, args, "num_split")
    axis = axis_within(int(require_constant(node, args, axis_at, "an axis")), len(data.shape))
    sizes = _split_sizes(node, data.shape[axis], args)
    return [TensorType(data.dtype, (*data.shape[:axis], size, *data.shape[axis + 1 :])) for size in sizes]


def _lower_split(node: Node, builder: OnnxBuilder) -> Any:
    data_at, axis_at = (1, 0) if node.op == "Split" else (0, 2)
    kind = builder.type_of(node.inputs[data_at])
    if kind.shape is None:
        raise not_constant(node, "an operand of a rank")
    axis = axis_within(int(constant_input(node, builder, axis_at, "an axis")), len(kind.shape))
    sizes = _split_sizes(node, kind.shape[axis], [builder.type_of(r) for r in node.inputs])
    if any(not isinstance(s, int) for s in sizes):
        raise not_constant(node, "a length to split")
    value = builder.value(node.inputs[data_at])
    if len(sizes) == 1:
        return (value,)
    lengths = builder.const(np.array(sizes, np.int64), "sizes")
    return builder.emit_several("Split", [value, lengths], len(sizes), axis=axis)


OPS = (
    OpDef(
        "ConcatV2",
        _infer_concat,
        _concat,
        _lower_concat,
        (Attr("N", "int", derive="count:1"), T, type_attr("Tidx", "in:-1")),
        nn=Nn(nn.concat),
        litert=litert.concat,
        loops=loops.concat,
        moves="join",
        data=(0, -1),
    ),
    OpDef(
        "Pack",
        _infer_pack,
        _pack,
        _lower_pack,
        (Attr("N", "int", derive="count"), T, Attr("axis", "int", 0)),
        nn=Nn(nn.pack),
        litert=litert.pack,
        loops=loops.pack,
        moves="join",
        data=(0, None),
    ),
    OpDef(
        "Unpack",
        _infer_unpack,
        _unpack,
        _lower_unpack,
        (Attr("num", "int"), T, Attr("axis", "int", 0)),
        outputs=-1,
        nn=Nn(nn.unpack),
        litert=litert.unpack,
        loops=loops.unpack,
        spellings=("Unstack",),
        moves="pick",
    ),
    OpDef(
        "Split",
        _infer_split,
        _split,
        _lower_split,
        (Attr("num_split", "int"), type_attr("T", "in:1")),
        barracuda=decompositions.SPLIT,
        nn=nn.split(axis_at=0),
        litert=litert.split,
        loops=loops.split,
        outputs=-1,
        moves="pick",
        data=(1, 2),
    ),
    OpDef(
        "SplitV",
        _infer_split,
        _split_v,
        _lower_split,
        (Attr("num_split", "int"), T, type_attr("Tlen", "in:1")),
        barracuda=decompositions.SPLIT,
        nn=nn.split(axis_at=2),
        litert=litert.split_v,
        loops=loops.split,
        outputs=-1,
        moves="pick",
    ),
)
