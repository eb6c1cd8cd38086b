"""Arithmetic, activations, comparisons, casts (tensorflow/lite/kernels of TensorFlow 2.21)."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from export_model.converters.formats.litert.importer.importer import LiteRTImporter
from export_model.converters.formats.litert.importer.operator import LiteRTOp, Translate
from export_model.converters.formats.litert.schema import ACTIVATIONS
from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn import activations as nn
from export_model.converters.graph.nn.normalisation import unit_length
from export_model.converters.graph.ops.litert.base import Operator
from export_model.converters.graph.ops.table import TABLE

#: Operators that take what the op takes, and mean the same: those that its entry is written as, and those that it is
#: written without.
_SAME = {
    **{e.litert.op: op for op, e in TABLE.items() if isinstance(e.litert, Operator) and not e.litert.options},
    "ADD_N": "AddN",
    "FLOOR_DIV": "FloorDiv",
    "SQUARE": "Square",
    "SQUARED_DIFFERENCE": "SquaredDifference",
    "ZEROS_LIKE": "ZerosLike",
}
#: Those that may apply an activation to their result.
_ARITHMETIC = {"ADD": "Add", "SUB": "Sub", "MUL": "Mul", "DIV": "RealDiv"}
_NAMES = {number: name for name, number in ACTIVATIONS.items()}
_APPLIED: Mapping[str, Callable[[Builder, str], str]] = {
    "RELU": nn.of_op("Relu"),
    "RELU6": nn.of_op("Relu6"),
    "TANH": nn.of_op("Tanh"),
    "RELU_N1_TO_1": lambda b, x: nn.clip(b, x, -1.0, 1.0),
}


def add_activation(op: LiteRTOp, net: LiteRTImporter, value: str) -> str:
    """A result with the activation that the operator is told to apply. Raises UnsupportedOpError."""
    number = op.integer("activation")
    if not number:
        return value
    if _NAMES.get(number) not in _APPLIED:
        raise op.refusal(f"it applies the activation {number}, which is not read")
    return _APPLIED[_NAMES[number]](net, value)


def _same(kind: str) -> Translate:
    return lambda op, net: net.add(kind, op.operands())


def _arithmetic(kind: str) -> Translate:
    return lambda op, net: add_activation(op, net, net.add(kind, op.operands()))


def _plain(function: Callable[[Builder, str], str]) -> Translate:
    return lambda op, net: function(net, op.need(0))


def _cast(op: LiteRTOp, net: LiteRTImporter) -> str:
    return net.add("Cast", [op.need(0)], DstT=op.dtypes[0])


def _softmax(op: LiteRTOp, net: LiteRTImporter) -> str:
    """Over the last axis; ``beta`` is a factor in front, 1 in every model that TensorFlow's converter makes."""
    return net.add("Softmax", [nn.scale_and_shift(net, op.need(0), op.number("beta"))])


def _leaky_relu(op: LiteRTOp, net: LiteRTImporter) -> str:
    return nn.leaky_relu(net, op.need(0), op.number("alpha"))


def _prelu(op: LiteRTOp, net: LiteRTImporter) -> str:
    return nn.prelu(net, op.need(0), op.need(1))


def _gelu(op: LiteRTOp, net: LiteRTImporter) -> str:
    return nn.gelu(net, op.need(0), tanh=op.flag("approximate"))


def _unit_length(op: LiteRTOp, net: LiteRTImporter) -> str:
    return add_activation(op, net, unit_length(net, op.need(0), net.rank(op.need(0)) - 1))


def _select(op: LiteRTOp, net: LiteRTImporter) -> str:
    """SELECT takes operands of one shape, and rows by a vector."""
    return net.add("Select", op.operands())


def _select_v2(op: LiteRTOp, net: LiteRTImporter) -> str:
    return net.where(*op.operands())


def _full(op: LiteRTOp, net: LiteRTImporter) -> str:
    return net.add("Fill", [net.shape_operand(op.need(0)), op.need(1)])


OPS: Mapping[str, Translate] = {
    **{kind: _same(op) for kind, op in _SAME.items()},
    **{kind: _arithmetic(op) for kind, op in _ARITHMETIC.items()},
    "CAST": _cast,
    "FILL": _full,
    "GELU": _gelu,
    "HARD_SWISH": _plain(nn.hard_swish),
    "L2_NORMALIZATION": _unit_length,
    "LEAKY_RELU": _leaky_relu,
    "PRELU": _prelu,
    "RELU_0_TO_1": _plain(lambda b, x: nn.clip(b, x, 0.0, 1.0)),
    "RELU_N1_TO_1": _plain(_APPLIED["RELU_N1_TO_1"]),
    "SELECT": _select,
    "SELECT_V2": _select_v2,
    "SOFTMAX": _softmax,
}
