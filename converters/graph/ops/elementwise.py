"""Elementwise ops: functions, casts, arithmetic. Others stand in ``activations`` and ``logic``.

Kernels of transcendental functions compute in float64 and round once, so constant folding gives the same bytes on
every processor, and the oracle is closer to the true value than any runtime it judges.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.barracuda import decompositions
from export_model.converters.graph.ops.barracuda import elementwise as nn
from export_model.converters.graph.ops.barracuda.arrays import same
from export_model.converters.graph.ops.barracuda.base import Nn
from export_model.converters.graph.ops.barracuda.vocabulary import Activation, LayerType
from export_model.converters.graph.ops.base import (
    REQUIRED,
    Attr,
    Lower,
    OnnxBuilder,
    OpDef,
    broadcast_of,
    chain,
    direct,
    plain,
    same_as,
    scalar,
    type_attr,
)
from export_model.converters.graph.ops.litert import elementwise as litert
from export_model.converters.graph.ops.litert.base import builtin, steps
from export_model.converters.graph.ops.loops import elementwise as loops
from export_model.converters.graph.ops.loops.base import Elementwise, simple
from export_model.converters.graph.ops.older import clip
from export_model.converters.graph.ops.rewriting import GraphBuilder
from export_model.converters.graph.types import BOOL, INT32, INT64, Symbols, TensorType

T = type_attr()


def wide(function: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
    """A kernel that computes floats in float64 and rounds once to the dtype of the first operand."""

    def kernel(node: Node, *arrays: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            wide = [a.astype(np.float64) if a.dtype.kind == "f" else a for a in arrays]
            return np.asarray(function(*wide)).astype(arrays[0].dtype)

    return kernel


_erf = np.vectorize(math.erf, otypes=[np.float64])


def unary(name: str, kernel: Callable[..., np.ndarray], lower: str | Lower, **traits: Any) -> OpDef:
    """A function of one operand; ``lower`` is what ONNX calls it, or how it is written there."""
    lowering = direct(lower) if isinstance(lower, str) else lower
    return OpDef(name, same_as(0, count=1), kernel, lowering, (T,), elementwise=True, **traits)


def smooth(name: str, function: Callable[..., np.ndarray], lower: str | Lower = "", **traits: Any) -> OpDef:
    """A function that each runtime approximates; ONNX calls it so unless ``lower`` says how it is written."""
    return unary(name, wide(function), lower or name, precision="approximate", **traits)


def _binary(name: str, function: Callable[..., np.ndarray], lower: str | Lower, **traits: Any) -> OpDef:
    lowering = _pair(lower) if isinstance(lower, str) else lower
    return OpDef(name, broadcast_of(count=2), plain(function), lowering, (T,), elementwise=True, **traits)


def _pair(name: str) -> Lower:
    """An ONNX op of two operands.

    A constant is written without leading axes of length 1 where the other operand has as many: Barracuda 1.1 gives the
    result of [B, n] and [1, n] another shape (Add_02).
    """

    def lower(node: Node, builder: OnnxBuilder) -> str:
        kinds = [builder.type_of(r) for r in node.inputs]
        values = []
        for kind, other, reference in zip(kinds, reversed(kinds), node.inputs, strict=True):
            value, constant = builder.value(reference), kind.constant
            if constant is not None and constant.shape[:1] == (1,) and 1 < constant.ndim <= (other.rank or 0):
                leading = next((i for i, n in enumerate(constant.shape) if n != 1), constant.ndim - 1)
                value = builder.const(constant.reshape(constant.shape[leading:]), "row")
            values.append(value)
        return builder.emit(name, values)

    return lower


def _lower_square(node: Node, builder: OnnxBuilder) -> Any:
    """Of the operand, or of the difference of two."""
    values = [builder.value(r) for r in node.inputs]
    value = values[0] if len(values) == 1 else builder.emit("Sub", values)
    return builder.emit("Mul", [value, value])


def _real_div(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Integers, which TensorFlow's old Div takes, are divided towards zero."""
    if a.dtype.kind == "f":
        return np.asarray(np.divide(a, b))
    quotient = np.floor_divide(np.abs(a), np.abs(b))
    return np.asarray(np.where((a < 0) != (b < 0), -quotient, quotient))


