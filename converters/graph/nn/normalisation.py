"""Normalisations: by stored statistics (batch), or by an input's own. Formulas: onnx/docs/Operators.md."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn.linear import matmul
from export_model.converters.graph.types import FLOAT32
from export_model.signatures.errors import UnsupportedOpError


def batch(
    b: Builder,
    x: str,
    scale: np.ndarray,
    bias: np.ndarray,
    mean: np.ndarray,
    variance: np.ndarray,
    epsilon: float,
    *,
    channels: int = 1,
) -> str:
    """(x − mean)·scale/√(variance + ε) + bias per channel of x; the statistics are [C], as is the axis ``channels``."""
    shape = [-1 if i == channels else 1 for i in range(b.rank(x))]
    wide = [a.astype(np.float64) for a in (scale, variance, mean, bias)]
    factor = wide[0] / np.sqrt(wide[1] + epsilon)
    centre, width, shift = (
        b.const(a.astype(FLOAT32).reshape(shape), name)
        for a, name in ((wide[2], "mean"), (factor, "factor"), (wide[3], "bias"))
    )
    return b.add("Add", [b.add("Mul", [b.add("Sub", [x, centre]), width]), shift])


def standardise(b: Builder, x: str, axes: Sequence[int], epsilon: float) -> tuple[str, str, str]:
    """((x − mean)/√(variance + ε), mean, 1/√(variance + ε)), the statistics taken over ``axes``, which stay as 1."""
    mean = b.reduce("Mean", x, axes, keep=True)
    centred = b.add("Sub", [x, mean])
    variance = b.reduce("Mean", b.add("Square", [centred]), axes, keep=True)
    deviation = b.add("Sqrt", [b.add("Add", [variance, b.number(x, epsilon)])])
    return b.add("RealDiv", [centred, deviation]), mean, b.add("Reciprocal", [deviation])


def layer(b: Builder, x: str, axis: int, scale: str, bias: str | None, epsilon: float = 1e-5) -> tuple[str, str, str]:
    """Over the axes from ``axis`` on, times a scale that broadcasts to x, plus a bias; with mean and 1/deviation."""
    value, mean, inverse = standardise(b, x, range(axis, b.rank(x)), epsilon)
    value = b.add("Mul", [value, scale])
    return value if bias is None else b.add("Add", [value, bias]), mean, inverse


def rms(b: Builder, x: str, axis: int, scale: str, epsilon: float = 1e-5) -> str:
    """x/√(mean(x²) + ε)·scale over the axes from ``axis`` on."""
    mean = b.reduce("Mean", b.add("Square", [x]), range(axis, b.rank(x)), keep=True)
    deviation = b.add("Sqrt", [b.add("Add", [mean, b.number(x, epsilon)])])
    return b.add("Mul", [b.add("RealDiv", [x, deviation]), scale])


def instance(b: Builder, x: str, scale: str, bias: str, epsilon: float = 1e-5, *, channels: int = 1) -> str:
    """Each channel of each row over its own pixels; scale and bias are [C], as is the axis ``channels`` of x."""
    rank = b.rank(x)
    value, _, _ = standardise(b, x, [i for i in range(1, rank) if i != channels], epsilon)
    shape = [-1 if i == channels else 1 for i in range(rank)]
    factor, shift = (b.reshape(r, shape) if channels < rank - 1 else r for r in (scale, bias))
    return b.add("Add", [b.add("Mul", [value, factor]), shift])


def group(b: Builder, x: str, groups: int, scale: str, bias: str, epsilon: float = 1e-5) -> str:
    """Groups of channels of x [B, C, …], each over its own pixels; scale and bias are [C], or [groups]."""
    dims, channels = b.shape(x), b.length(x, 1)
    if groups < 1 or channels % groups:
        raise UnsupportedOpError(f"it has {groups} groups for {channels} channels", why="the model is damaged")
    value, _, _ = standardise(b, b.reshape(x, (dims[0], groups, -1)), [2], epsilon)
    per_group = b.length(scale, 0) != channels
    shape = (1, groups, 1) if per_group else (1, -1, *(1,) * (len(dims) - 2))
    factor, shift = (b.reshape(r, shape) for r in (scale, bias))
    if per_group:
        return b.reshape(b.add("Add", [b.add("Mul", [value, factor]), shift]), dims)
    return b.add("Add", [b.add("Mul", [b.reshape(value, dims), factor]), shift])


def local(b: Builder, x: str, size: int, alpha: float, beta: float, bias: float) -> str:
    """X/(bias + alpha/size·Σx²)^beta, the squares summed over ``size`` neighbouring channels of x [B, C, …]."""
    channels, axis = b.length(x, 1), 1
    b.room(channels * channels)
    number = np.arange(channels)
    away = number[:, None] - number[None, :]
    near = (away >= -((size - 1) // 2)) & (away <= size // 2)  # [channel that is summed, channel]
    squares = b.transpose(b.add("Square", [x]), [*(i for i in range(b.rank(x)) if i != axis), axis])
    total = matmul(b, squares, b.floats(near, "near"))
    total = b.transpose(total, [0, b.rank(x) - 1, *range(1, b.rank(x) - 1)])
    base = b.add("Add", [b.add("Mul", [total, b.number(x, alpha / size)]), b.number(x, bias)])
    return b.add("RealDiv", [x, b.add("Pow", [base, b.number(x, beta)])])


def unit_length(b: Builder, x: str, axis: int, power: int = 2) -> str:
    """X divided by its norm along an axis, the sum of |x| (``power`` 1) or the root of that of squares; zeros stay."""
    if power == 1:
        norm = b.reduce("Sum", b.add("Abs", [x]), [axis], keep=True)
    else:
        norm = b.add("Sqrt", [b.reduce("Sum", b.add("Square", [x]), [axis], keep=True)])
    nothing = b.cast(b.add("Equal", [norm, b.number(norm, 0)]), b.dtype(norm))
    return b.add("RealDiv", [x, b.add("Add", [norm, nothing])])
