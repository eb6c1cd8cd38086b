"""Elementwise ONNX ops: arithmetic, activations, comparisons, casts.

Definitions: onnx/docs/Operators.md; what changed between opsets stands at each function.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from export_model.converters.formats.onnx.importer.importer import Importer
from export_model.converters.formats.onnx.importer.node import Op, Translate
from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn import activations as nn
from export_model.converters.graph.nn import trigonometry
from export_model.converters.graph.ops.table import op_of

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


def _same(kind: str) -> Translate:
    def function(op: Op, net: Importer) -> str:
        return net.add(kind, [op.need(i) for i in range(len(op.inputs))])

    return function


def _fold_operands(op: Op, net: Importer) -> str:
    value = op.need(0)
    for position in range(1, len(op.inputs)):
        value = net.add(_FOLDED[op.kind], [value, op.need(position)])
    return net.add("RealDiv", [value, net.number(value, len(op.inputs))]) if op.kind == "Mean" else value


def _identity(op: Op, net: Importer) -> str:
    return op.need(0)


def _add(op: Op, net: Importer) -> str:
    """A vector added to a product is a bias: the targets fuse it."""
    for x, bias in ((op.need(0), op.need(1)), (op.need(1), op.need(0))):
        if is_bias(net, x, bias):
            return net.add("BiasAdd", [x, bias])
    return net.add("Add", [op.need(0), op.need(1)])


def is_bias(net: Importer, x: str, bias: str) -> bool:
    """Whether ``bias`` is a constant vector as long as the last axis of ``x``, which is a product."""
    value, shape = net.constant(bias), net.type_of(x).shape
    if value is None or value.ndim != 1 or not shape or len(shape) < 2 or not net.is_float(x):
        return False
    layer = op_of(net.producer(x)).layer
    product = layer == "convolution" or (layer == "dense" and len(shape) == 2)
    return product and shape[-1] == value.shape[0]


def _div(op: Op, net: Importer) -> str:
    """Integers are divided towards zero."""
    a, b = op.need(0), op.need(1)
    if net.is_float(a):
        return net.add("RealDiv", [a, b])
    whole = net.add("FloorDiv", [net.add("Abs", [a]), net.add("Abs", [b])])
    return net.add("Mul", [net.add("Mul", [net.add("Sign", [a]), net.add("Sign", [b])]), whole])


def _mod(op: Op, net: Importer) -> str:
    """``fmod`` 0 (integers): the sign of the divisor; 1: that of the dividend, as C's fmod."""
    a, b = op.need(0), op.need(1)
    if not op.integer("fmod", 0):
        return net.add("FloorMod", [a, b])
    return net.add("Mul", [net.add("Sign", [a]), net.add("FloorMod", [net.add("Abs", [a]), net.add("Abs", [b])])])


def _pow(op: Op, net: Importer) -> str:
    """The exponent may have another dtype (opset 12). Squares and roots have ops of their own, which round once."""
    base, exponent = op.need(0), op.need(1)
    value = net.constant(exponent)
    if value is not None and value.size == 1 and net.is_float(base) and value.ndim <= (net.type_of(base).rank or 0):
        simple = {2.0: "Square", 0.5: "Sqrt"}.get(float(value.reshape(())))
        if simple is not None:
            return net.add(simple, [base])
    return net.add("Pow", [base, net.cast(exponent, net.dtype(base))])


def _clip(op: Op, net: Importer) -> str:
    """Bounds are attributes before opset 11, optional inputs from there on."""
    x = op.need(0)
    if op.opset < 11:
        low, high = (net.number(x, op.number(k, 0), k) if k in op.attrs else None for k in ("min", "max"))
    else:
        low, high = op.get(1), op.get(2)
    if low is not None and high is not None:
        least, most = net.constant(low), net.constant(high)
        if least is None or most is None or (least > most).any():
            return net.add(
                "Minimum", [net.add("Maximum", [x, low]), high]
            )  # where they cross, ONNX gives the upper one
    return nn.clip(net, x, low, high)


def _cast(op: Op, net: Importer) -> str:
    return net.cast(op.need(0), op.dtype("to", 0))


