"""Memories that a source takes as several tensors (``h_in``, ``c_in``), and how one row per agent is made of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from msgspec import Struct

from export_model.signatures.fields import Record, Shape, Text


class SourcePart(Record, frozen=True):
    """A tensor of the source that holds some columns of the memory [B, n]: ``shape`` has None where its batch is.

    PyTorch's states are [layers, B, hidden]; a row of them is layer after layer.
    """

    tensor: Text
    shape: Shape

    @property
    def axis(self) -> int:
        """The batch axis."""
        return self.shape.index(None)

    @property
    def size(self) -> int:
        """Numbers per row."""
        return math.prod(d for d in self.shape if d is not None)


def split_memory(parts: Sequence[SourcePart], memory: np.ndarray) -> dict[str, np.ndarray]:
    """What the source is fed for a memory [B, n]: each part's columns in its shape."""
    ends = np.cumsum([part.size for part in parts])
    fed = {}
    for part, end in zip(parts, ends.tolist(), strict=True):
        columns = memory[:, end - part.size : end]
        if len(columns) == 1:  # no axis has to move: a source of one row is asked so a million times
            fed[part.tensor] = columns.reshape([1 if d is None else d for d in part.shape])
            continue
        rest = [d for d in part.shape if d is not None]
        rows = columns.reshape(columns.shape[0], *rest)
        fed[part.tensor] = np.ascontiguousarray(np.moveaxis(rows, 0, part.axis))
    return fed


def join_memory(parts: Sequence[SourcePart], values: Mapping[str, np.ndarray]) -> np.ndarray:
    """The memory [B, n] that the source gave in ``parts``; the inverse of ``split_memory``."""
    found = [values[part.tensor] for part in parts]
    if all(value.shape[part.axis] == 1 for part, value in zip(parts, found, strict=True)):
        return np.concatenate([value.reshape(1, -1) for value in found], axis=1)
    rows = [np.moveaxis(value, part.axis, 0) for part, value in zip(parts, found, strict=True)]
    return np.concatenate([r.reshape(r.shape[0], -1) for r in rows], axis=1)


class SeparateMemory(Struct, frozen=True):
    """One of several memories of a graph: the placeholder ``input`` is fed what the tensor ``output`` gave.

    ``taken`` and ``given`` are their shapes, None where the batch is. ``part`` is ``h`` or ``c``, empty where it is
    not known.
    """

    input: str
    output: str
    taken: tuple[int | None, ...]
    given: tuple[int | None, ...]
    part: str = ""
