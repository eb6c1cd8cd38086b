"""Ops on each element by itself; of numbers alone they are computed while the program is walked through."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from export_model.converters.formats.torchscript.machine import Machine, unknown_length
from export_model.converters.formats.torchscript.ops.scalars import NUMBERS, join_lists
from export_model.converters.formats.torchscript.values import LengthFoundError, OpenLength, ScriptTensor
from export_model.converters.graph.nn import activations, trigonometry
from export_model.converters.graph.nn.activations import Activation
from export_model.converters.graph.types import BOOL, FLOAT32
from export_model.signatures.errors import UnsupportedOpError


def _floats(m: Machine, x: Any) -> str:
    return m.b.cast(m.ref(x), FLOAT32)


def _unary(function: Activation) -> Callable[..., ScriptTensor]:
    return lambda m, x: ScriptTensor(function(m.b, _floats(m, x)))


def _op(name: str) -> Callable[..., ScriptTensor]:
    return _unary(activations.of_op(name))


def _keep_type(name: str) -> Callable[..., ScriptTensor]:
    """An op that keeps whole numbers whole."""
    return lambda m, x: ScriptTensor(m.b.add(name, [m.ref(x)]))


# ------------------------------------------------------------------ two operands


def _numbers(m: Machine, name: str, a: Any, b: Any) -> Any:
    for one, other in ((a, b), (b, a)):
        if isinstance(one, OpenLength):
            if name in ("eq", "ne") and isinstance(other, int):
                raise LengthFoundError(one.symbol, other)
            raise unknown_length()
    if any(isinstance(v, list | tuple) and any(isinstance(i, list | tuple) for i in v) for v in (a, b)):
        raise UnsupportedOpError("lists of lists are compared", why="lists of numbers are known")
    if isinstance(a, list | tuple) and name in ("eq", "ne"):
        return (list(a) == list(b)) is (name == "eq")
    if isinstance(a, int | float) and isinstance(b, int | float):
        return m.number(NUMBERS[name](a, b))
    if name in ("eq", "ne"):
        return (a == b) is (name == "eq")
    raise UnsupportedOpError(f"{type(a).__name__} and {type(b).__name__} are joined", why="numbers are expected")


def _tensors(*values: Any) -> bool:
    return any(isinstance(v, ScriptTensor) for v in values)


def _binary(op: str, name: str) -> Callable[..., Any]:
    def translate(m: Machine, a: Any, b: Any) -> Any:
        return ScriptTensor(m.b.add(op, list(m.pair(a, b)))) if _tensors(a, b) else _numbers(m, name, a, b)

    return translate


def _with_factor(op: str, name: str, *, swapped: bool = False) -> Callable[..., Any]:
    """``add(a, b, alpha)``: a + alpha·b."""

    def translate(m: Machine, a: Any, b: Any, alpha: Any = 1) -> Any:
        if isinstance(a, list) and isinstance(b, list) and name == "add":
            return join_lists(a, b)
        if not _tensors(a, b):
            return _numbers(m, name, *((b, a) if swapped else (a, b)))
        if swapped:
            a, b = b, a
            return ScriptTensor(m.b.add(op, list(m.pair(a, _times(m, b, alpha)))))
        return ScriptTensor(m.b.add(op, list(m.pair(a, _times(m, b, alpha)))))

    return translate


def _times(m: Machine, value: Any, factor: Any) -> Any:
    if factor == 1:
        return value
    return (
        ScriptTensor(m.b.add("Mul", list(m.pair(value, factor)))) if isinstance(value, ScriptTensor) else value * factor
    )


def _divide(m: Machine, a: Any, b: Any, rounding_mode: Any = None) -> Any:
    if not _tensors(a, b):
        return m.number(
            a / b if rounding_mode is None else math.floor(a / b) if rounding_mode == "floor" else int(a / b)
        )
    left, right = (m.b.cast(r, FLOAT32) for r in m.pair(a, b))
    made = m.b.add("RealDiv", [left, right])
    if rounding_mode is None:
        return ScriptTensor(made)
    return ScriptTensor(m.b.add("Floor", [made]) if rounding_mode == "floor" else _towards_zero(m, made))


def _towards_zero(m: Machine, x: str) -> str:
    """Cut off what is behind the point."""
    return m.b.add("Mul", [m.b.add("Sign", [x]), m.b.add("Floor", [m.b.add("Abs", [x])])])


def _remainder(m: Machine, a: Any, b: Any) -> Any:
    """With the sign of the divisor."""
    if not _tensors(a, b):
        return m.number(a % b)
    left, right = m.pair(a, b)
    return ScriptTensor(m.b.add("FloorMod", [left, right]))


def _floor_divided(m: Machine, a: Any, b: Any) -> Any:
    return _divide(m, a, b, "floor") if _tensors(a, b) else m.number(a // b)


def _difference(m: Machine, a: Any, b: Any) -> Any:
    return _with_factor("Sub", "sub")(m, a, b)


def _scaled_log(m: Machine, x: Any, base: float) -> ScriptTensor:
    value = m.b.add("Log", [_floats(m, x)])
    return ScriptTensor(activations.scale_and_shift(m.b, value, 1 / math.log(base)))


def _power(m: Machine, x: Any, exponent: Any) -> Any:
    if not _tensors(x, exponent):
        raise UnsupportedOpError("a power of two numbers", why="it may be any number")
    if isinstance(exponent, int | float) and exponent in (2, 0.5, 1):
        value = _floats(m, x)
        return ScriptTensor(value if exponent == 1 else m.b.add("Square" if exponent == 2 else "Sqrt", [value]))
    a, b = m.pair(x, exponent)
    return ScriptTensor(m.b.add("Pow", [m.b.cast(a, FLOAT32), m.b.cast(b, FLOAT32)]))


def _clamp(m: Machine, x: Any, min: Any = None, max: Any = None) -> ScriptTensor:
    value = m.ref(x)
    low, high = (b if b is None or isinstance(b, int | float) else m.ref(b) for b in (min, max))
    value = value if m.b.is_float(value) else m.b.cast(value, FLOAT32)
    return ScriptTensor(activations.clip(m.b, value, low, high))


def _logical(op: str) -> Callable[..., Any]:
    def translate(m: Machine, a: Any, b: Any) -> Any:
        if not _tensors(a, b):
            return (a and b) if op == "LogicalAnd" else (a or b)
        return ScriptTensor(m.b.add(op, [m.b.cast(m.ref(v), BOOL) for v in (a, b)]))

    return translate


def _not(m: Machine, x: Any) -> Any:
    return ScriptTensor(m.b.add("LogicalNot", [m.b.cast(m.ref(x), BOOL)])) if isinstance(x, ScriptTensor) else not x


def _where(m: Machine, condition: Any, a: Any, b: Any) -> ScriptTensor:
    left, right = m.pair(a, b)
    return ScriptTensor(m.b.where(m.b.cast(m.ref(condition), BOOL), left, right))


def _masked_fill(m: Machine, x: Any, mask: Any, value: Any) -> ScriptTensor:
    return _where(m, mask, value, x)


def _negate(m: Machine, x: Any) -> Any:
    return ScriptTensor(m.b.add("Neg", [m.ref(x)])) if isinstance(x, ScriptTensor) else -x


# ------------------------------------------------------------------ activations


def _elu(m: Machine, x: Any, alpha: Any = 1, scale: Any = 1, input_scale: Any = 1) -> ScriptTensor:
    if (scale, input_scale) != (1, 1):
        raise UnsupportedOpError("an elu of other scales", why="only alpha is known")
    return ScriptTensor(activations.elu(m.b, _floats(m, x), float(alpha)))


def _gelu(m: Machine, x: Any, approximate: Any = "none") -> ScriptTensor:
    return ScriptTensor(activations.gelu(m.b, _floats(m, x), tanh=approximate == "tanh"))


def _softplus(m: Machine, x: Any, beta: Any = 1, threshold: Any = 20) -> ScriptTensor:
    value = activations.scale_and_shift(m.b, _floats(m, x), float(beta))
    return ScriptTensor(activations.scale_and_shift(m.b, m.b.add("Softplus", [value]), 1 / float(beta)))


def _glu(m: Machine, x: Any, dim: Any = -1) -> ScriptTensor:
    """The first half times the sigmoid of the second."""
    value = _floats(m, x)
    axis = m.b.axis(value, dim)
    half = m.b.length(value, axis) // 2
    gate = m.b.add("Sigmoid", [m.b.slice(value, axis, half, None)])
    return ScriptTensor(m.b.add("Mul", [m.b.slice(value, axis, None, half), gate]))


def _hardshrink(m: Machine, x: Any, limit: Any = 0.5) -> ScriptTensor:
    value = _floats(m, x)
    kept = m.b.add("Greater", [m.b.add("Abs", [value]), m.b.number(value, float(limit))])
    return ScriptTensor(m.b.where(kept, value, m.b.number(value, 0)))


def _softshrink(m: Machine, x: Any, limit: Any = 0.5) -> ScriptTensor:
    value = _floats(m, x)
    inside = activations.clip(m.b, value, -float(limit), float(limit))
    return ScriptTensor(m.b.add("Sub", [value, inside]))


def _threshold(m: Machine, x: Any, threshold: Any, value: Any) -> ScriptTensor:
    given = _floats(m, x)
    above = m.b.add("Greater", [given, m.b.number(given, float(threshold))])
    return ScriptTensor(m.b.where(above, given, m.b.number(given, float(value))))


def _rrelu(
    m: Machine, x: Any, lower: Any = 1 / 8, upper: Any = 1 / 3, training: Any = False, *rest: Any
) -> ScriptTensor:
    if training:
        return _random(m)
    return ScriptTensor(activations.leaky_relu(m.b, _floats(m, x), (float(lower) + float(upper)) / 2))


def _atan2(m: Machine, y: Any, x: Any) -> ScriptTensor:
    """The angle of (x, y): that of y/x, half a turn on where x is negative, a quarter where it is 0."""
    above, beside = (m.b.cast(r, FLOAT32) for r in m.pair(y, x))
    zero, half = m.b.number(beside, 0), m.b.number(beside, math.pi)
    upright = m.b.add("Equal", [beside, zero])
    angle = trigonometry.atan(m.b, m.b.add("RealDiv", [above, m.b.where(upright, m.b.number(beside, 1), beside)]))
    turn = m.b.where(m.b.add("GreaterEqual", [above, zero]), half, m.b.add("Neg", [half]))
    left = m.b.add("Less", [beside, zero])
    angle = m.b.add("Add", [angle, m.b.where(left, turn, m.b.add("Mul", [turn, zero]))])
    quarter = m.b.add("Mul", [m.b.add("Sign", [above]), m.b.number(beside, math.pi / 2)])
    return ScriptTensor(m.b.where(upright, quarter, angle))


def _clip(low: float | None, high: float | None) -> Callable[..., ScriptTensor]:
    return lambda m, x: ScriptTensor(activations.clip(m.b, _floats(m, x), low, high))


def _dropout(m: Machine, x: Any, p: Any, train: Any) -> Any:
    if train and p:
        raise UnsupportedOpError("dropout of a module that is in training", why="call eval() before it is saved")
    return x


def _copy(m: Machine, target: Any, source: Any, non_blocking: Any = False) -> ScriptTensor:
    """What ``copy_`` puts into a tensor."""
    return source if isinstance(source, ScriptTensor) else ScriptTensor(m.ref(source, m.ref(target)))


def _fill_like(m: Machine, x: Any, value: Any = 0) -> ScriptTensor:
    like = m.ref(x)
    return ScriptTensor(m.b.broadcast(m.b.number(like, float(value)), m.b.shape(like)))


def _random(m: Machine, *given: Any, **named: Any) -> ScriptTensor:
    raise UnsupportedOpError(
        "it draws random numbers", why="noise inside of a TorchScript module is not translated", fix="trace the mean"
    )


OPS: Mapping[str, Callable[..., Any]] = {
    **{name: _op(op) for name, op in (("relu", "Relu"), ("tanh", "Tanh"), ("sigmoid", "Sigmoid"), ("exp", "Exp"))},
    **{name: _op(op) for name, op in (("log", "Log"), ("sqrt", "Sqrt"), ("rsqrt", "Rsqrt"), ("sin", "Sin"))},
    **{name: _op(op) for name, op in (("cos", "Cos"), ("tan", "Tan"), ("floor", "Floor"), ("ceil", "Ceil"))},
    **{name: _op(op) for name, op in (("round", "Round"), ("reciprocal", "Reciprocal"), ("log1p", "Log1p"))},
    **{name: _op(op) for name, op in (("expm1", "Expm1"), ("erf", "Erf"), ("softsign", "Softsign"))},
    **{name: _keep_type(op) for name, op in (("abs", "Abs"), ("sign", "Sign"), ("square", "Square"))},
    "neg": _negate,
    "relu6": _clip(0, 6),
    "selu": _unary(activations.selu),
    "silu": _unary(activations.swish),
    "mish": _unary(activations.mish),
    "log_sigmoid": _unary(activations.log_sigmoid),
    "hardsigmoid": _unary(partial(activations.hard_sigmoid, alpha=1 / 6, beta=0.5)),
    "hardswish": _unary(activations.hard_swish),
    "elu": _elu,
    "celu": lambda m, x, alpha=1: ScriptTensor(activations.celu(m.b, _floats(m, x), float(alpha))),
    "leaky_relu": lambda m, x, slope=0.01: ScriptTensor(activations.leaky_relu(m.b, _floats(m, x), float(slope))),
    "prelu": lambda m, x, slope: ScriptTensor(activations.prelu(m.b, _floats(m, x), m.ref(slope))),
    "gelu": _gelu,
    "glu": _glu,
    "hardshrink": _hardshrink,
    "softshrink": _softshrink,
    "threshold": _threshold,
    "rrelu": _rrelu,
    "softplus": _softplus,
    "hardtanh": _clamp,
    "clamp": _clamp,
    "clip": _clamp,
    "clamp_min": lambda m, x, low: _clamp(m, x, low),
    "clamp_max": lambda m, x, high: _clamp(m, x, None, high),
    "add": _with_factor("Add", "add"),
    "sub": _with_factor("Sub", "sub"),
    "rsub": _with_factor("Sub", "sub", swapped=True),
    "mul": _binary("Mul", "mul"),
    "div": _divide,
    "trunc": lambda m, x: ScriptTensor(_towards_zero(m, _floats(m, x))),
    "fix": lambda m, x: ScriptTensor(_towards_zero(m, _floats(m, x))),
    "atan2": _atan2,
    "lerp": lambda m, a, b, w: _with_factor("Add", "add")(m, a, _binary("Mul", "mul")(m, _difference(m, b, a), w)),
    "addcmul": lambda m, x, a, b, value=1: _with_factor("Add", "add")(m, x, _binary("Mul", "mul")(m, a, b), value),
    "addcdiv": lambda m, x, a, b, value=1: _with_factor("Add", "add")(m, x, _divide(m, a, b), value),
    "log2": lambda m, x: _scaled_log(m, x, 2),
    "log10": lambda m, x: _scaled_log(m, x, 10),
    **{
        name: _unary(getattr(trigonometry, name))
        for name in ("sinh", "cosh", "asinh", "acosh", "atanh", "atan", "asin", "acos")
    },
    "true_divide": _divide,
    "floor_divide": _floor_divided,
    "remainder": _remainder,
    "pow": _power,
    "maximum": lambda m, a, b: ScriptTensor(m.b.add("Maximum", list(m.pair(a, b)))),
    "minimum": lambda m, a, b: ScriptTensor(m.b.add("Minimum", list(m.pair(a, b)))),
    "eq": _binary("Equal", "eq"),
    "ne": _binary("NotEqual", "ne"),
    "lt": _binary("Less", "lt"),
    "le": _binary("LessEqual", "le"),
    "gt": _binary("Greater", "gt"),
    "ge": _binary("GreaterEqual", "ge"),
    "logical_and": _logical("LogicalAnd"),
    "logical_or": _logical("LogicalOr"),
    "__and__": _logical("LogicalAnd"),
    "__or__": _logical("LogicalOr"),
    "logical_not": _not,
    "bitwise_not": _not,
    "where": _where,
    "masked_fill": _masked_fill,
    "dropout": _dropout,
    "feature_dropout": _dropout,
    "copy": _copy,
    "fill": _fill_like,
    "zero": _fill_like,
    **dict.fromkeys(("randn", "randn_like", "rand", "rand_like", "normal", "multinomial", "bernoulli"), _random),
}
