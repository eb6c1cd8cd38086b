"""Snappy's raw format (google/snappy, format_description.txt): what a table block may be compressed with.

A varint says the length; then come elements, told apart by the two low bits of their tag: a literal, or a copy of what
was written before, with an offset of 11, 16 or 32 bits. TensorFlow writes checkpoints without compression; other
writers of its table format need not.
"""

from __future__ import annotations

#: A copy of 64 bytes takes three, so nothing grows more than this.
_MOST = 64


class SnappyError(ValueError):
    """The data is not in the format; the text says where it breaks."""


def decompress(data: bytes) -> bytes:
    """The bytes behind ``data``. Raises SnappyError."""
    size, at = _length(data)
    if size > _MOST * len(data):
        raise SnappyError(f"{len(data)} bytes cannot hold the {size} that they claim")
    out = bytearray()
    while at < len(data):
        tag = data[at]
        at += 1
        if tag & 3 == 0:
            count, at = _literal(data, tag >> 2, at)
            if count > len(data) - at:
                raise SnappyError(f"a literal of {count} bytes is cut off")
            out += data[at : at + count]
            at += count
        else:
            width = (0, 1, 2, 4)[tag & 3]
            if width > len(data) - at:
                raise SnappyError("a copy is cut off")
            offset = int.from_bytes(data[at : at + width], "little")
            at += width
            count = (tag >> 2) + 1
            if width == 1:
                offset |= tag >> 5 << 8
                count = (tag >> 2 & 7) + 4
            if not 0 < offset <= len(out):
                raise SnappyError(f"a copy reaches {offset} bytes back where {len(out)} were written")
            start = len(out) - offset
            run = bytes(out[start : start + count])
            out += (run * (count // len(run) + 1))[:count]  # a copy may overlap with what it writes
        if len(out) > size:
            break
    if len(out) != size:
        raise SnappyError(f"it claims {size} bytes and holds {'more' if len(out) > size else len(out)}")
    return bytes(out)


def _length(data: bytes) -> tuple[int, int]:
    size = 0
    for at, byte in enumerate(data[:5]):
        size |= (byte & 0x7F) << 7 * at
        if byte < 0x80:
            return size, at + 1
    raise SnappyError("it does not say its length")


def _literal(data: bytes, code: int, at: int) -> tuple[int, int]:
    """(length, where the bytes begin): lengths above 60 follow the tag in one to four bytes."""
    if code < 60:
        return code + 1, at
    width = code - 59
    if width > len(data) - at:
        raise SnappyError("the length of a literal is cut off")
    return int.from_bytes(data[at : at + width], "little") + 1, at + width
