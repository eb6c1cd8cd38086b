"""Convolutions and pools."""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.onnx_reader.models import Case, floats, node

IMAGE = floats(2, 4, 9, 7)
ROW = floats(2, 4, 9)
POOLS = (11, 13, 15, 18)


def conv(title: str, kernel: Any, x: Any = IMAGE, *, bias: bool = True, op: str = "Conv", **attributes: Any) -> Case:
    inputs, constants = ["x", "w"], {"w": kernel}
    if bias:
        inputs.append("b")
        groups = attributes.get("group", 1)
        constants["b"] = floats(kernel.shape[0] if op == "Conv" else kernel.shape[1] * groups, seed=8)
    return Case(op, title, lambda _: [node(op, inputs, **attributes)], {"x": x}, constants, atol=1e-5, rtol=1e-5)


def pool(op: str, title: str, opsets: Any = POOLS, x: Any = IMAGE, **attributes: Any) -> Case:
    return Case(op, title, lambda _: [node(op, ["x"], **attributes)], {"x": x}, opsets=opsets)


K = floats(6, 4, 3, 3, seed=1)

CASES = [
    conv("plain", K),
    conv("no bias", K, bias=False),
    conv("strides", K, strides=[2, 3]),
    conv("paddings", K, pads=[1, 0, 2, 1]),
    conv("paddings that are SAME", K, pads=[1, 1, 1, 1]),
    conv("strides with paddings that are SAME", K, strides=[2, 2], pads=[1, 1, 1, 1]),
    conv("dilations", K, dilations=[2, 2]),
    conv("dilations and paddings", K, dilations=[2, 1], pads=[2, 1, 2, 1]),
    conv("SAME_UPPER", K, auto_pad="SAME_UPPER", strides=[2, 2]),
    conv("SAME_LOWER", K, auto_pad="SAME_LOWER", strides=[2, 2]),
    conv("VALID", K, auto_pad="VALID"),
    conv("an even window", floats(6, 4, 2, 4, seed=1)),
    conv("one pixel", floats(6, 4, 1, 1, seed=1)),
    conv("groups", floats(6, 2, 3, 3, seed=1), group=2),
    conv("depthwise", floats(4, 1, 3, 3, seed=1), group=4),
    conv("depthwise, two each", floats(8, 1, 3, 3, seed=1), group=4, pads=[1, 1, 1, 1]),
    conv("depthwise, unequal strides", floats(4, 1, 3, 3, seed=1), group=4, strides=[1, 2]),
    conv("a row of pixels", floats(6, 4, 3, seed=1), ROW, strides=[2], pads=[1, 1]),
    conv("turned", floats(4, 6, 3, 3, seed=1), op="ConvTranspose"),
    conv("strides", floats(4, 6, 3, 3, seed=1), op="ConvTranspose", strides=[2, 3]),
    conv("paddings", floats(4, 6, 3, 3, seed=1), op="ConvTranspose", strides=[2, 2], pads=[1, 0, 1, 2]),
    conv(
        "output paddings", floats(4, 6, 4, 4, seed=1), op="ConvTranspose", strides=[2, 2], pads=[1, 1, 1, 1],
        output_padding=[1, 0],
    ),
    conv("groups", floats(4, 3, 3, 3, seed=1), op="ConvTranspose", group=2, strides=[2, 2]),
    conv("dilations", floats(4, 6, 3, 3, seed=1), op="ConvTranspose", dilations=[2, 2]),
    conv("a row of pixels", floats(4, 6, 3, seed=1), ROW, op="ConvTranspose", strides=[2]),
    pool("MaxPool", "plain", (9, *POOLS), kernel_shape=[2, 3]),
    pool("MaxPool", "strides and paddings", (9, *POOLS), kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 1, 1]),
    pool("MaxPool", "other paddings", kernel_shape=[3, 3], strides=[2, 2], pads=[0, 1, 2, 0]),
    pool("MaxPool", "SAME_UPPER", (9, *POOLS), kernel_shape=[2, 2], strides=[2, 2], auto_pad="SAME_UPPER"),
    pool("MaxPool", "SAME_LOWER", kernel_shape=[2, 2], strides=[2, 2], auto_pad="SAME_LOWER"),
    pool("MaxPool", "rounded up", kernel_shape=[2, 2], strides=[2, 2], ceil_mode=1),
    pool("MaxPool", "a row of pixels", kernel_shape=[3], strides=[2], x=ROW),
    pool("AveragePool", "plain", (9, *POOLS), kernel_shape=[2, 3]),
    pool("AveragePool", "SAME_UPPER", (9, *POOLS), kernel_shape=[3, 3], strides=[2, 2], auto_pad="SAME_UPPER"),
    pool("AveragePool", "paddings do not count", kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 1, 1]),
    pool("AveragePool", "other paddings", kernel_shape=[3, 3], strides=[2, 2], pads=[0, 1, 2, 0]),
    pool("AveragePool", "paddings count", kernel_shape=[3, 3], pads=[1, 1, 1, 1], count_include_pad=1),
    pool("AveragePool", "SAME that counts", kernel_shape=[3, 3], strides=[2, 2], auto_pad="SAME_UPPER",
         count_include_pad=1),
    pool("AveragePool", "rounded up", kernel_shape=[2, 2], strides=[2, 2], ceil_mode=1, opsets=(13, 15, 18)),
    pool("MaxPool", "gaps", kernel_shape=[2, 3], dilations=[3, 2], strides=[1, 2], pads=[1, 0, 1, 1]),
    pool("MaxPool", "gaps, rounded up", kernel_shape=[2, 2], dilations=[2, 2], strides=[2, 2], ceil_mode=1),
    pool("AveragePool", "gaps", (19,), kernel_shape=[2, 2], dilations=[2, 3], strides=[2, 1], pads=[1, 1, 0, 1]),
    pool("LpPool", "squares", (11, 18), kernel_shape=[2, 3], strides=[2, 2], pads=[1, 0, 0, 1]),
    pool("GlobalLpPool", "cubes", (11, 18), p=3),
    pool("GlobalAveragePool", "plain", (9, *POOLS)),
    pool("GlobalMaxPool", "plain", (9, *POOLS)),
]  # fmt: skip


def stacked(_: int) -> list[Any]:
    """Two convolutions with an activation between: their transposes meet."""
    return [
        node("Conv", ["x", "w"], "a", pads=[1, 1, 1, 1]),
        node("LeakyRelu", ["a"], "b"),
        node("Conv", ["b", "v"], "c"),
        node("Add", ["c", "shift"]),
    ]


STACKED = Case(
    "Conv",
    "two in a row",
    stacked,
    {"x": IMAGE},
    {"w": K, "v": floats(3, 6, 3, 3, seed=2), "shift": np.abs(floats(1, 3, 1, 1, seed=3))},
    atol=1e-5,
    rtol=1e-5,
)
CASES.append(STACKED)
