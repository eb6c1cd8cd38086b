"""Normalisations: by stored statistics, or by an input's own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from export_model.converters.formats.keras.layers.step import Step, Translate
from export_model.converters.graph.nn import normalisation as nn


def _axes(step: Step, default: int = -1) -> list[int]:
    said = step.get("axis", default)
    return sorted(step.net.axis(step.x, int(a)) for a in (said if isinstance(said, Sequence) else [said]))


def _batch(step: Step) -> str:
    (axis,) = _axes(step)
    channels = step.net.length(step.x, axis)
    scale = step.take(channels) if step.get("scale", True) else np.ones(channels, np.float32)
    bias = step.take(channels) if step.get("center", True) else np.zeros(channels, np.float32)
    mean, variance = step.take(channels), step.take(channels)
    epsilon = float(step.get("epsilon", 1e-3))
    return nn.batch(
        step.net, step.x, scale=scale, bias=bias, mean=mean, variance=variance, epsilon=epsilon, channels=axis
    )


def _layer(step: Step) -> str:
    step.refuse_unless("rms_scaling", False)
    b, axes = step.net, _axes(step)
    value, _, _ = nn.standardise(b, step.x, axes, float(step.get("epsilon", 1e-3)))
    sizes = [b.length(step.x, a) for a in axes]
    shape = [b.length(step.x, i) if i in axes else 1 for i in range(b.rank(step.x))]
    for key, op in (("scale", "Mul"), ("center", "Add")):
        if step.get(key, True):
            value = b.add(op, [value, b.const(step.take(*sizes).reshape(shape), key)])
    return value


def _rms(step: Step) -> str:
    (axis,) = _axes(step)
    b, x = step.net, step.x
    step.refuse_unless("axis", -1, [-1], step.rank - 1)
    return nn.rms(b, x, axis, b.const(step.take(b.length(x, axis)), "scale"), float(step.get("epsilon", 1e-6)))


def _group(step: Step) -> str:
    """Groups of channels (−1: each its own), the channels last."""
    step.refuse_unless("axis", -1, step.rank - 1)
    b, x = step.net, step.x
    dims, channels = b.shape(x), b.length(x, -1)
    groups = int(step.get("groups", 32))
    groups = channels if groups == -1 else groups
    scale = step.take(channels) if step.get("scale", True) else np.ones(channels, np.float32)
    bias = step.take(channels) if step.get("center", True) else np.zeros(channels, np.float32)
    last = len(dims) - 1
    turned = b.transpose(x, [0, last, *range(1, last)])
    parts = [b.const(a, name) for a, name in ((scale, "scale"), (bias, "bias"))]
    value = nn.group(b, turned, groups, parts[0], parts[1], float(step.get("epsilon", 1e-3)))
    return b.transpose(value, [0, *range(2, last + 1), 1])


def _unit(step: Step) -> str:
    """X over its norm, which is 1e-12 at least in Keras 3 (2: its square is)."""
    b, x = step.net, step.x
    least = 1e-24 if step.is_keras_3 else 1e-12
    total = b.reduce("Sum", b.add("Square", [x]), _axes(step), keep=True)
    return b.add("Mul", [x, b.add("Rsqrt", [b.add("Maximum", [total, b.number(x, least)])])])


LAYERS: Mapping[str, Translate] = {
    "BatchNormalization": _batch,
    "SyncBatchNormalization": _batch,
    "LayerNormalization": _layer,
    "RMSNormalization": _rms,
    "GroupNormalization": _group,
    "UnitNormalization": _unit,
}
