"""Comparisons, choices and truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.barracuda import decompositions
from export_model.converters.graph.ops.barracuda.base import Nn
from export_model.converters.graph.ops.barracuda.elementwise import compare, pair
from export_model.converters.graph.ops.barracuda.vocabulary import LayerType
from export_model.converters.graph.ops.base import (
    Attr,
    Lower,
    OnnxBuilder,
    OpDef,
    broadcast_of,
    chain,
    direct,
    emit_unsqueeze,
    plain,
    require_one_dtype,
    same_as,
    type_attr,
)
from export_model.converters.graph.ops.litert.base import Litert, builtin
from export_model.converters.graph.ops.litert.elementwise import select
from export_model.converters.graph.ops.loops import elementwise as loops
from export_model.converters.graph.ops.loops.base import Elementwise, Loops, simple
from export_model.converters.graph.ops.older import select_v2
from export_model.converters.graph.ops.rewriting import GraphBuilder
from export_model.converters.graph.types import BOOL, Symbols, TensorType

T = type_attr()


def _comparison(
    name: str, function: Callable[..., np.ndarray], lowering: Lower, nn: Nn, litert: Litert, loops: Loops
) -> OpDef:
    attrs: tuple[Attr, ...] = (T,)
    if name in ("Equal", "NotEqual"):
        attrs = (T, Attr("incompatible_shape_error", "bool", True, since="1.15", supported=False))
    kernel = plain(function)
    return OpDef(
        name,
        broadcast_of(BOOL, count=2),
        kernel,
        lowering,
        attrs,
        nn=nn,
        litert=litert,
        loops=loops,
        precision="exact",
        elementwise=True,
        compares_equal=name == "Equal",
    )


def _select(node: Node, condition: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """TF 1's Select: a rank-1 condition chooses whole rows."""
    if condition.ndim == 1 and a.ndim > 1:
        condition = condition.reshape(condition.shape + (1,) * (a.ndim - 1))
    return np.where(condition, a, b)


def _lower_select(node: Node, builder: OnnxBuilder) -> Any:
    condition, a, b = (builder.value(r) for r in node.inputs)
    shape, wide = builder.type_of(node.inputs[0]).shape, builder.type_of(node.inputs[1]).rank
    if shape is not None and len(shape) == 1 and wide is not None and wide > 1:
        condition = emit_unsqueeze(builder, condition, list(range(1, wide)), [*shape, *[1] * (wide - 1)])
    return builder.emit("Where", [condition, a, b])


def _tfjs_select(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    """TensorFlow.js broadcasts a vector condition over the last axis, not the first: SelectV2 of a reshaped one."""
    condition = decompositions.whole_rows(builder, node, types)
    return Node(node.name, "SelectV2", (condition, *node.inputs[1:]), origin=node.origin)


def _infer_select(node: Node, args: Sequence[TensorType], symbols: Symbols) -> Sequence[TensorType]:
    require_one_dtype(node, args[1:])
    return [TensorType(args[1].dtype, args[1].shape if args[1].shape is not None else args[2].shape)]


def _infer_select_v2(node: Node, args: Sequence[TensorType], symbols: Symbols) -> Sequence[TensorType]:
    kind = args[1].dtype
    return broadcast_of()(node, [TensorType(kind, args[0].shape), *args[1:]], symbols)


#: Decomposed where it can be.
_NO_SELECT = Nn(None, why="it chooses an infinite number, and infinity times 0 is NaN")

OPS = (
    _comparison(
        "Less", np.less, direct("Less"), compare(LayerType.LESS), builtin("LESS"), loops.comparison_loops("less")
    ),
    _comparison(
        "LessEqual",
        np.less_equal,
        direct("LessOrEqual"),
        compare(LayerType.LESS_EQUAL),
        builtin("LESS_EQUAL"),
        loops.comparison_loops("less_equal"),
    ),
    _comparison(
        "Greater",
        np.greater,
        direct("Greater"),
        compare(LayerType.GREATER),
        builtin("GREATER"),
        Elementwise(loops.greater),
    ),
    # The other way round: Barracuda has no GreaterOrEqual.
    _comparison(
        "GreaterEqual",
        np.greater_equal,
        direct("LessOrEqual", 1, 0),
        compare(LayerType.GREATER_EQUAL),
        builtin("GREATER_EQUAL"),
        Elementwise(loops.greater_equal),
    ),
    _comparison(
        "Equal", np.equal, direct("Equal"), compare(LayerType.EQUAL), builtin("EQUAL"), loops.comparison_loops("equal")
    ),
    _comparison(
        "NotEqual",
        np.not_equal,
        chain(("Equal", None), ("Not", None)),
        compare(LayerType.EQUAL, negated=True),
        builtin("NOT_EQUAL"),
        Elementwise(loops.not_equal),
    ),
    *(
        OpDef(
            name,
            broadcast_of(BOOL, count=2),
            plain(function),
            direct(onnx),
            nn=pair(layer),
            litert=builtin(f"LOGICAL_{onnx.upper()}"),
            loops=loops.comparison_loops(onnx.lower()),
            precision="exact",
            elementwise=True,
        )
        for name, function, onnx, layer in (
            ("LogicalAnd", np.logical_and, "And", LayerType.MUL),
            ("LogicalOr", np.logical_or, "Or", LayerType.MAX),
        )
    ),
    OpDef(
        "LogicalNot",
        same_as(0, count=1),
        plain(np.logical_not),
        direct("Not"),
        barracuda=decompositions.LOGICAL_NOT,
        litert=builtin("LOGICAL_NOT"),
        loops=simple("not"),
        precision="exact",
        elementwise=True,
    ),
    OpDef(  # not elementwise: a condition of rank 1 chooses whole rows
        "Select",
        _infer_select,
        _select,
        _lower_select,
        (type_attr("T", "in:1"),),
        tfjs=_tfjs_select,
        barracuda=decompositions.SELECT,
        nn=_NO_SELECT,
        litert=select,
        loops=loops.select,
        precision="exact",
        condition=0,
    ),
    OpDef(  # of no policy's graph, but of a TensorFlow.js model's
        "SelectV2",
        _infer_select_v2,
        lambda node, c, a, b: np.where(c, a, b),
        attrs=(type_attr("T", "in:1"),),
        barracuda=decompositions.SELECT,
        nn=_NO_SELECT,
        older=select_v2,
        since="1.14",
        precision="exact",
        elementwise=True,
        condition=0,
    ),
)
