"""Whole numbers as protobuf and TensorFlow's tables write them: seven bits a byte, the lowest first."""

from __future__ import annotations

_MOST_BITS = 64


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
