"""Elementwise ONNX ops: arithmetic, activations, comparisons, casts.

Definitions: onnx/docs/Operators.md; what changed between opsets stands at each function.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from converters.onnx.importer.importer import Raiser
from converters.onnx.importer.node import Op, Raise

#: Ops that mean the same under another name, and take the same inputs.
_SAME = {
    **{name: name for name in ("Neg", "Abs", "Sign", "Reciprocal", "Floor", "Ceil", "Round", "Exp", "Log", "Sqrt")},
    **{name: name for name in ("Sin", "Cos", "Tan", "Erf", "Sigmoid", "Tanh", "Relu", "Softplus", "Softsign")},
    **{name: name for name in ("Sub", "Mul", "Less", "Greater", "Equal")},
    "Not": "LogicalNot",
    "And": "LogicalAnd",
    "Or": "LogicalOr",
    "Xor": "NotEqual",
    "LessOrEqual": "LessEqual",
    "GreaterOrEqual": "GreaterEqual",
}
#: Ops of any number of operands.
_FOLDED = {"Max": "Maximum", "Min": "Minimum", "Sum": "Add", "Mean": "Add"}
_SELU_ALPHA, _SELU_GAMMA = 1.67326319217681884765625, 1.05070102214813232421875
_CLOSE = 1e-6


def _same(kind: str) -> Raise:
    def function(op: Op, r: Raiser) -> str:
        return r.add(kind, [op.need(i) for i in range(len(op.inputs))])

    return function


def _folded(op: Op, r: Raiser) -> str:
    value = op.need(0)
    for position in range(1, len(op.inputs)):
        value = r.add(_FOLDED[op.kind], [value, op.need(position)])
    return r.add("RealDiv", [value, r.number(value, len(op.inputs))]) if op.kind == "Mean" else value


def _identity(op: Op, r: Raiser) -> str:
    return op.need(0)


def _add(op: Op, r: Raiser) -> str:
    """A vector added to a product is a bias: the targets fuse it."""
    for x, bias in ((op.need(0), op.need(1)), (op.need(1), op.need(0))):
        if is_bias(r, x, bias):
            return r.add("BiasAdd", [x, bias])
    return r.add("Add", [op.need(0), op.need(1)])


def is_bias(r: Raiser, x: str, bias: str) -> bool:
    """Whether ``bias`` is a constant vector as long as the last axis of ``x``, which is a product."""
    value, shape = r.constant(bias), r.type_of(x).shape
    if value is None or value.ndim != 1 or not shape or len(shape) < 2 or not r.is_float(x):
        return False
    return shape[-1] == value.shape[0] and r.producer(x).op in ("MatMul", "Conv2D", "DepthwiseConv2dNative")


def _div(op: Op, r: Raiser) -> str:
    """Integers are divided towards zero."""
    a, b = op.need(0), op.need(1)
    if r.is_float(a):
        return r.add("RealDiv", [a, b])
    whole = r.add("FloorDiv", [r.add("Abs", [a]), r.add("Abs", [b])])
    return r.add("Mul", [r.add("Mul", [r.add("Sign", [a]), r.add("Sign", [b])]), whole])


def _mod(op: Op, r: Raiser) -> str:
    """``fmod`` 0 (integers): the sign of the divisor; 1: that of the dividend, as C's fmod."""
    a, b = op.need(0), op.need(1)
    if not op.integer("fmod", 0):
        return r.add("FloorMod", [a, b])
    return r.add("Mul", [r.add("Sign", [a]), r.add("FloorMod", [r.add("Abs", [a]), r.add("Abs", [b])])])


def _pow(op: Op, r: Raiser) -> str:
    """The exponent may have another dtype (opset 12). Squares and roots have ops of their own, which round once."""
    base, exponent = op.need(0), op.need(1)
    value = r.constant(exponent)
    if value is not None and value.size == 1 and r.is_float(base) and value.ndim <= (r.type_of(base).rank or 0):
        simple = {2.0: "Square", 0.5: "Sqrt"}.get(float(value.reshape(())))
        if simple is not None:
            return r.add(simple, [base])
    return r.add("Pow", [base, r.cast(exponent, r.dtype(base))])


def _clip(op: Op, r: Raiser) -> str:
    """Bounds are attributes before opset 11, optional inputs from there on."""
    x = op.need(0)
    if op.opset < 11:
        low, high = (r.number(x, op.number(k, 0), k) if k in op.attrs else None for k in ("min", "max"))
    else:
        low, high = op.get(1), op.get(2)
    if high is not None:
        x = r.add("Minimum", [x, high])
    return x if low is None else r.add("Maximum", [x, low])


def _cast(op: Op, r: Raiser) -> str:
    return r.cast(op.need(0), op.dtype("to", 0))


def _cast_like(op: Op, r: Raiser) -> str:
    return r.cast(op.need(0), r.dtype(op.need(1)))


def _where(op: Op, r: Raiser) -> str:
    return r.where(op, op.need(0), op.need(1), op.need(2))


def _is_nan(op: Op, r: Raiser) -> str:
    return r.add("NotEqual", [op.need(0), op.need(0)])


def _is_inf(op: Op, r: Raiser) -> str:
    x = op.need(0)
    found = [s for s, k in ((1, "detect_positive"), (-1, "detect_negative")) if op.integer(k, 1)]
    if len(found) == 2:
        return r.add("Equal", [r.add("Abs", [x]), r.number(x, np.inf)])
    if not found:
        return r.add("LogicalAnd", [r.add("Equal", [x, x]), r.add("NotEqual", [x, x])])
    return r.add("Equal", [x, r.number(x, found[0] * np.inf)])


