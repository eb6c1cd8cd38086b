"""What is fed to source code, and what it answers, row by row."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from export_model.converters.files.children.frames import Tensors
from export_model.converters.formats.programs.members import Field, Header

OUTSIDE = "an index of {} inputs lies outside of the table that it is looked up in"


def row_count(header: Header, feeds: Tensors) -> int:
    """Count the agents that are fed."""
    batched = [f.spec.name for f in header.fed if f.spec.batched]
    return max((len(feeds[n]) for n in batched if n in feeds), default=1)


def as_declared(field: Field, array: np.ndarray, rows: int) -> np.ndarray:
    """Return an answer in the dtype and shape of the contract."""
    lengths = tuple(n or 1 for n in field.spec.shape)
    if field.spec.batched:
        lengths = (rows, *lengths[1:])
    declared = (array if field.spec.batched else array[-1]).astype(field.spec.dtype)
    return np.asarray(declared.reshape(lengths))


def fed_rows(field: Field, array: np.ndarray | None, rows: int, dtypes: Mapping[str, str] | None = None) -> np.ndarray:
    """Return what is fed, row by row; zeros where nothing is. ``dtypes``: what a language has in a dtype's place."""
    kind = (dtypes or {}).get(field.spec.dtype, field.spec.dtype)
    if array is None:
        return np.zeros((rows, field.size), kind)
    flat = np.asarray(array).astype(kind).reshape(-1, field.size)
    return np.ascontiguousarray(flat if len(flat) == rows else np.broadcast_to(flat, (rows, field.size)))
