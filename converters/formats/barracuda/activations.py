"""Activations: which op or layer stands for which number, and the three that look at a whole row."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from export_model.converters.formats.barracuda.layer_builder import LayerBuilder, NnValue
from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn import activations as nn
from export_model.converters.graph.nn import reduction, trigonometry
from export_model.converters.graph.ops.barracuda.vocabulary import Activation, activation_label
from export_model.converters.graph.ops.table import TABLE

#: Activations that are one op: those that its entry is written as, and those that Barracuda lacks before 1.4 or rounds
#: another way, which are read alone.
_ONE_OP: Mapping[int, str] = {
    **{e.nn.kind: op for op, e in TABLE.items() if e.nn is not None and isinstance(e.nn.kind, Activation)},
    Activation.SOFTPLUS: "Softplus",
    Activation.SOFTSIGN: "Softsign",
    Activation.ROUND: "Round",
    Activation.COS: "Cos",
    Activation.SIN: "Sin",
    Activation.TAN: "Tan",
    Activation.ERF: "Erf",
}
_FUNCTIONS: Mapping[int, Callable[[Builder, str], str]] = {
    Activation.SWISH: nn.swish,
    Activation.ACOS: trigonometry.acos,
    Activation.ACOSH: trigonometry.acosh,
    Activation.ASIN: trigonometry.asin,
    Activation.ASINH: trigonometry.asinh,
    Activation.ATAN: trigonometry.atan,
    Activation.ATANH: trigonometry.atanh,
    Activation.COSH: trigonometry.cosh,
    Activation.SINH: trigonometry.sinh,
}
#: Activations that read ``alpha`` and ``beta``, in that order; Unity drops them where the activation is fused into
#: another layer.
_PARAMETRIC: Mapping[int, Callable[[Builder, str, float, float], str]] = {
    Activation.LEAKY_RELU: lambda b, x, alpha, beta: nn.leaky_relu(b, x, alpha),
    Activation.SELU: nn.selu,
    Activation.HARD_SIGMOID: nn.hard_sigmoid,
    Activation.CLIP: nn.clip,
    Activation.POW: lambda b, x, alpha, beta: b.add("Pow", [x, b.number(x, alpha)]),
}
_ROWS: Mapping[int, Callable[[Builder, str], str]] = {
    Activation.SOFTMAX: lambda b, x: reduction.over_last_axis(b, "Softmax", x),
    Activation.LOG_SOFTMAX: lambda b, x: reduction.over_last_axis(b, "LogSoftmax", x),
    Activation.HARDMAX: reduction.hardmax,
}


def activate(b: LayerBuilder, number: int, x: NnValue, *, axis: int = -1, fused: bool = False) -> NnValue:
    """``number`` applied to ``x``; the parameters are the current layer's, or the defaults where it is fused."""
    if number == Activation.NONE:
        return x
    if fused and number in (*_PARAMETRIC, Activation.PRELU):
        raise b.unsupported_error(
            f"{activation_label(number)} is fused into it",
            "Unity drops the parameters of a fused activation, so what it computed is not known",
        )
    if number in _ROWS:
        return _over_rows(b, Activation(number), x, axis)
    if number == Activation.ELU:
        return NnValue(nn.elu(b, x.reference, 1.0 if fused else b.layer.alpha), x.shape)
    if number in _ONE_OP:
        return NnValue(b.add(_ONE_OP[number], [x.reference]), x.shape)
    if number in _FUNCTIONS:
        return NnValue(_FUNCTIONS[number](b, x.reference), x.shape)
    if number in _PARAMETRIC:
        return NnValue(_PARAMETRIC[number](b, x.reference, b.layer.alpha, b.layer.beta), x.shape)
    raise b.unsupported_error(f"its activation is {activation_label(number)}", "no formula of it is known")


def prelu(b: LayerBuilder, x: NnValue, slope: NnValue) -> NnValue:
    """max(0, x) + slope·min(0, x)."""
    (data, factor), shape = b.operands([x, slope])
    if shape != x.shape:
        raise b.damaged_error(
            f"slopes of shape {list(slope.shape)} for {list(x.shape)}", "there are more slopes than numbers"
        )
    return NnValue(nn.prelu(b, data, factor), shape)


# ------------------------------------------------------------------ over rows


def _over_rows(b: LayerBuilder, kind: Activation, x: NnValue, axis: int) -> NnValue:
    """Softmax and its kin, over the flattened row up to version 16, along an axis (8-D order) from 18 on."""
    along_channels = axis in (-1, 7)
    if x.rank == 4 and b.version > 16:
        if not along_channels or b.version == 17:
            raise b.unsupported_error(
                f"{activation_label(kind)} of a tensor of shape {list(x.shape)}, axis {axis}",
                "Barracuda 1.x took the whole row, later versions an axis; only an axis of channels is known for sure",
            )
        return NnValue(_ROWS[kind](b, x.reference), x.shape)
    if b.version > 16 and not along_channels:
        raise b.unsupported_error(f"{activation_label(kind)} along axis {axis}", "that axis is not the channels'")
    return b.rows(_ROWS[kind](b, b.as_matrix(x)), x.shape[0], x.size)
