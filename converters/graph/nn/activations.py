"""Activations: one number in, one number out. All take and give a float tensor of any shape.

Formulas: onnx/docs/Operators.md; Unity Barracuda's are the same (ReferenceCPUOps.cs), but where a function says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from export_model.converters.graph.builder import Builder

Activation = Callable[[Builder, str], str]
#: The constants of tf.nn.selu and torch.nn.SELU.
SELU_ALPHA, SELU_GAMMA = 1.67326319217681884765625, 1.05070102214813232421875
_CLOSE = 1e-6


def clip(b: Builder, x: str, low: float | str | None, high: float | str | None) -> str:
    """max(min(x, high), low), the bounds numbers or tensors that broadcast; None is no bound.

    With low above high the result is low, as in ONNX, tf.clip_by_value and Unity's Mathf.Clamp.
    """
    if high is not None:
        x = b.add("Minimum", [x, high if isinstance(high, str) else b.number(x, high)])
    if low is not None:
        x = b.add("Maximum", [x, low if isinstance(low, str) else b.number(x, low)])
    return x


def scale_and_shift(b: Builder, x: str, factor: float, shift: float = 0.0) -> str:
    """factor·x + shift; a factor of 1 and a shift of 0 are left out."""
    if factor != 1:
        x = b.add("Mul", [x, b.number(x, factor, "scale")])
    return x if shift == 0 else b.add("Add", [x, b.number(x, shift, "shift")])


def log_sigmoid(b: Builder, x: str) -> str:
    """−softplus(−x)."""
    return b.add("Neg", [b.add("Softplus", [b.add("Neg", [x])])])


# ------------------------------------------------------------------ bent lines


def leaky_relu(b: Builder, x: str, alpha: float) -> str:
    """Where x is below 0 alpha·x, else x, whatever alpha is (the op's expansion: ``passes/normalise.py``)."""
    return b.add("LeakyRelu", [x], alpha=alpha)


def prelu(b: Builder, x: str, slope: str) -> str:
    """max(x, 0) + slope·min(x, 0); the slopes broadcast to x."""
    below = b.add("Mul", [slope, b.add("Minimum", [x, b.number(x, 0)])])
    return b.add("Add", [b.add("Relu", [x]), below])


def thresholded_relu(b: Builder, x: str, alpha: float = 1.0) -> str:
    """Where x is above alpha x, else 0."""
    return b.add("Select", [b.add("Greater", [x, b.number(x, alpha)]), x, b.add("ZerosLike", [x])])


def hard_sigmoid(b: Builder, x: str, alpha: float = 0.2, beta: float = 0.5) -> str:
    """clip(alpha·x + beta, 0, 1)."""
    line = b.add("Add", [b.add("Mul", [x, b.number(x, alpha)]), b.number(x, beta)])
    return clip(b, line, 0, 1)


def hard_swish(b: Builder, x: str) -> str:
    """x·hard_sigmoid(x) with alpha 1/6 and beta 1/2."""
    return b.add("Mul", [x, hard_sigmoid(b, x, 1 / 6, 0.5)])


# ------------------------------------------------------------------ exponential units


def elu(b: Builder, x: str, alpha: float = 1.0) -> str:
    """Where x is below 0 alpha·(eˣ − 1), else x."""
    return b.add("Elu", [x]) if alpha == 1 else _elu(b, x, alpha, 1)


def celu(b: Builder, x: str, alpha: float = 1.0) -> str:
    """Where x is below 0 alpha·(e^(x/alpha) − 1), else x."""
    return b.add("Elu", [x]) if alpha == 1 else _elu(b, x, alpha, alpha)


def selu(b: Builder, x: str, alpha: float = SELU_ALPHA, gamma: float = SELU_GAMMA) -> str:
    """gamma·elu(x, alpha)."""
    if abs(alpha - SELU_ALPHA) < _CLOSE and abs(gamma - SELU_GAMMA) < _CLOSE:
        return b.add("Selu", [x])
    return b.add("Mul", [b.number(x, gamma), _elu(b, x, alpha, 1)])


def _elu(b: Builder, x: str, alpha: float, inner: float) -> str:
    """max(x, 0) + alpha·(exp(min(x, 0)/inner) − 1): one of the two is 0."""
    low = b.add("Minimum", [x, b.number(x, 0)])
    if inner != 1:
        low = b.add("RealDiv", [low, b.number(x, inner)])
    return b.add("Add", [b.add("Relu", [x]), b.add("Mul", [b.number(x, alpha), b.add("Elu", [low])])])


# ------------------------------------------------------------------ smooth gates


def swish(b: Builder, x: str, alpha: float = 1.0) -> str:
    """x·sigmoid(alpha·x); SiLU where alpha is 1."""
    inner = x if alpha == 1 else b.add("Mul", [x, b.number(x, alpha)])
    return b.add("Mul", [x, b.add("Sigmoid", [inner])])


def mish(b: Builder, x: str) -> str:
    """x·tanh(softplus(x))."""
    return b.add("Mul", [x, b.add("Tanh", [b.add("Softplus", [x])])])


def gelu(b: Builder, x: str, *, tanh: bool = False) -> str:
    """x·Φ(x) by erf, or its approximation by tanh."""
    half = b.add("Mul", [x, b.number(x, 0.5)])
    if tanh:
        cube = b.add("Mul", [b.add("Mul", [x, x]), b.add("Mul", [x, b.number(x, 0.044715)])])
        inner = b.add("Mul", [b.add("Add", [x, cube]), b.number(x, math.sqrt(2 / math.pi))])
        bell = b.add("Tanh", [inner])
    else:
        bell = b.add("Erf", [b.add("Mul", [x, b.number(x, math.sqrt(0.5))])])
    return b.add("Mul", [half, b.add("Add", [bell, b.number(x, 1)])])


# ------------------------------------------------------------------ by name


def of_op(op: str) -> Activation:
    """The one that is an op itself."""
    return lambda b, x: b.add(op, [x])


#: What Keras and PyTorch call alike.
NAMED: Mapping[str, Activation] = {
    "relu": of_op("Relu"),
    "tanh": of_op("Tanh"),
    "sigmoid": of_op("Sigmoid"),
    "softplus": of_op("Softplus"),
    "softsign": of_op("Softsign"),
    "elu": elu,
    "selu": selu,
    "celu": celu,
    "gelu": gelu,
    "silu": swish,
    "swish": swish,
    "mish": mish,
}
