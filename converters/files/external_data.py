"""Keeps large tensors out of protobuf messages; a placeholder marks each.

protobuf copies what it parses, what is taken out of a message, what one message is given of another, and all of it
again to serialise it: a graph of 200 MB was some gigabytes. With its weights detached it has some kilobytes. A reader
parses the file without them (``without``) and takes them as views of the file's bytes (``array``), a writer puts the
arrays' marks into its message (``mark``) and their bytes between the serialised parts (``whole``).

A mark begins with bytes that were drawn when this process started, so no file can hold one.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TypeAlias

import numpy as np

from export_model.converters.files.chunks import Pieces
from export_model.converters.files.wire_format import BYTES, GROUP, GROUP_END, WireError, message_fields, varint

#: Field number → the fields of the message that it holds, or None where it is what is detached.
Fields: TypeAlias = Mapping[int, "Fields | None"]
#: Contents of fewer bytes stay where they are.
LARGE = 1 << 12
#: Files of fewer bytes are parsed as they are.
LARGE_FILE = 1 << 20
#: Protobuf's own limit.
MAX_MESSAGE = (2 << 30) - 1
#: Fields of a message that are looked through: a graph has no more than 131,072 nodes.
MAX_MODEL_FIELDS = 1 << 18
_SECRET = os.urandom(16)
_MARK = re.compile(re.escape(_SECRET) + b".{8}", re.DOTALL)
_MARK_BYTES = len(_SECRET) + 8


class Detached:
    """Arrays by their marks: those of at least so many bytes."""

    def __init__(self, least: int = LARGE) -> None:
        self._least = least
        self._arrays: list[np.ndarray] = []
        self._numbers: dict[tuple[object, ...], int] = {}

    @classmethod
    def of(cls, arrays: Iterable[np.ndarray]) -> Detached:
        """Return the store for a message of these arrays.

        If they are small together, all stay in the message, which takes less than to look for their places in it.
        """
        return cls(LARGE if sum(a.nbytes for a in arrays) >= LARGE_FILE else LARGE_FILE)

    def takes(self, array: np.ndarray) -> bool:
        """Whether an array is to be kept here."""
        return array.nbytes >= self._least

    def mark(self, array: np.ndarray) -> bytes:
        """What stands for the bytes of an array in a message; the same memory has the same."""
        place = (array.__array_interface__["data"][0], array.shape, array.strides, array.dtype.str)
        number = self._numbers.setdefault(place, len(self._arrays))
        if number == len(self._arrays):
            self._arrays.append(array)
        return _SECRET + number.to_bytes(8, "little")

    def array(self, content: bytes) -> np.ndarray | None:
        """What a field's content is the mark of; None where it is no mark."""
        if len(content) != _MARK_BYTES or not content.startswith(_SECRET):
            return None
        return self._arrays[int.from_bytes(content[len(_SECRET) :], "little")]

    def without(self, data: bytes | memoryview, fields: Fields) -> bytes:
        """A serialised message with marks for the large contents of ``fields``. What is no message stays as it is."""
        parts = self._without(memoryview(data), fields)
        return bytes(data) if parts is None else b"".join(parts)

    def _without(self, view: memoryview, fields: Fields) -> list[bytes | memoryview] | None:
        parts: list[bytes | memoryview] = []
        kept = 0
        try:
            for number, tag_end, start, end in _large_fields(view, LARGE, MAX_MODEL_FIELDS):
                if number not in fields:
                    continue
                inner = fields[number]
                content: Sequence[bytes | memoryview] | None
                if inner is None:
                    content = [self.mark(np.frombuffer(view[start:end], np.uint8))]
                else:
                    content = self._without(view[start:end], inner)
                if content is None:
                    continue
                parts += [view[kept:tag_end], varint(sum(map(len, content))), *content]
                kept = end
        except WireError:
            return None
        return [*parts, view[kept:]]

    def whole(self, data: bytes) -> Pieces:
        """The serialised message ``data`` with the arrays in place of their marks."""
        places = [m.start() for m in _MARK.finditer(data)] if self._arrays else []
        return Pieces(*self._whole(memoryview(data), places, 0)) if places else Pieces(data)

    def _whole(self, view: memoryview, places: Sequence[int], offset: int) -> list[bytes | np.ndarray]:
        """``places`` are where the marks in ``view`` lie, which begins at ``offset`` of the whole."""
        if len(view) == _MARK_BYTES and list(places) == [offset]:
            array = self.array(bytes(view))
            assert array is not None
            return [array]
        parts: list[bytes | np.ndarray] = []
        kept = next_place = 0
        for _, tag_end, start, end in _large_fields(view, _MARK_BYTES):
            first = next_place
            while next_place < len(places) and places[next_place] < offset + end:
                next_place += 1
            if first == next_place:
                continue
            content = self._whole(view[start:end], places[first:next_place], offset + start)
            size = sum(len(p) if isinstance(p, bytes) else p.nbytes for p in content)
            parts += [bytes(view[kept:tag_end]) + varint(size), *content]
            kept = end
        return [*parts, bytes(view[kept:])]


def is_readable(message: Pieces) -> bool:
    """Whether protobuf could read a message in one."""
    return message.size <= MAX_MESSAGE


def _large_fields(view: memoryview, least: int, most: int | None = None) -> Iterator[tuple[int, int, int, int]]:
    """(number, end of the tag, start, end) of each field of bytes that has at least so many.

    Raises WireError for what is no message, or has more fields than ``most``: those are left to protobuf, which is
    quicker with them.
    """
    for count, (tag, tag_end, start, end) in enumerate(message_fields(view, 0, len(view)), 1):
        kind = tag & 7
        if end > len(view) or kind in (GROUP, GROUP_END) or (most is not None and count > most):
            raise WireError
        if kind == BYTES and end - start >= least:
            yield tag >> 3, tag_end, start, end
