"""TensorFlow's table files, the form of a checkpoint's ``.index`` (tensorflow/core/lib/io/table_format.txt).

It is LevelDB's: sorted keys in data blocks, an index block of (a key not before the block's last, the block's place),
and a footer of 48 bytes: the places of the metaindex and of the index, zeros, and a magic number. A block is followed
by a byte for its compression and by the masked CRC-32C of block and byte. Inside a block a key is stored as what it
shares with the key before, and the rest; the places where a key is stored whole ("restarts") stand at its end.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

from export_model.converters.files.wire_format import read_varint
from export_model.converters.formats.checkpoint.crc32c import crc32c, mask_crc
from export_model.signatures.errors import DamagedFileError

MAGIC = struct.pack("<Q", 0xDB4775248B80FB57)
_FOOTER, _TRAILER = 48, 5
#: A block's compression. TensorFlow writes checkpoints without one (tensor_bundle.cc: kNoCompression).
_NONE = 0
#: Keys unfold from what they share with the one before: a small file could claim any amount of memory.
MAX_KEY_BYTES = 1 << 26
_FIX = "copy the checkpoint again (binary, not through a text filter), or take one of another step: --step N"


def read_table(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """The (key, value) pairs of a table file in the order of their keys. Raises DamagedFileError."""
    if len(data) < _FOOTER or not data.endswith(MAGIC):
        raise _damaged_error("it does not end as a table does", "it was cut off, or is none")
    footer = data[-_FOOTER:]
    _, at = _handle(footer, 0, "footer")
    index, _ = _handle(footer, at, "footer")
    end = 0  # blocks follow one another, so that no block is read twice
    budget = MAX_KEY_BYTES
    last: bytes | None = None
    for bound, place in _entries(_block(data, index, "index block"), "index block", MAX_KEY_BYTES):
        handle, _ = _handle(place, 0, "index block")
        offset, size = handle
        name = f"data block at byte {offset}"
        if offset < end:
            raise _damaged_error(f"the {name} overlaps with the one before")
        end = offset + size + _TRAILER
        for key, value in _entries(_block(data, handle, name), name, budget):
            if last is not None and key <= last:
                raise _damaged_error(
                    f"the {name} has its keys in disorder", f"{_key_text(key)} follows {_key_text(last)}"
                )
            budget -= len(key)
            last = key
            yield key, value
        if last is not None and last > bound:
            raise _damaged_error(f"the {name} goes beyond the key that the index names", f"{_key_text(last)}")


def _block(data: bytes, handle: tuple[int, int], name: str) -> bytes:
    """A block's content, its checksum verified."""
    offset, size = handle
    if offset + size + _TRAILER > len(data) - _FOOTER:
        raise _damaged_error(f"the {name} reaches beyond the end of the file")
    content = data[offset : offset + size]
    kind = data[offset + size]
    (stored,) = struct.unpack_from("<I", data, offset + size + 1)
    if mask_crc(crc32c(data[offset : offset + size + 1])) != stored:
        raise _damaged_error(f"the {name} has another checksum (crc32c) than it was written with")
    if kind != _NONE:
        raise _damaged_error(f"the {name} has the compression {kind}", "TensorFlow writes checkpoints without one (0)")
    return content


def _entries(block: bytes, name: str, budget: int) -> Iterator[tuple[bytes, bytes]]:
    """The (key, value) pairs of a block; ``budget`` is how many bytes its keys may have together."""
    if len(block) < 4:
        raise _damaged_error(f"the {name} has no restarts")
    (restarts,) = struct.unpack_from("<I", block, len(block) - 4)
    end = len(block) - 4 - 4 * restarts
    if end < 0:
        raise _damaged_error(f"the {name} claims {restarts} restarts, more than it can hold")
    wholes = set(struct.unpack_from(f"<{restarts}I", block, end))
    at, key = 0, b""
    while at < end:
        start = at
        shared, at = _varint(block, at, end, name)
        rest, at = _varint(block, at, end, name)
        size, at = _varint(block, at, end, name)
        if shared > len(key) or (shared and start in wholes):
            raise _damaged_error(f"the {name} has a key that shares {shared} bytes with one of {len(key)}")
        if rest > end - at or size > end - at - rest:
            raise _damaged_error(f"the {name} has an entry that is cut off")
        key = key[:shared] + block[at : at + rest]
        budget -= len(key)
        if budget < 0:
            raise _damaged_error(f"the {name} has keys of more than {MAX_KEY_BYTES} bytes")
        at += rest
        yield key, block[at : at + size]
        at += size


def _handle(data: bytes, at: int, name: str) -> tuple[tuple[int, int], int]:
    """((offset, size) of a block, where the next handle begins)."""
    offset, at = _varint(data, at, len(data), name)
    size, at = _varint(data, at, len(data), name)
    return (offset, size), at


def _varint(data: bytes, at: int, end: int, name: str) -> tuple[int, int]:
    value, at = read_varint(data, at, end)
    if value < 0:
        raise _damaged_error(f"the {name} has a number that is cut off")
    return value, at


def _key_text(key: bytes) -> str:
    return repr(key.decode("utf-8", "replace")[:80])


def _damaged_error(what: str, why: str | None = None) -> DamagedFileError:
    return DamagedFileError(f"the checkpoint's index is damaged: {what}", why=why, fix=_FIX)
