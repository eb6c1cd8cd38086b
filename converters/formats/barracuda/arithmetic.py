"""Layers that compute number by number, with broadcasting, and reductions along an axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from export_model.converters.formats.barracuda.layer_builder import LayerBuilder, NnValue, Shape, with_length
from export_model.converters.formats.barracuda.shaping import axis_of
from export_model.converters.graph.nn import reduction
from export_model.converters.graph.ops.barracuda.vocabulary import C, LayerType, N
from export_model.converters.graph.ops.table import TABLE
from export_model.converters.graph.types import FLOAT32

_FOLDED: Mapping[LayerType, str] = {
    LayerType.ADD: "Add",
    LayerType.SUB: "Sub",
    LayerType.MUL: "Mul",
    LayerType.DIV: "RealDiv",
    LayerType.POW: "Pow",
    LayerType.MIN: "Minimum",
    LayerType.MAX: "Maximum",
    LayerType.MEAN: "Add",
}
#: Comparisons, whose results are 1 and 0, and their ops.
_COMPARISONS: Mapping[int, str] = {
    e.nn.kind: op for op, e in TABLE.items() if e.nn is not None and isinstance(e.nn.kind, LayerType)
}
_REDUCED: Mapping[int, reduction.Reduction] = {
    LayerType.REDUCE_MAX: reduction.of_kind("Max"),
    LayerType.REDUCE_MEAN: reduction.of_kind("Mean"),
    LayerType.REDUCE_MIN: reduction.of_kind("Min"),
    LayerType.REDUCE_PROD: reduction.of_kind("Prod"),
    LayerType.REDUCE_SUM: reduction.of_kind("Sum"),
    LayerType.REDUCE_L1: reduction.l1,
    LayerType.REDUCE_L2: reduction.l2,
    LayerType.REDUCE_SUM_SQUARE: reduction.sum_square,
    LayerType.REDUCE_LOG_SUM: reduction.log_sum,
    LayerType.REDUCE_LOG_SUM_EXP: reduction.log_sum_exp,
}


def fold_inputs(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """The inputs combined from left to right: ((a − b) − c) …; the mean divides the sum by their number."""
    kind, total = LayerType(b.layer.type), args[0]
    for value in args[1:]:
        operands, shape = b.operands([total, value])
        total = NnValue(b.add(_FOLDED[kind], operands), shape)
    if kind is LayerType.MEAN and len(args) > 1:
        total = NnValue(b.add("Mul", [total.reference, b.floats(1 / len(args), "share")]), total.shape)
    return total


def compare_operands(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """1 where the comparison holds, else 0."""
    operands, shape = b.operands(args)
    return _as_float(b, b.add(_COMPARISONS[b.layer.type], operands), shape)


def logical(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """And, or, not, exclusive or of truths: a number is true unless it is 0."""
    operands, shape = b.operands(args)
    truths = [_truth(b, r) for r in operands]
    kind = LayerType(b.layer.type)
    if kind is LayerType.LOGICAL_NOT:
        result = b.add("LogicalNot", truths)
    elif kind is LayerType.LOGICAL_XOR:
        result = b.add("NotEqual", truths)
    else:
        result = b.add("LogicalAnd" if kind is LayerType.LOGICAL_AND else "LogicalOr", truths)
    return _as_float(b, result, shape)


def where(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """The second input where the first is not 0, else the third."""
    (condition, *choices), shape = b.operands(args)
    return NnValue(b.add("SelectV2", [_truth(b, condition), *choices]), shape)


def sign(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """−1, 0 or 1."""
    return NnValue(b.add("Sign", [args[0].reference]), args[0].shape)


def _truth(b: LayerBuilder, reference: str) -> str:
    return b.add("NotEqual", [reference, b.floats(0, "zero")])


def _as_float(b: LayerBuilder, truth: str, shape: Shape) -> NnValue:
    return NnValue(b.add("Cast", [truth], DstT=FLOAT32), shape)


def reduce_axis(b: LayerBuilder, args: Sequence[NnValue]) -> NnValue:
    """One number per row along an axis, which stays with length 1. A second input names the axis and is ignored."""
    x = args[0]
    axis = axis_of(b, b.layer.axis)
    if axis == N:
        raise b.unsupported_error("it reduces over the batch", "an agent's action would depend on the other agents")
    small = x.shape[1:3] == (1, 1)
    data, along = (b.as_matrix(x), 1) if small and axis == C else (b.as_image(x), axis)
    shape = with_length(x.shape, axis, 1)
    kind = LayerType(b.layer.type)
    if kind in (LayerType.ARG_MAX, LayerType.ARG_MIN):
        best = b.add("ArgMax" if kind is LayerType.ARG_MAX else "ArgMin", [data, b.ints(along, "axis")])
        return b.as_shape(b.add("Cast", [best], DstT=FLOAT32), shape, best if small else None)
    result = _REDUCED[kind](b, data, [along], True)
    return b.rows(result, shape[0], shape[3]) if small and axis == C else b.as_shape(result, shape)
