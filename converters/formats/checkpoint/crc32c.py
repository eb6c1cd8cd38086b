"""CRC-32C (Castagnoli, RFC 3720 appendix B.4), masked as LevelDB and TensorFlow store it (crc32c.h: ``Mask``).

Tables and checkpoints carry a checksum per block and per tensor. A Python loop over the bytes of a large network takes
tens of seconds, so long data is cut into lanes of equal length that numpy advances side by side; their remainders are
then joined, which is possible because a CRC is linear: appending n zero bytes is a matrix over GF(2).
"""

from __future__ import annotations

import numpy as np

_POLYNOMIAL = 0x82F63B78  # reflected
_MASK_DELTA = 0xA282EAD8
_ONES = 0xFFFFFFFF
#: Shorter data is not worth the lanes.
_SHORT = 1 << 15


def _table() -> np.ndarray:
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> np.uint32(1)) ^ np.uint32(_POLYNOMIAL), table >> np.uint32(1))
    return table.astype(np.uint32)


_TABLE = _table()
#: Two bytes at once.
_PAIRS = _TABLE[(_TABLE[np.arange(1 << 16) & 0xFF] ^ (np.arange(1 << 16) >> 8)) & 0xFF] ^ (
    _TABLE[np.arange(1 << 16) & 0xFF] >> np.uint32(8)
)
_NUMBERS: list[int] = _TABLE.tolist()


def _scalar(state: int, data: bytes | memoryview) -> int:
    for byte in data:
        state = _NUMBERS[(state ^ byte) & 0xFF] ^ (state >> 8)
    return state


def _advance(states: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Every state moved over its lane; ``columns`` are the lanes' pairs of bytes, one row per position."""
    for column in columns:
        states = _PAIRS[(states ^ column) & np.uint32(0xFFFF)] ^ (states >> np.uint32(16))
    return states


def crc32c(data: bytes | memoryview, before: int = 0) -> int:
    """The checksum of ``data``, not masked; ``before`` is that of what lies before it."""
    if len(data) < _SHORT:
        return _scalar(before ^ _ONES, data) ^ _ONES
    length = max(int(len(data) ** 0.5) // 4, 128) * 2
    count = len(data) // length
    lanes = np.frombuffer(data, "<u2", count * length // 2).reshape(count, length // 2)
    states = np.zeros(count, np.uint32)
    states[0] = before ^ _ONES
    ends: list[int] = _advance(states, np.ascontiguousarray(lanes.T)).tolist()
    bits = np.uint32(1) << np.arange(32, dtype=np.uint32)
    images: list[int] = _advance(bits, np.zeros((length // 2, 1), np.uint16)).tolist()
    state = ends[0]
    for end in ends[1:]:
        moved = 0
        for bit, image in enumerate(images):
            if state >> bit & 1:
                moved ^= image
        state = moved ^ end
    return _scalar(state, data[count * length :]) ^ _ONES


def mask_crc(crc: int) -> int:
    """A checksum as it is stored: rotated and shifted, so that the checksum of data with checksums is no constant."""
    return ((crc >> 15 | crc << 17) + _MASK_DELTA) & _ONES
