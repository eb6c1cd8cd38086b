"""Whether an input of a candidate can take what the reference's takes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from export_model.converters.formats.format import Port
from export_model.signatures.spec import TensorSpec


def misfit(spec: TensorSpec, port: Port) -> str:
    """Return why an input cannot take what the reference takes; empty where it can, as far as the file tells."""
    kinds = (np.dtype(spec.dtype).kind, None if port.dtype is None else np.dtype(port.dtype).kind)
    integers = {"i", "u", "b"}
    if kinds[1] is not None and spec.dtype != port.dtype and not {*kinds} <= integers:
        return f"the input {port.name!r} is {port.dtype}, the reference's {spec.dtype}"
    if port.shape is None:
        return ""
    same = len(port.shape) == len(spec.shape) and all(
        a is None or b is None or a == b for a, b in zip(port.shape[1:], spec.shape[1:], strict=True)
    )
    if not same:
        return f"the input {port.name!r} has the shape {dims(port.shape)}, the reference's {dims(spec.shape)}"
    if port.shape and spec.batched and port.shape[0] is not None:
        return f"the input {port.name!r} takes {port.shape[0]} rows only, the reference any number"
    return ""


def dims(shape: Sequence[int | None]) -> str:
    """Return a shape for people."""
    return "[" + ", ".join("?" if n is None else str(n) for n in shape) + "]"
