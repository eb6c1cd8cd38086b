"""Arguments of Keras 3's operations: tensors, numbers and settings, in the dtype in which Keras computes.

Promotion: keras/src/backend/common/dtypes.py. A float of any width is a float32 here; a plain number takes the dtype of
the tensor that it meets.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any

import numpy as np

from export_model.converters.formats.keras.layers.step import Step
from export_model.converters.graph.types import BOOL, FLOAT32, INT32
from export_model.signatures.errors import UnsupportedOpError
from export_model.signatures.spec import DTYPES

#: Elements of a constant that stands among the arguments of a call.
_MAX_OPERAND = 1 << 16


def argument(step: Step, at: int, key: str, default: Any = None) -> Any:
    """An argument of the call, by place or name, else a setting."""
    if at < len(step.args):
        return step.args[at]
    setting = step.get(key, default)
    return step.kwargs.get(key, setting)


def constant(value: Any) -> np.ndarray:
    """Numbers among the arguments. Raises UnsupportedOpError for anything else."""
    try:
        array = np.asarray(value)
    except ValueError:
        array = np.asarray(None)
    if array.dtype.kind not in "fiub" or array.size > _MAX_OPERAND:
        raise UnsupportedOpError(f"it is given {str(value)[:60]!r}")
    return array


def promote(step: Step, values: Sequence[Any], *, least: np.dtype | None = None) -> list[str]:
    """Tensors and numbers as tensors of one dtype, which ``least`` may widen."""
    arrays = {i: constant(v) for i, v in enumerate(values) if not isinstance(v, str)}
    dtypes = [step.net.dtype(v) for v in values if isinstance(v, str)]
    dtypes += [FLOAT32 if a.dtype.kind == "f" else INT32 for a in arrays.values() if a.ndim or a.dtype.kind == "f"]
    if any(a.dtype.kind in "iu" for a in arrays.values()) and not set(dtypes) - {BOOL}:
        dtypes.append(INT32)
    if least is not None:
        dtypes.append(least)
    common: np.dtype = FLOAT32
    if not any(d.kind == "f" for d in dtypes):
        common = reduce(np.promote_types, dtypes or [BOOL])
    return [
        step.net.cast(v, common) if isinstance(v, str) else step.net.const(arrays[i].astype(common), "operand")
        for i, v in enumerate(values)
    ]


def named_dtype(name: Any) -> np.dtype:
    """The dtype of a setting; every float is a float32. Raises UnsupportedOpError."""
    if name == "bfloat16" or (name in DTYPES and name.startswith("float")):
        return FLOAT32
    if name not in DTYPES:
        raise UnsupportedOpError(f"its dtype is {str(name)[:60]!r}")
    return np.dtype(str(name))


def cast_to_setting(step: Step, value: str) -> str:
    """``value`` in the dtype that the operation says, if it says one."""
    name = step.get("dtype")
    return value if name is None else step.net.cast(value, named_dtype(name))


def as_float(step: Step, value: str) -> str:
    """``value`` as a float: most functions of integers are floats in Keras."""
    return step.net.cast(value, FLOAT32)


def axes_of(step: Step, at: int = 1) -> list[int]:
    """The axes that a reduction goes over; all where it says none."""
    axis = argument(step, at, "axis")
    if axis is None:
        return [*range(step.rank)]
    return sorted(step.net.axis(step.x, int(a)) for a in ([axis] if isinstance(axis, int) else axis))


def axis_of(step: Step, at: int = 1, default: int | None = -1) -> int:
    """The one axis that an operation works along. Raises UnsupportedOpError where it takes all elements as one row."""
    axis = argument(step, at, "axis", default)
    if axis is None:
        raise UnsupportedOpError("it takes the elements of all rows as one")
    return step.net.axis(step.x, int(axis))
