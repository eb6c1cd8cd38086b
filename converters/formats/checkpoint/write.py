"""Values to a checkpoint of one shard: the form that ``tensor_bundle`` and ``table`` describe, without compression."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

import numpy as np

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.chunks import Pieces
from export_model.converters.files.wire_format import varint
from export_model.converters.formats.checkpoint.crc32c import crc32c, mask_crc
from export_model.converters.formats.checkpoint.table import MAGIC


def checkpoint(values: Mapping[str, np.ndarray]) -> dict[str, Pieces]:
    """The files, by what their names have after the prefix."""
    header = schema.BundleHeaderProto(num_shards=1)
    header.version.producer = 1
    pairs = [(b"", schema.serialise(header))]
    at = 0
    arrays = [values[name] for name in sorted(values, key=str.encode)]
    for name, array in zip(sorted(values, key=str.encode), arrays, strict=True):
        entry = schema.BundleEntryProto(dtype=schema.dtype_number(array.dtype), offset=at, size=array.nbytes)
        entry.shape.SetInParent()
        for length in array.shape:
            entry.shape.dim.add(size=length)
        crc = 0
        for chunk in Pieces(array).chunks():
            crc = crc32c(chunk, crc)
        entry.crc32c = mask_crc(crc)
        pairs.append((name.encode(), schema.serialise(entry)))
        at += array.nbytes
    return {".index": Pieces(_table(pairs)), ".data-00000-of-00001": Pieces(*arrays)}


def _table(pairs: Sequence[tuple[bytes, bytes]]) -> bytes:
    """A table of one data block, in which every key is whole."""
    out = bytearray()

    def put(content: bytes) -> bytes:
        handle = varint(len(out)) + varint(len(content))
        content += b"\0"  # not compressed
        out.extend(content + struct.pack("<I", mask_crc(crc32c(content))))
        return handle

    data = put(_block(pairs))
    footer = put(_block([])) + put(_block([(pairs[-1][0], data)]))
    return bytes(out) + footer.ljust(40, b"\0") + MAGIC


def _block(pairs: Sequence[tuple[bytes, bytes]]) -> bytes:
    out, restarts = bytearray(), []
    for key, value in pairs:
        restarts.append(len(out))
        out += varint(0) + varint(len(key)) + varint(len(value)) + key + value
    restarts = restarts or [0]
    return bytes(out) + struct.pack(f"<{len(restarts) + 1}I", *restarts, len(restarts))
