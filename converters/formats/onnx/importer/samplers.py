"""Samplers. Seeds are dropped: a sampler that stays draws anew in every run."""

from __future__ import annotations

from collections.abc import Mapping

from export_model.converters.formats.onnx.importer.importer import Importer
from export_model.converters.formats.onnx.importer.node import Op, Translate
from export_model.converters.graph.nn.activations import scale_and_shift
from export_model.converters.graph.types import BATCH, FLOAT32, INT32


def _shape(op: Op, net: Importer) -> str:
    """The shape to draw: an attribute, or that of an input. A fixed number of rows becomes the batch."""
    dims = op.integers("shape")
    if not op.kind.endswith("Like"):
        if dims is None:
            raise op.op_error("it has no shape", "the model is damaged")
    else:
        known = net.type_of(op.need(0)).shape
        if known is None or any(isinstance(d, str) for d in known):
            return net.add("Shape", [op.need(0)], "shape", out_type=INT32)
        dims = tuple(int(d) for d in known)
    rows = net.batch is not None and len(dims) > 1 and dims[0] == net.batch
    return net.vector((BATCH, *dims[1:]) if rows else dims)


def _float(op: Op) -> None:
    """Draws are float32 in every target; ``dtype`` is the input's where it is left out."""
    if op.integer("dtype", 1) not in (1, 11):
        raise op.op_error("it draws numbers that are not float32")


def _normal(op: Op, net: Importer) -> str:
    """N(mean, scale²) as a draw of N(0, 1), which is what is lifted under the value's name."""
    _float(op)
    draw = net.draw("RandomStandardNormal", [_shape(op, net)], op.outputs[0])
    return scale_and_shift(net, draw, op.number("scale", 1.0), op.number("mean", 0.0))


def _uniform(op: Op, net: Importer) -> str:
    _float(op)
    low, high = op.number("low", 0.0), op.number("high", 1.0)
    draw = net.add("RandomUniform", [_shape(op, net)], dtype=FLOAT32)
    return scale_and_shift(net, draw, high - low, low)


def _multinomial(op: Op, net: Importer) -> str:
    """Classes drawn from rows of log-probabilities."""
    count = net.ints(op.integer("sample_size", 1), "count")
    return net.add("Multinomial", [op.need(0), count], output_dtype=op.dtype("dtype", 6))


OPS: Mapping[str, Translate] = {
    "RandomNormal": _normal,
    "RandomNormalLike": _normal,
    "RandomUniform": _uniform,
    "RandomUniformLike": _uniform,
    "Multinomial": _multinomial,
}
