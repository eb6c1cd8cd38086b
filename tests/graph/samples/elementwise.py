"""Samples of ops: elementwise."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from export_model.converters.graph.types import BOOL, FLOAT32, INT32, INT64
from tests.graph.samples.base import (
    EXTREMES,
    HALVES,
    INF,
    KEPT_FINITE,
    NAN,
    NAN_LOST,
    Sample,
    bools,
    const,
    f32,
    fixed,
    floats,
    ints,
    sample,
)


def _unary() -> Iterator[Sample]:
    wide = {"Exp", "Expm1", "Sigmoid", "Tanh", "Relu", "Relu6", "Elu", "Selu", "Softplus", "Erf"}
    plain = {"Neg", "Abs", "Sign", "Square"}
    for op in ("Sin", "Cos", "Tan", *sorted(wide | plain)):
        yield sample(op, "matrix", floats(3, 5, low=-4, high=4))
        yield sample(op, "rank 4", floats(2, 2, 3, 2, seed=1))
    lost = {
        "Relu6": {"tfjs-wasm": NAN_LOST},
        "Sign": {"tfjs-cpu": NAN_LOST, "tfjs-wasm": "numbers up to 1e-7 count as zero"},
        "Exp": {"litert": NAN_LOST},
        **dict.fromkeys(("Expm1", "Selu", "Softplus"), KEPT_FINITE),
    }
    rootless = {"Rsqrt": {"litert": "of 0 it gives no number"}, "Reciprocal": KEPT_FINITE, "Log1p": KEPT_FINITE}
    for op in sorted(wide | plain):
        yield sample(op, "extremes", EXTREMES, differs=lost.get(op))
    for op in sorted(plain):
        yield sample(op, "int32", ints(4, 3))
    for op in ("Floor", "Ceil", "Round"):
        yield sample(op, "halves", HALVES)
        yield sample(op, "rank 1", floats(7, low=-1e4, high=1e4))
    for op in ("Log", "Sqrt", "Rsqrt", "Reciprocal", "Log1p"):
        yield sample(op, "positive", floats(3, 4, low=1e-3, high=9))
        yield sample(
            op, "outside of its domain", f32(-2, -0.5, 0, 1e-30, INF, NAN).reshape(3, 2), differs=rootless.get(op)
        )
    yield sample("Softsign", "matrix", floats(3, 5, low=-4, high=4))
    yield sample("Softsign", "large", f32(-1e30, -100, 0, 100, 1e30))
    yield sample("Log1p", "near zero", f32(1e-8, -1e-8, 1e-4, -1e-4).reshape(2, 2))
    yield sample("Expm1", "near zero", f32(1e-8, -1e-8, 1e-4, -1e-4).reshape(2, 2))
    for op in ("ZerosLike", "OnesLike"):
        yield sample(op, "float32", EXTREMES)
        yield sample(op, "int32", ints(2, 3))
        yield sample(op, "bool", bools(2, 3))
    yield sample("LogicalNot", "matrix", bools(3, 4))
    yield sample("LogicalNot", "rank 1", bools(5))
    yield sample("LeakyRelu", "default slope", floats(3, 4))
    yield sample("LeakyRelu", "slope 0.01", EXTREMES, alpha=0.01)
    yield sample("LeakyRelu", "slope above 1", floats(3, 4), alpha=1.5)


def _casts() -> Iterator[Sample]:
    for source, target in itertools.permutations((FLOAT32, INT32, INT64, BOOL), 2):
        values = f32(-2.7, -1.0, -0.4, 0.0, 0.6, 3.9).reshape(3, 2)
        array = values.astype(source) if source != INT64 else ints(3, 2, dtype=np.int64)
        yield sample("Cast", f"{source} to {target}", array, DstT=target)


def _binary() -> Iterator[Sample]:
    for op in ("Add", "Sub", "Mul", "RealDiv", "Maximum", "Minimum", "SquaredDifference"):
        yield sample(op, "same shape", floats(3, 4), floats(3, 4, seed=1))
        yield sample(op, "row", floats(3, 4), const(floats(4, seed=1)))
        yield sample(op, "outer", floats(3, 1), const(floats(1, 4, seed=1)))
        yield sample(op, "scalar on the left", const(f32(1.5).reshape(())), floats(2, 3, 2))
        lost = dict.fromkeys(("litert", "litert-plain"), NAN_LOST)
        differs = lost if op in ("Maximum", "Minimum") else None if op == "SquaredDifference" else KEPT_FINITE
        yield sample(op, "not finite", EXTREMES, const(f32(INF, 0.0, -1.0)), differs=differs)
    for op in ("Add", "Sub", "Mul", "Maximum", "Minimum", "SquaredDifference", "FloorDiv", "FloorMod"):
        yield sample(op, "int32", ints(4, 3), const(ints(3, seed=3, low=1)))
    for op in ("FloorDiv", "FloorMod"):
        yield sample(op, "int32, signs", const(7, -7, 7, -7, 6, -6), fixed(np.array([3, 3, -3, -3, 2, -2], np.int32)))
        differs = {"tfjs-cpu": "the quotient is int32"} if op == "FloorDiv" else None
        yield sample(op, "float32", f32(5.5, -5.5, 5.5, -5.5, 6, 0).reshape(3, 2), const(f32(2, -2)), differs=differs)
    # numpy's own floor_divide says 9 and -10 here
    near = f32(1, -1).reshape(2, 1)
    yield sample(
        "FloorDiv", "float32, near an integer", near, const(f32(0.1)), differs={"tfjs-cpu": "the quotient is int32"}
    )
    yield sample("Pow", "positive base", floats(3, 4, low=0.1, high=3), floats(3, 4, seed=1))
    yield sample("Pow", "negative base", floats(3, 4, low=-3, high=-0.1), const(f32(2, 3, -1, 0.5)))
    yield sample("Pow", "zero", f32(0, 0, 0, 1).reshape(2, 2), const(f32(0, 2)))
    for op in ("Less", "LessEqual", "Greater", "GreaterEqual", "Equal", "NotEqual"):
        yield sample(op, "float32", f32(0, 1, 2, NAN, INF, -INF).reshape(3, 2), const(f32(1, NAN)))
        yield sample(op, "int32", ints(4, 3, low=0, high=2), const(np.array([[0, 1, 2]], np.int32)))
        yield sample(op, "int64", ints(4, 3, low=0, high=2, dtype=np.int64), const(1, dtype=np.int64))
    for op in ("LogicalAnd", "LogicalOr"):
        yield sample(op, "same shape", bools(3, 4), bools(3, 4, seed=1))
        yield sample(op, "row", bools(3, 4), const(bools(4, seed=1)))


def _several() -> Iterator[Sample]:
    yield sample("AddN", "one", floats(3, 4))
    yield sample("AddN", "three", floats(3, 4), floats(3, 4, seed=1), floats(3, 4, seed=2))
    yield sample("ClipByValue", "scalars", floats(3, 4), const(f32(-1).reshape(())), const(f32(1).reshape(())))
    yield sample(
        "ClipByValue",
        "not finite",
        EXTREMES,
        const(f32(-5).reshape(())),
        const(f32(5).reshape(())),
        differs={"tfjs-wasm": NAN_LOST},
    )
    a, b = floats(3, 4), floats(3, 4, seed=1)
    yield sample("Select", "same shape", bools(3, 4), a, b)
    yield sample("Select", "rows", np.array([True, False, True]), a, b)
    yield sample("Select", "rows of rank 3", np.array([True, False]), floats(2, 2, 3), floats(2, 2, 3, seed=1))
    yield sample("Select", "square, rows", np.array([True, False]), floats(2, 2), floats(2, 2, seed=1))
    yield sample("Select", "scalar condition", const(np.array(False)), a, b)
    yield sample("Select", "rank 1", bools(5), floats(5), floats(5, seed=1))
    yield sample("Select", "int32", bools(3, 4), ints(3, 4), ints(3, 4, seed=1))
    yield sample("SelectV2", "same shape", bools(3, 4), a, b)
    yield sample("SelectV2", "column", bools(3, 1), a, b)
    yield sample("SelectV2", "row and scalar", const(bools(4)), a, const(f32(9).reshape(())))
    yield sample("SelectV2", "wider condition", bools(3, 4), const(floats(4)), const(ints(4).astype(np.float32)))


def samples() -> Iterator[Sample]:
    yield from _unary()
    yield from _casts()
    yield from _binary()
    yield from _several()
