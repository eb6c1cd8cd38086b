"""Keras 3's operations (``keras.ops``, and operators on tensors) between layers. They hold no weights."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from converters.formats.keras.layers.activations import activation_of, softmax
from converters.formats.keras.layers.step import Step, Translate
from converters.graph.nn.activations import clip, elu
from converters.graph.nn.linear import matmul
from converters.graph.ops.einsum import einsum
from converters.graph.types import FLOAT32
from signatures.errors import UnsupportedOpError


def _argument(step: Step, at: int, key: str, default: Any = None) -> Any:
    """An argument of the call, by place or name, else a setting."""
    if at < len(step.args):
        return step.args[at]
    setting = step.get(key, default)
    return step.kwargs.get(key, setting)


def _operand(step: Step, value: Any) -> str:
    """A tensor, or a number as one."""
    if isinstance(value, str):
        return value
    array = np.asarray(value)
    if array.dtype.kind not in "fiub" or array.size > 1 << 16:
        raise UnsupportedOpError(f"it is given {str(value)[:60]!r}")
    like = next((t for t in step.tensors), None)
    return step.net.const(array.astype(FLOAT32 if like is None else step.net.dtype(like)), "operand")


def _binary(step: Step, op: str) -> str:
    first, second = (_operand(step, _argument(step, i, k)) for i, k in ((0, "x1"), (1, "x2")))
    return step.net.add(op, [first, second])


def _unary(step: Step, op: str) -> str:
    return step.net.add(op, [step.x])


def _activation(step: Step, name: str) -> str:
    return activation_of(step, name)(step.net, step.x)


def _softmax(step: Step, op: str) -> str:
    return softmax(step.net, step.x, int(_argument(step, 1, "axis", -1)), op)


def _reduce(step: Step, kind: str) -> str:
    b, axis = step.net, _argument(step, 1, "axis")
    axes = range(b.rank(step.x)) if axis is None else [axis] if isinstance(axis, int) else axis
    keep = bool(_argument(step, 2, "keepdims", False))
    return b.reduce(kind, step.x, sorted(b.axis(step.x, int(a)) for a in axes), keep=keep)


def _clip(step: Step) -> str:
    low, high = (_argument(step, i, k) for i, k in ((1, "x_min"), (2, "x_max")))
    return clip(step.net, step.x, *(v if isinstance(v, str) or v is None else float(v) for v in (low, high)))


def _stack(step: Step) -> str:
    axis = int(step.get("axis", 0))
    return step.net.add("Pack", step.tensors, axis=axis % (step.rank + 1))


def _reshape(step: Step) -> str:
    b = step.net
    shape = [b.shape(step.x)[0] if n is None else int(n) for n in _argument(step, 1, "newshape")]
    if shape[0] == -1 and shape.count(-1) == 1:
        return b.reshape(step.x, shape)
    known = [n for n in shape[1:] if isinstance(n, int)]
    if -1 in known:
        whole = int(np.prod([b.length(step.x, i) for i in range(1, step.rank)], dtype=object))
        shape[shape.index(-1, 1)] = whole // max(-int(np.prod(known, dtype=object)), 1)
    return b.reshape(step.x, [b.shape(step.x)[0], *shape[1:]])


def _item(step: Step) -> str:
    """``x[:, 1:3]``: slices, and single indices, whose axes go."""
    b, value, axis = step.net, step.x, 0
    keys = _argument(step, 1, "key")
    for key in keys if isinstance(keys, list | tuple) else [keys]:
        if isinstance(key, slice):
            start, stop, by = key.start, key.stop, key.step or 1
            if (start, stop, by) != (None, None, 1):
                value = b.slice(value, axis, start, stop, by)
            axis += 1
        elif isinstance(key, int):
            value = b.squeeze(b.slice(value, axis, key, key + 1 if key != -1 else None), [axis])
        else:
            raise UnsupportedOpError("it picks elements by more than slices and numbers")
    return value


def _transpose(step: Step) -> str:
    axes = _argument(step, 1, "axes")
    return step.net.transpose(step.x, [*range(step.rank)][::-1] if axes is None else [int(a) for a in axes])


def _squeeze(step: Step) -> str:
    axis = _argument(step, 1, "axis")
    if axis is None:
        raise UnsupportedOpError("it squeezes every axis of length 1")
    return step.net.squeeze(
        step.x, [step.net.axis(step.x, int(a)) for a in (axis if isinstance(axis, list) else [axis])]
    )


def _expand_dims(step: Step) -> str:
    axis = int(_argument(step, 1, "axis"))
    return step.net.expand_dims(step.x, axis % (step.rank + 1))


_BINARY = {
    "Add": "Add",
    "Subtract": "Sub",
    "Multiply": "Mul",
    "Divide": "RealDiv",
    "TrueDivide": "RealDiv",
    "Maximum": "Maximum",
    "Minimum": "Minimum",
    "Power": "Pow",
}
#: Operations that are one op of the same name, and two that are called otherwise.
_SAME = "Exp Log Sqrt Square Abs Sin Cos Tanh Sign Log1p Expm1 Rsqrt Reciprocal"
_UNARY = {**{name: name for name in _SAME.split()}, "Absolute": "Abs", "Negative": "Neg"}
#: Activations without settings; the class of ``hard_silu`` is HardSilu.
_ACTIVATIONS = "relu relu6 sigmoid selu softplus softsign silu hard_sigmoid hard_silu log_sigmoid"
_REDUCTIONS = {"Mean": "Mean", "Sum": "Sum", "Max": "Max", "Min": "Min", "Prod": "Prod", "Amax": "Max", "Amin": "Min"}
OPERATIONS: Mapping[str, Translate] = {
    **{name: partial(_binary, op=op) for name, op in _BINARY.items()},
    **{name: partial(_unary, op=op) for name, op in _UNARY.items()},
    **{name.title().replace("_", ""): partial(_activation, name=name) for name in _ACTIVATIONS.split()},
    **{name: partial(_reduce, kind=kind) for name, kind in _REDUCTIONS.items()},
    "Elu": lambda s: elu(s.net, s.x, float(_argument(s, 1, "alpha", 1.0))),
    "Gelu": lambda s: activation_of(s, "gelu_new" if _argument(s, 1, "approximate", True) else "gelu")(s.net, s.x),
    "Softmax": partial(_softmax, op="Softmax"),
    "LogSoftmax": partial(_softmax, op="LogSoftmax"),
    "Clip": _clip,
    "Concatenate": lambda s: s.net.concat(s.tensors, s.net.axis(s.x, int(s.get("axis", -1) or 0))),
    "Stack": _stack,
    "Reshape": _reshape,
    "GetItem": _item,
    "Transpose": _transpose,
    "Squeeze": _squeeze,
    "ExpandDims": _expand_dims,
    "Matmul": lambda s: matmul(s.net, *s.tensors[:2]),
    "Einsum": lambda s: einsum(s.net, str(s.get("subscripts")), s.tensors, shape_of=s.net.shape),
}
