"""Keras 3's operations (``keras.ops``, and operators on tensors) between layers. They hold no weights."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

import numpy as np

from export_model.converters.formats.keras.layers import rearranging
from export_model.converters.formats.keras.layers.activations import activation_of, softmax
from export_model.converters.formats.keras.layers.arguments import (
    argument,
    as_float,
    axes_of,
    axis_of,
    cast_to_setting,
    constant,
    named_dtype,
    promote,
)
from export_model.converters.formats.keras.layers.step import Step, Translate
from export_model.converters.graph.nn import choosing, reduction, trigonometry
from export_model.converters.graph.nn.activations import Activation, celu, clip, elu, leaky_relu, scale_and_shift
from export_model.converters.graph.nn.linear import matmul
from export_model.converters.graph.ops.einsum import einsum
from export_model.converters.graph.ops.table import TABLE
from export_model.converters.graph.types import BOOL, FLOAT32, INT32
from export_model.signatures.errors import UnsupportedOpError

# ------------------------------------------------------------------ each element by itself


def _pair(step: Step, least: np.dtype | None = None) -> list[str]:
    return promote(step, [argument(step, i, k) for i, k in ((0, "x1"), (1, "x2"))], least=least)


def _binary(step: Step, op: str, least: np.dtype | None = INT32) -> str:
    """An op on two tensors of one dtype; ``least`` is FLOAT32 where the result is a float in any case."""
    return step.net.add(op, _pair(step, least if least is FLOAT32 or _both_bool(step) else None))


def _both_bool(step: Step) -> bool:
    return all(step.net.dtype(t) == BOOL for t in step.tensors)


def _divide_no_nan(step: Step) -> str:
    """The quotient, and 0 where the divisor is."""
    b, (x, y) = step.net, _pair(step, FLOAT32)
    return b.where(b.add("Equal", [y, b.number(y, 0)]), b.number(x, 0), b.add("RealDiv", [x, y]))


def _against_largest(step: Step, op: str) -> str:
    """Comparison of the absolute value with the largest number; of a NaN every comparison is false."""
    size = step.net.add("Abs", [as_float(step, step.x)])
    return step.net.add(op, [size, step.net.number(size, float(np.finfo(FLOAT32).max))])


def _logical(step: Step, op: str) -> str:
    operands = [step.net.cast(v, BOOL) for v in _pair(step)]
    return step.net.add(op, operands)


def _unary(step: Step, op: str) -> str:
    return step.net.add(op, [step.x])


def _of_float(step: Step, function: Activation) -> str:
    return function(step.net, as_float(step, step.x))


def _op_of_float(step: Step, op: str) -> str:
    return step.net.add(op, [as_float(step, step.x)])


def _activation(step: Step, name: str) -> str:
    return activation_of(step, name)(step.net, as_float(step, step.x))


def _fixed_activation(step: Step, name: str, setting: str, value: float) -> str:
    """An activation that is read with one value of its setting."""
    step.refuse_unless(setting, value)
    return _activation(step, name)


def _softmax(step: Step, op: str) -> str:
    return softmax(step.net, as_float(step, step.x), int(argument(step, 1, "axis", -1)), op)


def _clip(step: Step) -> str:
    low, high = (argument(step, i, k) for i, k in ((1, "x_min"), (2, "x_max")))
    given = [step.x, *(v for v in (low, high) if v is not None)]
    value, *bounds = promote(step, given)
    pending = iter(bounds)
    return clip(step.net, value, *(None if v is None else next(pending) for v in (low, high)))


def _where(step: Step) -> str:
    condition, *values = (argument(step, i, k) for i, k in enumerate(("condition", "x1", "x2")))
    if None in values:
        raise UnsupportedOpError("it lists the places where a condition holds")
    (given,) = promote(step, [condition])
    return step.net.where(step.net.cast(given, BOOL), *promote(step, values))


def _round(step: Step) -> str:
    step.refuse_unless("decimals", 0)
    return _unary(step, "Round")


def _truncate(step: Step) -> str:
    b, x = step.net, step.x
    return b.add("Mul", [b.add("Sign", [x]), b.add("Floor", [b.add("Abs", [x])])])


def _replace_odd(step: Step) -> str:
    """NaN and the infinities as numbers."""
    b, x = step.net, step.x
    largest = float(np.finfo(FLOAT32).max)
    nan, top, bottom = (argument(step, i, k) for i, k in ((1, "nan"), (2, "posinf"), (3, "neginf")))
    value = b.where(b.add("NotEqual", [x, x]), b.number(x, float(nan or 0)), x)
    for op, limit, said in (("Greater", largest, top), ("Less", -largest, bottom)):
        beyond = b.add(op, [value, b.number(x, limit)])
        value = b.where(beyond, b.number(x, limit if said is None else float(said)), value)
    return value


def _full_like(step: Step) -> str:
    b, x = step.net, cast_to_setting(step, step.x)
    value = constant(argument(step, 1, "fill_value")).item()
    return b.add("Add", [b.add("ZerosLike", [x]), b.number(x, value)])


def _scale_result(step: Step, op: str, factor: float) -> str:
    return scale_and_shift(step.net, _op_of_float(step, op), factor)


# ------------------------------------------------------------------ many elements


def _reduce(step: Step, kind: str) -> str:
    b, x, axes = step.net, step.x, axes_of(step)
    keep = bool(argument(step, 2, "keepdims", False))
    if kind == "Mean":
        x = as_float(step, x)
    elif not TABLE[kind].exact and not b.is_float(x):  # sums and products
        x = b.cast(x, np.promote_types(b.dtype(x), INT32))
    return cast_to_setting(step, b.reduce(kind, x, axes, keep=keep))


def _reduce_truth(step: Step, op: str) -> str:
    b = step.net
    axes = b.ints(axes_of(step), "axes")
    return b.add(op, [b.cast(step.x, BOOL), axes], keep_dims=bool(argument(step, 2, "keepdims", False)))


def _count_nonzero(step: Step) -> str:
    b = step.net
    return b.reduce("Sum", b.cast(b.cast(step.x, BOOL), INT32), axes_of(step), keep=False)


def _log_sum_exp(step: Step) -> str:
    keep = bool(argument(step, 2, "keepdims", False))
    return reduction.log_sum_exp(step.net, as_float(step, step.x), axes_of(step), keep)


def _variance(step: Step) -> str:
    b, x, axes = step.net, as_float(step, step.x), axes_of(step)
    centred = b.add("Sub", [x, b.reduce("Mean", x, axes, keep=True)])
    return b.reduce("Mean", b.add("Square", [centred]), axes, keep=bool(argument(step, 2, "keepdims", False)))


def _norm(step: Step) -> str:
    """The length of vectors, or of matrices as vectors (Frobenius)."""
    b, x, axes, order = step.net, as_float(step, step.x), axes_of(step, 2), argument(step, 1, "ord")
    keep = bool(argument(step, 3, "keepdims", False))
    if order in (None, "fro") or (order == 2 and len(axes) == 1):
        return reduction.l2(b, x, axes, keep)
    if len(axes) == 1 and order == 1:
        return reduction.l1(b, x, axes, keep)
    if len(axes) == 1 and order == math.inf:
        return b.reduce("Max", b.add("Abs", [x]), axes, keep=keep)
    raise UnsupportedOpError(f"its norm is of the order {str(order)[:60]!r}")


def _place_of(step: Step, op: str) -> str:
    """The index of the largest element, or the smallest, int32; of equal ones the first."""
    b, axis = step.net, axis_of(step, 1, None)
    value = b.cast(b.add(op, [step.x, b.ints(axis, "axis")], output_type=np.dtype(np.int64)), INT32)
    return b.expand_dims(value, axis) if argument(step, 2, "keepdims", False) else value


def _cumulate(step: Step, *, product: bool) -> str:
    b, axis = step.net, axis_of(step, 1, None)
    if not b.is_float(step.x):
        raise UnsupportedOpError("it adds up whole numbers")
    value = choosing.cumulate(b, choosing.last(b, cast_to_setting(step, step.x), axis), product=product)
    return choosing.moved_back(b, value, axis)


def _sort(step: Step, *, places: bool = False) -> str:
    b, axis = step.net, axis_of(step)
    x = choosing.last(b, step.x, axis)
    best, index = choosing.top_k(b, x, b.length(x, -1), largest=False)
    return choosing.moved_back(b, b.cast(index, INT32) if places else best, axis)


def _top_k(step: Step) -> list[str]:
    argument(step, 2, "sorted")  # where it is false any order will do
    best, index = choosing.top_k(step.net, step.x, int(argument(step, 1, "k")))
    return [best, step.net.cast(index, INT32)]


_BINARY = {
    "Add": "Add",
    "Subtract": "Sub",
    "Multiply": "Mul",
    "Maximum": "Maximum",
    "Minimum": "Minimum",
    "Power": "Pow",
    "Mod": "FloorMod",
    "FloorDivide": "FloorDiv",
}
_COMPARISONS = "Greater GreaterEqual Less LessEqual Equal NotEqual"
_LOGICAL = {"LogicalAnd": "LogicalAnd", "LogicalOr": "LogicalOr", "LogicalXor": "NotEqual"}
#: Operations that are one op of the same name, of the dtype that they are given; those that give floats.
_SAME = "Square Abs Sign"
_FLOAT = "Exp Log Sqrt Sin Cos Tan Tanh Log1p Expm1 Rsqrt Reciprocal Floor Ceil Erf"
_UNARY = {**{name: name for name in _SAME.split()}, "Absolute": "Abs", "Negative": "Neg"}
_TRIGONOMETRY: Mapping[str, Activation] = {
    "Sinh": trigonometry.sinh,
    "Cosh": trigonometry.cosh,
    "Arcsinh": trigonometry.asinh,
    "Arccosh": trigonometry.acosh,
    "Arctanh": trigonometry.atanh,
    "Arctan": trigonometry.atan,
}
_FINITE = {"Isinf": "Greater", "Isfinite": "LessEqual"}
#: Activations without settings; the class of ``hard_silu`` is HardSilu.
_ACTIVATIONS = (
    "relu relu6 sigmoid selu softplus softsign silu hard_sigmoid hard_silu hard_tanh log_sigmoid tanh_shrink"
    " sparse_plus sparse_sigmoid"
)
_REDUCTIONS = {"Mean": "Mean", "Sum": "Sum", "Max": "Max", "Min": "Min", "Prod": "Prod", "Amax": "Max", "Amin": "Min"}
OPERATIONS: Mapping[str, Translate] = {
    **rearranging.OPERATIONS,
    **{name: partial(_binary, op=op) for name, op in _BINARY.items()},
    **dict.fromkeys(("Divide", "TrueDivide"), partial(_binary, op="RealDiv", least=FLOAT32)),
    "DivideNoNan": _divide_no_nan,
    **{name: partial(_binary, op=name) for name in _COMPARISONS.split()},
    **{name: partial(_logical, op=op) for name, op in _LOGICAL.items()},
    **{name: partial(_unary, op=op) for name, op in _UNARY.items()},
    **{name: partial(_op_of_float, op=name) for name in _FLOAT.split()},
    **{name: partial(_against_largest, op=op) for name, op in _FINITE.items()},
    "Isnan": lambda s: s.net.add("NotEqual", [s.x, s.x]),
    **{name: partial(_of_float, function=function) for name, function in _TRIGONOMETRY.items()},
    **{name.title().replace("_", ""): partial(_activation, name=name) for name in _ACTIVATIONS.split()},
    **{name: partial(_reduce, kind=kind) for name, kind in _REDUCTIONS.items()},
    **dict.fromkeys(("StopGradient", "Copy"), lambda s: s.x),
    "Cast": lambda s: s.net.cast(s.x, named_dtype(argument(s, 1, "dtype"))),
    "LogicalNot": lambda s: s.net.add("LogicalNot", [s.net.cast(s.x, BOOL)]),
    "Where": _where,
    "Clip": _clip,
    "Round": _round,
    "Trunc": _truncate,
    "NanToNum": _replace_odd,
    "FullLike": _full_like,
    "ZerosLike": lambda s: s.net.add("ZerosLike", [cast_to_setting(s, s.x)]),
    "OnesLike": lambda s: s.net.add("OnesLike", [cast_to_setting(s, s.x)]),
    "Erfc": lambda s: scale_and_shift(s.net, _op_of_float(s, "Erf"), -1, 1),
    "Log2": partial(_scale_result, op="Log", factor=1 / math.log(2)),
    "Log10": partial(_scale_result, op="Log", factor=1 / math.log(10)),
    "Elu": lambda s: elu(s.net, s.x, float(argument(s, 1, "alpha", 1.0))),
    "Celu": lambda s: celu(s.net, s.x, float(argument(s, 1, "alpha", 1.0))),
    "LeakyRelu": lambda s: leaky_relu(s.net, s.x, float(argument(s, 1, "negative_slope", 0.2))),
    "HardShrink": partial(_fixed_activation, name="hard_shrink", setting="threshold", value=0.5),
    "SoftShrink": partial(_fixed_activation, name="soft_shrink", setting="threshold", value=0.5),
    "Squareplus": partial(_fixed_activation, name="squareplus", setting="b", value=4),
    "Glu": partial(_fixed_activation, name="glu", setting="axis", value=-1),
    "Gelu": lambda s: activation_of(s, "gelu_new" if argument(s, 1, "approximate", True) else "gelu")(s.net, s.x),
    "Softmax": partial(_softmax, op="Softmax"),
    "LogSoftmax": partial(_softmax, op="LogSoftmax"),
    "All": partial(_reduce_truth, op="All"),
    "Any": partial(_reduce_truth, op="Any"),
    "CountNonzero": _count_nonzero,
    "Logsumexp": _log_sum_exp,
    "Var": _variance,
    "Std": lambda s: s.net.add("Sqrt", [_variance(s)]),
    "Norm": _norm,
    "Argmax": partial(_place_of, op="ArgMax"),
    "Argmin": partial(_place_of, op="ArgMin"),
    "Cumsum": partial(_cumulate, product=False),
    "Cumprod": partial(_cumulate, product=True),
    "Sort": _sort,
    "Argsort": partial(_sort, places=True),
    "TopK": _top_k,
    "Matmul": lambda s: matmul(s.net, *_pair(s)),
    "Einsum": lambda s: einsum(s.net, str(s.get("subscripts")), promote(s, s.args), shape_of=s.net.shape),
}
