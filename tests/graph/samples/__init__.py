"""Samples of every op of the table, by theme."""

from __future__ import annotations

from tests.graph.samples import arrays, elementwise, images, linear, samplers
from tests.graph.samples.arrays import random_slices
from tests.graph.samples.base import INF, NAN, TFJS, Sample, bools, f32, floats, ints
from tests.graph.samples.samplers import DRAWS, PROBABILITIES

SAMPLES: tuple[Sample, ...] = tuple(
    sample for theme in (elementwise, linear, images, arrays, samplers) for sample in theme.samples()
)

__all__ = [
    "DRAWS", "INF", "NAN", "PROBABILITIES", "SAMPLES", "TFJS", "Sample", "bools", "f32", "floats", "ints",
    "random_slices",
]  # fmt: skip
