"""How many fields a protobuf message has, counted before protobuf parses it.

An empty message takes two bytes of a file and up to 175 in memory, so a file of some megabytes could be gigabytes. They
are counted in one flat loop that makes no object per message: a chain of 300,000 nodes has 2.4 million fields.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from converters.files.wire_format import read_varint
from signatures.errors import NotAPolicyError

#: Fields of a file, those of messages in messages too: a graph may have 131,072 nodes, of two dozen each.
MAX_FIELDS = 3 << 20
#: A field has two bytes at least, so a file of fewer bytes has no more fields than these.
_FROM = 2 * MAX_FIELDS
#: Numbers in one field are in a byte each in the file, and in eight in memory; eight of these count as a field.
_PACKED = 3  # a shift
_MESSAGE, _BYTES = 11, 2
#: Where ONNX and TensorFlow may keep weights of 16 bits, in two or three bytes each: many such count as no fields.
_HALVES, _LARGE = ("int32_data", "half_val"), 1 << 20
_MOST = (1 << 64) - 1
#: FieldDescriptor.type of what is written as a varint: int64, uint64, int32, bool, uint32, enum, sint32, sint64.
_VARINTS = frozenset((3, 4, 5, 8, 13, 14, 17, 18))
#: Tag → the same of the message that it holds; None: numbers. Where they may be weights, -tag is there too.
Table: TypeAlias = "dict[int, Table | None]"
_TABLES: dict[str, Table] = {}
#: That of a group, which none of our messages has: protobuf passes over it whatever is in it, and reads on behind it.
_GROUP: Table = {}
#: Wire type → bytes of a field that always has so many.
_FIXED = {1: 8, 5: 4}


def check_size(message_class: Any, data: bytes) -> None:
    """Raise NotAPolicyError where a serialised message has more than MAX_FIELDS fields. What is damaged is protobuf's
    to refuse, which reads as far as the damage.
    """
    if len(data) >= _FROM and fields_of(data, _table(message_class.DESCRIPTOR), MAX_FIELDS) > MAX_FIELDS:
        raise NotAPolicyError(
            f"the file is made of more than {MAX_FIELDS} parts",
            why=f"it has {len(data)} bytes, few of them weights; the graph of a policy has some thousand parts",
            fix="export the policy alone",
        )


def fields_of(data: bytes, table: Table, most: int) -> int:
    """How many fields there are, up to the first damage, or just more than ``most``."""
    at, end, weight = 0, len(data), 0
    ends: list[tuple[int, Table]] = []
    count = 0
    try:
        for count in range(1, most + 2):
            while at >= end:
                if at > end or not ends or table is _GROUP:
                    return count - 1 + weight
                end, table = ends.pop()
            tag = data[at]
            at += 1
            if tag > 0x7F:
                if data[at] <= 0x7F:
                    tag = tag & 0x7F | data[at] << 7
                    at += 1
                else:
                    tag, at = _varint(data, at - 1)
            wire = tag & 7
            if wire == _BYTES:
                length = data[at]
                at += 1
                if length > 0x7F:
                    length, at = _varint(data, at - 1)
                if tag in table:
                    inner = table[tag]
                    if inner is None:
                        if length < _LARGE or -tag not in table or not _is_dense(data, at, min(at + length, end)):
                            weight += length >> _PACKED
                        at += length
                        if count + weight > most:
                            return count + weight
                    elif length:
                        ends.append((end, table))
                        if at + length > end:
                            return count + weight
                        end, table = at + length, inner
                else:
                    at += length
            elif wire == 0:
                while data[at] > 0x7F:
                    at += 1
                at += 1
            elif wire in _FIXED:
                at += _FIXED[wire]
            elif wire == 3:
                ends.append((end, table))
                table = _GROUP
            elif table is not _GROUP:  # the end of no group, or no type of a field
                return count + weight
            elif wire == 4:
                end, table = ends.pop()
            else:
                return count + weight
    except IndexError:  # cut off
        pass
    return count + weight


def _is_dense(data: bytes, start: int, end: int) -> bool:
    """Whether numbers of 32 bits take at most twice in memory what they take in the file."""
    return 2 * int(np.count_nonzero(np.frombuffer(data, np.uint8, end - start, start) < 0x80)) <= end - start


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A number, of which protobuf in Python keeps the low bits; in C it refuses what is cut here."""
    value, at = read_varint(data, at, len(data))
    if value < 0:
        raise IndexError
    return value & _MOST, at


def _table(descriptor: Any) -> Table:
    """The table of a message, with those of all that it may hold."""
    found = _TABLES.get(descriptor.full_name)
    if found is None:
        found = _TABLES[descriptor.full_name] = {}
        for field in descriptor.fields:
            if field.type == _MESSAGE:
                found[field.number << 3 | _BYTES] = _table(field.message_type)
            elif field.type in _VARINTS:
                found[field.number << 3 | _BYTES] = None
                if field.name in _HALVES:
                    found[-(field.number << 3 | _BYTES)] = None
    return found
