"""Normalisations: by stored statistics (batch), or by an input's own (layer, instance, length)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from converters.graph.types import FLOAT32
from converters.onnx.importer.importer import Raiser
from converters.onnx.importer.node import Op, Raise


def _batch(op: Op, r: Raiser) -> list[str | None]:
    """(x − mean)·scale/√(variance + ε) + bias per channel, axis 1. Statistics of a batch are no policy's business."""
    if op.integer("training_mode", 0):
        raise op.refused(
            "it is in training mode",
            "its statistics would come from the batch, so an agent's action would depend on the other agents",
            "call model.eval() before the export",
        )
    x = op.need(0)
    shape = (1, -1, *(1,) * (r.rank(op, x) - 2))
    scale, bias, mean, variance = (
        r.needed_constant(op, op.need(i), "its statistics").astype(np.float64) for i in range(1, 5)
    )
    factor = scale / np.sqrt(variance + op.number("epsilon", 1e-5))
    centre, width, shift = (
        r.const(a.astype(FLOAT32).reshape(shape), n) for a, n in ((mean, "mean"), (factor, "factor"), (bias, "bias"))
    )
    scaled = r.add("Mul", [r.add("Sub", [x, centre]), width])
    return [r.add("Add", [scaled, shift]), *[None] * (len(op.outputs) - 1)]


def _standardised(r: Raiser, x: str, axes: Sequence[int], epsilon: float) -> tuple[str, str, str]:
    """((x − mean)/√(variance + ε), mean, 1/√(variance + ε)), the statistics taken over ``axes``."""
    mean = r.reduce("Mean", x, axes, keep=True)
    centred = r.add("Sub", [x, mean])
    variance = r.reduce("Mean", r.add("Square", [centred]), axes, keep=True)
    deviation = r.add("Sqrt", [r.add("Add", [variance, r.number(x, epsilon)])])
    return r.add("RealDiv", [centred, deviation]), mean, r.add("Reciprocal", [deviation])


def _layer(op: Op, r: Raiser) -> list[str | None]:
    """Over the axes from ``axis`` on (opset 17)."""
    x = op.need(0)
    axes = range(r.axis(op, x, op.integer("axis", -1)), r.rank(op, x))
    value, mean, inverse = _standardised(r, x, axes, op.number("epsilon", 1e-5))
    value = r.add("Mul", [value, op.need(1)])
    bias = op.get(2)
    return [value if bias is None else r.add("Add", [value, bias]), mean, inverse]


def _rms(op: Op, r: Raiser) -> str:
    """Elements as x/√(mean(x²) + ε)·scale over the axes from ``axis`` on (opset 23)."""
    x = op.need(0)
    axes = range(r.axis(op, x, op.integer("axis", -1)), r.rank(op, x))
    mean = r.reduce("Mean", r.add("Square", [x]), axes, keep=True)
    deviation = r.add("Sqrt", [r.add("Add", [mean, r.number(x, op.number("epsilon", 1e-5))])])
    return r.add("Mul", [r.add("RealDiv", [x, deviation]), op.need(1)])


def _instance(op: Op, r: Raiser) -> str:
    """Each channel of each row over its own pixels."""
    x = op.need(0)
    rank = r.rank(op, x)
    value, _, _ = _standardised(r, x, range(2, rank), op.number("epsilon", 1e-5))
    shape = (1, -1, *(1,) * (rank - 2))
    scale, bias = (r.reshape(op.need(i), shape) for i in (1, 2))
    return r.add("Add", [r.add("Mul", [value, scale]), bias])


def _group(op: Op, r: Raiser) -> str:
    """Groups of channels, each over its own pixels. Scale and bias are per group in opset 18, per channel later."""
    x = op.need(0)
    dims = r.shape(op, x)
    groups, channels = op.integer("num_groups", 1), r.length(op, x, 1)
    if groups < 1 or channels % groups:
        raise op.refused(f"it has {groups} groups for {channels} channels", "the model is damaged")
    split = r.reshape(x, (dims[0], groups, -1))
    value, _, _ = _standardised(r, split, [2], op.number("epsilon", 1e-5))
    per_group = r.length(op, op.need(1), 0) != channels
    shape = (1, groups, 1) if per_group else (1, -1, *(1,) * (len(dims) - 2))
    scale, bias = (r.reshape(op.need(i), shape) for i in (1, 2))
    if per_group:
        return r.reshape(r.add("Add", [r.add("Mul", [value, scale]), bias]), dims)
    return r.add("Add", [r.add("Mul", [r.reshape(value, dims), scale]), bias])


def _length(op: Op, r: Raiser) -> str:
    """Elements divided by their norm along an axis."""
    x, p = op.need(0), op.integer("p", 2)
    axis = [r.axis(op, x, op.integer("axis", -1))]
    if p == 1:
        norm = r.reduce("Sum", r.add("Abs", [x]), axis, keep=True)
    else:
        norm = r.add("Sqrt", [r.reduce("Sum", r.add("Square", [x]), axis, keep=True)])
    return r.add("RealDiv", [x, norm])


OPS: Mapping[str, Raise] = {
    "BatchNormalization": _batch,
    "LayerNormalization": _layer,
    "RMSNormalization": _rms,
    "InstanceNormalization": _instance,
    "GroupNormalization": _group,
    "LpNormalization": _length,
}
