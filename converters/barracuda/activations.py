"""Activations: one number in, one number out, but for the three that look at a whole row.

Formulas: Barracuda's ReferenceCPUOps. What TensorFlow has no op for is written in the ones it has.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import MappingProxyType

from converters.barracuda.builder import Builder, Value
from converters.barracuda.vocabulary import Activation, activation_label

#: Activations that are one op.
_OPS = MappingProxyType(
    {
        Activation.RELU: "Relu",
        Activation.TANH: "Tanh",
        Activation.SIGMOID: "Sigmoid",
        Activation.RELU6: "Relu6",
        Activation.SOFTPLUS: "Softplus",
        Activation.ABS: "Abs",
        Activation.NEG: "Neg",
        Activation.CEIL: "Ceil",
        Activation.FLOOR: "Floor",
        Activation.ROUND: "Round",
        Activation.RECIPROCAL: "Reciprocal",
        Activation.SQRT: "Sqrt",
        Activation.EXP: "Exp",
        Activation.LOG: "Log",
        Activation.COS: "Cos",
        Activation.SIN: "Sin",
        Activation.TAN: "Tan",
        Activation.ERF: "Erf",
    }
)
#: Activations that read ``alpha`` or ``beta``; Unity drops them where the activation is fused into another layer.
PARAMETRIC = frozenset(
    (Activation.LEAKY_RELU, Activation.SELU, Activation.HARD_SIGMOID, Activation.CLIP, Activation.POW)
)
_ROWS = (Activation.SOFTMAX, Activation.LOG_SOFTMAX, Activation.HARDMAX)

#: Takes (builder, x, alpha, beta) and gives the reference of the result.
_Formula = Callable[[Builder, str, float, float], str]


def activate(b: Builder, number: int, x: Value, version: int, *, axis: int = -1, fused: bool = False) -> Value:
    """``number`` applied to ``x``; the parameters are the current layer's, or the defaults where it is fused."""
    if number == Activation.NONE:
        return x
    if fused and number in (*PARAMETRIC, Activation.PRELU):
        raise b.unsupported(
            f"{activation_label(number)} is fused into it",
            "Unity drops the parameters of a fused activation, so what it computed is not known",
        )
    if number in _ROWS:
        return _over_rows(b, Activation(number), x, version, axis)
    if number in _OPS:
        return Value(b.op(_OPS[Activation(number)], [x.reference]), x.shape)
    formula = _FORMULAS.get(number)
    if formula is None:
        raise b.unsupported(f"its activation is {activation_label(number)}", "no formula of it is known")
    alpha, beta = (1.0, 0.0) if fused else (b.layer.alpha, b.layer.beta)
    return Value(formula(b, x.reference, alpha, beta), x.shape)


def prelu(b: Builder, x: Value, slope: Value) -> Value:
    """max(0, x) + slope·min(0, x)."""
    (data, factor), shape = b.operands([x, slope])
    if shape != x.shape:
        raise b.damaged(
            f"slopes of shape {list(slope.shape)} for {list(x.shape)}", "there are more slopes than numbers"
        )
    below = b.op("Mul", [b.op("Minimum", [data, b.const(0, "zero")]), factor])
    return Value(b.op("Add", [b.op("Relu", [data]), below]), shape)


# ------------------------------------------------------------------ over rows


def _over_rows(b: Builder, kind: Activation, x: Value, version: int, axis: int) -> Value:
    """Softmax and its kin, over the flattened row up to version 16, along an axis (8-D order) from 18 on."""
    along_channels = axis in (-1, 7)
    if x.rank == 4 and version > 16:
        if not along_channels or version == 17:
            raise b.unsupported(
                f"{activation_label(kind)} of a tensor of shape {list(x.shape)}, axis {axis}",
                "Barracuda 1.x took the whole row, later versions an axis; only an axis of channels is known for sure",
            )
        rows = b.op("Reshape", [x.reference, b.ints([-1, x.c], "rows")], label="rows")
        return b.shaped(_row_op(b, kind, rows, x.c), x.shape)
    if version > 16 and not along_channels:
        raise b.unsupported(f"{activation_label(kind)} along axis {axis}", "that axis is not the channels'")
    return b.rows(_row_op(b, kind, b.matrix(x), x.size), x.shape[0], x.size)


def _row_op(b: Builder, kind: Activation, rows: str, width: int) -> str:
    if kind is not Activation.HARDMAX:
        return b.op("Softmax" if kind is Activation.SOFTMAX else "LogSoftmax", [rows])
    best = b.op("ArgMax", [rows, b.ints(1, "axis")])
    return b.op("OneHot", [best, b.ints(width, "depth"), b.const(1, "on"), b.const(0, "off")], axis=-1)


# ------------------------------------------------------------------ formulas


def _scaled(b: Builder, x: str, factor: float, label: str = "factor") -> str:
    return x if factor == 1 else b.op("Mul", [x, b.const(factor, label)])


def _exponential_unit(b: Builder, x: str, alpha: float) -> str:
    """X above 0, alpha·(eˣ − 1) below: what lies above and below are summed, one of them being 0."""
    if alpha == 1:
        return b.op("Elu", [x])
    below = b.op("Elu", [b.op("Minimum", [x, b.const(0, "zero")])])
    return b.op("Add", [b.op("Relu", [x]), _scaled(b, below, alpha, "alpha")])


def _elu(b: Builder, x: str, alpha: float, beta: float) -> str:
    return _exponential_unit(b, x, alpha)


def _selu(b: Builder, x: str, alpha: float, gamma: float) -> str:
    return _scaled(b, _exponential_unit(b, x, alpha), gamma, "gamma")


