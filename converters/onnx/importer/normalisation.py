"""Normalisations: by stored statistics (batch), or by an input's own (layer, instance, length)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from converters.graph.types import FLOAT32
from converters.onnx.importer.importer import Importer
from converters.onnx.importer.node import Op, Translate


def _batch(op: Op, net: Importer) -> list[str | None]:
    """(x − mean)·scale/√(variance + ε) + bias per channel, axis 1. Statistics of a batch are no policy's business."""
    if op.integer("training_mode", 0):
        raise op.refused(
            "it is in training mode",
            "its statistics would come from the batch, so an agent's action would depend on the other agents",
            "call model.eval() before the export",
        )
    x = op.need(0)
    shape = (1, -1, *(1,) * (net.rank(x) - 2))
    scale, bias, mean, variance = (
        net.needed_constant(op.need(i), "its statistics").astype(np.float64) for i in range(1, 5)
    )
    factor = scale / np.sqrt(variance + op.number("epsilon", 1e-5))
    centre, width, shift = (
        net.const(a.astype(FLOAT32).reshape(shape), n) for a, n in ((mean, "mean"), (factor, "factor"), (bias, "bias"))
    )
    scaled = net.add("Mul", [net.add("Sub", [x, centre]), width])
    return [net.add("Add", [scaled, shift]), *[None] * (len(op.outputs) - 1)]


def _standardised(net: Importer, x: str, axes: Sequence[int], epsilon: float) -> tuple[str, str, str]:
    """((x − mean)/√(variance + ε), mean, 1/√(variance + ε)), the statistics taken over ``axes``."""
    mean = net.reduce("Mean", x, axes, keep=True)
    centred = net.add("Sub", [x, mean])
    variance = net.reduce("Mean", net.add("Square", [centred]), axes, keep=True)
    deviation = net.add("Sqrt", [net.add("Add", [variance, net.number(x, epsilon)])])
    return net.add("RealDiv", [centred, deviation]), mean, net.add("Reciprocal", [deviation])


def _layer(op: Op, net: Importer) -> list[str | None]:
    """Over the axes from ``axis`` on (opset 17)."""
    x = op.need(0)
    axes = range(net.axis(x, op.integer("axis", -1)), net.rank(x))
    value, mean, inverse = _standardised(net, x, axes, op.number("epsilon", 1e-5))
    value = net.add("Mul", [value, op.need(1)])
    bias = op.get(2)
    return [value if bias is None else net.add("Add", [value, bias]), mean, inverse]


def _rms(op: Op, net: Importer) -> str:
    """Elements as x/√(mean(x²) + ε)·scale over the axes from ``axis`` on (opset 23)."""
    x = op.need(0)
    axes = range(net.axis(x, op.integer("axis", -1)), net.rank(x))
    mean = net.reduce("Mean", net.add("Square", [x]), axes, keep=True)
    deviation = net.add("Sqrt", [net.add("Add", [mean, net.number(x, op.number("epsilon", 1e-5))])])
    return net.add("Mul", [net.add("RealDiv", [x, deviation]), op.need(1)])


def _instance(op: Op, net: Importer) -> str:
    """Each channel of each row over its own pixels."""
    x = op.need(0)
    rank = net.rank(x)
    value, _, _ = _standardised(net, x, range(2, rank), op.number("epsilon", 1e-5))
    shape = (1, -1, *(1,) * (rank - 2))
    scale, bias = (net.reshape(op.need(i), shape) for i in (1, 2))
    return net.add("Add", [net.add("Mul", [value, scale]), bias])


def _group(op: Op, net: Importer) -> str:
    """Groups of channels, each over its own pixels. Scale and bias are per group in opset 18, per channel later."""
    x = op.need(0)
    dims = net.shape(x)
    groups, channels = op.integer("num_groups", 1), net.length(x, 1)
    if groups < 1 or channels % groups:
        raise op.refused(f"it has {groups} groups for {channels} channels", "the model is damaged")
    split = net.reshape(x, (dims[0], groups, -1))
    value, _, _ = _standardised(net, split, [2], op.number("epsilon", 1e-5))
    per_group = net.length(op.need(1), 0) != channels
    shape = (1, groups, 1) if per_group else (1, -1, *(1,) * (len(dims) - 2))
    scale, bias = (net.reshape(op.need(i), shape) for i in (1, 2))
    if per_group:
        return net.reshape(net.add("Add", [net.add("Mul", [value, scale]), bias]), dims)
    return net.add("Add", [net.add("Mul", [net.reshape(value, dims), scale]), bias])


def _length(op: Op, net: Importer) -> str:
    """Elements divided by their norm along an axis."""
    x, p = op.need(0), op.integer("p", 2)
    axis = [net.axis(x, op.integer("axis", -1))]
    if p == 1:
        norm = net.reduce("Sum", net.add("Abs", [x]), axis, keep=True)
    else:
        norm = net.add("Sqrt", [net.reduce("Sum", net.add("Square", [x]), axis, keep=True)])
    return net.add("RealDiv", [x, norm])


OPS: Mapping[str, Translate] = {
    "BatchNormalization": _batch,
    "LayerNormalization": _layer,
    "RMSNormalization": _rms,
    "InstanceNormalization": _instance,
    "GroupNormalization": _group,
    "LpNormalization": _length,
}
