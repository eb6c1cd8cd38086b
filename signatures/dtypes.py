"""The dtypes that a policy's tensors may have, with their numbers and names in the files of TensorFlow and ONNX."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class DataType(NamedTuple):
    """A dtype as files number and name it: TensorFlow's types.proto, ONNX's TensorProto.DataType."""

    dtype: np.dtype
    tensorflow: int
    name: str
    onnx: int


DATA_TYPES = (
    DataType(np.dtype(np.float32), 1, "DT_FLOAT", 1),
    DataType(np.dtype(np.float64), 2, "DT_DOUBLE", 11),
    DataType(np.dtype(np.int32), 3, "DT_INT32", 6),
    DataType(np.dtype(np.uint8), 4, "DT_UINT8", 2),
    DataType(np.dtype(np.int16), 5, "DT_INT16", 5),
    DataType(np.dtype(np.int8), 6, "DT_INT8", 3),
    DataType(np.dtype(np.int64), 9, "DT_INT64", 7),
    DataType(np.dtype(np.bool_), 10, "DT_BOOL", 9),
    DataType(np.dtype(np.uint16), 17, "DT_UINT16", 4),
    DataType(np.dtype(np.float16), 19, "DT_HALF", 10),
    DataType(np.dtype(np.uint32), 22, "DT_UINT32", 12),
    DataType(np.dtype(np.uint64), 23, "DT_UINT64", 13),
)
