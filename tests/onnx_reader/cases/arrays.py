"""Ops that make, move, cut and reshape arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from onnx import numpy_helper

from tests.onnx_reader.models import OPSETS, Case, constant, floats, node, rng

X = floats(3, 5)
CUBE = floats(2, 3, 4)
DEEP = floats(2, 3, 4, 5)
INDEX = rng(3).integers(-4, 4, (2,)).astype(np.int64)
LONG = 2**63 - 1


def reshape(target: Sequence[int], x: Any = CUBE, title: str = "", **more: Any) -> Case:
    build = lambda _: [constant("s", target, np.int64), node("Reshape", ["x", "s"], **more)]  # noqa: E731
    return Case("Reshape", title or str(list(target)), build, {"x": x}, opsets=(15, 18) if more else OPSETS)


def axes_op(op: str, axes: Sequence[int], x: Any) -> Case:
    def build(opset: int) -> Sequence[Any]:
        if opset < 13:
            return [node(op, ["x"], axes=list(axes))]
        return [constant("axes", axes, np.int64), node(op, ["x", "axes"])]

    return Case(op, f"axes {list(axes)}", build, {"x": x})


def sliced(title: str, starts: Any, ends: Any, axes: Any = None, steps: Any = None, x: Any = CUBE) -> Case:
    def build(opset: int) -> Sequence[Any]:
        if opset < 10:
            more = {} if axes is None else {"axes": axes}
            return [node("Slice", ["x"], starts=starts, ends=ends, **more)]
        names, made = ["x"], []
        for name, value in (("starts", starts), ("ends", ends), ("axes", axes), ("steps", steps)):
            if value is None and name == "axes" and steps is not None:
                value = list(range(len(starts)))
            if value is not None:
                made.append(constant(name, value, np.int64))
                names.append(name)
        return [*made, node("Slice", names)]

    return Case("Slice", title, build, {"x": x}, opsets=OPSETS if steps is None else (11, 13, 15, 18))


def split(sizes: Sequence[int] | None, count: int) -> Callable[[int], Sequence[Any]]:
    def build(opset: int) -> Sequence[Any]:
        outputs = [f"y{i}" for i in range(count)]
        if sizes is None:
            more = {"num_outputs": count} if opset >= 18 else {}
            return [node("Split", ["x"], outputs, axis=1, **more)]
        if opset < 13:
            return [node("Split", ["x"], outputs, axis=1, split=list(sizes))]
        return [constant("sizes", sizes, np.int64), node("Split", ["x", "sizes"], outputs, axis=1)]

    return build


def pad(pads: Sequence[int], value: float) -> Callable[[int], Sequence[Any]]:
    def build(opset: int) -> Sequence[Any]:
        if opset < 11:
            return [node("Pad", ["x"], pads=list(pads), value=value)]
        return [constant("pads", pads, np.int64), constant("value", value), node("Pad", ["x", "pads", "value"])]

    return build


def mirrored(mode: str) -> Case:
    build = lambda _: [constant("p", [0, 1, 2, 0, 0, 1], np.int64), node("Pad", ["x", "p"], mode=mode)]  # noqa: E731
    return Case("Pad", mode, build, {"x": CUBE}, opsets=(13, 18))


def gather(title: str, indices: Any, axis: int, x: Any = CUBE) -> Case:
    build = lambda _: [constant("i", indices, np.int64), node("Gather", ["x", "i"], axis=axis)]  # noqa: E731
    return Case("Gather", title, build, {"x": x})


def one_hot(axis: int, on: float = 1.0, off: float = 0.0) -> Callable[[int], Sequence[Any]]:
    return lambda _: [
        constant("depth", 4, np.int64),
        constant("values", [off, on]),
        node("OneHot", ["x", "depth", "values"], axis=axis),
    ]


def dynamic_slice(_: int) -> Sequence[Any]:
    """What PyTorch makes of x[:, : x.shape[1] - 1]."""
    return [
        node("Shape", ["x"], "shape"),
        constant("one", 1, np.int64),
        node("Gather", ["shape", "one"], "width"),
        node("Sub", ["width", "one"], "last"),
        constant("axes", [0], np.int64),
        node("Unsqueeze", ["last", "axes"], "ends"),
        constant("starts", [0], np.int64),
        constant("which", [1], np.int64),
        node("Slice", ["x", "starts", "ends", "which"]),
    ]


def shape_chain(opset: int) -> Sequence[Any]:
    """What PyTorch makes of x.view(x.shape[0], -1)."""
    zero = constant("axes", [0], np.int64)
    unsqueeze = [node("Unsqueeze", ["rows"], "one", axes=[0])]
    if opset >= 13:
        unsqueeze = [zero, node("Unsqueeze", ["rows", "axes"], "one")]
    return [
        node("Shape", ["x"], "shape"),
        constant("zero", 0, np.int64),
        node("Gather", ["shape", "zero"], "rows"),
        *unsqueeze,
        constant("rest", [-1], np.int64),
        node("Concat", ["one", "rest"], "target", axis=0),
        node("Reshape", ["x", "target"]),
    ]


def expand_to_shape(opset: int) -> Sequence[Any]:
    """A row as often as there are rows in x."""
    return [constant("row", [[1, 2, 3, 4, 5]]), node("Shape", ["x"], "shape"), node("Expand", ["row", "shape"])]


SEQUENCES = (11, 15, 18)


def taken(title: str, position: int, lengths: Any = None, axis: int = 1, **more: Any) -> Case:
    """An element of a tensor that is cut into a sequence, as PyTorch's exporter writes ``chunk`` in a GRUCell."""
    cut = node("SplitToSequence", ["x"] if lengths is None else ["x", "n"], "parts", axis=axis, **more)
    given = [] if lengths is None else [constant("n", lengths, np.int64)]
    build = lambda _: [*given, cut, constant("i", position, np.int64), node("SequenceAt", ["parts", "i"])]  # noqa: E731
    return Case("SequenceAt", title, build, {"x": CUBE}, opsets=SEQUENCES)


