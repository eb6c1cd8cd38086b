"""Normalisations: by stored statistics (batch), or by an input's own (layer, instance, length)."""

from __future__ import annotations

from collections.abc import Mapping

from export_model.converters.formats.onnx.importer.importer import Importer
from export_model.converters.formats.onnx.importer.node import Op, Translate
from export_model.converters.graph.nn import normalisation as nn


def _epsilon(op: Op) -> float:
    return op.number("epsilon", 1e-5)


def _batch(op: Op, net: Importer) -> list[str | None]:
    """Statistics of a batch are no policy's business."""
    if op.integer("training_mode", 0):
        raise op.op_error(
            "it is in training mode",
            "its statistics would come from the batch, so an agent's action would depend on the other agents",
            "call model.eval() before the export",
        )
    scale, bias, mean, variance = (net.needed_constant(op.need(i), "its statistics") for i in range(1, 5))
    value = nn.batch(net, op.need(0), scale=scale, bias=bias, mean=mean, variance=variance, epsilon=_epsilon(op))
    return [value, *[None] * (len(op.outputs) - 1)]


def _layer(op: Op, net: Importer) -> list[str | None]:
    """From opset 17 on."""
    x = op.need(0)
    return [*nn.layer(net, x, net.axis(x, op.integer("axis", -1)), op.need(1), op.get(2), _epsilon(op))]


def _rms(op: Op, net: Importer) -> str:
    """From opset 23 on."""
    x = op.need(0)
    return nn.rms(net, x, net.axis(x, op.integer("axis", -1)), op.need(1), _epsilon(op))


def _group(op: Op, net: Importer) -> str:
    """Scale and bias are per group in opset 18, per channel later."""
    return nn.group(net, op.need(0), op.integer("num_groups", 1), op.need(1), op.need(2), _epsilon(op))


def _length(op: Op, net: Importer) -> str:
    x = op.need(0)
    return nn.unit_length(net, x, net.axis(x, op.integer("axis", -1)), op.integer("p", 2))


def _local(op: Op, net: Importer) -> str:
    size = op.integer("size", 1)
    if size < 1 or size % 2 == 0:
        raise op.op_error(f"it sums over {size} channels", "onnxruntime takes odd numbers alone")
    return nn.local(net, op.need(0), size, op.number("alpha", 1e-4), op.number("beta", 0.75), op.number("bias", 1.0))


OPS: Mapping[str, Translate] = {
    "BatchNormalization": _batch,
    "LayerNormalization": _layer,
    "RMSNormalization": _rms,
    "InstanceNormalization": lambda op, net: nn.instance(net, op.need(0), op.need(1), op.need(2), _epsilon(op)),
    "GroupNormalization": _group,
    "LpNormalization": _length,
    "LRN": _local,
}
