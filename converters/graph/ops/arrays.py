"""Constants, placeholders and pass-throughs; shapes of things, and things under other shapes.

Most kernels are structural: they also work on symbolic shape vectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from export_model.converters.graph.nodes import Node, TensorShape
from export_model.converters.graph.ops.barracuda import arrays as nn
from export_model.converters.graph.ops.barracuda.base import Nn
from export_model.converters.graph.ops.base import (
    Attr,
    OnnxBuilder,
    OpDef,
    axes_within,
    by_shape,
    constant_input,
    direct,
    emit_squeeze,
    emit_unsqueeze,
    insert_axis,
    not_constant,
    require_constant,
    same_as,
    shape_error,
    type_attr,
)
from export_model.converters.graph.ops.litert import arrays as litert
from export_model.converters.graph.ops.litert.base import LitertBuilder, Value, same, without
from export_model.converters.graph.ops.loops.arrays import transpose
from export_model.converters.graph.ops.loops.base import view
from export_model.converters.graph.types import BATCH, INT32, Dim, Symbols, TensorType, of_array, product

T = type_attr()


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


def _lower_measure(node: Node, builder: OnnxBuilder) -> Any:
    """Shape and Size, which ONNX gives as int64."""
    value = builder.emit(node.op, [builder.value(node.inputs[0])])
    return value if node.attrs["out_type"] != INT32 else builder.emit("Cast", [value], to=INT32)


def _infer_size(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    dtype = node.attrs["out_type"]
    if args[0].shape is None:
        return [TensorType(dtype, ())]
    total = product(args[0].shape, symbols)
    value = np.array(total, dtype if isinstance(total, int) else object)
    return [TensorType(dtype, (), value)]


def _infer_rank(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    rank = args[0].rank
    return [TensorType(INT32, (), None if rank is None else np.array(rank, np.int32))]


def target_dims(kind: TensorType, symbols: Symbols) -> list[Dim] | None:
    """The dims that a shape operand stands for; fresh symbols where it is not known."""
    if kind.value is not None:
        return [d if isinstance(d, str) else int(d) for d in kind.value.reshape(-1).tolist()]
    if kind.shape is not None and len(kind.shape) == 1 and isinstance(kind.shape[0], int):
        return [symbols.fresh() for _ in range(kind.shape[0])]
    return None


def _infer_reshape(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    target = target_dims(args[1], symbols)
    if args[1].dtype.kind != "i":
        raise shape_error(node, args, f"the target shape is of {args[1].dtype}, and must be of int32 or int64")
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


def _squeeze_axes(node: Node, shape: Sequence[Dim]) -> tuple[int, ...]:
    wanted = node.attrs["squeeze_dims"]
    if wanted:
        return axes_within(wanted, len(shape))
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
    if shape is None:
        raise not_constant(node, "an operand of a rank")
    axes = _squeeze_axes(node, shape)
    kept = [d for i, d in enumerate(shape) if i not in axes]
    return emit_squeeze(builder, builder.value(node.inputs[0]), axes, kept)


def _litert_squeeze(node: Node, builder: LitertBuilder) -> Value:
    kind = builder.type_of(node.inputs[0])
    if kind.shape is None:
        raise not_constant(node, "an operand of a rank")
    axes = _squeeze_axes(node, kind.shape)
    return without(builder, builder.value(node.inputs[0]), kind.dtype, kind.shape, axes)


@by_shape
def _infer_expand_dims(
    node: Node, args: Sequence[TensorType], shape: tuple[Dim, ...], symbols: Symbols
) -> Sequence[Dim]:
    return insert_axis(shape, int(require_constant(node, args, 1, "an axis").reshape(()))) or ()


def _lower_expand_dims(node: Node, builder: OnnxBuilder) -> Any:
    axis = int(constant_input(node, builder, 1, "an axis").reshape(()))
    result = insert_axis(builder.type_of(node.inputs[0]).shape, axis)
    return emit_unsqueeze(builder, builder.value(node.inputs[0]), [axis], result)


def _transpose(node: Node, x: np.ndarray, permutation: np.ndarray) -> np.ndarray:
    return np.asarray(x.transpose([int(p) for p in permutation]), order="C")


@by_shape
def _infer_transpose(node: Node, args: Sequence[TensorType], shape: tuple[Dim, ...], symbols: Symbols) -> Sequence[Dim]:
    permutation = require_constant(node, args, 1, "a permutation").tolist()
    if sorted(permutation) != list(range(len(shape))):
        raise shape_error(node, args, f"{permutation} must be a permutation of {len(shape)} axes")
    return [shape[p] for p in permutation]


def _lower_transpose(node: Node, builder: OnnxBuilder) -> Any:
    permutation = constant_input(node, builder, 1, "a permutation").tolist()
    if not permutation:  # a scalar; ONNX wants at least one axis
        return builder.value(node.inputs[0])
    return builder.emit("Transpose", [builder.value(node.inputs[0])], perm=permutation)


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
        lambda node, args, symbols: [placeholder_type(node, symbols)],
        attrs=(Attr("dtype", "type"), Attr("shape", "shape", TensorShape(None))),
        spellings=("PlaceholderV2",),
        start="fed",
        precision="exact",
    ),
    *(
        OpDef(
            name,
            same_as(0),
            lambda node, x: x,
            lambda node, builder: builder.value(node.inputs[0]),
            (T, Attr("message", "str", "")) if name in ("PreventGradient", "CheckNumerics") else (T,),
            nn=Nn(nn.same),
            litert=same,
            loops=view,
            moves="same",
        )
        for name in ("Identity", "StopGradient", "PreventGradient", "Snapshot", "CheckNumerics")
    ),
    OpDef(
        "Shape", _infer_shape, _shape, _lower_measure, _SHAPE_OF, litert=litert.shape, precision="exact", of_shape=True
    ),
    OpDef(
        "Size",
        _infer_size,
        lambda node, x: np.array(x.size, node.attrs["out_type"]),
        _lower_measure,
        _SHAPE_OF,
        litert=litert.size,
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
        direct("Reshape", shape_at=1),
        (T, type_attr("Tshape", "in:1")),
        nn=Nn(nn.reshape),
        litert=litert.reshape,
        loops=view,
        moves="view",
    ),
    OpDef(
        "Squeeze",
        _infer_squeeze,
        _squeeze,
        _lower_squeeze,
        (T, Attr("squeeze_dims", "int", ())),
        nn=Nn(nn.reshape),
        litert=_litert_squeeze,
        loops=view,
        moves="view",
    ),
    OpDef(
        "ExpandDims",
        _infer_expand_dims,
        lambda node, x, axis: np.expand_dims(x, int(axis.reshape(()))),
        _lower_expand_dims,
        (T, type_attr("Tdim", "in:1")),
        nn=Nn(nn.reshape),
        litert=litert.expand_dims,
        loops=view,
        moves="view",
    ),
    OpDef(
        "Transpose",
        _infer_transpose,
        _transpose,
        _lower_transpose,
        (T, type_attr("Tperm", "in:1")),
        nn=Nn(nn.transpose),
        litert=litert.transpose,
        loops=transpose,
        moves="turn",
    ),
)
