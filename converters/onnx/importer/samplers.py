"""Samplers. Seeds are dropped: a sampler that stays draws anew in every run."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from converters.graph.types import BATCH, FLOAT32, INT32
from converters.onnx.importer.importer import Raiser
from converters.onnx.importer.node import Op, Raise


def _shape(op: Op, r: Raiser) -> str:
    """The shape to draw: an attribute, or that of an input. A fixed number of rows becomes the batch."""
    dims = op.integers("shape")
    if not op.kind.endswith("Like"):
        if dims is None:
            raise op.refused("it has no shape", "the model is damaged")
    else:
        known = r.type_of(op.need(0)).shape
        if known is None or any(isinstance(d, str) for d in known):
            return r.add("Shape", [op.need(0)], "shape", out_type=INT32)
        dims = tuple(int(d) for d in known)
    rows = r.batch is not None and len(dims) > 1 and dims[0] == r.batch
    return r.vector((BATCH, *dims[1:]) if rows else dims)


def _float(op: Op) -> None:
    """Draws are float32 in every target; ``dtype`` is the input's where it is left out."""
    if op.integer("dtype", 1) not in (1, 11):
        raise op.refused("it draws numbers that are no float32")


def _moved(op: Op, r: Raiser, value: str, factor: float, shift: float) -> str:
    if factor != 1:
        value = r.add("Mul", [value, r.const(np.array(factor, FLOAT32), "scale")])
    return value if shift == 0 else r.add("Add", [value, r.const(np.array(shift, FLOAT32), "shift")])


def _normal(op: Op, r: Raiser) -> str:
    """N(mean, scale²) as a draw of N(0, 1), which is what is lifted under the value's name."""
    _float(op)
    draw = r.draw("RandomStandardNormal", [_shape(op, r)], op.outputs[0])
    return _moved(op, r, draw, op.number("scale", 1.0), op.number("mean", 0.0))


def _uniform(op: Op, r: Raiser) -> str:
    _float(op)
    low, high = op.number("low", 0.0), op.number("high", 1.0)
    draw = r.add("RandomUniform", [_shape(op, r)], dtype=FLOAT32)
    return _moved(op, r, draw, high - low, low)


def _multinomial(op: Op, r: Raiser) -> str:
    """Classes drawn from rows of log-probabilities."""
    count = r.ints(op.integer("sample_size", 1), "count")
    return r.add("Multinomial", [op.need(0), count], output_dtype=op.dtype("dtype", 6))


OPS: Mapping[str, Raise] = {
    "RandomNormal": _normal,
    "RandomNormalLike": _normal,
    "RandomUniform": _uniform,
    "RandomUniformLike": _uniform,
    "Multinomial": _multinomial,
}
