"""Protobuf's wire format: the fields of a message, and whole numbers (varints).

A varint has seven bits a byte, the lowest first; TensorFlow's tables write whole numbers likewise.
"""

from __future__ import annotations

from collections.abc import Iterator

_MOST_BITS, _MOST = 64, (1 << 64) - 1
#: Types of a field's content; between the tags of a group lie fields.
VARINT, LONG, BYTES, GROUP, GROUP_END, SHORT = range(6)
#: Bytes of a content that always has so many.
_SIZES = {LONG: 8, SHORT: 4, GROUP: 0, GROUP_END: 0}


class WireError(Exception):
    """The bytes there must be a field, and are not."""


class CutOffError(WireError):
    """The bytes end within a number."""


def message_fields(data: bytes | memoryview, at: int, end: int) -> Iterator[tuple[int, int, int, int]]:
    """(tag, where that ends, where the content begins, where it ends) of each field of a message in ``data[at:end]``.

    A content may be cut off: it then ends beyond ``end``, and is the last. Raises WireError at the first damage.
    """
    try:
        while at < end:
            tag = data[at]
            tag_end = at + 1
            if tag > 0x7F:
                tag, tag_end = _number(data, at, end)
            kind = tag & 7
            start = tag_end
            if kind == BYTES:
                length = data[start]
                start += 1
                if length > 0x7F:
                    length, start = _number(data, tag_end, end)
                at = start + length
            elif kind == VARINT:
                at = start
                while data[at] > 0x7F:
                    at += 1
                at += 1
            elif kind in _SIZES:
                at = start + _SIZES[kind]
            else:
                raise WireError
            if tag <= 7:  # number 0
                raise WireError
            yield tag, tag_end, start, at
    except IndexError:
        raise CutOffError from None


def _number(data: bytes | memoryview, at: int, end: int) -> tuple[int, int]:
    """A number, of which protobuf in Python keeps the low bits; in C it refuses what is cut here."""
    value, at = read_varint(data, at, end)
    if value < 0:
        raise CutOffError
    return value & _MOST, at


def read_varint(data: bytes | memoryview, at: int, end: int) -> tuple[int, int]:
    """(the number that begins at ``at``, where it ends); −1 where it goes beyond ``end``, or has more than 64 bits."""
    value = shift = 0
    while at < end and shift < _MOST_BITS:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at += 1
        if byte < 0x80:
            return value, at
        shift += 7
    return -1, at


def varint(value: int) -> bytes:
    """A number that is not negative."""
    data = bytearray()
    while value > 0x7F:
        data.append(value & 0x7F | 0x80)
        value >>= 7
    data.append(value)
    return bytes(data)
