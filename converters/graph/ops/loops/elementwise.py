"""Arithmetic, activations, casts, comparisons and choices."""

from __future__ import annotations

from collections.abc import Mapping

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.loops.base import (
    Elementwise,
    Expression,
    LoopBuilder,
    Loops,
    Number,
    Tensor,
    apply,
    element,
    holds,
    select_expression,
    shape_of,
)
from export_model.converters.graph.types import BOOL


def _like(x: Expression, value: float) -> Number:
    return Number(value, x.dtype)


def sign(x: Expression) -> Expression:
    """-1, 0, 1, or NaN as it is."""
    zero = _like(x, 0)
    return select_expression(
        holds("less", zero, x),
        _like(x, 1),
        select_expression(holds("less", x, zero), _like(x, -1), apply("mul", x, zero)),
    )


def square(*x: Expression) -> Expression:
    """Of the operand, or of the difference of two."""
    base = x[0] if len(x) == 1 else apply("sub", *x)
    return apply("mul", base, base)


def reciprocal(x: Expression) -> Expression:
    """1/x."""
    return apply("div", _like(x, 1), x)


def rsqrt(x: Expression) -> Expression:
    """1/sqrt(x)."""
    return reciprocal(apply("sqrt", x))


def sigmoid(x: Expression) -> Expression:
    """1 / (1 + exp(-x))."""
    return reciprocal(apply("add", _like(x, 1), apply("exp", apply("neg", x))))


def relu(x: Expression) -> Expression:
    """0 where x is below."""
    return select_expression(holds("less", x, _like(x, 0)), _like(x, 0), x)


def relu6(x: Expression) -> Expression:
    """From 0 to 6."""
    return select_expression(holds("less", _like(x, 6), x), _like(x, 6), relu(x))


def elu(x: Expression) -> Expression:
    """exp(x) - 1 below 0."""
    return select_expression(holds("less", _like(x, 0), x), x, apply("expm1", x))


def selu(x: Expression) -> Expression:
    """Elu, scaled."""
    below = apply("mul", _like(x, 1.6732632423543772), apply("expm1", x))
    return apply("mul", _like(x, 1.0507009873554805), select_expression(holds("less", _like(x, 0), x), x, below))


def softplus(x: Expression) -> Expression:
    """max(x, 0) + log(1 + exp(-|x|))."""
    return apply("add", relu(x), apply("log1p", apply("exp", apply("neg", apply("abs", x)))))


def softsign(x: Expression) -> Expression:
    """X / (1 + |x|)."""
    return apply("div", x, apply("add", _like(x, 1), apply("abs", x)))


def divide(a: Expression, b: Expression) -> Expression:
    """Whole numbers towards zero."""
    return apply("div", a, b)


def floor_div(a: Expression, b: Expression) -> Expression:
    """The quotient, rounded down."""
    return apply("floor", apply("div", a, b)) if a.dtype.kind == "f" else apply("intdiv", a, b)


def add_n(first: Expression, *others: Expression) -> Expression:
    """The sum of all."""
    for other in others:
        first = apply("add", first, other)
    return first


def greater(a: Expression, b: Expression) -> Expression:
    """B < a."""
    return holds("less", b, a)


def greater_equal(a: Expression, b: Expression) -> Expression:
    """B <= a."""
    return holds("less_equal", b, a)


def not_equal(a: Expression, b: Expression) -> Expression:
    """Not a = b."""
    return apply("not", holds("equal", a, b), dtype=BOOL)


def comparison_loops(function: str) -> Loops:
    """A comparison, or one of truths."""
    return Elementwise(lambda a, b: holds(function, a, b))


def apply_activations(node: Node, x: Expression, known: Mapping[str, Elementwise]) -> Expression:
    """What the activations of a fused op, ``known`` by the names of their ops, make of an element."""
    for name in node.attrs.get("fused_ops", ())[1:]:
        x = known[name].function(x)
    return x


def cast(node: Node, builder: LoopBuilder) -> Tensor:
    """To bool: what is not 0."""
    target = builder.type_of(node.name).dtype

    def convert(x: Expression) -> Expression:
        if x.dtype == target:
            return x
        return not_equal(x, _like(x, 0)) if target == BOOL else apply("cast", x, dtype=target)

    made: Tensor = Elementwise(convert)(node, builder)
    return made


def full_of(value: int) -> Loops:
    """The same number everywhere."""

    def loops(node: Node, builder: LoopBuilder) -> Tensor:
        dtype = builder.type_of(node.name).dtype
        return builder.compute(shape_of(node, builder), lambda at: Number(value, dtype), dtype)

    return loops


def select(node: Node, builder: LoopBuilder) -> Tensor:
    """A condition of rank 1 chooses whole rows."""
    condition, a, b = (builder.value(r) for r in node.inputs)
    rows = len(condition.shape) == 1 and len(a.shape) > 1
    return builder.compute(
        shape_of(node, builder),
        lambda at: select_expression(element(condition, at[:1] if rows else at), element(a, at), element(b, at)),
        a.dtype,
    )
