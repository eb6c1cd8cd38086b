"""Elements chosen by computed indices, the largest ones, running sums; images made larger and smaller."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tests.onnx_reader.models import Array, Case, constant, floats, node, rng

X = floats(3, 5)
CUBE = floats(2, 3, 4)
TIES = np.array([[1, 2, 2, 0], [3, 3, 3, 3], [-np.inf, 1, -np.inf, np.inf]], np.float32)
PLACES = rng(4).integers(-4, 4, (2, 3, 4)).astype(np.int64)
IMAGE = floats(2, 3, 4, 5)
LATE = (11, 13, 15, 18)


def best(title: str, k: int, x: Array, opsets: Sequence[int] = LATE, **more: Any) -> Case:
    def build(opset: int) -> Sequence[Any]:
        if opset < 10:
            return [node("TopK", ["x"], ["y", "i"], k=k, **more)]
        return [constant("k", [k], np.int64), node("TopK", ["x", "k"], ["y", "i"], **more)]

    return Case("TopK", title, build, {"x": x}, outputs=("y", "i"), opsets=opsets)


def summed(title: str, axis: int, x: Any = CUBE, op: str = "CumSum", **more: Any) -> Case:
    build = lambda _: [constant("a", axis, np.int64), node(op, ["x", "a"], **more)]  # noqa: E731
    return Case(op, title, build, {"x": x}, opsets=LATE)


def elements(title: str, indices: Any, axis: int) -> Case:
    build = lambda _: [node("GatherElements", ["x", "i"], axis=axis)]  # noqa: E731
    return Case(
        "GatherElements", title, build, {"x": CUBE}, {"i": np.asarray(indices)}, opsets=LATE, shapes={"x": [2, 3, 4]}
    )


def gathered(title: str, indices: Any, x: Any = CUBE, **more: Any) -> Case:
    build = lambda _: [node("GatherND", ["x", "i"], **more)]  # noqa: E731
    return Case(
        "GatherND", title, build, {"x": x, "i": np.asarray(indices)}, opsets=(12, 13, 18) if more else LATE,
        shapes={"x": list(x.shape), "i": list(np.shape(indices))},
    )  # fmt: skip


def written(
    op: str, title: str, indices: Any, updates: Any, opsets: Sequence[int] = LATE, x: Any = CUBE, **more: Any
) -> Case:
    constants = {"i": np.asarray(indices, np.int64), "u": np.asarray(updates, np.float32)}
    build = lambda _: [node(op, ["x", "i", "u"], **more)]  # noqa: E731
    return Case(op, title, build, {"x": x}, constants, opsets=opsets, shapes={"x": list(x.shape)})


def resized(
    title: str, *, scales: Any = None, sizes: Any = None, opsets: Sequence[int] = (13, 18), **more: Any
) -> Case:
    def build(_: int) -> Sequence[Any]:
        names, made = ["x", ""], []
        for name, value, dtype in (("scales", scales, np.float32), ("sizes", sizes, np.int64)):
            names.append("" if value is None else name)
            if value is not None:
                made.append(constant(name, value, dtype))
        while not names[-1]:
            names.pop()
        return [*made, node("Resize", names, **more)]

    shapes = {"x": list(IMAGE.shape)} if sizes is not None else {}
    return Case("Resize", title, build, {"x": IMAGE}, opsets=opsets, shapes=shapes, atol=2e-5, rtol=2e-5)


def upsampled(opset: int) -> Sequence[Any]:
    if opset < 9:
        return [node("Upsample", ["x"], scales=[1.0, 1.0, 2.0, 3.0])]
    return [constant("s", [1, 1, 2, 3]), node("Upsample", ["x", "s"])]


def fraction(side: int, scale: float, opset: int, **more: Any) -> Case:
    """A scale whose product with the side is a whole number in float32 only."""
    op = "Upsample" if opset < 10 else "Resize"
    names = ["x", "s"] if opset < 11 else ["x", "", "s"]
    build = lambda _: [constant("s", [1, 1, scale, scale], np.float32), node(op, names, **more)]  # noqa: E731
    return Case(op, f"{side} times {scale} {more}", build, {"x": floats(1, 2, side, side)}, opsets=(opset,))


def blocks(op: str, mode: str | None, x: Any) -> Case:
    more: dict[str, Any] = {} if mode is None else {"mode": mode}
    build: Callable[[int], Sequence[Any]] = lambda _: [node(op, ["x"], blocksize=2, **more)]  # noqa: E731
    return Case(op, str(mode), build, {"x": x}, opsets=(11, 13, 18))


CASES = [
    best("three", 3, X, (9, *LATE)),
    best("all, the smallest first, along the second axis", 3, CUBE, axis=1, largest=0),
    best("of equals the first", 3, TIES),
    summed("along the last axis", -1),
    summed("from the end, without itself", 1, reverse=1, exclusive=1),
    summed("without itself", 2, exclusive=1),
    elements("places counted from the end", PLACES, 2),
    elements("along the first, a part of the others", [[[0, 1]], [[-1, 0]]], 0),
    gathered("elements", [[0, 1, -1], [1, -2, 2]]),
    gathered("rows", [[[0, 1]], [[1, 2]]]),
    gathered("of each row its own", [[0, 1], [2, 3]], batch_dims=1),
    written("ScatterElements", "along the last axis", [[[0], [1], [-1]], [[2], [0], [3]]], floats(2, 3, 1), axis=2),
    written(
        "ScatterElements", "added", [[[0, 0], [1, 1], [-1, 2]], [[2, 0], [0, 1], [3, 3]]], floats(2, 3, 2), (16, 18),
        axis=2, reduction="add",
    ),
    written("Scatter", "along the first axis", np.zeros((1, 3, 4)), floats(1, 3, 4), (9,)),
    written("ScatterND", "elements", [[0, 1, 2], [1, -1, 0]], floats(2)),
    written("ScatterND", "rows", [[1, 2], [0, 0]], floats(2, 4)),
    written("ScatterND", "the larger", [[1, 2], [1, 2]], floats(2, 4), (18,), reduction="max"),
    Case(
        "Compress", "columns", lambda _: [node("Compress", ["x", "c"], axis=1)], {"x": X},
        {"c": np.array([True, False, True, True, False])}, opsets=LATE,
    ),
    resized("twice as large", scales=[1, 1, 2, 2], mode="nearest"),
    resized("as torch's interpolate", scales=[1, 1, 2, 3], mode="nearest", nearest_mode="floor",
            coordinate_transformation_mode="asymmetric"),
    resized("linear", scales=[1, 1, 1.5, 2], mode="linear"),
    resized("linear, as torch", scales=[1, 1, 0.5, 2], mode="linear",
            coordinate_transformation_mode="pytorch_half_pixel"),
    resized("corners", sizes=[2, 3, 7, 3], mode="linear", coordinate_transformation_mode="align_corners"),
    resized("cubic", sizes=[2, 3, 9, 4], mode="cubic"),
    resized("cubic, what is outside left out", sizes=[2, 3, 3, 9], mode="cubic", exclude_outside=1, cubic_coeff_a=-0.5),
    resized("antialiased", sizes=[2, 3, 2, 3], mode="linear", antialias=1, opsets=(18,)),
    Case("Upsample", "nearest", upsampled, {"x": IMAGE}, opsets=(7, 9)),
    fraction(5, 1.4, 9),
    fraction(5, 1.4, 13, coordinate_transformation_mode="asymmetric", nearest_mode="floor"),
    fraction(10, 0.6, 13, coordinate_transformation_mode="asymmetric", nearest_mode="floor"),
    fraction(10, 0.6, 13),
    blocks("DepthToSpace", None, floats(2, 8, 2, 3)),
    blocks("DepthToSpace", "CRD", floats(2, 8, 2, 3)),
    blocks("SpaceToDepth", None, floats(2, 3, 4, 6)),
]  # fmt: skip
