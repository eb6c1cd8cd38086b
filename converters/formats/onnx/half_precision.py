"""A model in half precision as one in float32: the same weights, computed with more digits.

float16 and bfloat16 are for accelerators. No target here computes in them throughout, and their own rounding is no
part of a policy, so both what is read and what it is compared with are the model in float32.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from export_model.converters.files.external_data import LARGE, Detached
from export_model.converters.formats.onnx.proto import bodies, raw_of, tensors
from export_model.signatures.errors import DamagedFileError

_FLOAT, _FLOAT16, _BFLOAT16 = 1, 10, 16  # TensorProto.DataType
_HALVES = (_FLOAT16, _BFLOAT16)
#: Attributes that name a data type: of Cast, and of the ops that make tensors.
_TYPES = ("to", "dtype", "output_datatype", "stash_type")


def widen(model: Any, detached: Detached | None = None) -> bool:
    """Make a ModelProto float32 in place, whose tensors hold their data, or ``detached`` does.

    Returns whether anything of it was half precision.
    """
    found = False
    for part in (model.graph, *model.functions):
        for tensor in tensors(part):
            if tensor.data_type in _HALVES:
                found = True
                _widen_tensor(tensor, detached)
        for body in bodies(part):
            values = (*body.input, *body.output, *body.value_info)
            for value in (v for v in values if not isinstance(v, str)):  # a function's are names
                if value.type.tensor_type.elem_type in _HALVES:
                    found = True
                    value.type.tensor_type.elem_type = _FLOAT
            for attribute in (a for node in body.node for a in node.attribute):
                if attribute.name in _TYPES and attribute.i in _HALVES:
                    found = True
                    attribute.i = _FLOAT
    return found


def _widen_tensor(tensor: Any, detached: Detached | None) -> None:
    whole = tensor.HasField("raw_data")
    stored = raw_of(tensor, detached) if whole else np.fromiter(tensor.int32_data, "<i4", len(tensor.int32_data))
    data = stored if whole else stored.astype("<u2")
    if data.nbytes % 2 or (not whole and (data != stored).any()):
        raise DamagedFileError(
            f"the tensor {tensor.name!r} holds {stored.nbytes} bytes, which are no 16-bit numbers",
            fix="export the model again",
        )
    raw = data.view("<u2")
    wide = raw.view(np.float16).astype("<f4") if tensor.data_type == _FLOAT16 else (raw.astype("<u4") << 16).view("<f4")
    tensor.ClearField("int32_data")
    tensor.raw_data = wide.tobytes() if detached is None or wide.nbytes < LARGE else detached.mark(wide.view(np.uint8))
    tensor.data_type = _FLOAT
