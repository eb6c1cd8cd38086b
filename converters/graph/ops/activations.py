"""Activations of networks, alone and as a part of a product or convolution."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.barracuda import decompositions
from export_model.converters.graph.ops.barracuda import elementwise as nn
from export_model.converters.graph.ops.barracuda.base import Nn
from export_model.converters.graph.ops.barracuda.vocabulary import Activation
from export_model.converters.graph.ops.base import Attr, Lower, OnnxBuilder, OpDef, chain, plain, same_as
from export_model.converters.graph.ops.elementwise import T, smooth, unary, wide
from export_model.converters.graph.ops.litert import elementwise as litert
from export_model.converters.graph.ops.litert.base import Operator, builtin
from export_model.converters.graph.ops.loops import elementwise as loops
from export_model.converters.graph.ops.loops.base import Elementwise, simple
from export_model.converters.graph.ops.older import leaky_relu


def _sigmoid(x: np.ndarray) -> np.ndarray:
    small = np.exp(-np.abs(x))
    return np.asarray(np.where(x >= 0, 1.0, small) / (1 + small))


def _elu(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, np.expm1(np.minimum(x, 0.0)))


#: The slope below 0 and the scale, for which a network keeps its activations normal.
_SELU = 1.6732632423543772, 1.0507009873554805


def _selu(x: np.ndarray) -> np.ndarray:
    alpha, scale = _SELU
    return np.asarray(scale * np.where(x > 0, x, alpha * np.expm1(np.minimum(x, 0))))


def _clamp(name: str, function: Callable[..., np.ndarray], lower: str | Lower, **traits: Any) -> OpDef:
    return unary(name, plain(function), lower, precision="exact", tfjs_fuses=True, **traits)


def _leaky_relu(node: Node, x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, x * x.dtype.type(node.attrs["alpha"]))


OPS = (
    smooth(
        "Sigmoid",
        _sigmoid,
        activation="sigmoid",
        finite="always",
        tfjs_fuses=True,
        nn=nn.activation(Activation.SIGMOID),
        loops=Elementwise(loops.sigmoid),
        litert=builtin("LOGISTIC"),
    ),
    smooth(
        "Tanh",
        np.tanh,
        activation="tanh",
        finite="always",
        remapped="dense",
        nn=nn.activation(Activation.TANH),
        loops=simple("tanh"),
        litert=builtin("TANH"),
    ),
    _clamp(
        "Relu",
        lambda x: np.maximum(x, x.dtype.type(0)),
        "Relu",
        activation="relu",
        nn=nn.activation(Activation.RELU),
        loops=Elementwise(loops.relu),
        litert=Operator("RELU", applied=True),
    ),
    _clamp(
        "Relu6",
        lambda x: np.clip(x, x.dtype.type(0), x.dtype.type(6)),
        chain(("Max", 0.0), ("Min", 6.0)),
        activation="relu 6",
        remapped_behind="convolution",
        nn=nn.activation(Activation.RELU6),
        loops=Elementwise(loops.relu6),
        litert=Operator("RELU6", applied=True),
    ),
    smooth(
        "Elu",
        _elu,
        activation="elu",
        tfjs_fuses=True,
        nn=nn.activation(Activation.ELU),
        loops=Elementwise(loops.elu),
        litert=builtin("ELU"),
    ),
    smooth("Selu", _selu, activation="selu", nn=nn.selu(*_SELU), loops=Elementwise(loops.selu), litert=litert.selu),
    smooth(
        "Softplus",
        lambda x: np.maximum(x, 0) + np.log1p(np.exp(-np.abs(x))),
        activation="softplus",
        barracuda=decompositions.SOFTPLUS,
        loops=Elementwise(loops.softplus),
        litert=litert.softplus,
    ),
    unary(
        "Softsign",
        wide(lambda x: x / (1 + np.abs(x))),
        "Softsign",
        tfjs=decompositions.SOFTSIGN.write,  # TensorFlow.js 4.22 has none
        activation="softsign",
        barracuda=decompositions.SOFTSIGN,
        loops=Elementwise(loops.softsign),
        litert=litert.softsign,
    ),
    OpDef(
        "LeakyRelu",
        same_as(0),
        _leaky_relu,
        attrs=(T, Attr("alpha", "float", 0.20000000298023224)),
        older=leaky_relu,
        nn=Nn(nn.leaky_relu),
        activation="leaky relu",
        elementwise=True,
    ),
)

_BY_NAME = {op.name: op for op in OPS}
#: Activation → what it is in a ``.nn``, of those that every Barracuda has.
NN_KINDS = {op.name: op.nn.kind for op in OPS if op.nn is not None and isinstance(op.nn.kind, Activation)}
#: Activation → its operator in LiteRT, and its loops, of those that a fused op may carry there.
LITERT_OPERATORS = {op.name: op.litert for op in OPS if isinstance(op.litert, Operator)}
LOOPS = {op.name: op.loops for op in OPS if isinstance(op.loops, Elementwise)}
#: What a fused op has beside the attributes of the plain one.
FUSED = (Attr("num_args", "int", 1), Attr("fused_ops", "str"), Attr("epsilon", "float", 0.0001))


def apply_activations(node: Node, x: np.ndarray) -> np.ndarray:
    """A product and its bias, then the activations that the fused op carries."""
    for name in node.attrs["fused_ops"][1:]:
        kernel = _BY_NAME[name].kernel
        assert kernel is not None
        x = np.asarray(kernel(Node(name, name), x))
    return x


def lower_activated(node: Node, value: str, builder: OnnxBuilder) -> str:
    """``apply_activations`` in ONNX, which calls the activations as TensorFlow does but has no Relu6."""
    for name in node.attrs.get("fused_ops", ())[1:]:
        if name == "Relu6":
            low, high = (builder.const(np.array(bound, np.float32), "bound") for bound in (0, 6))
            value = builder.emit("Min", [builder.emit("Max", [value, low]), high])
        else:
            value = builder.emit(name, [value])
    return value
