"""Constants, placeholders and pass-throughs; shapes of things; joining and cutting.

Most kernels are structural: they also work on symbolic shape vectors.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from converters.graph.nodes import Node, TensorShape
from converters.graph.ops.base import (
    Attr,
    OnnxBuilder,
    OpDef,
    as_int64,
    by_shape,
    constant_input,
    inserted,
    not_constant,
    require_constant,
    same_as,
    shape_error,
    squeezed,
    type_attr,
    unsqueezed,
)
from converters.graph.types import BATCH, INT32, Dim, Symbols, TensorType, of_array, product

T = type_attr()
#: Outputs that a Split or Unpack may have.
_MAX_PIECES = 1 << 16


# ------------------------------------------------------------------ sources and pass-throughs


def _infer_const(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    assert node.value is not None
    return [of_array(node.value)]


def placeholder_type(node: Node, symbols: Symbols) -> TensorType:
    """The type of a Placeholder: its leading free axis is the batch, further free axes are unknown lengths."""
    shape: TensorShape = node.attrs["shape"]
    if shape.dims is None:
        return TensorType(node.attrs["dtype"], None)
    dims: list[Dim] = [
        (BATCH if i == 0 else symbols.fresh()) if d is None else int(d) for i, d in enumerate(shape.dims)
    ]
    return TensorType(node.attrs["dtype"], tuple(dims))


def _infer_placeholder(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    return [placeholder_type(node, symbols)]


def _identity(node: Node, x: np.ndarray) -> np.ndarray:
    return x


def _lower_identity(node: Node, builder: OnnxBuilder) -> Any:
    return builder.value(node.inputs[0])


# ------------------------------------------------------------------ shape of things


def _shape(node: Node, x: np.ndarray) -> np.ndarray:
    return np.array(x.shape, node.attrs["out_type"])


def _infer_shape(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    shape = args[0].shape
    if shape is None:
        return [TensorType(node.attrs["out_type"], (symbols.fresh(),))]
    if all(isinstance(d, int) for d in shape):
        return [of_array(np.array(shape, node.attrs["out_type"]))]
    value = np.empty(len(shape), object)
    value[:] = shape
    return [TensorType(node.attrs["out_type"], (len(shape),), value)]


def _lower_shape(node: Node, builder: OnnxBuilder) -> Any:
    value = builder.emit("Shape", [builder.value(node.inputs[0])])
    return value if node.attrs["out_type"] != INT32 else builder.emit("Cast", [value], to=INT32)


def _infer_size(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    dtype = node.attrs["out_type"]
    if args[0].shape is None:
        return [TensorType(dtype, ())]
    total = product(args[0].shape, symbols)
    value = np.array(total, dtype if isinstance(total, int) else object)
    return [TensorType(dtype, (), value)]


def _lower_size(node: Node, builder: OnnxBuilder) -> Any:
    value = builder.emit("Size", [builder.value(node.inputs[0])])
    return value if node.attrs["out_type"] != INT32 else builder.emit("Cast", [value], to=INT32)


def _infer_rank(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    rank = args[0].rank
    return [TensorType(INT32, (), None if rank is None else np.array(rank, np.int32))]


def target_dims(value: np.ndarray | None, kind: TensorType, symbols: Symbols) -> list[Dim] | None:
    """The dims that a shape operand stands for; fresh symbols where it is not known."""
    if value is not None:
        return [d if isinstance(d, str) else int(d) for d in value.reshape(-1).tolist()]
    if kind.shape is not None and len(kind.shape) == 1 and isinstance(kind.shape[0], int):
        return [symbols.fresh() for _ in range(kind.shape[0])]
    return None


def _infer_reshape(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    target = target_dims(args[1].value, args[1], symbols)
    if target is None:
        return [TensorType(args[0].dtype, None)]
    if target.count(-1) > 1:
        raise shape_error(node, args, "the target shape leaves more than one axis open")
    source = args[0].shape
    if -1 in target:
        target[target.index(-1)] = _open_length(node, args, source, target, symbols)
    elif (
        source is not None
        and all(isinstance(d, int) for d in (*source, *target))
        and product(source, symbols) != product(target, symbols)
    ):
        raise shape_error(node, args, f"{list(source)} does not reshape to {target}")
    value = args[0].value
    if value is not None and all(isinstance(d, int) for d in target):
        value = value.reshape([int(d) for d in target])
    else:
        value = None
    return [TensorType(args[0].dtype, tuple(target), value)]


def _open_length(
    node: Node, args: Sequence[TensorType], source: tuple[Dim, ...] | None, target: list[Dim], symbols: Symbols
) -> Dim:
    """The length that -1 stands for: what is left of the source when the other axes are divided out."""
    if source is None:
        # Unknown source: [-1, n] of a graph without shapes is, in every policy seen, one row per agent.
        return BATCH if target[0] == -1 else symbols.fresh()
    names = [d for d in source if isinstance(d, str)]
    number = 1
    for d in source:
        number *= d if isinstance(d, int) else 1
    for d in target:
        if isinstance(d, str):
            if d not in names:
                return symbols.fresh()
            names.remove(d)
        elif d != -1:
            if d == 0 or (number % d and not names):
                raise shape_error(node, args, f"{list(source)} does not reshape to {target}")
            if number % d:
                return symbols.fresh()
            number //= d
    if not names:
        return number
    return names[0] if len(names) == 1 and number == 1 else symbols.fresh()


def _lower_reshape(node: Node, builder: OnnxBuilder) -> Any:
    return builder.emit("Reshape", [builder.value(node.inputs[0]), as_int64(node, builder, 1)])


def _squeeze_axes(node: Node, shape: Sequence[Dim]) -> tuple[int, ...]:
    wanted = node.attrs["squeeze_dims"]
    if wanted:
        return tuple(sorted({int(a) % len(shape) for a in wanted}))
    return tuple(i for i, d in enumerate(shape) if d == 1)


def _squeeze(node: Node, x: np.ndarray) -> np.ndarray:
    return np.squeeze(x, _squeeze_axes(node, x.shape))


@by_shape
def _infer_squeeze(node: Node, args: Sequence[TensorType], shape: tuple[Dim, ...], symbols: Symbols) -> Sequence[Dim]:
    if not node.attrs["squeeze_dims"] and any(isinstance(d, str) and d != BATCH for d in shape):
        raise not_constant(node, "a list of axes to squeeze")
    axes = _squeeze_axes(node, shape)
    return [d for i, d in enumerate(shape) if i not in axes]


def _lower_squeeze(node: Node, builder: OnnxBuilder) -> Any:
    shape = builder.type_of(node.inputs[0]).shape
    assert shape is not None
    axes = _squeeze_axes(node, shape)
    kept = [d for i, d in enumerate(shape) if i not in axes]
    return squeezed(builder, builder.value(node.inputs[0]), axes, kept)


def _expand_dims(node: Node, x: np.ndarray, axis: np.ndarray) -> np.ndarray:
    return np.expand_dims(x, int(axis.reshape(())))


@by_shape
def _infer_expand_dims(
    node: Node, args: Sequence[TensorType], shape: tuple[Dim, ...], symbols: Symbols
) -> Sequence[Dim]:
    return inserted(shape, int(require_constant(node, args, 1, "an axis").reshape(()))) or ()


def _lower_expand_dims(node: Node, builder: OnnxBuilder) -> Any:
    axis = int(constant_input(node, builder, 1, "an axis").reshape(()))
    result = inserted(builder.type_of(node.inputs[0]).shape, axis)
    return unsqueezed(builder, builder.value(node.inputs[0]), [axis], result)


def _transpose(node: Node, x: np.ndarray, permutation: np.ndarray) -> np.ndarray:
    return np.asarray(x.transpose([int(p) for p in permutation]), order="C")


@by_shape
def _infer_transpose(node: Node, args: Sequence[TensorType], shape: tuple[Dim, ...], symbols: Symbols) -> Sequence[Dim]:
    permutation = require_constant(node, args, 1, "a permutation").tolist()
    if sorted(permutation) != list(range(len(shape))):
        raise shape_error(node, args, f"{permutation} is no permutation of {len(shape)} axes")
    return [shape[p] for p in permutation]


def _lower_transpose(node: Node, builder: OnnxBuilder) -> Any:
    permutation = constant_input(node, builder, 1, "a permutation").tolist()
    if not permutation:  # a scalar; ONNX wants at least one axis
        return builder.value(node.inputs[0])
    return builder.emit("Transpose", [builder.value(node.inputs[0])], perm=permutation)


# ------------------------------------------------------------------ joining and cutting


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
        axis %= len(known[0])
        return [TensorType(parts[0].dtype, (*known[0][:axis], symbols.fresh(), *known[0][axis + 1 :]))]
    rank = len(known[0])
    if not -rank <= axis < rank or any(len(s) != rank for s in known):
        raise shape_error(node, args, f"parts of different rank, or axis {axis} out of range")
    axis %= rank
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
    shape = next((a.shape for a in args if a.shape is not None), None)
    if shape is None:
        # Scalars of unknown rank (an old sequence_length) packed with known scalars never get here.
        return [TensorType(args[0].dtype, None)]
    dims = list(shape)
    axis = node.attrs["axis"]
    dims.insert(axis + len(dims) + 1 if axis < 0 else axis, len(args))
    return [TensorType(args[0].dtype, tuple(dims))]


def _lower_pack(node: Node, builder: OnnxBuilder) -> Any:
    axis = node.attrs["axis"]
    parts = [
        unsqueezed(builder, builder.value(r), [axis], inserted(builder.type_of(r).shape, axis)) for r in node.inputs
    ]
    return builder.emit("Concat", parts, axis=axis)


def _unpack(node: Node, x: np.ndarray) -> tuple[np.ndarray, ...]:
    axis = node.attrs["axis"]
    return tuple(np.take(x, i, axis=axis) for i in range(x.shape[axis]))


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
    axis %= len(shape)
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
    axis = int(require_constant(node, args, axis_at, "an axis")) % len(data.shape)
    sizes = _split_sizes(node, data.shape[axis], args)
    return [TensorType(data.dtype, (*data.shape[:axis], size, *data.shape[axis + 1 :])) for size in sizes]


def _lower_split(node: Node, builder: OnnxBuilder) -> Any:
    """For an importer of Unity's a Slice for each piece: Barracuda reads the sizes of a Split from its attribute alone,
    which opset 13 has not.
    """
    data_at, axis_at = (1, 0) if node.op == "Split" else (0, 2)
    kind = builder.type_of(node.inputs[data_at])
    assert kind.shape is not None
    axis = int(constant_input(node, builder, axis_at, "an axis")) % len(kind.shape)
    sizes = _split_sizes(node, kind.shape[axis], [builder.type_of(r) for r in node.inputs])
    if any(not isinstance(s, int) for s in sizes):
        raise not_constant(node, "a length to split")
    value = builder.value(node.inputs[data_at])
    if len(sizes) == 1:
        return (value,)
    if builder.splits:
        lengths = builder.const(np.array(sizes, np.int64), "sizes")
        return builder.emit_several("Split", [value, lengths], len(sizes), axis=axis)
    bounds = [0, *itertools.accumulate(int(s) for s in sizes)]
    starts = [builder.const(np.array([b], np.int64), "bound") for b in bounds]
    on = builder.const(np.array([axis], np.int64), "axis")
    return tuple(builder.emit("Slice", [value, begin, end, on]) for begin, end in itertools.pairwise(starts))


_SHAPE_OF = (T, Attr("out_type", "type", INT32))

OPS = (
    OpDef(
        "Const",
        _infer_const,
        lambda node: node.value,
        attrs=(Attr("dtype", "type", derive="out:0"),),
        start="constant",
        precision="exact",
    ),
    OpDef(
        "Placeholder",
        _infer_placeholder,
        attrs=(Attr("dtype", "type"), Attr("shape", "shape", TensorShape(None))),
        spellings=("PlaceholderV2",),
        start="fed",
        precision="exact",
    ),
    *(
        OpDef(
            name,
            same_as(0),
            _identity,
            _lower_identity,
            (T, Attr("message", "str", "")) if name in ("PreventGradient", "CheckNumerics") else (T,),
            moves="same",
        )
        for name in ("Identity", "StopGradient", "PreventGradient", "Snapshot", "CheckNumerics")
    ),
    OpDef("Shape", _infer_shape, _shape, _lower_shape, _SHAPE_OF, precision="exact", of_shape=True),
    OpDef(
        "Size",
        _infer_size,
        lambda node, x: np.array(x.size, node.attrs["out_type"]),
        _lower_size,
        _SHAPE_OF,
        precision="exact",
        of_shape=True,
    ),
    OpDef(
        "Rank", _infer_rank, lambda node, x: np.array(x.ndim, np.int32), None, (T,), precision="exact", of_shape=True
    ),
    OpDef(
        "Reshape",
        _infer_reshape,
        lambda node, x, shape: x.reshape([int(d) for d in shape.reshape(-1)]),
        _lower_reshape,
        (T, type_attr("Tshape", "in:1")),
        moves="view",
    ),
    OpDef("Squeeze", _infer_squeeze, _squeeze, _lower_squeeze, (T, Attr("squeeze_dims", "int", ())), moves="view"),
    OpDef(
        "ExpandDims",
        _infer_expand_dims,
        _expand_dims,
        _lower_expand_dims,
        (T, type_attr("Tdim", "in:1")),
        moves="view",
    ),
    OpDef("Transpose", _infer_transpose, _transpose, _lower_transpose, (T, type_attr("Tperm", "in:1")), moves="turn"),
    OpDef(
        "ConcatV2",
        _infer_concat,
        _concat,
        _lower_concat,
        (Attr("N", "int", derive="count:1"), T, type_attr("Tidx", "in:-1")),
        moves="join",
        data=(0, -1),
    ),
    OpDef(
        "Pack",
        _infer_pack,
        _pack,
        _lower_pack,
        (Attr("N", "int", derive="count"), T, Attr("axis", "int", 0)),
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
        spellings=("Unstack",),
        moves="pick",
    ),
    OpDef(
        "Split",
        _infer_split,
        _split,
        _lower_split,
        (Attr("num_split", "int"), type_attr("T", "in:1")),
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
        outputs=-1,
        moves="pick",
    ),
)
