"""Tensors of a policy's graph as tensors of a ``.nn``: where each axis lies, and what they are joined from.

A ``.nn`` knows [N, H, W, C] alone. Every axis of a tensor of the graph lies on one of the four, or nowhere if its
length is 1; N is the batch. A vector [B, C] is [N, 1, 1, C], an image of TensorFlow lies as it is, and one of torch
([B, C, H, W]) lies on N, C, H, W: a Transpose of the graph moves nothing, it only says where the axes are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from export_model.converters.graph.ops.barracuda.vocabulary import C, N
from export_model.converters.graph.types import BATCH, Dim

Array = npt.NDArray[np.float32]
#: Where each axis of a tensor of the graph lies: N, H, W or C; None: nowhere, its length is 1.
Axes = tuple[int | None, ...]
#: Lengths along N, H, W, C; N is ``FREE`` for a row per agent.
Dims = tuple[int, int, int, int]

FREE = -1


class Piece(Struct, frozen=True):
    """Channels ``start`` to ``stop`` of the ``width`` that a layer, an input or a constant has."""

    name: str
    width: int
    start: int
    stop: int

    @property
    def whole(self) -> bool:
        """Whether nothing is cut off."""
        return self.stop - self.start == self.width


class Value(Struct, frozen=True):
    """A tensor of the graph.

    ``shape`` is the graph's, with ``BATCH`` for the batch. Either ``array`` holds its numbers (of that shape, length 1
    in place of the batch: every row is the same), or ``pieces`` are what it is joined from along C. ``axes`` say
    where the axes lie; an ``array`` has none. A [B, K] that flattens an image whose axes lie in another order than the
    graph's has no pieces yet: ``flat_of`` is the image.
    """

    shape: tuple[Dim, ...]
    axes: Axes = ()
    pieces: tuple[Piece, ...] = ()
    array: npt.NDArray[np.generic] | None = None
    flat_of: Value | None = None

    @property
    def dims(self) -> Dims:
        """The lengths in the file."""
        lengths = [1, 1, 1, 1]
        for length, axis in zip(self.shape, self.axes, strict=True):
            if axis is not None:
                lengths[axis] = FREE if isinstance(length, str) else length
        return lengths[0], lengths[1], lengths[2], lengths[3]

    @property
    def size(self) -> int:
        """Elements of one row."""
        return math.prod(d for d in self.shape if isinstance(d, int))

    @property
    def in_order(self) -> bool:
        """Whether the elements stand in the file in the order in which the graph counts them."""
        places = [a for a, d in zip(self.axes, self.shape, strict=True) if a is not None and d != 1]
        return places == sorted(places)

    @property
    def by_rows(self) -> bool:
        """Whether the graph counts one agent's elements after the other's."""
        return rows_first(self.shape)


def rows_first(shape: Sequence[Dim]) -> bool:
    """Whether no axis but those of length 1 stands before the batch."""
    return all(d == 1 for d in shape[: list(shape).index(BATCH)]) if BATCH in shape else True


def usual_axes(shape: Sequence[Dim]) -> Axes | None:
    """Where the axes of a tensor lie unless something else is known: the last ones last; None where that cannot be.

    An axis of the batch that is not the first (torch's recurrent layers have it second) lies on N all the same.
    """
    if len(shape) == 4 and all(isinstance(d, int) for d in shape[1:]):
        return 0, 1, 2, 3
    axes: list[int | None] = [None] * len(shape)
    free = C
    for i in reversed(range(len(shape))):
        if isinstance(shape[i], str):
            if shape[i] != BATCH or N in axes:
                return None
            axes[i] = N
        elif shape[i] != 1:
            if free == N:
                return None
            axes[i], free = free, free - 1
    return tuple(axes)
