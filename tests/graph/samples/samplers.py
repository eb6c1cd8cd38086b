"""Samples of ops: samplers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from export_model.converters.graph.types import FLOAT32, INT32
from tests.graph.samples.base import (
    NO_LOWERING,
    Sample,
    const,
    f32,
    floats,
    sample,
    shape_of,
)

#: Draws per sample, many enough that a wrong distribution shows.
DRAWS = 20_000
PROBABILITIES = f32(0.6, 0.1, 0.3)


def _random() -> Iterator[Sample]:
    for op in ("RandomStandardNormal", "RandomUniform", "TruncatedNormal"):
        differs = NO_LOWERING if op == "TruncatedNormal" else None
        yield sample(op, "constant shape", const(DRAWS // 4, 4), dtype=FLOAT32, drawn=True, differs=differs)
        shape = shape_of(floats(DRAWS // 2, 2))
        yield sample(op, "as an input", shape, dtype=FLOAT32, drawn=True, differs=differs)
    logits = np.log(PROBABILITIES).reshape(1, 3)
    yield sample("Multinomial", "one row", logits, const(DRAWS), drawn=True)
    yield sample("Multinomial", "int32", logits, const(DRAWS), output_dtype=INT32, drawn=True)
    rows = np.repeat(logits, 2, axis=0)
    again = {"tfjs-cpu": "its generator starts anew for every row"}
    yield sample("Multinomial", "two rows", rows, const(DRAWS // 2), drawn=True, differs=again)


def samples() -> Iterator[Sample]:
    yield from _random()