# ------------------------------------------------------------------ activations


def _scaled_elu(r: Raiser, x: str, alpha: float, inner: float = 1.0) -> str:
    """max(x, 0) + alpha·(exp(min(x, 0)/inner) − 1)."""
    low = r.add("Minimum", [x, r.number(x, 0)])
    if inner != 1:
        low = r.add("RealDiv", [low, r.number(x, inner)])
    return r.add("Add", [r.add("Relu", [x]), r.add("Mul", [r.number(x, alpha), r.add("Elu", [low])])])


def _elu(op: Op, r: Raiser) -> str:
    alpha = op.number("alpha", 1.0)
    return r.add("Elu", [op.need(0)]) if alpha == 1 else _scaled_elu(r, op.need(0), alpha)


def _celu(op: Op, r: Raiser) -> str:
    alpha = op.number("alpha", 1.0)
    return r.add("Elu", [op.need(0)]) if alpha == 1 else _scaled_elu(r, op.need(0), alpha, alpha)


def _selu(op: Op, r: Raiser) -> str:
    alpha, gamma = op.number("alpha", _SELU_ALPHA), op.number("gamma", _SELU_GAMMA)
    x = op.need(0)
    if abs(alpha - _SELU_ALPHA) < _CLOSE and abs(gamma - _SELU_GAMMA) < _CLOSE:
        return r.add("Selu", [x])
    return r.add("Mul", [r.number(x, gamma), _scaled_elu(r, x, alpha)])


def _leaky_relu(op: Op, r: Raiser) -> str:
    return r.add("LeakyRelu", [op.need(0)], alpha=op.number("alpha", 0.01))


def _prelu(op: Op, r: Raiser) -> str:
    """The slope is a tensor that broadcasts to x."""
    x = op.need(0)
    low = r.add("Mul", [op.need(1), r.add("Minimum", [x, r.number(x, 0)])])
    return r.add("Add", [r.add("Relu", [x]), low])


def _thresholded_relu(op: Op, r: Raiser) -> str:
    x = op.need(0)
    above = r.add("Greater", [x, r.number(x, op.number("alpha", 1.0))])
    return r.add("Select", [above, x, r.add("ZerosLike", [x])])


def _between_zero_and_one(r: Raiser, x: str, slope: float, shift: float) -> str:
    """clip(slope·x + shift, 0, 1)."""
    line = r.add("Add", [r.add("Mul", [x, r.number(x, slope)]), r.number(x, shift)])
    return r.add("Maximum", [r.add("Minimum", [line, r.number(x, 1)]), r.number(x, 0)])


def _hard_sigmoid(op: Op, r: Raiser) -> str:
    return _between_zero_and_one(r, op.need(0), op.number("alpha", 0.2), op.number("beta", 0.5))


def _hard_swish(op: Op, r: Raiser) -> str:
    return r.add("Mul", [op.need(0), _between_zero_and_one(r, op.need(0), 1 / 6, 0.5)])


def _swish(op: Op, r: Raiser) -> str:
    x, alpha = op.need(0), op.number("alpha", 1.0)
    inner = x if alpha == 1 else r.add("Mul", [x, r.number(x, alpha)])
    return r.add("Mul", [x, r.add("Sigmoid", [inner])])


def _mish(op: Op, r: Raiser) -> str:
    return r.add("Mul", [op.need(0), r.add("Tanh", [r.add("Softplus", [op.need(0)])])])


def _gelu(op: Op, r: Raiser) -> str:
    """x·Φ(x), or its approximation by tanh."""
    x = op.need(0)
    half = r.add("Mul", [x, r.number(x, 0.5)])
    if op.text("approximate", "none") == "tanh":
        cube = r.add("Mul", [r.add("Mul", [x, x]), r.add("Mul", [x, r.number(x, 0.044715)])])
        inner = r.add("Mul", [r.add("Add", [x, cube]), r.number(x, np.sqrt(2 / np.pi))])
        bell = r.add("Tanh", [inner])
    else:
        bell = r.add("Erf", [r.add("Mul", [x, r.number(x, np.sqrt(0.5))])])
    return r.add("Mul", [half, r.add("Add", [bell, r.number(x, 1)])])


def _dropout(op: Op, r: Raiser) -> list[str | None]:
    """Inference: the input itself. From opset 12 on training is an input; a policy that drops at random is none."""
    mode = op.get(2)
    if mode is not None:
        value = r.known(mode)
        if value is None or bool(value.reshape(-1)[0]):
            raise op.refused(
                "it is in training mode", "its output would be random", "call model.eval() before the export"
            )
    return [op.need(0), None]


OPS: Mapping[str, Raise] = {
    **{kind: _same(name) for kind, name in _SAME.items()},
    **dict.fromkeys(_FOLDED, _folded),
    "Identity": _identity,
    "Dropout": _dropout,
    "Add": _add,
    "Div": _div,
    "Mod": _mod,
    "Pow": _pow,
    "Clip": _clip,
    "Cast": _cast,
    "CastLike": _cast_like,
    "Where": _where,
    "IsNaN": _is_nan,
    "IsInf": _is_inf,
    "Elu": _elu,
    "Celu": _celu,
    "Selu": _selu,
    "LeakyRelu": _leaky_relu,
    "PRelu": _prelu,
    "ThresholdedRelu": _thresholded_relu,
    "HardSigmoid": _hard_sigmoid,
    "HardSwish": _hard_swish,
    "Swish": _swish,
    "Mish": _mish,
    "Gelu": _gelu,
}
