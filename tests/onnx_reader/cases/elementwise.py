"""Arithmetic, activations, comparisons, casts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tests.onnx_reader.models import OPSETS, Array, Case, constant, floats, helper, node, rng

X = floats(3, 5, scale=2)
POSITIVE = np.abs(X) + np.float32(0.1)
EDGES = np.array([[0.0, -0.0, 1.5, 2.5, -0.5], [np.inf, -np.inf, 3.0, -3.0, 1e-30]], np.float32)
INTS = rng(1).integers(-9, 9, (3, 5)).astype(np.int64)
BOOLS = rng(2).random((3, 5)) < 0.5
LATE = (13, 15, 18)


def unary(op: str, x: Array = X, *, title: str = "", opsets: Sequence[int] = OPSETS, **attributes: Any) -> Case:
    return Case(op, title or "plain", lambda _: [node(op, ["x"], **attributes)], {"x": x}, opsets=opsets)


def binary(
    op: str, a: Array, b: Array, title: str = "plain", opsets: Sequence[int] = OPSETS, **attributes: Any
) -> Case:
    return Case(op, title, lambda _: [node(op, ["a", "b"], **attributes)], {"a": a, "b": b}, opsets=opsets)


def with_constant(op: str, value: Any, title: str, dtype: Any = np.float32, x: Array = X) -> Case:
    return Case(op, title, lambda _: [constant("c", value, dtype), node(op, ["x", "c"])], {"x": x})


def clip(opset: int) -> Sequence[Any]:
    if opset < 11:
        return [node("Clip", ["x"], min=-1.0, max=0.5)]
    return [constant("low", -1), constant("high", 0.5), node("Clip", ["x", "low", "high"])]


def clip_above(opset: int) -> Sequence[Any]:
    if opset < 11:
        return [node("Clip", ["x"], max=0.5)]
    return [constant("high", 0.5), node("Clip", ["x", "", "high"])]


def dropout(opset: int) -> Sequence[Any]:
    if opset < 12:
        return [node("Dropout", ["x"], ratio=0.5)]
    return [constant("ratio", 0.5), constant("training", False, np.bool_), node("Dropout", ["x", "ratio", "training"])]


def cast(to: Any) -> Callable[[int], Sequence[Any]]:
    return lambda _: [node("Cast", ["x"], to=helper.np_dtype_to_tensor_dtype(np.dtype(to)))]


CASES = [
    *(unary(op) for op in ("Neg", "Abs", "Sign", "Floor", "Ceil", "Exp", "Sin", "Cos", "Tan", "Erf", "Sigmoid")),
    *(unary(op) for op in ("Tanh", "Relu", "Softplus", "Softsign", "Identity", "Elu", "Selu", "HardSigmoid")),
    *(unary(op, POSITIVE) for op in ("Log", "Sqrt", "Reciprocal")),
    unary("Round", EDGES[:1], opsets=(11, 13, 15, 18)),
    unary("Abs", INTS, title="integers"),
    unary("Elu", title="alpha", alpha=0.3),
    unary("Celu", opsets=(13, 15, 18)),
    unary("Celu", title="alpha", alpha=0.7, opsets=(13, 15, 18)),
    unary("Selu", title="alpha and gamma", alpha=1.2, gamma=0.9),
    unary("LeakyRelu"),
    unary("LeakyRelu", title="alpha above 1", alpha=1.5),
    unary("ThresholdedRelu", opsets=(11, 13, 15, 18)),
    unary("ThresholdedRelu", title="alpha", alpha=0.2, opsets=(11, 13, 15, 18)),
    unary("HardSigmoid", title="alpha and beta", alpha=0.3, beta=0.4),
    unary("HardSwish", opsets=(15, 18)),
    unary("Mish", opsets=(18,)),
    *(unary(op, opsets=(9, 15, 18)) for op in ("Sinh", "Cosh", "Atan", "Asinh")),
    *(unary(op, np.tanh(X), opsets=(9, 15, 18)) for op in ("Asin", "Acos", "Atanh")),
    unary("Acosh", POSITIVE + 1, opsets=(9, 15, 18)),
    unary("Gelu", opsets=(20,)),
    unary("Gelu", title="tanh", approximate="tanh", opsets=(20,)),
    unary("IsNaN", np.array([[np.nan, 1.0, np.inf]], np.float32)),
    unary("IsInf", EDGES, opsets=(11, 13, 15, 18)),
    unary("IsInf", EDGES, title="positive only", detect_negative=0, opsets=(11, 13, 15, 18)),
    unary("IsInf", EDGES, title="negative only", detect_positive=0, opsets=(11, 13, 15, 18)),
    unary("IsInf", EDGES, title="neither", detect_positive=0, detect_negative=0, opsets=(11, 13, 15, 18)),
    unary("Not", BOOLS),
    *(binary(op, X, floats(3, 5, seed=1)) for op in ("Add", "Sub", "Mul", "Div", "Less", "Greater", "Max", "Min")),
    *(binary(op, X, floats(5, seed=1).reshape(1, 5), "broadcast") for op in ("Add", "Sub", "Mul", "Div", "Less")),
    *(binary(op, INTS, INTS[::-1].copy(), "integers") for op in ("Add", "Sub", "Mul")),
    binary("Div", INTS, np.where(INTS == 0, 7, -INTS[::-1] | 1), "integers are divided towards zero"),
    binary("Equal", INTS, INTS[:, ::-1].copy()),
    binary("Equal", BOOLS, BOOLS[::-1].copy(), "booleans"),
    *(binary(op, BOOLS, BOOLS[:, ::-1].copy()) for op in ("And", "Or", "Xor")),
    *(binary(op, X, floats(3, 5, seed=1), opsets=(13, 15, 18)) for op in ("LessOrEqual", "GreaterOrEqual")),
    binary("Mod", INTS, np.abs(INTS[::-1]) + 1, opsets=(11, 13, 15, 18)),
    binary("Mod", INTS, -np.abs(INTS[::-1]) - 1, "negative divisor", opsets=(11, 13, 15, 18)),
    binary("Mod", X, floats(3, 5, seed=1) + 3, "fmod", opsets=(11, 13, 15, 18), fmod=1),
    binary("Pow", POSITIVE, floats(3, 5, seed=1)),
    with_constant("Pow", 2, "square"),
    with_constant("Pow", 0.5, "root", x=POSITIVE),
    with_constant("Pow", 3, "cube"),
    with_constant("Pow", [1, 2, 3, 4, 0], "a vector of exponents"),
    Case(
        "Pow",
        "an integer exponent",
        lambda _: [constant("c", 3, np.int64), node("Pow", ["x", "c"])],
        {"x": X},
        opsets=(13, 15, 18),
    ),
    with_constant("Add", [1, 2, 3, 4, 5], "a vector that is no bias"),
    binary("PRelu", X, np.abs(floats(1, 5, seed=3)), "slope per column"),
    *(
        Case(
            op,
            "three operands",
            lambda _, op=op: [node(op, ["a", "b", "c"])],  # type: ignore[misc]
            {"a": X, "b": floats(3, 5, seed=1), "c": floats(1, 5, seed=2)},
        )
        for op in ("Max", "Min", "Sum", "Mean")
    ),
    Case("Max", "one operand", lambda _: [node("Max", ["x"])], {"x": X}),
    Case("Clip", "both bounds", clip, {"x": X}),
    Case("Clip", "above only", clip_above, {"x": X}),
    Case(
        "Clip",
        "bounds that cross",
        lambda _: [constant("low", 1), constant("high", -1), node("Clip", ["x", "low", "high"])],
        {"x": X},
        opsets=(13, 15, 18),
    ),
    unary("Shrink", title="both ways", lambd=0.7, bias=0.2, opsets=(9, 15, 18)),
    Case("Clip", "none", lambda _: [node("Clip", ["x"])], {"x": X}),
    Case("Dropout", "at inference", dropout, {"x": X}),
    Case("Cast", "float to integer", cast(np.int64), {"x": X}),
    Case("Cast", "float to int32", cast(np.int32), {"x": X}),
    Case("Cast", "integer to float", cast(np.float32), {"x": INTS}),
    Case("Cast", "boolean to float", cast(np.float32), {"x": BOOLS}),
    Case("Cast", "float to boolean", cast(np.bool_), {"x": np.round(X)}),
    Case("Cast", "to itself", cast(np.float32), {"x": X}),
    Case("CastLike", "to integer", lambda _: [node("CastLike", ["x", "i"])], {"x": X, "i": INTS}, opsets=(15, 18)),
    Case("Where", "of one shape", lambda _: [node("Where", ["c", "a", "b"])], {"c": BOOLS, "a": X, "b": -X}),
    Case(
        "Where",
        "broadcast",
        lambda _: [constant("zero", -1.0), node("Where", ["c", "a", "zero"])],
        {"c": BOOLS, "a": floats(1, 5, seed=4)},
        shapes={"a": [1, 5]},
    ),
    Case(
        "Where",
        "broadcast integers",
        lambda _: [constant("zero", 7, np.int64), node("Where", ["c", "a", "zero"])],
        {"c": BOOLS, "a": INTS[:1]},
        shapes={"a": [1, 5]},
    ),
]