def rejoined(axis: int) -> Case:
    def build(_: int) -> Sequence[Any]:
        made = [node("Neg", ["x"], "m"), node("SequenceConstruct", ["x", "m", "x"], "s"), constant("i", -2, np.int64)]
        return [*made, node("SequenceAt", ["s", "i"], "t"), node("ConcatFromSequence", ["s"], "c", axis=axis),
                node("Concat", ["c", "t"], axis=axis)]  # fmt: skip

    return Case("ConcatFromSequence", f"axis {axis}", build, {"x": CUBE}, opsets=SEQUENCES)


CASES = [
    Case("Constant", "a tensor", lambda _: [constant("c", [1, 2, 3, 4, 5]), node("Add", ["x", "c"])], {"x": X}),
    *(
        Case(
            "Constant",
            key,
            lambda _, key=key, value=value: [node("Constant", [], "c", **{key: value}), node("Mul", ["x", "c"])],  # type: ignore[misc]
            {"x": x},
            opsets=(13, 15, 18),
        )
        for key, value, x in (
            ("value_float", 2.5, X),
            ("value_floats", [1.0, 2.0, 3.0, 4.0, 5.0], X),
            ("value_int", 3, INDEX[:, None]),
            ("value_ints", [3, 4], INDEX[:, None]),
        )
    ),
    Case(
        "ConstantOfShape",
        "a constant shape",
        lambda _: [
            constant("s", [3, 5], np.int64),
            node("ConstantOfShape", ["s"], "c", value=numpy_helper.from_array(np.array([2.5], np.float32))),
            node("Add", ["x", "c"]),
        ],
        {"x": X},
        shapes={"x": [3, 5]},
    ),
    Case(
        "ConstantOfShape",
        "the batch's",
        lambda _: [node("Shape", ["x"], "s"), node("ConstantOfShape", ["s"], "c"), node("Add", ["x", "c"])],
        {"x": X},
    ),
    Case("EyeLike", "below the diagonal", lambda _: [node("EyeLike", ["c"], "e", k=-1), node("MatMul", ["x", "e"])],
         {"x": X}, {"c": floats(5, 5)}),
    Case(
        "Range",
        "of a length",
        lambda _: [
            constant("a", 0, np.int64),
            constant("b", 5, np.int64),
            constant("d", 1, np.int64),
            node("Range", ["a", "b", "d"], "r"),
            node("Cast", ["r"], "f", to=1),
            node("Add", ["x", "f"]),
        ],
        {"x": X},
        opsets=(11, 13, 15, 18),
    ),
    Case("Shape", "whole", lambda _: [node("Shape", ["x"])], {"x": DEEP}),
    Case("Shape", "a part", lambda _: [node("Shape", ["x"], start=1, end=3)], {"x": DEEP}, opsets=(15, 18)),
    Case("Shape", "from the end", lambda _: [node("Shape", ["x"], start=-2)], {"x": DEEP}, opsets=(15, 18)),
    Case("Size", "whole", lambda _: [node("Size", ["x"])], {"x": DEEP}),
    reshape([-1, 12]),
    reshape([0, 0, 2, 2], title="copied lengths"),
    reshape([0, -1], title="a copied batch and an open rest"),
    reshape([-1]),
    reshape([2, 12], title="all lengths given"),
    reshape([-1, 4, 3], title="allowzero", allowzero=1),
    Case("Reshape", "a computed shape", shape_chain, {"x": DEEP}),
    Case("Flatten", "default axis", lambda _: [node("Flatten", ["x"])], {"x": DEEP}),
    Case("Flatten", "axis 2", lambda _: [node("Flatten", ["x"], axis=2)], {"x": DEEP}),
    Case("Flatten", "axis 0", lambda _: [node("Flatten", ["x"], axis=0)], {"x": DEEP}),
    Case("Flatten", "from the end", lambda _: [node("Flatten", ["x"], axis=-1)], {"x": DEEP}, opsets=(11, 13, 15)),
    axes_op("Squeeze", [1], floats(3, 1, 5)),
    axes_op("Squeeze", [-1, 1], floats(3, 1, 5, 1)),
    Case("Squeeze", "every axis of length 1", lambda _: [node("Squeeze", ["x"])], {"x": floats(3, 1, 5, 1)}),
    axes_op("Unsqueeze", [1], X),
    axes_op("Unsqueeze", [0, 3], X),
    Case("Unsqueeze", "from the end",
         lambda _: [constant("axes", [-1], np.int64), node("Unsqueeze", ["x", "axes"])], {"x": X}, opsets=(13, 15)),
    Case("Transpose", "given", lambda _: [node("Transpose", ["x"], perm=[0, 2, 1])], {"x": CUBE}),
    Case("Transpose", "reversed", lambda _: [node("Transpose", ["x"])], {"x": CUBE}),
    Case("Expand", "a constant shape",
         lambda _: [constant("s", [1, 4, 5], np.int64), node("Expand", ["x", "s"])], {"x": floats(3, 1, 5)}),
    Case("Expand", "more axes",
         lambda _: [constant("s", [2, 1, 1], np.int64), node("Expand", ["x", "s"])], {"x": X}),
    Case("Expand", "to the batch", expand_to_shape, {"x": X}),
    Case("Tile", "twice", lambda _: [constant("n", [1, 3], np.int64), node("Tile", ["x", "n"])], {"x": X}),
    Case("Concat", "two", lambda _: [node("Concat", ["x", "x"], axis=-1)], {"x": X}),
    Case("Concat", "one", lambda _: [node("Concat", ["x"], axis=1)], {"x": X}),
    Case("Split", "equal", split(None, 5), {"x": X}, outputs=tuple(f"y{i}" for i in range(5))),
    Case("Split", "given", split([1, 4], 2), {"x": X}, outputs=("y0", "y1")),
    Case("Split", "one part is used", split([1, 3, 1], 3), {"x": X}, outputs=("y1",)),
    *(taken(f"equal parts, {i}", i, 2, 2) for i in (0, 1)),
    taken("the last one is shorter", 1, 2),
    *(taken(f"given lengths, {i}", i, [1, 3], 2) for i in (0, 1, -1)),
    taken("single elements", 2),
    taken("single elements without their axis", 1, keepdims=0),
    *(rejoined(axis) for axis in (1, -1)),
    Case("Split", "uneven", lambda _: [node("Split", ["x"], ["y0", "y1"], axis=1, num_outputs=2)], {"x": X},
         outputs=("y0", "y1"), opsets=(18,)),
    sliced("front", [0], [2], [2]),
    sliced("to the end", [1], [LONG], [1]),
    sliced("from the end", [-3], [-1], [2]),
    sliced("beyond the end", [1], [100], [2]),
    sliced("two axes", [0, 1], [2, 3], [1, 2]),
    sliced("axes from the end", [1], [3], [-1]),
    sliced("default axes", [0, 1, 0], [2, 3, 2]),
    sliced("nothing", [2], [1], [2]),
    sliced("steps", [0], [LONG], [2], [2]),
    sliced("backwards", [-1], [-LONG - 1], [2], [-1]),
    sliced("backwards in part", [3], [0], [2], [-2]),
    sliced("backwards from beyond", [LONG], [-LONG - 1], [1], [-1]),
    Case("Slice", "a computed bound", dynamic_slice, {"x": X}, opsets=(13, 15, 18)),
    gather("a number", 1, 1),
    gather("a number from the end", -1, 2),
    gather("the first", 0, 1),
    gather("a vector", [2, 0, -1], 2),
    gather("a matrix", [[0, 1], [2, 1]], 1),
    Case("Gather", "computed", lambda _: [node("Gather", ["t", "i"], axis=0)], {"i": INDEX}, {"t": floats(4, 6)}),
    Case(
        "GatherElements",
        "along the last axis",
        lambda _: [node("GatherElements", ["x", "i"], axis=1)],
        {"x": X, "i": rng(5).integers(-5, 5, (3, 2)).astype(np.int64)},
        opsets=(11, 13, 15, 18),
    ),
    Case("Pad", "zeros", pad([0, 1, 2, 0, 0, 1], 0.0), {"x": CUBE}),
    Case("Pad", "a number", pad([0, 1, 2, 0, 0, 1], 1.5), {"x": CUBE}),
    mirrored("reflect"),
    mirrored("edge"),
    Case("Pad", "cut off", pad([0, -1, 0, 0, 1, -2], 0.0), {"x": CUBE}),
    Case(
        "Pad",
        "chosen axes",
        lambda _: [
            constant("pads", [1, 2], np.int64),
            constant("axes", [-1], np.int64),
            node("Pad", ["x", "pads", "", "axes"]),
        ],
        {"x": CUBE},
        opsets=(18,),
    ),
    Case("OneHot", "last axis", one_hot(-1), {"x": INDEX}),
    Case("OneHot", "first axis", one_hot(0), {"x": INDEX}, shapes={"x": [2]}),
    Case("OneHot", "other values", one_hot(-1, 2.0, -1.0), {"x": INDEX}),
    Case("OneHot", "out of range", one_hot(-1), {"x": np.array([9, -9, 3], np.int64)}),
    Case("Trilu", "upper", lambda _: [node("Trilu", ["x"])], {"x": CUBE}, opsets=(15, 18)),
    Case(
        "Trilu",
        "lower, shifted",
        lambda _: [constant("k", 1, np.int64), node("Trilu", ["x", "k"], upper=0)],
        {"x": CUBE},
        opsets=(15, 18),
    ),
    Case(
        "NonZero",
        "of a constant (torch.arange in older exports)",
        lambda _: [
            constant("ones", [1, 1, 1, 1, 1], np.int64),
            node("NonZero", ["ones"], "n"),
            node("Cast", ["n"], "f", to=1),
            node("Add", ["x", "f"]),
        ],
        {"x": X},
    ),
]  # fmt: skip
