"""Taking parts of arrays: slices, strided slices with TensorFlow's masks, gathers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
    by_shape,
    constant_input,
    emit_reshape,
    emit_squeeze,
    emit_unsqueeze,
    insert_axis,
    not_constant,
    require_constant,
    shape_error,
    type_attr,
)
from export_model.converters.graph.ops.litert.arrays import gather
from export_model.converters.graph.ops.litert.base import LitertBuilder, Value, as_int32, ints, with_axis
from export_model.converters.graph.ops.loops import arrays as loops
from export_model.converters.graph.ops.loops.base import LoopBuilder, Tensor
from export_model.converters.graph.ops.rewriting import GraphBuilder
from export_model.converters.graph.types import Dim, Symbols, TensorType

T = type_attr()


def _slice(node: Node, x: np.ndarray, begin: np.ndarray, size: np.ndarray) -> np.ndarray:
    index = tuple(slice(int(b), None if s == -1 else int(b) + int(s)) for b, s in zip(begin, size, strict=True))
    return x[index]


@by_shape
def _infer_slice(node: Node, args: Sequence[TensorType], shape: tuple[Dim, ...], symbols: Symbols) -> Sequence[Dim]:
    begin, size = args[1].constant, args[2].constant
    dims: list[Dim] = []
    for i, length in enumerate(shape):
        start = None if begin is None else int(begin[i])
        wanted = None if size is None else int(size[i])
        if wanted is not None and wanted >= 0:
            dims.append(wanted)
        elif wanted == -1 and start is not None and isinstance(length, int):
            dims.append(length - start)
        else:
            dims.append(length if wanted == -1 and start == 0 else symbols.fresh())
    return dims


def _lower_slice(node: Node, builder: OnnxBuilder) -> Any:
    shape = builder.type_of(node.inputs[0]).shape
    begin = constant_input(node, builder, 1, "the beginning of a slice").tolist()
    size = constant_input(node, builder, 2, "the size of a slice").tolist()
    cuts: list[_Cut] = []
    for axis, (first, count) in enumerate(zip(begin, size, strict=True)):
        length = _LIMIT if shape is None else shape[axis]
        last = length if isinstance(length, int) else _LIMIT
        cuts.append((axis, first, last if count == -1 else first + count, 1, length))
    return _cut(builder, builder.value(node.inputs[0]), cuts)


#: One entry of a strided slice: ("slice", begin, end, stride) | ("take", index) | ("new",)
SliceStep = tuple[Any, ...]


def strided_steps(
    node: Node, rank: int, begin: Sequence[int], end: Sequence[int], strides: Sequence[int]
) -> list[SliceStep]:
    """TensorFlow's five masks resolved to one step per axis (plus "new" steps that insert an axis).

    Source of the rules: the documentation of ``tf.strided_slice``: an ellipsis stands for as many whole axes as are
    missing; a set bit of begin/end mask means "from the start"/"to the end"; shrink takes one element and drops the
    axis; new axis inserts one.
    """
    masks = {k: int(node.attrs[f"{k}_mask"]) for k in ("begin", "end", "ellipsis", "new_axis", "shrink_axis")}
    steps: list[SliceStep] = []
    covered = sum(1 for i in range(len(begin)) if not (masks["ellipsis"] | masks["new_axis"]) >> i & 1)
    for i in range(len(begin)):
        if masks["ellipsis"] >> i & 1:
            steps.extend([("slice", None, None, 1)] * (rank - covered))
        elif masks["new_axis"] >> i & 1:
            steps.append(("new",))
        elif masks["shrink_axis"] >> i & 1:
            steps.append(("take", int(begin[i])))
        else:
            first = None if masks["begin"] >> i & 1 else int(begin[i])
            last = None if masks["end"] >> i & 1 else int(end[i])
            steps.append(("slice", first, last, int(strides[i])))
    used = sum(1 for s in steps if s[0] != "new")
    steps.extend([("slice", None, None, 1)] * (rank - used))
    return steps


def _strided_slice(node: Node, x: np.ndarray, begin: np.ndarray, end: np.ndarray, strides: np.ndarray) -> np.ndarray:
    index: list[Any] = []
    for step in strided_steps(node, x.ndim, begin.tolist(), end.tolist(), strides.tolist()):
        if step[0] == "new":
            index.append(None)
        elif step[0] == "take":
            index.append(step[1])
        else:
            index.append(slice(step[1], step[2], step[3]))
    return np.asarray(x[tuple(index)])


def _strided_operands(args: Sequence[TensorType]) -> tuple[list[int], list[int], list[int]] | None:
    values = [a.constant for a in args[1:4]]
    if any(v is None for v in values):
        return None
    begin, end, strides = (v.tolist() for v in values if v is not None)
    return begin, end, strides


def _infer_strided_slice(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    shape = args[0].shape
    operands = _strided_operands(args)
    if shape is None or operands is None:
        return [TensorType(args[0].dtype, None)]
    steps = strided_steps(node, len(shape), *operands)
    if sum(1 for s in steps if s[0] != "new") != len(shape):
        raise shape_error(node, args, "the slice has more axes than the tensor")
    dims: list[Dim] = []
    lengths = iter(shape)
    for step in steps:
        if step[0] == "new":
            dims.append(1)
            continue
        length = next(lengths)
        if step[0] == "take":
            if isinstance(length, int) and not -length <= step[1] < length:
                raise shape_error(node, args, f"index {step[1]} is out of range for {length}")
            continue
        if isinstance(length, int):
            dims.append(len(range(*slice(step[1], step[2], step[3]).indices(length))))
        else:
            dims.append(length if step[1:] in ((None, None, 1), (0, None, 1)) else symbols.fresh())
    return [TensorType(args[0].dtype, tuple(dims))]


def _lower_strided_slice(node: Node, builder: OnnxBuilder) -> Any:
    kind = builder.type_of(node.inputs[0])
    operands = _strided_operands([builder.type_of(r) for r in node.inputs])
    if operands is None or kind.shape is None:
        raise not_constant(node, "the bounds of a slice")
    steps = strided_steps(node, len(kind.shape), *operands)
    cuts: list[_Cut] = []
    drop, insert = [], []
    axis = position = 0
    for step in steps:
        if step[0] == "new":
            insert.append(position)
            position += 1
            continue
        length = kind.shape[axis]
        if step[0] == "take":
            first = step[1] % length if isinstance(length, int) else step[1]
            cuts.append((axis, first, first + 1 if first != -1 else _LIMIT, 1, length))
            drop.append(axis)
        else:
            cuts.append((axis, *_bounds(step, length), length))
            position += 1
        axis += 1
    value = _cut(builder, builder.value(node.inputs[0]), cuts)
    if not (drop or insert):
        return value
    result = builder.type_of(node.name).shape
    return emit_reshape(builder, value, result) or emit_unsqueeze(
        builder, emit_squeeze(builder, value, drop, None), insert, None
    )


#: An end that is behind the last element of any axis.
_LIMIT = 2**31 - 1
#: (axis, first, end, stride, length of the axis)
_Cut = tuple[int, int, int, int, Dim]


def _bounds(step: SliceStep, length: Dim) -> tuple[int, int, int]:
    """(first, end, stride) of a step as ONNX takes them."""
    _, first, last, stride = step
    if not isinstance(length, int):
        return (
            first if first is not None else (0 if stride > 0 else _LIMIT),
            last if last is not None else (_LIMIT if stride > 0 else -_LIMIT),
            stride,
        )
    taken = range(*slice(first, last, stride).indices(length))
    if not taken:
        return 0, 0, 1  # backwards from before the start: ONNX would begin at element 0
    return taken.start, taken.stop, stride


def _cut(builder: OnnxBuilder, value: str, cuts: Sequence[_Cut]) -> str:
    """One Slice for all axes that are not taken whole.

    An axis taken backwards is a Gather: Barracuda does not step back (Slice_13), and 1.1 misreads an end that is no
    index (Slice_10), so none is written where a length is known.
    """
    partial = []
    for axis, first, end, stride, length in cuts:
        if stride < 0 and isinstance(length, int):
            indices = builder.const(np.arange(first, end, stride, dtype=np.int64), "indices")
            value = builder.emit("Gather", [value, indices], axis=axis)
        elif (first, end, stride) != (0, length if isinstance(length, int) else _LIMIT, 1):
            partial.append((first, end, axis, stride))
    if not partial:
        return value
    starts, ends, axes, strides = zip(*partial, strict=True)
    operands = [starts, ends, axes] if set(strides) == {1} else [starts, ends, axes, strides]
    result: str = builder.emit("Slice", [value, *(builder.const(np.array(o, np.int64), "slice") for o in operands)])
    return result


def _tfjs_strided_slice(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    """TensorFlow.js takes other elements where a stride stands beside a shrunk axis, which is kept, then squeezed."""
    operands = [types[r].constant for r in node.inputs[1:4]]
    attrs = node.attrs
    shrunk = [i for i in range(32) if int(attrs["shrink_axis_mask"]) >> i & 1]
    plain = not (attrs["ellipsis_mask"] or attrs["new_axis_mask"])
    if not shrunk or not plain or any(o is None for o in operands):
        return node
    begin, end, strides = (np.array(o) for o in operands)
    if (strides == 1).all():
        return node
    end_mask = int(attrs["end_mask"])
    for axis in shrunk:
        end[axis], strides[axis] = begin[axis] + 1, 1
        end_mask = end_mask | 1 << axis if begin[axis] == -1 else end_mask & ~(1 << axis)
    begin_mask = int(attrs["begin_mask"]) & ~sum(1 << axis for axis in shrunk)
    bounds = [builder.const(v, f"{node.name}/{k}") for k, v in (("begin", begin), ("end", end), ("strides", strides))]
    kept = builder.add(
        "StridedSlice", [node.inputs[0], *bounds], f"{node.name}/kept", begin_mask=begin_mask, end_mask=end_mask
    )
    return Node(node.name, "Squeeze", (kept,), {"squeeze_dims": tuple(shrunk)}, origin=node.origin)


def _litert_slice(node: Node, builder: LitertBuilder) -> Value:
    return builder.emit("SLICE", [builder.value(node.inputs[0]), *(as_int32(builder, r) for r in node.inputs[1:])])


def _litert_strided_slice(node: Node, builder: LitertBuilder) -> Value:
    """A bound for each axis, as TensorFlow's masks are resolved; an axis that is put in is a RESHAPE behind it."""
    kind, operands = builder.type_of(node.inputs[0]), _strided_operands([builder.type_of(r) for r in node.inputs])
    if operands is None or kind.shape is None:
        raise not_constant(node, "the bounds of a slice")
    steps = strided_steps(node, len(kind.shape), *operands)
    result = builder.result
    new, position = [], 0
    for step in steps:
        new += [position] if step[0] == "new" else []
        position += step[0] != "take"
    dims = None if result.shape is None else tuple(d for i, d in enumerate(result.shape) if i not in new)
    value = _litert_bounds(builder, node.inputs[0], [s for s in steps if s[0] != "new"], TensorType(kind.dtype, dims))
    for count, axis in enumerate(new, 1):
        last = count == len(new) or dims is None
        dims = insert_axis(dims, axis)
        value = with_axis(builder, value, result if last else TensorType(kind.dtype, dims), axis)
    return value


