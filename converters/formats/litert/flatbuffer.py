"""FlatBuffers by the rows of ``schema``: a tree of tables to bytes and back (flatbuffers.dev, "internals").

A table is a dictionary of the fields that are not what they are by default. Written, what is equal stands once, and the
weights, which are most of a file, are not copied. Read, every offset is held against the bytes that are there, nothing
is read twice, and how much is read is bounded by the length of the file: it may come from anybody.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from export_model.converters.files.chunks import Pieces
from export_model.converters.formats.litert.schema import IDENTIFIER, OPTIONS, TABLES, TableField
from export_model.signatures.errors import DamagedFileError, TooLargeError

Table = dict[str, Any]

_SCALARS = {"i8": "b", "u8": "B", "bool": "B", "i32": "i", "u32": "I", "f32": "f", "i64": "q", "u64": "Q"}
_NUMBERS = {"i32": "<i4", "f32": "<f4", "i64": "<i8", "u8": "u1"}
_OPTION_TABLES = {number: name for name, number in OPTIONS.items()}
#: Where bytes of weights begin is a multiple of it, in any file (schema.fbs: ``force_align: 16``).
_ALIGNED = 16
#: Offsets are of 32 bits, with a sign where they are of a vtable.
LARGEST = 2**31 - 1


# ------------------------------------------------------------------ writing


def encode(model: Table) -> Pieces:
    """The file of a ``Model``; ``data`` is bytes or an array. Raises TooLargeError."""
    return _Writer().file(model)


class _Piece:
    """What stands in one place of the file: its bytes, its alignment, and where in it offsets of others go."""

    def __init__(self, data: bytearray, align: int, vtable: bytes | None = None) -> None:
        self.data, self.align, self.vtable = data, align, vtable
        self.links: list[tuple[int, _Piece]] = []
        #: what a vector of bytes holds
        self.content: bytes | np.ndarray = b""
        #: how far from its beginning the place is that must be aligned
        self.lead = 0
        self.at = 0

    @property
    def size(self) -> int:
        return len(self.data) + (self.content.nbytes if isinstance(self.content, np.ndarray) else len(self.content))


class _Writer:
    """The pieces of a file, in an order that its offsets allow.

    An offset says how much farther on something is, so tables stand before what they lead to. What several lead to,
    which leads nowhere itself, stands behind all of them.
    """

    def __init__(self) -> None:
        self.inner: list[_Piece] = []
        self.leaves: dict[tuple[bytes | None, bytes], _Piece] = {}
        self.weights: list[_Piece] = []
        self.vtables: dict[bytes, int] = {}

    def file(self, model: Table) -> Pieces:
        root = self._table("Model", model)
        at = 8
        for vtable in dict.fromkeys(p.vtable for p in (*self.inner, *self.leaves.values()) if p.vtable is not None):
            self.vtables[vtable] = at
            at += len(vtable)
        pieces = [*self.inner, *self.leaves.values(), *self.weights]
        for piece in pieces:
            at += -(at + piece.lead) % piece.align
            piece.at = at
            at += piece.size
        if at > LARGEST:
            raise TooLargeError(
                "the policy is too large for a .tflite file",
                why=f"it would take {at:,} bytes; offsets in such a file are of 31 bits",
                fix="write the other formats: --to bytes,saved_model,onnx",
            )
        parts: list[bytes | np.ndarray] = [struct.pack("<I4s", root.at, IDENTIFIER), *self.vtables]
        end = 8 + sum(map(len, self.vtables))
        for piece in pieces:
            if piece.vtable is not None:
                struct.pack_into("<i", piece.data, 0, piece.at - self.vtables[piece.vtable])
            for where, other in piece.links:
                struct.pack_into("<I", piece.data, where, other.at - piece.at - where)
            parts += [bytes(piece.at - end) + bytes(piece.data), piece.content]
            end = piece.at + piece.size
        return Pieces(*_join_bytes(parts))

    def _table(self, name: str, values: Mapping[str, Any]) -> _Piece:
        """Its fields by falling size behind the offset of the vtable, so that each is aligned."""
        known = TABLES[name]
        present = [f for f in known if f.name in values and not (f.kind in _SCALARS and values[f.name] == f.default)]
        slots = [0] * (1 + max((f.slot for f in present), default=-1))
        piece = _Piece(bytearray(4), 4)
        linked: list[tuple[int, TableField]] = []
        # One field of eight bytes must lie at a multiple of that: they go behind four bytes of nothing.
        wide = any(f.kind in ("i64", "u64") for f in present)
        if wide:
            piece.data += bytes(4)
            piece.align = 8
        for field in sorted(present, key=lambda f: -_width(f)):
            slots[field.slot] = len(piece.data)
            if field.kind in _SCALARS:
                piece.data += struct.pack(f"<{_SCALARS[field.kind]}", values[field.name])
            else:
                linked.append((len(piece.data), field))
                piece.data += bytes(4)
        piece.vtable = struct.pack(f"<HH{len(slots)}H", 4 + 2 * len(slots), len(piece.data), *slots)
        if not linked:
            return self._leaf(piece)
        self.inner.append(piece)
        for where, field in sorted(linked, key=lambda pair: pair[1].slot):
            piece.links.append((where, self._linked(field, values)))
        return piece

    def _linked(self, field: TableField, values: Mapping[str, Any]) -> _Piece:
        value, kind = values[field.name], field.kind
        if kind == "str":
            text = value.encode()
            return self._leaf(_Piece(bytearray(struct.pack("<I", len(text)) + text + b"\0"), 4))
        if kind == "data":
            size = value.nbytes if isinstance(value, np.ndarray) else len(value)
            piece = _Piece(bytearray(struct.pack("<I", size)), _ALIGNED)
            piece.content, piece.lead = value, 4
            self.weights.append(piece)
            return piece
        if kind == "union":
            return self._table(_OPTION_TABLES[values[f"{field.name}_type"]], value)
        if not kind.startswith("["):
            return self._table(kind, value)
        of = kind[1:-1]
        if of in _NUMBERS:
            numbers = np.asarray(value, _NUMBERS[of])
            piece = _Piece(bytearray(struct.pack("<I", numbers.size) + numbers.tobytes()), max(4, numbers.itemsize))
            piece.lead = 4
            return self._leaf(piece)
        piece = _Piece(bytearray(struct.pack("<I", len(value)) + bytes(4 * len(value))), 4)
        self.inner.append(piece)
        piece.links = [(4 + 4 * i, self._table(of, entry)) for i, entry in enumerate(value)]
        return piece

    def _leaf(self, piece: _Piece) -> _Piece:
        return self.leaves.setdefault((piece.vtable, bytes([piece.align, piece.lead]) + piece.data), piece)


def _width(field: TableField) -> int:
    return struct.calcsize(_SCALARS.get(field.kind, "I"))


def _join_bytes(parts: Sequence[bytes | np.ndarray]) -> list[bytes | np.ndarray]:
    """Neighbours that are bytes as one."""
    found: list[bytes | np.ndarray] = []
    small: list[bytes] = []
    for part in parts:
        if isinstance(part, bytes):
            small.append(part)
        else:
            found += [b"".join(small), part]
            small = []
    return [*found, b"".join(small)]


# ------------------------------------------------------------------ reading


def decode(data: bytes | memoryview) -> Table:
    """The ``Model`` of a file. Raises DamagedFileError."""
    return _TableReader(data).model()


class _TableReader:
    def __init__(self, data: bytes | memoryview) -> None:
        self.data = memoryview(data)
        self.read: dict[tuple[str, int], Table] = {}
        self.texts: dict[int, str] = {}
        #: entries of vectors that may still be read: a file has no more than a fourth of its bytes, each named once
        self.left = len(self.data)

    def model(self) -> Table:
        if bytes(self.data[4:8]) != IDENTIFIER:
            raise self._damaged("it does not begin as one")
        return self._table("Model", self._number("I", 0))

    def _damaged(self, why: str) -> DamagedFileError:
        return DamagedFileError("the .tflite file is damaged", why=why, fix="fetch or convert it again")

    def _number(self, code: str, at: int) -> int:
        found: int = struct.unpack(f"<{code}", self._span(at, struct.calcsize(code)))[0]
        return found

    def _span(self, at: int, size: int) -> memoryview:
        if at < 0 or size > len(self.data) - at:
            raise self._damaged(f"{size} bytes are said to be at byte {at}, and the file has {len(self.data)}")
        return self.data[at : at + size]

    def _table(self, name: str, at: int) -> Table:
        """A table that several lead to is read once."""
        if (name, at) in self.read:
            return self.read[name, at]
        made: Table = {}
        self.read[name, at] = made
        vtable = at - self._number("i", at)
        length, size = self._number("H", vtable), self._number("H", vtable + 2)
        self._span(vtable, length)
        for field in TABLES[name]:
            where = self._number("H", vtable + 4 + 2 * field.slot) if 4 + 2 * field.slot + 2 <= length else 0
            if where:
                if where < 4 or where + _width(field) > size:
                    raise self._damaged(f"the field {field.name} is said to be outside of its table at byte {at}")
                self._field(made, field, at + where)
        return made

    def _field(self, made: Table, field: TableField, at: int) -> None:
        if field.kind in _SCALARS:
            made[field.name] = self._number(_SCALARS[field.kind], at)
            return
        target = at + self._number("I", at)
        kind = field.kind
        if kind == "union":
            table = _OPTION_TABLES.get(made.get(f"{field.name}_type", 0))
            if table is None:  # an operator that is told nothing that counts, or is none of ours
                made.pop(f"{field.name}_type", None)
            else:
                made[field.name] = self._table(table, target)
        elif kind == "str":
            if target not in self.texts:
                text = bytes(self._span(target + 4, self._number("I", target)))
                self.texts[target] = text.decode("utf-8", "replace")
            made[field.name] = self.texts[target]
        elif kind == "data":
            made[field.name] = np.frombuffer(self._span(target + 4, self._number("I", target)), np.uint8)
        elif not kind.startswith("["):
            made[field.name] = self._table(kind, target)
        elif (of := kind[1:-1]) in _NUMBERS:
            dtype = np.dtype(_NUMBERS[of])
            count = self._number("I", target)
            made[field.name] = np.frombuffer(self._span(target + 4, count * dtype.itemsize), dtype)
        else:
            count = self._number("I", target)
            self._span(target + 4, 4 * count)
            self.left -= count
            if self.left < 0:
                raise self._damaged("its tables lead to one another more often than a file of its length can")
            places = range(target + 4, target + 4 + 4 * count, 4)
            made[field.name] = [self._table(of, place + self._number("I", place)) for place in places]
