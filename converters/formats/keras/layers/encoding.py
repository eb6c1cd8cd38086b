"""Layers that make numbers of categories, and categories of numbers (keras/src/utils/numerical_utils.py)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from export_model.converters.formats.keras.layers.arguments import constant
from export_model.converters.formats.keras.layers.rearranging import one_hot
from export_model.converters.formats.keras.layers.step import Step, Translate
from export_model.converters.graph.types import FLOAT32, INT32
from export_model.signatures.errors import UnsupportedOpError


def _encode(step: Step, index: str, classes: int, mode: str) -> str:
    """An index as itself, as 1 at its place, or those of a row joined."""
    b = step.net
    step.refuse_unless("sparse", False)
    if mode == "int":
        return index
    if mode == "one_hot":
        index = b.squeeze(index, [b.rank(index) - 1]) if b.shape(index)[-1] == 1 else index
        return one_hot(step, index, classes, -1, FLOAT32)
    if mode not in ("multi_hot", "count"):
        raise UnsupportedOpError(f"its output_mode is {mode[:60]!r}")
    return b.reduce(
        "Max" if mode == "multi_hot" else "Sum", one_hot(step, index, classes, -1, FLOAT32), [1], keep=False
    )


def _category_encoding(step: Step) -> str:
    return _encode(step, step.x, int(step.get("num_tokens")), str(step.get("output_mode", "multi_hot")))


def _discretization(step: Step) -> str:
    """How many of the boundaries are not above x."""
    b, bounds = step.net, step.get("bin_boundaries")
    if bounds is None:
        raise UnsupportedOpError("it does not say its boundaries")
    limits = constant(bounds).astype(FLOAT32).reshape(-1)
    reached = b.add(
        "GreaterEqual",
        [b.expand_dims(b.cast(step.x, FLOAT32), step.rank), b.const(np.sort(limits), "boundaries")],
    )
    index = b.reduce("Sum", b.cast(reached, INT32), [step.rank], keep=False)
    mode = str(step.get("output_mode", "int"))
    return _encode(step, index, limits.size + 1, mode)


LAYERS: Mapping[str, Translate] = {"CategoryEncoding": _category_encoding, "Discretization": _discretization}