def _litert_bounds(
    builder: LitertBuilder, reference: str, taken: Sequence[tuple[Any, ...]], result: TensorType
) -> Value:
    """A STRIDED_SLICE of the axes that are there; the value itself where all of each is taken."""
    bounds = [(s[1], s[1] + 1, 1) if s[0] == "take" else s[1:] for s in taken]
    vectors = [ints(builder, *(0 if b[i] is None else b[i] for b in bounds)) for i in range(3)]
    value = builder.value(reference)
    if all(b == (None, None, 1) for b in bounds):
        return value
    masks = {
        "begin_mask": sum(1 << i for i, (first, _, _) in enumerate(bounds) if first is None),
        "end_mask": sum(1 << i for i, (_, last, _) in enumerate(bounds) if last is None),
        "shrink_axis_mask": sum(1 << i for i, s in enumerate(taken) if s[0] == "take"),
    }
    return builder.emit("STRIDED_SLICE", [value, *vectors], result, **masks)


def _loops_strided_slice(node: Node, builder: LoopBuilder) -> Tensor:
    operands, rank = _strided_operands([builder.type_of(r) for r in node.inputs]), builder.type_of(node.inputs[0]).rank
    if operands is None or rank is None:
        raise not_constant(node, "the bounds of a slice")
    return loops.strided_slice(node, builder, strided_steps(node, rank, *operands))


