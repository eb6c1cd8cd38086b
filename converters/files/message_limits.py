"""How many fields a protobuf message has, counted before protobuf parses it.

An empty message takes two bytes of a file and up to 175 in memory, so a file of some megabytes could be gigabytes. They
are counted without an object that stays for a message: a chain of 300,000 nodes has 2.4 million fields.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from export_model.converters.files.wire_format import BYTES, GROUP, GROUP_END, WireError, message_fields
from export_model.signatures.errors import NotAPolicyError

#: Fields of a file, those of messages in messages too: a graph may have 131,072 nodes, of two dozen each.
MAX_FIELDS = 3 << 20
#: A field has two bytes at least, so a file of fewer bytes has no more fields than these.
_FROM = 2 * MAX_FIELDS
#: Numbers in one field are in a byte each in the file, and in eight in memory; eight of these count as a field.
_PACKED = 3  # a shift
_MESSAGE = 11
#: Where ONNX and TensorFlow may keep weights of 16 bits, in two or three bytes each: many such count as no fields.
_HALVES, _LARGE = ("int32_data", "half_val"), 1 << 20
#: FieldDescriptor.type of what is written as a varint: int64, uint64, int32, bool, uint32, enum, sint32, sint64.
_VARINTS = frozenset((3, 4, 5, 8, 13, 14, 17, 18))
#: Tag → the same of the message that it holds; None: numbers. Where they may be weights, -tag is there too.
Table: TypeAlias = "dict[int, Table | None]"
_TABLES: dict[str, Table] = {}


def check_size(message_class: Any, data: bytes) -> None:
    """Raise NotAPolicyError where a serialised message has more than MAX_FIELDS fields.

    A damaged message is left to protobuf, which reads as far as the damage and refuses it.
    """
    if len(data) >= _FROM and fields_of(data, _table(message_class.DESCRIPTOR), MAX_FIELDS) > MAX_FIELDS:
        raise NotAPolicyError(
            f"the file is made of more than {MAX_FIELDS} parts",
            why=f"it has {len(data)} bytes, few of them weights; the graph of a policy has some thousand parts",
            fix="export the policy alone",
        )


def fields_of(data: bytes, table: Table, most: int) -> int:
    """How many fields there are, up to the first damage, or just more than ``most``."""
    count = 0
    open_messages = [(message_fields(data, 0, len(data)), len(data), table)]
    try:
        while open_messages and count <= most:
            walk, message_end, table = open_messages[-1]
            groups = 0  # none of our messages has any: protobuf passes over them whatever is in them, and reads on
            for tag, _, start, end in walk:
                count += 1
                if tag & 7 in (GROUP, GROUP_END):
                    groups += 1 if tag & 7 == GROUP else -1
                    if groups < 0:
                        return count
                elif not groups and tag in table:
                    inner = table[tag]
                    if inner is None:
                        if (
                            end - start < _LARGE
                            or -tag not in table
                            or not _is_dense(data, start, min(end, message_end))
                        ):
                            count += end - start >> _PACKED
                    elif end > message_end:
                        return count
                    elif end > start:
                        open_messages.append((message_fields(data, start, end), end, inner))
                        break
                if count > most or end > message_end:
                    return count
            else:
                if groups:
                    return count
                open_messages.pop()
    except WireError:
        pass
    return count


def _is_dense(data: bytes, start: int, end: int) -> bool:
    """Whether numbers of 32 bits take at most twice in memory what they take in the file."""
    return 2 * int(np.count_nonzero(np.frombuffer(data, np.uint8, end - start, start) < 0x80)) <= end - start


def _table(descriptor: Any) -> Table:
    """The table of a message, with those of all that it may hold."""
    found = _TABLES.get(descriptor.full_name)
    if found is None:
        found = _TABLES[descriptor.full_name] = {}
        for field in descriptor.fields:
            if field.type == _MESSAGE:
                found[field.number << 3 | BYTES] = _table(field.message_type)
            elif field.type in _VARINTS:
                found[field.number << 3 | BYTES] = None
                if field.name in _HALVES:
                    found[-(field.number << 3 | BYTES)] = None
    return found