def _floor_div(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """TensorFlow rounds the quotient down; numpy's floor_divide takes the remainder off first (1 // 0.1 is 9 there)."""
    return np.asarray(np.floor(a / b) if a.dtype.kind == "f" else np.floor_divide(a, b))


def _lower_floor_div(node: Node, builder: OnnxBuilder) -> Any:
    a, b = (builder.value(r) for r in node.inputs)
    if builder.type_of(node.inputs[0]).dtype.kind == "f":
        return builder.emit("Floor", [builder.emit("Div", [a, b])])
    # ONNX divides integers towards zero: subtract the remainder (which has the divisor's sign) first.
    rest = builder.emit("Mod", [a, b])
    return builder.emit("Div", [builder.emit("Sub", [a, rest]), b])


def _lower_floor_mod(node: Node, builder: OnnxBuilder) -> Any:
    a, b = (builder.value(r) for r in node.inputs)
    if builder.type_of(node.inputs[0]).dtype.kind != "f":
        return builder.emit("Mod", [a, b])
    # What C's fmod leaves has the dividend's sign, and is exact; a divisor more where that is not the divisor's.
    zero = scalar(builder, node, 0.0)
    rest = builder.emit("Mod", [a, b], fmod=1)
    signs = builder.emit("Xor", [builder.emit("Less", [rest, zero]), builder.emit("Less", [b, zero])])
    left = builder.emit("Not", [builder.emit("Equal", [rest, zero])])
    return builder.emit("Where", [builder.emit("And", [left, signs]), builder.emit("Add", [rest, b]), rest])


def _cast(node: Node, x: np.ndarray) -> np.ndarray:
    with np.errstate(all="ignore"):
        return np.asarray(x.astype(node.attrs["DstT"]))


def _infer_cast(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    value = args[0].value
    # A symbolic shape vector keeps its symbols through int32 → int64.
    keep = value if value is not None and value.dtype == object and node.attrs["DstT"] in (INT32, INT64) else None
    return [TensorType(node.attrs["DstT"], args[0].shape, keep)]


def _lower_cast(node: Node, builder: OnnxBuilder) -> Any:
    return builder.emit("Cast", [builder.value(node.inputs[0])], to=node.attrs["DstT"])


def _add_n(node: Node, *arrays: np.ndarray) -> np.ndarray:
    total = arrays[0]
    for array in arrays[1:]:
        total = total + array
    return np.asarray(total)


def _lower_add_n(node: Node, builder: OnnxBuilder) -> Any:
    value = builder.value(node.inputs[0])
    for reference in node.inputs[1:]:
        value = builder.emit("Add", [value, builder.value(reference)])
    return value


def _tfjs_cast(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    """TensorFlow.js cuts a float that is cast to bool (0.6 is false on wasm)."""
    source = types[node.inputs[0]].dtype
    if node.attrs["DstT"] != BOOL or source.kind != "f":
        return node
    zero = builder.const(np.zeros((), source), f"{node.name}/zero")
    return Node(node.name, "NotEqual", (node.inputs[0], zero), origin=node.origin)


UNARY = (
    unary(
        "Neg",
        plain(np.negative),
        "Neg",
        nn=nn.activation(Activation.NEG),
        loops=simple("neg"),
        litert=builtin("NEG"),
        precision="exact",
    ),
    unary(
        "Abs",
        plain(np.abs),
        "Abs",
        nn=nn.activation(Activation.ABS),
        loops=simple("abs"),
        litert=builtin("ABS"),
        precision="exact",
    ),
    unary(
        "Sign",
        plain(np.sign),
        "Sign",
        barracuda=decompositions.SIGN,
        loops=Elementwise(loops.sign),
        litert=builtin("SIGN"),
        precision="exact",
    ),
    unary(
        "Square",
        plain(np.square),
        _lower_square,
        nn=Nn(nn.square),
        loops=Elementwise(loops.square),
        litert=litert.square,
    ),
    unary(
        "Reciprocal",
        plain(np.reciprocal),
        "Reciprocal",
        spellings=("Inv",),
        nn=nn.activation(Activation.RECIPROCAL),
        loops=Elementwise(loops.reciprocal),
        litert=litert.reciprocal,
    ),
    unary(
        "Floor",
        plain(np.floor),
        "Floor",
        nn=nn.activation(Activation.FLOOR),
        loops=simple("floor"),
        litert=builtin("FLOOR"),
        precision="exact",
    ),
    unary(
        "Ceil",
        plain(np.ceil),
        "Ceil",
        nn=nn.activation(Activation.CEIL),
        loops=simple("ceil"),
        litert=builtin("CEIL"),
        precision="exact",
    ),
    unary(
        "Round",
        plain(np.rint),
        "Round",
        barracuda=decompositions.ROUND,
        loops=simple("rint"),
        litert=builtin("ROUND"),
        precision="exact",
    ),
    smooth("Exp", np.exp, nn=nn.activation(Activation.EXP), loops=simple("exp"), litert=builtin("EXP")),
    smooth(
        "Expm1",
        np.expm1,
        chain(("Exp", None), ("Sub", 1.0)),
        barracuda=decompositions.EXPM1,
        loops=simple("expm1"),
        litert=litert.expm1,
    ),
    smooth("Log", np.log, nn=nn.activation(Activation.LOG), loops=simple("log"), litert=builtin("LOG")),
    smooth(
        "Log1p",
        np.log1p,
        chain(("Add", 1.0), ("Log", None)),
        barracuda=decompositions.LOG1P,
        loops=simple("log1p"),
        litert=steps(("ADD", 1.0), ("LOG", None)),
    ),
    unary(
        "Sqrt", wide(np.sqrt), "Sqrt", nn=nn.activation(Activation.SQRT), loops=simple("sqrt"), litert=builtin("SQRT")
    ),
    smooth(
        "Rsqrt",
        lambda x: np.asarray(1 / np.sqrt(x)),
        chain(("Sqrt", None), ("Reciprocal", None)),
        barracuda=decompositions.RSQRT,
        loops=Elementwise(loops.rsqrt),
        litert=builtin("RSQRT"),
    ),
    smooth("Sin", np.sin, loops=simple("sin"), litert=builtin("SIN")),
    smooth("Cos", np.cos, loops=simple("cos"), litert=builtin("COS")),
    smooth("Tan", np.tan, loops=simple("tan"), litert=litert.tan),
    smooth("Erf", _erf, remapped_behind="dense", barracuda=decompositions.ERF, loops=simple("erf"), litert=litert.erf),
    OpDef(
        "Cast",
        _infer_cast,
        _cast,
        _lower_cast,
        (
            type_attr("SrcT"),
            Attr("DstT", "type", REQUIRED),
            Attr("Truncate", "bool", False, since="1.14", supported=False),
        ),
        tfjs=_tfjs_cast,
        barracuda=decompositions.CAST,
        nn=Nn(same),
        loops=loops.cast,
        litert=litert.cast,
        precision="exact",
        elementwise=True,
    ),
)

BINARY = (
    _binary(
        "Add",
        np.add,
        "Add",
        spellings=("AddV2",),
        operand="summand",
        finite="as its operands",
        nn=nn.pair(LayerType.ADD),
        loops=simple("add"),
        litert=builtin("ADD"),
    ),
    _binary(
        "Sub",
        np.subtract,
        "Sub",
        barracuda=decompositions.SUB,
        nn=Nn(nn.subtract),
        operand="subtrahend",
        finite="as its operands",
        loops=simple("sub"),
        litert=builtin("SUB"),
    ),
    _binary(
        "Mul",
        np.multiply,
        "Mul",
        operand="factor",
        finite="as its operands",
        nn=nn.pair(LayerType.MUL),
        loops=simple("mul"),
        litert=builtin("MUL"),
    ),
    _binary(
        "RealDiv",
        _real_div,
        "Div",
        barracuda=decompositions.DIV,
        nn=Nn(nn.divide),
        spellings=("Div",),
        operand="divisor",
        loops=Elementwise(loops.divide),
        litert=builtin("DIV"),
    ),
    _binary(
        "FloorDiv",
        _floor_div,
        _lower_floor_div,
        nn=Nn(nn.floor_divide),
        loops=Elementwise(loops.floor_div),
        litert=litert.floor_div,
    ),
    _binary(
        "FloorMod",
        np.mod,
        _lower_floor_mod,
        barracuda=decompositions.FLOOR_MOD,
        loops=simple("mod"),
        litert=builtin("FLOOR_MOD"),
        remainder=True,
    ),
    _binary(
        "Maximum",
        np.maximum,
        "Max",
        precision="exact",
        finite="as its operands",
        takes="largest",
        nn=nn.pair(LayerType.MAX),
        loops=simple("max"),
        litert=builtin("MAXIMUM"),
    ),
    _binary(
        "Minimum",
        np.minimum,
        "Min",
        precision="exact",
        finite="as its operands",
        takes="smallest",
        nn=nn.pair(LayerType.MIN),
        loops=simple("min"),
        litert=builtin("MINIMUM"),
    ),
    OpDef(
        "Pow",
        broadcast_of(count=2),
        wide(np.power),
        direct("Pow"),
        (T,),
        nn=Nn(nn.power),
        loops=simple("pow"),
        litert=builtin("POW"),
        precision="approximate",
        elementwise=True,
    ),
    _binary(
        "SquaredDifference",
        lambda a, b: np.square(a - b),
        _lower_square,
        nn=Nn(nn.squared_difference),
        loops=Elementwise(loops.square),
        litert=litert.square,
    ),
    OpDef(
        "ClipByValue",
        broadcast_of(),
        plain(lambda x, low, high: np.maximum(np.minimum(x, high), low)),
        direct("Clip"),
        (T,),
        older=clip,
        nn=Nn(nn.clip),
        precision="exact",
        elementwise=True,
    ),
    OpDef(
        "AddN",
        broadcast_of(),
        _add_n,
        _lower_add_n,
        (Attr("N", "int", derive="count"), T),
        nn=Nn(nn.add_n),
        loops=Elementwise(loops.add_n),
        litert=litert.add_n,
        elementwise=True,
    ),
)

OPS = UNARY + BINARY
