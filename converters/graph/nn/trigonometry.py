"""Arc and hyperbolic functions out of ops that TensorFlow 1.4 and TensorFlow.js have. Any shape, float32."""

from __future__ import annotations

import math

from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn.activations import clip, scale_and_shift
from export_model.converters.graph.ops.approximations import RANGES


def sinh(b: Builder, x: str) -> str:
    """(eˣ − e⁻ˣ)/2."""
    return _hyperbolic(b, "Sub", x)


def cosh(b: Builder, x: str) -> str:
    """(eˣ + e⁻ˣ)/2."""
    return _hyperbolic(b, "Add", x)


def _hyperbolic(b: Builder, op: str, x: str) -> str:
    return scale_and_shift(b, b.add(op, [b.add("Exp", [x]), b.add("Exp", [b.add("Neg", [x])])]), 0.5)


def asinh(b: Builder, x: str) -> str:
    """sign(x)·ln(|x| + √(x² + 1)); Unity leaves the signs out and loses digits far below 0."""
    root = b.add("Sqrt", [_one_plus_square(b, x)])
    return b.add("Mul", [b.add("Sign", [x]), b.add("Log", [b.add("Add", [b.add("Abs", [x]), root])])])


def acosh(b: Builder, x: str) -> str:
    """ln(x + √((x − 1)·(x + 1)))."""
    one = b.number(x, 1, "one")
    root = b.add("Sqrt", [b.add("Mul", [b.add("Sub", [x, one]), b.add("Add", [x, one])])])
    return b.add("Log", [b.add("Add", [x, root])])


def atanh(b: Builder, x: str) -> str:
    """½·ln((1 + x) / (1 − x))."""
    x = _end_at_one(b, x)
    one = b.number(x, 1, "one")
    return scale_and_shift(b, b.add("Log", [b.add("RealDiv", [b.add("Add", [one, x]), b.add("Sub", [one, x])])]), 0.5)


def atan(b: Builder, x: str) -> str:
    """The arc tangent, right to float32's digits.

    atan(x) = 2·atan(t) with t = x / (1 + √(1 + x²)); twice halved, |t| ≤ tan(π/8), where the series up to t⁹ is right
    to 3e-6. One step y − (sin y − x·cos y) / √(1 + x²) cubes what error is left (its own is below 1e-15).
    """
    # Beyond 1e9 the square overflows, and the arc tangent is π/2 to all of float32's digits.
    x = clip(b, x, -1e9, 1e9)
    cosine = b.add("Sqrt", [_one_plus_square(b, x)])
    t = x
    for _ in range(2):
        root = b.add("Sqrt", [_one_plus_square(b, t)])
        t = b.add("RealDiv", [t, b.add("Add", [root, b.number(x, 1, "one")])])
    square = b.add("Square", [t])
    series = b.number(x, 1 / 9, "ninth")
    for power in (7, 5, 3, 1):
        sign = 1 if power in (5, 1) else -1
        series = b.add("Add", [b.add("Mul", [series, square]), b.number(x, sign / power, f"c{power}")])
    y = scale_and_shift(b, b.add("Mul", [series, t]), 4)
    off = b.add("Sub", [b.add("Sin", [y]), b.add("Mul", [x, b.add("Cos", [y])])])
    return b.add("Sub", [y, b.add("RealDiv", [off, cosine])])


def asin(b: Builder, x: str) -> str:
    """atan(x / √((1 − x)·(1 + x))); ±1 gives ±π/2 through the division by 0, beyond them NaN as it should."""
    x = _end_at_one(b, x)
    one = b.number(x, 1, "one")
    root = b.add("Sqrt", [b.add("Mul", [b.add("Sub", [one, x]), b.add("Add", [one, x])])])
    return atan(b, b.add("RealDiv", [x, root]))


def acos(b: Builder, x: str) -> str:
    """π/2 − asin(x)."""
    return b.add("Sub", [b.number(x, math.pi / 2, "right_angle"), asin(b, x)])


def _end_at_one(b: Builder, x: str) -> str:
    """``x``, cut to ±1 where a function gives it that ends there: a runtime's goes some units beyond it (RANGES)."""
    _, high = RANGES.get(b.producer(x).op, (-math.inf, math.inf))
    return clip(b, x, -1, 1) if high < math.inf else x


def _one_plus_square(b: Builder, x: str) -> str:
    return b.add("Add", [b.add("Square", [x]), b.number(x, 1, "one")])
