"""TensorProto to numpy and back (tensor.proto)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from converters.schema import TensorProto, dtype_number, dtype_of
from signatures.errors import DamagedFileError

#: A constant that is written as one repeated value may not unfold to more elements than this.
MAX_ELEMENTS = 1 << 27

_VALUE_FIELDS = {
    "float32": "float_val",
    "float64": "double_val",
    "int32": "int_val",
    "int16": "int_val",
    "int8": "int_val",
    "uint16": "int_val",
    "uint8": "int_val",
    "int64": "int64_val",
    "bool": "bool_val",
    "uint32": "uint32_val",
    "uint64": "uint64_val",
}


def to_array(proto: Any, where: str) -> np.ndarray:
    """The array of a TensorProto; ``where`` names the node in errors."""
    dtype = dtype_of(proto.dtype)
    shape = tuple(int(d.size) for d in proto.tensor_shape.dim)
    if proto.tensor_shape.unknown_rank or any(n < 0 for n in shape):
        raise _damaged(where, "its shape is not fully known")
    count = math.prod(shape)
    if count > MAX_ELEMENTS:
        raise _damaged(where, f"it claims {count} elements")
    if dtype.kind == "S":
        return np.array(list(proto.string_val) or [b""], np.bytes_).reshape(shape if count == 1 else -1)
    if dtype.kind == "O":
        raise _damaged(where, "resources cannot be constants")
    if proto.tensor_content:
        if len(proto.tensor_content) != count * dtype.itemsize:
            raise _damaged(where, f"it holds {len(proto.tensor_content)} bytes for {count} elements of {dtype}")
        return np.frombuffer(proto.tensor_content, dtype.newbyteorder("<")).astype(dtype, copy=False).reshape(shape)
    if dtype == np.float16:
        values = np.array(list(proto.half_val), np.uint16).view(np.float16)
    else:
        values = np.array(getattr(proto, _VALUE_FIELDS[dtype.name]), dtype)
    if values.size > count:
        raise _damaged(where, f"it holds {values.size} values for {count} elements")
    if values.size < count:
        # TensorFlow's short form: the last value stands for all that are missing, zero if there is none.
        last = values[-1] if values.size else dtype.type(0)
        values = np.concatenate([values, np.full(count - values.size, last, dtype)])
    return values.reshape(shape)


def _damaged(where: str, why: str) -> DamagedFileError:
    return DamagedFileError(
        f"the constant {where!r} cannot be read", why=why, fix="freeze the graph again; this file is damaged"
    )


def from_array(array: np.ndarray) -> Any:
    """A TensorProto with the array's raw little-endian bytes (strings as values)."""
    proto = TensorProto(dtype=dtype_number(array.dtype))
    for size in array.shape:
        proto.tensor_shape.dim.add(size=int(size))
    if array.dtype.kind == "S":
        proto.string_val.extend(array.reshape(-1).tolist())
    else:
        little = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False)
        proto.tensor_content = little.tobytes()
    return proto
