"""Samples of ops: images."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from tests.graph.samples.base import (
    Sample,
    any_size,
    const,
    f32,
    floats,
    ints,
    sample,
)
from tests.graph.samples.linear import unfused


def _convolutions() -> Iterator[Sample]:
    image = floats(2, 7, 6, 3)
    kernel = const(floats(3, 2, 3, 4, seed=1))
    for padding, stride in itertools.product(("SAME", "VALID"), (1, 2, 3)):
        attrs: dict[str, Any] = {"padding": padding, "strides": (1, stride, stride, 1)}
        # the last column of the image is under no window
        yield sample("Conv2D", f"{padding}, stride {stride}", image, kernel, **attrs)
        yield sample("DepthwiseConv2dNative", f"{padding}, stride {stride}", image, kernel, **attrs)
        yield sample("Conv2D", f"{padding}, stride {stride}, any size", any_size(floats(2, 8, 7, 3)), kernel, **attrs)
    for padding in ("SAME", "VALID"):
        attrs = {"padding": padding, "strides": (1, 1, 1, 1), "dilations": (1, 2, 2, 1)}
        yield sample("Conv2D", f"{padding}, dilated", image, kernel, **attrs)
        yield sample("Conv2D", f"{padding}, dilated, any size", any_size(floats(2, 7, 6, 3)), kernel, **attrs)
        refused = {"tensorflow": "its CPU kernel takes no dilations"}
        yield sample("DepthwiseConv2dNative", f"{padding}, dilated", image, kernel, differs=refused, **attrs)
    for padding, strides, dilations in itertools.product(
        ("SAME", "VALID"), ((2, 2), (1, 2), (3, 2)), ((2, 2), (2, 1), (4, 3))
    ):
        attrs = {"padding": padding, "strides": (1, *strides, 1), "dilations": (1, *dilations, 1)}
        named = f"{padding}, strides {strides}, dilations {dilations}"
        wide = floats(2, 13, 12, 3)
        yield sample("Conv2D", named, wide, kernel, **attrs)
        refused = "SAME pads by the size of the image"
        differs = dict.fromkeys(("onnxruntime", "tfjs-cpu", "tfjs-wasm", "js"), refused) if padding == "SAME" else {}
        yield sample("Conv2D", f"{named}, any size", any_size(wide), kernel, differs=differs, **attrs)
    yield sample(
        "Conv2D", "strides differ", image, const(floats(4, 4, 3, 2, seed=1)), padding="SAME", strides=(1, 2, 1, 1)
    )
    yield sample("Conv2D", "1 x 1", image, const(floats(1, 1, 3, 2, seed=1)), padding="VALID", strides=(1, 1, 1, 1))
    bias = const(floats(4, seed=2))
    for names in (("BiasAdd",), ("BiasAdd", "Relu"), ("BiasAdd", "Relu6"), ("BiasAdd", "Elu")):
        attrs = {"padding": "SAME", "strides": (1, 2, 2, 1), "fused_ops": names}
        fused = sample("_FusedConv2D", " + ".join(names), image, kernel, bias, **attrs)
        # what TensorFlow 2.21 calls _FusedConv2D has more attributes
        yield replace(fused, oracle=unfused(fused))


def _pools() -> Iterator[Sample]:
    image = floats(2, 7, 6, 3)
    for op, padding, size, stride in itertools.product(("MaxPool", "AvgPool"), ("SAME", "VALID"), (2, 3), (1, 2)):
        yield sample(
            op,
            f"{padding}, {size} by {stride}",
            image,
            padding=padding,
            ksize=(1, size, size, 1),
            strides=(1, stride, stride, 1),
        )
    for op in ("MaxPool", "AvgPool"):
        negative = floats(2, 5, 5, 2, low=-3, high=-1)
        yield sample(
            op, "negative, window not square", negative, padding="SAME", ksize=(1, 3, 2, 1), strides=(1, 2, 3, 1)
        )


def _padding() -> Iterator[Sample]:
    one, image = (
        const(np.array([[0, 0], [1, 2]], np.int32)),
        const(np.array([[0, 0], [1, 0], [0, 2], [0, 0]], np.int32)),
    )
    yield sample("Pad", "matrix", floats(2, 3), one)
    yield sample("Pad", "image", floats(2, 3, 3, 2), image)
    yield sample("Pad", "int32", ints(2, 3), one)
    yield sample("PadV2", "value", floats(2, 3), one, const(f32(-7).reshape(())))
    yield sample("PadV2", "image", floats(2, 3, 3, 2), image, const(f32(1.5).reshape(())))


def samples() -> Iterator[Sample]:
    yield from _convolutions()
    yield from _pools()
    yield from _padding()
