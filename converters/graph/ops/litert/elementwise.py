"""Arithmetic, activations and casts."""

from __future__ import annotations

import numpy as np

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.litert.base import Litert, LitertBuilder, Value, number
from export_model.converters.graph.types import BOOL, FLOAT32, INT32, INT64, TensorType


def square(node: Node, builder: LitertBuilder) -> Value:
    """Of the operand, or of the difference of two; whole numbers by MUL, which has them."""
    values = [builder.value(r) for r in node.inputs]
    if builder.result.dtype == FLOAT32:
        return builder.emit("SQUARE" if len(values) == 1 else "SQUARED_DIFFERENCE", values)
    value = values[0] if len(values) == 1 else builder.emit("SUB", values)
    return builder.emit("MUL", [value, value])


def reciprocal(node: Node, builder: LitertBuilder) -> Value:
    """1/x."""
    return builder.emit("DIV", [number(builder, node.inputs[0], 1), builder.value(node.inputs[0])])


def tan(node: Node, builder: LitertBuilder) -> Value:
    """The sine over the cosine."""
    x = builder.value(node.inputs[0])
    return builder.emit("DIV", [builder.emit("SIN", [x]), builder.emit("COS", [x])])


def expm1(node: Node, builder: LitertBuilder) -> Value:
    """ELU computes it below 0; above, exp(x) - 1."""
    x, zero = builder.value(node.inputs[0]), number(builder, node.inputs[0], 0)
    below = builder.emit("ELU", [builder.emit("MINIMUM", [x, zero])])
    above = builder.emit("EXP", [builder.emit("MAXIMUM", [x, zero])])
    return builder.emit("ADD", [below, builder.emit("SUB", [above, number(builder, node.inputs[0], 1)])])


def erf(node: Node, builder: LitertBuilder) -> Value:
    """Abramowitz and Stegun 7.1.26, right to 1.5e-7."""
    x = builder.value(node.inputs[0])

    def with_number(op: str, value: Value, operand: float) -> Value:
        return builder.emit(op, [value, number(builder, node.inputs[0], operand)])

    size = builder.emit("ABS", [x])
    below = with_number("ADD", with_number("MUL", size, 0.3275911), 1)
    t = builder.emit("DIV", [number(builder, node.inputs[0], 1), below])
    series = with_number("MUL", t, 1.061405429)
    for factor in (-1.453152027, 1.421413741, -0.284496736, 0.254829592):
        series = builder.emit("MUL", [with_number("ADD", series, factor), t])
    bell = builder.emit("EXP", [builder.emit("NEG", [builder.emit("SQUARE", [x])])])
    rest = builder.emit("MUL", [series, bell])
    upper = builder.emit("SUB", [number(builder, node.inputs[0], 1), rest])
    return builder.emit("MUL", [upper, builder.emit("SIGN", [x])])


def selu(node: Node, builder: LitertBuilder) -> Value:
    """Scale · (max(x, 0) + alpha · elu(min(x, 0)))."""
    alpha, scale = 1.6732632423543772, 1.0507009873554805
    reference = node.inputs[0]
    x, zero = builder.value(reference), number(builder, reference, 0)
    below = builder.emit("ELU", [builder.emit("MINIMUM", [x, zero])])
    below = builder.emit("MUL", [below, number(builder, reference, alpha * scale)])
    above = builder.emit("MUL", [builder.emit("RELU", [x]), number(builder, reference, scale)])
    return builder.emit("ADD", [above, below])


def softplus(node: Node, builder: LitertBuilder) -> Value:
    """max(x, 0) + log(1 + exp(-|x|))."""
    x = builder.value(node.inputs[0])
    small = builder.emit("EXP", [builder.emit("NEG", [builder.emit("ABS", [x])])])
    rest = builder.emit("LOG", [builder.emit("ADD", [small, number(builder, node.inputs[0], 1)])])
    return builder.emit("ADD", [builder.emit("RELU", [x]), rest])


def softsign(node: Node, builder: LitertBuilder) -> Value:
    """X / (1 + |x|)."""
    x = builder.value(node.inputs[0])
    below = builder.emit("ADD", [builder.emit("ABS", [x]), number(builder, node.inputs[0], 1)])
    return builder.emit("DIV", [x, below])


def floor_div(node: Node, builder: LitertBuilder) -> Value:
    """TensorFlow rounds the quotient down, where FLOOR_DIV takes the remainder off first."""
    values = [builder.value(r) for r in node.inputs]
    if builder.result.dtype.kind != "f":
        return builder.emit("FLOOR_DIV", values)
    return builder.emit("FLOOR", [builder.emit("DIV", values)])


def add_n(node: Node, builder: LitertBuilder) -> Value:
    """ADD_N, and of whole numbers of 64 bits, or of one, one ADD after the other."""
    first, *rest = (builder.value(r) for r in node.inputs)
    if rest and builder.result.dtype != INT64:
        return builder.emit("ADD_N", [first, *rest])
    for value in rest:
        first = builder.emit("ADD", [first, value])
    return first


def cast(node: Node, builder: LitertBuilder) -> Value:
    """To bool: what is not 0."""
    value, source = builder.value(node.inputs[0]), builder.type_of(node.inputs[0]).dtype
    target = node.attrs["DstT"]
    if source == target:
        return value
    if target == BOOL:
        return builder.emit("NOT_EQUAL", [value, number(builder, node.inputs[0], 0)])
    return builder.emit("CAST", [value], in_data_type=source, out_data_type=target)


def full_like(value: int) -> Litert:
    """A FILL of the operand's shape."""

    def lower(node: Node, builder: LitertBuilder) -> Value:
        if value == 0 and builder.result.dtype != BOOL:
            return builder.emit("ZEROS_LIKE", [builder.value(node.inputs[0])])
        rank = builder.type_of(node.inputs[0]).rank
        kind = TensorType(INT32, None if rank is None else (rank,))
        shape = builder.emit("SHAPE", [builder.value(node.inputs[0])], kind, out_type=INT32)
        return builder.emit("FILL", [shape, builder.const(np.array(value, builder.result.dtype))])

    return lower


def select(node: Node, builder: LitertBuilder) -> Value:
    """SELECT of operands of one shape, and of rows by a vector, as TensorFlow's; else SELECT_V2."""
    shapes = [builder.type_of(r).shape for r in node.inputs]
    values = [builder.value(r) for r in node.inputs]
    rows = shapes[0] is not None and len(shapes[0]) == 1
    plain = shapes[1] is not None and shapes[1] == shapes[2] and (rows or shapes[0] == shapes[1])
    return builder.emit("SELECT" if plain else "SELECT_V2", values)
