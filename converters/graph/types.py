"""What is known of a tensor before it runs: dtype, shape with symbols for free axes, and sometimes its value."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from msgspec import Struct

#: An axis: its length, or a symbol (equal symbols are equal lengths).
Dim = int | str

#: The symbol of the batch axis: the leading free axis of every input.
BATCH = "batch"

FLOAT32 = np.dtype(np.float32)
INT32 = np.dtype(np.int32)
INT64 = np.dtype(np.int64)
BOOL = np.dtype(np.bool_)


class TensorType(Struct, frozen=True, eq=False):
    """dtype and shape of a tensor (``shape`` None: unknown rank).

    ``value`` is the array where it is known. A shape vector that depends on the batch is known as an object array of
    ints and symbols (``array([1, 'batch', 8], dtype=object)``); ``dtype`` is then still the tensor's own.
    """

    dtype: np.dtype
    shape: tuple[Dim, ...] | None
    value: np.ndarray | None = None

    @property
    def constant(self) -> np.ndarray | None:
        """The value, if every element of it is known."""
        return self.value if self.value is not None and self.value.dtype != object else None

    @property
    def rank(self) -> int | None:
        """Number of axes, None if unknown."""
        return None if self.shape is None else len(self.shape)


class Symbols:
    """Makes symbols for free axes: ``?1``, ``?2``… in the order in which they are met."""

    def __init__(self) -> None:
        self.count = 0

    def fresh(self) -> str:
        """A symbol that equals no other."""
        self.count += 1
        return f"?{self.count}"


def of_array(array: np.ndarray) -> TensorType:
    """The type of a constant."""
    return TensorType(array.dtype, tuple(int(n) for n in array.shape), array)


def static_shape(shape: Sequence[Dim] | None) -> tuple[int | None, ...] | None:
    """The shape with None in place of symbols."""
    return None if shape is None else tuple(d if isinstance(d, int) else None for d in shape)


def broadcast(a: tuple[Dim, ...] | None, b: tuple[Dim, ...] | None, symbols: Symbols) -> tuple[Dim, ...] | None:
    """Numpy's broadcasting over known and symbolic lengths; raises ValueError where lengths contradict."""
    if a is None or b is None:
        return None
    rank = max(len(a), len(b))
    left = (1,) * (rank - len(a)) + a
    right = (1,) * (rank - len(b)) + b
    return tuple(_broadcast_dim(x, y, symbols) for x, y in zip(left, right, strict=True))


def _broadcast_dim(x: Dim, y: Dim, symbols: Symbols) -> Dim:
    if x == y or y == 1:
        return x
    if x == 1:
        return y
    if isinstance(x, int) and isinstance(y, int):
        raise ValueError(f"lengths {x} and {y} do not broadcast")
    if isinstance(x, int):
        return x
    if isinstance(y, int):
        return y
    # Two different symbols: at run time they are equal or one of them is 1. The batch is the likelier answer.
    return BATCH if BATCH in (x, y) else symbols.fresh()


def product(dims: Iterable[Dim], symbols: Symbols) -> Dim:
    """The product of lengths: a number, a symbol, or a fresh symbol where it is neither."""
    number, names = 1, []
    for dim in dims:
        if isinstance(dim, str):
            names.append(dim)
        else:
            number *= int(dim)
    if number == 0:
        return 0
    if not names:
        return number
    return names[0] if number == 1 and len(names) == 1 else symbols.fresh()