def _leaky_relu(b: Builder, x: str, alpha: float, beta: float) -> str:
    return b.op("Maximum", [x, b.op("Mul", [x, b.const(alpha, "alpha")])])


def _swish(b: Builder, x: str, alpha: float, beta: float) -> str:
    return b.op("Mul", [x, b.op("Sigmoid", [x])])


def _softsign(b: Builder, x: str, alpha: float, beta: float) -> str:
    """The number over 1 + |x|; TensorFlow has an op for it, TensorFlow.js has not."""
    return b.op("RealDiv", [x, b.op("Add", [b.op("Abs", [x]), b.const(1, "one")])])


def _between(b: Builder, x: str, low: float, high: float) -> str:
    return b.op("Maximum", [b.op("Minimum", [x, b.const(high, "high")]), b.const(low, "low")])


def _hard_sigmoid(b: Builder, x: str, alpha: float, beta: float) -> str:
    return _between(b, b.op("Add", [_scaled(b, x, alpha, "alpha"), b.const(beta, "beta")]), 0, 1)


def _pow(b: Builder, x: str, alpha: float, beta: float) -> str:
    return b.op("Pow", [x, b.const(alpha, "alpha")])


def _hyperbolic(op: str) -> _Formula:
    def formula(b: Builder, x: str, alpha: float, beta: float) -> str:
        both = b.op(op, [b.op("Exp", [x]), b.op("Exp", [b.op("Neg", [x])])])
        return _scaled(b, both, 0.5, "half")

    return formula


def _one_plus_square(b: Builder, x: str) -> str:
    return b.op("Add", [b.op("Square", [x]), b.const(1, "one")])


def _asinh(b: Builder, x: str, alpha: float, beta: float) -> str:
    """sign(x)·ln(|x| + √(x² + 1)); Unity leaves the signs out and loses digits far below 0."""
    root = b.op("Sqrt", [_one_plus_square(b, x)])
    return b.op("Mul", [b.op("Sign", [x]), b.op("Log", [b.op("Add", [b.op("Abs", [x]), root])])])


def _acosh(b: Builder, x: str, alpha: float, beta: float) -> str:
    """ln(x + √((x − 1)·(x + 1)))."""
    one = b.const(1, "one")
    root = b.op("Sqrt", [b.op("Mul", [b.op("Sub", [x, one]), b.op("Add", [x, one])])])
    return b.op("Log", [b.op("Add", [x, root])])


def _atanh(b: Builder, x: str, alpha: float, beta: float) -> str:
    """½·ln((1 + x) / (1 − x))."""
    one = b.const(1, "one")
    quotient = b.op("RealDiv", [b.op("Add", [one, x]), b.op("Sub", [one, x])])
    return _scaled(b, b.op("Log", [quotient]), 0.5, "half")


def _atan(b: Builder, x: str, alpha: float, beta: float) -> str:
    """The arc tangent out of ops that every runtime has.

    atan(x) = 2·atan(t) with t = x / (1 + √(1 + x²)); twice halved, |t| ≤ tan(π/8), where the series up to t⁹ is right
    to 3e-6. One step y − (sin y − x·cos y) / √(1 + x²) cubes what error is left (its own is below 1e-15).
    """
    # Beyond 1e9 the square overflows, and the arc tangent is π/2 to all of float32's digits.
    x = _between(b, x, -1e9, 1e9)
    cosine = b.op("Sqrt", [_one_plus_square(b, x)])
    t = x
    for _ in range(2):
        root = b.op("Sqrt", [_one_plus_square(b, t)])
        t = b.op("RealDiv", [t, b.op("Add", [root, b.const(1, "one")])])
    square = b.op("Square", [t])
    series = b.const(1 / 9, "ninth")
    for power in (7, 5, 3, 1):
        sign = 1 if power in (5, 1) else -1
        series = b.op("Add", [b.op("Mul", [series, square]), b.const(sign / power, f"c{power}")])
    y = _scaled(b, b.op("Mul", [series, t]), 4, "four")
    off = b.op("Sub", [b.op("Sin", [y]), b.op("Mul", [x, b.op("Cos", [y])])])
    return b.op("Sub", [y, b.op("RealDiv", [off, cosine])])


def _asin(b: Builder, x: str, alpha: float, beta: float) -> str:
    """atan(x / √((1 − x)·(1 + x))); ±1 gives ±π/2 through the division by 0, beyond them NaN as it should."""
    one = b.const(1, "one")
    root = b.op("Sqrt", [b.op("Mul", [b.op("Sub", [one, x]), b.op("Add", [one, x])])])
    return _atan(b, b.op("RealDiv", [x, root]), alpha, beta)


def _acos(b: Builder, x: str, alpha: float, beta: float) -> str:
    return b.op("Sub", [b.const(math.pi / 2, "right_angle"), _asin(b, x, alpha, beta)])


_FORMULAS: MappingProxyType[int, _Formula] = MappingProxyType(
    {
        Activation.ELU: _elu,
        Activation.LEAKY_RELU: _leaky_relu,
        Activation.SELU: _selu,
        Activation.SWISH: _swish,
        Activation.SOFTSIGN: _softsign,
        Activation.HARD_SIGMOID: _hard_sigmoid,
        Activation.CLIP: lambda b, x, low, high: _between(b, x, low, high),
        Activation.POW: _pow,
        Activation.ACOS: _acos,
        Activation.ACOSH: _acosh,
        Activation.ASIN: _asin,
        Activation.ASINH: _asinh,
        Activation.ATAN: _atan,
        Activation.ATANH: _atanh,
        Activation.COSH: _hyperbolic("Add"),
        Activation.SINH: _hyperbolic("Sub"),
    }
)
