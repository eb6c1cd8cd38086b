"""Products, reductions, softmax."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tests.onnx_reader.models import OPSETS, Case, constant, floats, node

X = floats(3, 5)
CUBE = floats(2, 3, 4)
DEEP = floats(2, 3, 4, 5)
W = floats(5, 4, seed=1)
BIAS = floats(4, seed=2)
TIES = np.array([[1, 3, 3, 0], [2, 2, -1, 2]], np.float32)
REDUCTIONS = ("ReduceMean", "ReduceMax", "ReduceMin", "ReduceProd", "ReduceL1", "ReduceL2", "ReduceSumSquare")


def gemm(title: str, inputs: Sequence[str] = ("x", "w", "c"), **attributes: Any) -> Case:
    constants = {"w": W, "c": BIAS, "wt": W.T.copy(), "row": BIAS[None], "column": floats(3, 1, seed=5)}
    used = {n: constants[n] for n in inputs if n in constants}
    opsets = OPSETS if len(inputs) > 2 else OPSETS[1:]
    return Case("Gemm", title, lambda _: [node("Gemm", inputs, **attributes)], {"x": X}, used, opsets=opsets)


def reduced(op: str, axes: Sequence[int] | None, keep: int, since: int = 18) -> Callable[[int], Sequence[Any]]:
    def build(opset: int) -> Sequence[Any]:
        if axes is None:
            return [node(op, ["x"], keepdims=keep)]
        if opset < since:
            return [node(op, ["x"], axes=list(axes), keepdims=keep)]
        return [constant("axes", axes, np.int64), node(op, ["x", "axes"], keepdims=keep)]

    return build


def reductions(op: str, since: int = 18) -> list[Case]:
    x = np.abs(CUBE) + np.float32(0.5) if op in ("ReduceLogSum", "ReduceProd") else CUBE
    return [
        Case(op, "one axis", reduced(op, [-1], 1, since), {"x": x}),
        Case(op, "two axes, dropped", reduced(op, [1, 2], 0, since), {"x": x}),
        Case(op, "all axes", reduced(op, None, 0, since), {"x": x}, rtol=1e-5),
    ]


def top_k(opset: int) -> Sequence[Any]:
    if opset < 10:
        return [node("TopK", ["x"], ["y", "i"], k=1)]
    return [constant("k", [1], np.int64), node("TopK", ["x", "k"], ["y", "i"])]


def smallest(opset: int) -> Sequence[Any]:
    return [constant("k", [1], np.int64), node("TopK", ["x", "k"], ["y", "i"], largest=0, axis=1)]


def matmul(title: str, a: Any, b: Any, *, fixed: bool = True) -> Case:
    nodes = [node("MatMul", ["a", "b"])]
    if fixed:
        return Case("MatMul", title, lambda _: nodes, {"a": a}, {"b": b})
    return Case("MatMul", title, lambda _: nodes, {"a": a, "b": b})


def einsum(equation: str, *operands: Any) -> Case:
    names = [f"x{i}" for i in range(len(operands))]
    feeds = dict(zip(names, operands, strict=True))
    build = lambda _: [node("Einsum", names, equation=equation)]  # noqa: E731
    shapes = {"x1": operands[1].shape} if equation.startswith("bi,ij") else {}
    return Case("Einsum", equation, build, feeds, opsets=(13, 15, 18), shapes=shapes)


CASES = [
    gemm("bias"),
    gemm("no bias", ("x", "w")),
    gemm("transposed weights", ("x", "wt", "c"), transB=1),
    gemm("alpha and beta", alpha=0.5, beta=2.0),
    gemm("beta of nothing", beta=0.0),
    gemm("bias as a row", ("x", "w", "row")),
    gemm("bias as a column", ("x", "w", "column")),
    Case("Gemm", "computed weights", lambda _: [node("Gemm", ["x", "w", "c"])], {"x": X, "w": W, "c": floats(3, 4)}),
    Case(
        "Gemm",
        "transposed input",
        lambda _: [node("Gemm", ["x", "w"], transA=1)],
        {"x": floats(5, 3)},
        {"w": W},
        shapes={"x": [5, "n"]},
        opsets=OPSETS[1:],
    ),
    matmul("matrices", X, W),
    matmul("three axes by a matrix", CUBE, floats(4, 6, seed=3)),
    matmul("four axes by a matrix", DEEP, floats(5, 2, seed=3)),
    matmul("batches", CUBE, floats(2, 4, 3, seed=3), fixed=False),
    matmul("batches of batches", DEEP, floats(2, 3, 5, 4, seed=3), fixed=False),
    matmul("a row per batch", floats(3, 1, 4), floats(3, 4, 2, seed=3), fixed=False),
    matmul("batches broadcast", DEEP, floats(3, 5, 4, seed=3)),
    matmul("by a vector", X, floats(5, seed=3)),
    matmul("three axes by a vector", CUBE, floats(4, seed=3)),
    einsum("bi,ij->bj", X, W),
    einsum("bij,bjk->bik", CUBE, floats(2, 4, 3)),
    einsum("bhqd,bhkd->bhqk", DEEP, floats(2, 3, 6, 5)),
    einsum("bhqk,bhkd->bqhd", DEEP, floats(2, 3, 5, 4)),
    einsum("bij->bji", CUBE),
    einsum("bij->b", CUBE),
    einsum("bi,bi", X, floats(3, 5, seed=7)),
    einsum("bi,bi->b", X, floats(3, 5, seed=7)),
    einsum("bi,bj", X, floats(3, 4, seed=7)),
    *(c for op in REDUCTIONS for c in reductions(op)),
    *reductions("ReduceSum", since=13),
    *reductions("ReduceLogSum"),
    *reductions("ReduceLogSumExp"),
    Case(
        "ReduceLogSumExp",
        "minus infinity",
        reduced("ReduceLogSumExp", [1], 1),
        {"x": np.array([[-np.inf, -np.inf], [-np.inf, 1.0]], np.float32)},
    ),
    Case(
        "ReduceSum",
        "no axes, left as it is",
        lambda _: [node("ReduceSum", ["x"], noop_with_empty_axes=1)],
        {"x": X},
        opsets=(13, 15, 18),
    ),
    *(
        Case(op, title, lambda _, op=op, more=more: [node(op, ["x"], **more)], {"x": TIES})  # type: ignore[misc]
        for op in ("ArgMax", "ArgMin")
        for title, more in (("axis 0", {}), ("last, dropped", {"axis": -1, "keepdims": 0}), ("axis 1", {"axis": 1}))
    ),
    Case("TopK", "the best", top_k, {"x": TIES}, outputs=("y", "i")),
    Case("TopK", "the worst", smallest, {"x": TIES}, outputs=("y", "i"), opsets=(11, 13, 15, 18)),
    *(
        Case(op, f"{title}, {x.ndim} axes", lambda _, op=op, more=more: [node(op, ["x"], **more)], {"x": x})  # type: ignore[misc]
        for op in ("Softmax", "LogSoftmax")
        for x in (X, CUBE, DEEP)
        for title, more in (("default axis", {}), ("last axis", {"axis": -1}), ("axis 1", {"axis": 1}))
    ),
    Case("Softmax", "axis 0", lambda _: [node("Softmax", ["x"], axis=0)], {"x": X}, opsets=(13, 15, 18)),
    Case(
        "ArgMax",
        "the last of equals",
        lambda _: [node("ArgMax", ["x"], axis=1, select_last_index=1)],
        {"x": TIES},
        opsets=(13, 18),
    ),
    Case("Hardmax", "second axis", lambda _: [node("Hardmax", ["x"], axis=1)], {"x": CUBE}, opsets=(13, 18)),
    Case("Hardmax", "last axis", lambda _: [node("Hardmax", ["x"], axis=-1)], {"x": TIES}, opsets=OPSETS),
]
