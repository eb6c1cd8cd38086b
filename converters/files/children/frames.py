"""Frames between this process and a runtime's: tensors cross as raw bytes, never as printed decimals.

A frame is a little-endian uint32, the length of a JSON header; the header; then the bytes of the tensors that
``header["tensors"]`` lists (``{"name", "dtype", "shape"}``), one after the other, little-endian, in C order.
``converters/runtimes/javascript/js/frames.mjs`` speaks the same.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from functools import cache
from operator import index
from typing import Any, BinaryIO

import numpy as np

Tensors = dict[str, np.ndarray]
#: Bytes that are taken from a pipe at once.
_CHUNK = 1 << 20
#: The most bytes of a frame's header, and of its tensors together (weights come back from Keras).
MAX_HEADER_BYTES, MAX_TENSOR_BYTES = 1 << 26, 1 << 34


class FramingError(Exception):
    """What came is no frame, so that nothing after it can be read."""


def write_frame(stream: BinaryIO, header: Mapping[str, Any], tensors: Mapping[str, np.ndarray] | None = None) -> None:
    """Send a header with its tensors, which may be as large as a model: they are not copied."""
    parts = []
    entries = []
    for name, array in (tensors or {}).items():
        dtype, little = _dtypes(array.dtype)
        entries.append({"name": name, "dtype": dtype, "shape": list(array.shape)})
        # As bytes, before the first is sent: numpy shows some dtypes (bfloat16) to no stream.
        parts.append(np.ascontiguousarray(array, little).reshape(-1).view(np.uint8))
    text = json.dumps({**header, "tensors": entries} if tensors is not None else dict(header)).encode()
    stream.write(struct.pack("<I", len(text)) + text)
    for part in parts:
        if part.size:
            stream.write(part.data)
    stream.flush()


def read_frame(stream: BinaryIO, most: int = MAX_TENSOR_BYTES) -> tuple[dict[str, Any], Tensors]:
    """Receive a frame; raises EOFError at the end of the stream, FramingError where it is none.

    ``most``: bytes that its tensors may have together.
    """
    (length,) = struct.unpack("<I", _exactly(stream, 4))
    if length > MAX_HEADER_BYTES:
        raise FramingError(f"its header is said to have {length} bytes")
    text = _exactly(stream, length)
    tensors: Tensors = {}
    try:
        header: dict[str, Any] = json.loads(text)
        for entry in header.get("tensors", ()):
            dtype = np.dtype(entry["dtype"])
            size = math.prod(map(index, entry["shape"])) * dtype.itemsize  # of nothing but integers
            most -= size
            if most < 0 or size < 0:
                raise ValueError("its tensors are larger than an answer may be")
            data = _exactly(stream, size)
            array = np.frombuffer(data, dtype.newbyteorder("<")).astype(dtype, copy=False)
            tensors[entry["name"]] = array.reshape(entry["shape"])
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError, SyntaxError, OverflowError) as error:
        raise FramingError(f"what it said cannot be read as a frame: {error}") from error
    return header, tensors


@cache
def _dtypes(dtype: np.dtype[Any]) -> tuple[str, np.dtype[Any]]:
    """Its name, which numpy puts together every time, and itself as it crosses."""
    return dtype.name, dtype.newbyteorder("<")


def _exactly(stream: BinaryIO, count: int) -> bytearray:
    """So many bytes, in memory of their own, which what is made of them may write to."""
    data = bytearray()
    while len(data) < count:
        chunk = stream.read(min(count - len(data), _CHUNK))
        if not chunk:
            raise EOFError("the other process ended")
        data += chunk
    return data
