"""TensorProto to numpy and back (tensor.proto)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from export_model.converters.files.external_data import Detached
from export_model.converters.files.tensorflow_messages import TensorProto, dtype_number, dtype_of, node_def
from export_model.converters.graph.size_limits import Allowance
from export_model.signatures.errors import DamagedFileError

_MAX_AXES = 32
_MAX_ELEMENTS = 1 << 31
_MAX_STRING_BYTES = 1 << 26

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


def to_array(proto: Any, allowance: Allowance | None = None, detached: Detached | None = None) -> np.ndarray:
    """The array of a TensorProto, a view of what is ``detached``; raises DamagedFileError."""
    dtype = dtype_of(proto.dtype)
    shape = tuple(int(d.size) for d in proto.tensor_shape.dim[: _MAX_AXES + 1])
    if proto.tensor_shape.unknown_rank or any(n < 0 for n in shape):
        raise _damaged_error("its shape is not fully known")
    if len(shape) > _MAX_AXES or math.prod(n or 1 for n in shape) > _MAX_ELEMENTS:
        raise _damaged_error(f"it claims the shape {_shape_text(shape)}")
    count = math.prod(shape)
    if dtype.kind == "S":
        return _strings(list(proto.string_val) or [b""], shape, count)
    if dtype.kind == "O":
        raise _damaged_error("it is a resource, which has no value outside a session")
    if content := proto.tensor_content:
        held = None if detached is None else detached.array(content)
        data = np.frombuffer(content, np.uint8) if held is None else held.reshape(-1).view(np.uint8)
        if data.size != count * dtype.itemsize:
            raise _damaged_error(f"it holds {data.size} bytes for {count} elements of {dtype}")
        return data.view(dtype.newbyteorder("<")).astype(dtype, copy=False).reshape(shape)
    values = _values(proto, dtype)
    if values.size > count:
        raise _damaged_error(f"it holds {values.size} values for {count} elements")
    if values.size < count:
        # TensorFlow's short form: the last value stands for all that are missing, zero if there is none.
        claimed = count - values.size
        if not (allowance or Allowance()).take(claimed):
            raise _damaged_error(f"it claims {claimed} elements that the file does not hold")
        last = values[-1] if values.size else dtype.type(0)
        values = np.concatenate([values, np.full(count - values.size, last, dtype)])
    return values.reshape(shape)


def _values(proto: Any, dtype: np.dtype) -> np.ndarray:
    try:
        if dtype == np.float16:
            return np.fromiter(proto.half_val, np.uint16, len(proto.half_val)).view(np.float16)
        return np.array(getattr(proto, _VALUE_FIELDS[dtype.name]), dtype)
    except OverflowError as error:
        raise _damaged_error(f"it holds a value that {dtype} does not have") from error


def _strings(values: list[bytes], shape: tuple[int, ...], count: int) -> np.ndarray:
    """Strings, each as wide as the longest; a list of them where there are not as many as the shape says."""
    if len(values) * max(len(v) for v in values) > _MAX_STRING_BYTES:
        raise _damaged_error(f"its {len(values)} strings are too long")
    array = np.array(values, np.bytes_)
    return array.reshape(shape) if count == array.size else array


def _shape_text(shape: tuple[int, ...]) -> str:
    return f"[{', '.join(map(str, shape[:8]))}{', …' if len(shape) > 8 else ''}]"


def _damaged_error(why: str) -> DamagedFileError:
    return DamagedFileError("the tensor cannot be read", why=why, fix="freeze the graph again; this file is damaged")


def from_array(array: np.ndarray, detached: Detached | None = None) -> Any:
    """A TensorProto with the array's raw little-endian bytes (strings as values); large ones go to ``detached``."""
    proto = TensorProto(dtype=dtype_number(array.dtype))
    for size in array.shape:
        proto.tensor_shape.dim.add(size=int(size))
    if array.dtype.kind == "S":
        proto.string_val.extend(array.reshape(-1).tolist())
    elif detached is not None and detached.takes(array):
        proto.tensor_content = detached.mark(array)
    else:
        little = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False)
        proto.tensor_content = little.tobytes()
    return proto


def constant(name: str, value: np.ndarray, detached: Detached | None = None) -> Any:
    """A NodeDef of a constant."""
    node = node_def(name, "Const", dtype=dtype_number(value.dtype))
    node.attr["value"].tensor.CopyFrom(from_array(value, detached))
    return node
