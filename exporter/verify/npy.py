"""An array in numpy's own format (``numpy/lib/format.py``), read by checks of ours: numpy evaluates a header as Python.

Magic, version, the header's length (2 bytes in version 1, 4 from 2 on), a dictionary of ``descr``, ``fortran_order``
and ``shape`` as Python writes it, then the numbers.
"""

from __future__ import annotations

import json
import math
import re
import struct
from typing import Any

import numpy as np

_MAGIC = b"\x93NUMPY"
#: What ``descr`` may be: numbers, and texts, which no tensor is.
_DTYPE = re.compile(r"[<>|=]?[biufcUS]\d{1,4}")
_KEYS = {"descr", "fortran_order", "shape"}
#: numpy reads no longer ones either.
_MOST_CHARACTERS = 10_000
#: Python's way to write what JSON writes otherwise; none of it can stand in a dtype.
_AS_JSON = {"'": '"', "(": "[", ")": "]", "True": "true", "False": "false"}


def read_array(data: bytes) -> np.ndarray:
    """The array, a view of the bytes. Raises ValueError, TypeError, RecursionError, struct.error for what is none."""
    if not data.startswith(_MAGIC):
        raise ValueError("it must be a numpy array")
    begin, form = (10, "<H") if data[6:7] == b"\x01" else (12, "<I")
    (length,) = struct.unpack_from(form, data, 8)
    if length > min(_MOST_CHARACTERS, len(data) - begin):
        raise ValueError(f"its header should have {length} characters")
    shape, dtype, columns = _header(data[begin : begin + length].decode("ascii"))
    count, begin = math.prod(shape), begin + length
    if count * dtype.itemsize > len(data) - begin:
        raise ValueError(f"it says to be {list(shape)[:8]} and has {len(data) - begin} bytes")
    flat = np.frombuffer(data, dtype, count, begin) if count else np.zeros(0, dtype)
    return flat.reshape(shape, order="F" if columns else "C")


def _header(text: str) -> tuple[tuple[int, ...], np.dtype, bool]:
    for python, other in _AS_JSON.items():
        text = text.replace(python, other)
    header: Any = json.loads(re.sub(r",\s*([\]}])", r"\1", re.sub(r"(\d)L\b", r"\1", text)))  # Python 2: (3L,)
    if not isinstance(header, dict) or set(header) != _KEYS:
        raise ValueError("its header does not say what it is")
    descr, columns, shape = header["descr"], header["fortran_order"], header["shape"]
    if not isinstance(shape, list) or not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError(f"its shape is {str(shape)[:80]}")
    if not isinstance(descr, str) or not _DTYPE.fullmatch(descr) or not isinstance(columns, bool):
        raise ValueError(f"its numbers are {str(descr)[:80]!r}")
    return tuple(shape), np.dtype(descr), columns
