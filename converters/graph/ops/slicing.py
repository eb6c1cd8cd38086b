"""Taking parts of arrays: slices, strided slices with TensorFlow's masks, gathers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from converters.graph.nodes import Node
from converters.graph.ops.base import (
    Attr,
    OnnxBuilder,
    OpDef,
    constant_input,
    not_constant,
    require_constant,
    shape_error,
    squeezed,
    type_attr,
    unsqueezed,
)
from converters.graph.types import Dim, Symbols, TensorType

T = type_attr()


def _slice(node: Node, x: np.ndarray, begin: np.ndarray, size: np.ndarray) -> np.ndarray:
    index = tuple(slice(int(b), None if s == -1 else int(b) + int(s)) for b, s in zip(begin, size, strict=True))
    return x[index]


def _infer_slice(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    shape, begin, size = args[0].shape, args[1].constant, args[2].constant
    if shape is None:
        return [TensorType(args[0].dtype, None)]
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
    return [TensorType(args[0].dtype, tuple(dims))]


def _lower_slice(node: Node, builder: OnnxBuilder) -> Any:
    rank = builder.type_of(node.inputs[0]).rank
    begin = constant_input(node, builder, 1, "the beginning of a slice").astype(np.int64)
    size = constant_input(node, builder, 2, "the size of a slice").astype(np.int64)
    ends = np.where(size == -1, np.int64(2**31 - 1), begin + size)
    axes = builder.const(np.arange(rank or 0, dtype=np.int64), "axes")
    return builder.emit(
        "Slice", [builder.value(node.inputs[0]), builder.const(begin, "starts"), builder.const(ends, "ends"), axes]
    )


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


def _strided_operands(node: Node, args: Sequence[TensorType]) -> tuple[list[int], list[int], list[int]] | None:
    values = [a.constant for a in args[1:4]]
    if any(v is None for v in values):
        return None
    begin, end, strides = (v.tolist() for v in values if v is not None)
    return begin, end, strides


def _infer_strided_slice(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    shape = args[0].shape
    operands = _strided_operands(node, args)
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
                raise shape_error(node, args, f"index {step[1]} is outside of {length}")
            continue
        if isinstance(length, int):
            dims.append(len(range(*slice(step[1], step[2], step[3]).indices(length))))
        else:
            dims.append(length if step[1:] in ((None, None, 1), (0, None, 1)) else symbols.fresh())
    return [TensorType(args[0].dtype, tuple(dims))]


def _lower_strided_slice(node: Node, builder: OnnxBuilder) -> Any:
    kind = builder.type_of(node.inputs[0])
    operands = _strided_operands(node, [builder.type_of(r) for r in node.inputs])
    if operands is None or kind.shape is None:
        raise not_constant(node, "the bounds of a slice")
    steps = strided_steps(node, len(kind.shape), *operands)
    limit = 2**31 - 1
    starts, ends, axes, strides = [], [], [], []
    drop, insert = [], []
    axis = 0
    for step in steps:
        if step[0] == "new":
            continue
        if step[0] == "take":
            bounds = (step[1], step[1] + 1 if step[1] != -1 else limit, 1)
            drop.append(axis)
        else:
            first = step[1] if step[1] is not None else (0 if step[3] > 0 else limit)
            bounds = (first, step[2] if step[2] is not None else (limit if step[3] > 0 else -limit), step[3])
            length = kind.shape[axis]
            if isinstance(length, int) and not range(*slice(*step[1:]).indices(length)):
                bounds = (0, 0, 1)  # backwards from before the start: ONNX would begin at element 0
        if bounds != (0, limit, 1):
            starts.append(bounds[0])
            ends.append(bounds[1])
            strides.append(bounds[2])
            axes.append(axis)
        axis += 1
    position = 0
    for step in steps:
        if step[0] == "new":
            insert.append(position)
        position += step[0] != "take"
    value = builder.value(node.inputs[0])
    if axes:
        operand = [builder.const(np.array(v, np.int64), "slice") for v in (starts, ends, axes, strides)]
        value = builder.emit("Slice", [value, *operand])
    return unsqueezed(builder, squeezed(builder, value, drop), insert)


def _gather(node: Node, x: np.ndarray, indices: np.ndarray, axis: np.ndarray | None = None) -> np.ndarray:
    return np.take(x, indices, axis=0 if axis is None else int(axis))


def _infer_gather(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    if args[0].shape is None or args[1].shape is None:
        return [TensorType(args[0].dtype, None)]
    axis = 0 if len(args) < 3 else int(require_constant(node, args, 2, "an axis")) % len(args[0].shape)
    return [TensorType(args[0].dtype, args[0].shape[:axis] + args[1].shape + args[0].shape[axis + 1 :])]


def _lower_gather(node: Node, builder: OnnxBuilder) -> Any:
    axis = 0 if len(node.inputs) < 3 else int(constant_input(node, builder, 2, "an axis"))
    return builder.emit("Gather", [builder.value(r) for r in node.inputs[:2]], axis=axis)


_MASKS = tuple(Attr(f"{k}_mask", "int", 0) for k in ("begin", "end", "ellipsis", "new_axis", "shrink_axis"))

OPS = (
    OpDef("Slice", _infer_slice, _slice, _lower_slice, (T, type_attr("Index", "in:1")), structural=True),
    OpDef(
        "StridedSlice",
        _infer_strided_slice,
        _strided_slice,
        _lower_strided_slice,
        (T, type_attr("Index", "in:1"), *_MASKS),
        structural=True,
    ),
    OpDef(
        "Gather",
        _infer_gather,
        _gather,
        _lower_gather,
        (type_attr("Tparams"), type_attr("Tindices", "in:1"), Attr("validate_indices", "bool", True)),
        structural=True,
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
        structural=True,
    ),
)