def _is_inf(op: Op, net: Importer) -> str:
    x = op.need(0)
    found = [s for s, k in ((1, "detect_positive"), (-1, "detect_negative")) if op.integer(k, 1)]
    if len(found) == 2:
        return net.add("Equal", [net.add("Abs", [x]), net.number(x, np.inf)])
    if not found:
        return net.add("LogicalAnd", [net.add("Equal", [x, x]), net.add("NotEqual", [x, x])])
    return net.add("Equal", [x, net.number(x, found[0] * np.inf)])


# ------------------------------------------------------------------ activations


def _plain(function: Callable[[Builder, str], str]) -> Translate:
    return lambda op, net: function(net, op.need(0))


def _with(function: Callable[..., str], **defaults: float) -> Translate:
    """A layer whose parameters are the node's attributes of the same names."""
    return lambda op, net: function(net, op.need(0), **{k: op.number(k, v) for k, v in defaults.items()})


def _prelu(op: Op, net: Importer) -> str:
    return nn.prelu(net, op.need(0), op.need(1))


def _shrink(op: Op, net: Importer) -> str:
    """X moved towards 0 by ``bias`` where it is farther from it than ``lambd``, else 0."""
    x, bias, bound = op.need(0), op.number("bias", 0.0), op.number("lambd", 0.5)
    zero = net.number(x, 0)
    up = net.where(net.add("Less", [x, net.number(x, -bound)]), net.add("Add", [x, net.number(x, bias)]), zero)
    down = net.where(net.add("Greater", [x, net.number(x, bound)]), net.add("Sub", [x, net.number(x, bias)]), zero)
    return net.add("Add", [up, down])


def _dropout(op: Op, net: Importer) -> list[str | None]:
    """Inference: the input itself. From opset 12 on training is an input; a policy that drops at random is none."""
    mode = op.get(2)
    if mode is not None:
        value = net.constant_of(mode)
        if value is None or bool(value.reshape(-1)[0]):
            raise op.op_error(
                "it is in training mode", "its output would be random", "call model.eval() before the export"
            )
    return [op.need(0), None]


OPS: Mapping[str, Translate] = {
    **{kind: _same(name) for kind, name in _SAME.items()},
    **dict.fromkeys(_FOLDED, _fold_operands),
    "Identity": _identity,
    "Dropout": _dropout,
    "Add": _add,
    "Div": _div,
    "Mod": _mod,
    "Pow": _pow,
    "Clip": _clip,
    "Cast": _cast,
    "CastLike": lambda op, net: net.cast(op.need(0), net.dtype(op.need(1))),
    "Where": lambda op, net: net.where(op.need(0), op.need(1), op.need(2)),
    "IsNaN": lambda op, net: net.add("NotEqual", [op.need(0), op.need(0)]),
    "IsInf": _is_inf,
    "Elu": _with(nn.elu, alpha=1.0),
    "Celu": _with(nn.celu, alpha=1.0),
    "Selu": _with(nn.selu, alpha=nn.SELU_ALPHA, gamma=nn.SELU_GAMMA),
    "LeakyRelu": _with(nn.leaky_relu, alpha=0.01),
    "PRelu": _prelu,
    "ThresholdedRelu": _with(nn.thresholded_relu, alpha=1.0),
    "HardSigmoid": _with(nn.hard_sigmoid, alpha=0.2, beta=0.5),
    "HardSwish": _plain(nn.hard_swish),
    "Swish": _with(nn.swish, alpha=1.0),
    "Mish": _plain(nn.mish),
    "Gelu": lambda op, net: nn.gelu(net, op.need(0), tanh=op.text("approximate", "none") == "tanh"),
    "Shrink": _shrink,
    "Sinh": _plain(trigonometry.sinh),
    "Cosh": _plain(trigonometry.cosh),
    "Asin": _plain(trigonometry.asin),
    "Acos": _plain(trigonometry.acos),
    "Atan": _plain(trigonometry.atan),
    "Asinh": _plain(trigonometry.asinh),
    "Acosh": _plain(trigonometry.acosh),
    "Atanh": _plain(trigonometry.atanh),
}
