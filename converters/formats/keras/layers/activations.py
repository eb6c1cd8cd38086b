"""Keras' activations, by their names, and the layers that are one.

Formulas: keras/src/activations/activations.py; the hard sigmoid changed its slope with Keras 3.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from export_model.converters.formats.keras.layers.step import Step, Translate
from export_model.converters.formats.keras.model import layer_of
from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn import activations as nn
from export_model.converters.graph.nn.activations import Activation
from export_model.converters.graph.nn.reduction import over_last_axis
from export_model.signatures.errors import UnsupportedOpError


def _softmax(op: str) -> Activation:
    return lambda b, x: over_last_axis(b, op, x)


def _squareplus(b: Builder, x: str) -> str:
    root = b.add("Sqrt", [b.add("Add", [b.add("Square", [x]), b.number(x, 4)])])
    return nn.scale_and_shift(b, b.add("Add", [x, root]), 0.5)


def _sparse_plus(b: Builder, x: str) -> str:
    """(x + 1)²/4 between −1 and 1, where it leaves 0 and meets x."""
    bend = b.add("Square", [b.add("Add", [nn.clip(b, x, -1, 1), b.number(x, 1)])])
    above = b.add("Relu", [b.add("Sub", [x, b.number(x, 1)])])
    return b.add("Add", [nn.scale_and_shift(b, bend, 0.25), above])


def _outside(b: Builder, x: str, inside: Callable[[str], str]) -> str:
    """X where |x| is above a half, as ``inside`` says there; else 0."""
    far = b.add("Greater", [b.add("Abs", [x]), b.number(x, 0.5)])
    return b.add("Select", [far, inside(x), b.add("ZerosLike", [x])])


def _glu(b: Builder, x: str) -> str:
    half = b.length(x, -1) // 2
    axis = b.rank(x) - 1
    return b.add("Mul", [b.slice(x, axis, 0, half), b.add("Sigmoid", [b.slice(x, axis, half, None)])])


_OLD_HARD_SIGMOID: Activation = lambda b, x: nn.hard_sigmoid(b, x, 0.2, 0.5)  # noqa: E731
_ACTIVATIONS: Mapping[str, Activation] = {
    **nn.NAMED,
    "linear": lambda b, x: x,
    "relu6": nn.of_op("Relu6"),
    "exponential": nn.of_op("Exp"),
    "gelu_new": lambda b, x: nn.gelu(b, x, tanh=True),
    "leaky_relu": lambda b, x: nn.leaky_relu(b, x, 0.2),
    "hard_sigmoid": lambda b, x: nn.hard_sigmoid(b, x, 1 / 6, 0.5),
    "hard_swish": nn.hard_swish,
    "hard_silu": nn.hard_swish,
    "hard_tanh": lambda b, x: nn.clip(b, x, -1, 1),
    "softmax": _softmax("Softmax"),
    "log_softmax": _softmax("LogSoftmax"),
    "log_sigmoid": nn.log_sigmoid,
    "squareplus": _squareplus,
    "sparse_plus": _sparse_plus,
    "sparse_sigmoid": lambda b, x: nn.hard_sigmoid(b, x, 0.5, 0.5),
    "tanh_shrink": lambda b, x: b.add("Sub", [x, b.add("Tanh", [x])]),
    "hard_shrink": lambda b, x: _outside(b, x, lambda inner: inner),
    "soft_shrink": lambda b, x: b.add("Sub", [x, nn.clip(b, x, -0.5, 0.5)]),
    "glu": _glu,
}


def activation_of(step: Step, spec: Any) -> Activation:
    """The activation that a setting says: a name, or a layer. Raises UnsupportedOpError for any other function."""
    if spec is None:
        return _ACTIVATIONS["linear"]
    if isinstance(spec, Mapping):
        inner = layer_of(spec)
        if inner.kind not in LAYERS:
            raise UnsupportedOpError(f"its activation is {(inner.name or inner.kind)[:80]!r}, a custom function")
        return lambda b, x: str(LAYERS[inner.kind](step.inner(inner, [x], ())))
    name = {"logSoftmax": "log_softmax", "hardSigmoid": "hard_sigmoid"}.get(spec, spec)
    if name == "hard_sigmoid" and not step.is_keras_3:
        return _OLD_HARD_SIGMOID
    if name not in _ACTIVATIONS:
        raise UnsupportedOpError(f"its activation is {str(spec)[:80]!r}, which is not known")
    return _ACTIVATIONS[name]


def apply_activation(step: Step, value: str, key: str = "activation") -> str:
    """``value`` behind the layer's activation."""
    return activation_of(step, step.get(key))(step.net, value)


# ------------------------------------------------------------------ layers


def _relu(step: Step) -> str:
    """max_value, negative_slope and threshold: up to the threshold the slope times the distance to it."""
    b, x = step.net, step.x
    top, slope, threshold = (float(_scalar(step.get(k)) or 0) for k in ("max_value", "negative_slope", "threshold"))
    if threshold:
        over = b.add("Greater", [x, b.number(x, threshold)])
        below = nn.scale_and_shift(b, x, slope, -slope * threshold) if slope else b.add("ZerosLike", [x])
        value = b.add("Select", [over, x, below])
    else:
        value = nn.leaky_relu(b, x, slope) if slope else b.add("Relu", [x])
    return nn.clip(b, value, None, top) if step.get("max_value") is not None else value


def _scalar(value: Any) -> Any:
    """A number that Keras 2 may have written as an array of its own."""
    return value["value"] if isinstance(value, Mapping) else value


def _slope(step: Step, *keys: str, default: float) -> float:
    found = next((step.get(k) for k in keys if step.get(k) is not None), default)
    return float(_scalar(found))


def _prelu(step: Step) -> str:
    b, x = step.net, step.x
    shared = [int(a) for a in step.get("shared_axes") or ()]
    shape = [1 if i in shared else b.length(x, i) for i in range(1, b.rank(x))]
    return nn.prelu(b, x, b.const(step.take(*shape)[None], "alpha"))


def _softmax_layer(step: Step) -> str:
    axis = step.get("axis", -1)
    if isinstance(axis, Sequence):
        if len(axis) != 1:
            raise UnsupportedOpError("its softmax is over several axes")
        (axis,) = axis
    if len(step.tensors) > 1 or step.kwargs.get("mask") is not None:
        raise UnsupportedOpError("it is given a mask")
    return softmax(step.net, step.x, int(axis))


def softmax(b: Builder, x: str, axis: int, op: str = "Softmax") -> str:
    """Softmax over any axis."""
    axis, last = b.axis(x, axis), b.rank(x) - 1
    order = [last if i == axis else axis if i == last else i for i in range(last + 1)]
    return b.transpose(over_last_axis(b, op, b.transpose(x, order)), order)


LAYERS: Mapping[str, Translate] = {
    "Activation": lambda s: apply_activation(s, s.x),
    "ReLU": _relu,
    "LeakyReLU": lambda s: nn.leaky_relu(s.net, s.x, _slope(s, "negative_slope", "alpha", default=0.3)),
    "ELU": lambda s: nn.elu(s.net, s.x, _slope(s, "alpha", default=1.0)),
    "ThresholdedReLU": lambda s: nn.thresholded_relu(s.net, s.x, _slope(s, "theta", default=1.0)),
    "PReLU": _prelu,
    "Softmax": _softmax_layer,
}