def _gather(node: Node, x: np.ndarray, indices: np.ndarray, axis: np.ndarray | None = None) -> np.ndarray:
    """An index that is outside its axis is an error, as in TensorFlow on a CPU; numpy counts some from the end."""
    if indices.size and indices.dtype.kind in "iu" and indices.min() < 0:
        raise IndexError(f"index {indices.min()} is out of bounds: TensorFlow does not count from the end")
    return np.take(x, indices, axis=0 if axis is None else int(axis))


def _infer_gather(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    if args[0].shape is None or args[1].shape is None:
        return [TensorType(args[0].dtype, None)]
    axis = 0 if len(args) < 3 else axis_within(int(require_constant(node, args, 2, "an axis")), len(args[0].shape))
    return [TensorType(args[0].dtype, args[0].shape[:axis] + args[1].shape + args[0].shape[axis + 1 :])]


def _rows_of_table(node: Node, args: Sequence[TensorType]) -> int | None:
    axis = 0 if len(args) < 3 else args[2].constant
    if args[0].shape is None or axis is None:
        return None
    size = args[0].shape[int(axis) % max(1, len(args[0].shape))] if args[0].shape else None
    return size if isinstance(size, int) else None


def _lower_gather(node: Node, builder: OnnxBuilder) -> Any:
    axis = 0 if len(node.inputs) < 3 else int(constant_input(node, builder, 2, "an axis"))
    return builder.emit("Gather", [builder.value(r) for r in node.inputs[:2]], axis=axis)


_MASKS = tuple(Attr(f"{k}_mask", "int", 0) for k in ("begin", "end", "ellipsis", "new_axis", "shrink_axis"))

OPS = (
    OpDef(
        "Slice",
        _infer_slice,
        _slice,
        _lower_slice,
        (T, type_attr("Index", "in:1")),
        nn=Nn(nn.slice_),
        litert=_litert_slice,
        loops=loops.slice_,
        moves="pick",
    ),
    OpDef(
        "StridedSlice",
        _infer_strided_slice,
        _strided_slice,
        _lower_strided_slice,
        (T, type_attr("Index", "in:1"), *_MASKS),
        tfjs=_tfjs_strided_slice,
        nn=nn.strided_slice(strided_steps),
        litert=_litert_strided_slice,
        loops=_loops_strided_slice,
        moves="pick",
    ),
    OpDef(
        "Gather",
        _infer_gather,
        _gather,
        _lower_gather,
        (type_attr("Tparams"), type_attr("Tindices", "in:1"), Attr("validate_indices", "bool", True)),
        barracuda=decompositions.GATHER,
        nn=Nn(nn.gather, (0, 2)),
        litert=gather,
        loops=loops.gather,
        moves="pick",
        looks_up=1,
        table_size=_rows_of_table,
    ),
    OpDef(
        "GatherV2",
        _infer_gather,
        _gather,
        _lower_gather,
        (
            type_attr("Tparams"),
            type_attr("Tindices", "in:1"),
            type_attr("Taxis", "in:2"),
            Attr("batch_dims", "int", 0, since="1.14", supported=False),
        ),
        barracuda=decompositions.GATHER,
        nn=Nn(nn.gather, (0, 2)),
        litert=gather,
        loops=loops.gather,
        moves="pick",
        looks_up=1,
        table_size=_rows_of_table,
    ),
)
