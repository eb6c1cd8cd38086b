"""Pools of images [B, H, W, C]; windows as in convolution.py. Definition: onnx/docs/Operators.md."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn.convolution import Pair, Window, pad_image
from export_model.converters.graph.types import FLOAT32
from export_model.signatures.errors import UnsupportedOpError

#: Places of a window with gaps, each of which is a slice.
_MAX_PLACES = 64


def max_pool(b: Builder, image: str, window: Window, lowest: float = -np.inf) -> str:
    """The largest element under each window; ``lowest`` stands where the image is not."""
    if set(window.dilations) != {1}:
        window = window.with_pads([b.length(image, axis) for axis in (1, 2)])
        frame = b.pad(image, [(0, 0), *window.pads, (0, 0)], lowest)
        value, *rest = _under(b, frame, window)
        for part in rest:
            value = b.add("Maximum", [value, part])
        return value
    data, padding = pad_image(b, image, window, lowest)
    return b.add("MaxPool", [data], **_attrs(window, padding))


def average_pool(b: Builder, image: str, window: Window, counted: tuple[Pair, Pair] | None = None) -> str:
    """The mean of the image's elements under each window; ``counted`` paddings count as zeros."""
    data, padding = image, "VALID"
    if set(window.dilations) != {1}:
        lengths = [b.length(image, axis) for axis in (1, 2)]
        window = window.with_pads(lengths)
        value, *rest = _under(b, b.pad(image, [(0, 0), *window.pads, (0, 0)]), window)
        for part in rest:
            value = b.add("Add", [value, part])
        count = _counts(b, lengths, window, counted or ((0, 0), (0, 0))).astype(FLOAT32)
        return b.add("RealDiv", [value, b.const(count[None, :, :, None], "count")])
    if counted is None or not any(map(any, window.pads)):
        if window.same or not any(map(any, window.pads)):
            return b.add("AvgPool", [image], **_attrs(window, "SAME" if window.same else "VALID"))
        counted = ((0, 0), (0, 0))
    lengths = [b.length(image, axis) for axis in (1, 2)]
    if not any(map(any, counted)) and window.pads == window.same_pads(lengths):
        return b.add("AvgPool", [image], **_attrs(window, "SAME"))
    counts = _counts(b, lengths, window, counted)
    data = b.pad(image, [(0, 0), *window.pads, (0, 0)])
    mean = b.add("AvgPool", [data], **_attrs(window, padding))
    factor = (window.size[0] * window.size[1] / counts).astype(FLOAT32)
    return b.add("Mul", [mean, b.const(factor[None, :, :, None], "share")])


def _under(b: Builder, frame: str, window: Window) -> list[str]:
    """The elements under each place of a window with gaps, which no target has: a slice for each place."""
    places = [(i, j) for i in range(window.size[0]) for j in range(window.size[1])]
    if len(places) > _MAX_PLACES:
        raise UnsupportedOpError(
            f"its window has gaps and {len(places)} places", why=f"up to {_MAX_PLACES} are written"
        )
    lengths = [b.length(frame, axis) for axis in (1, 2)]
    counts = [(n - span) // stride + 1 for n, span, stride in zip(lengths, window.span, window.strides, strict=True)]
    parts = []
    for place in places:
        part = frame
        for axis in range(2):
            first, stride = place[axis] * window.dilations[axis], window.strides[axis]
            part = b.slice(part, axis + 1, first, first + (counts[axis] - 1) * stride + 1, stride)
        parts.append(part)
    return parts


def _attrs(window: Window, padding: str) -> dict[str, Any]:
    return {"ksize": (1, *window.size, 1), "strides": (1, *window.strides, 1), "padding": padding}


def _counts(b: Builder, lengths: Sequence[int], window: Window, counted: tuple[Pair, Pair]) -> np.ndarray:
    """How many elements each window has that count: the image's, and the padding's in ``counted``."""
    sums = []
    for length, size, gap, stride, (before, after), (first, last) in zip(
        lengths, window.size, window.dilations, window.strides, window.pads, counted, strict=True
    ):
        whole = before + length + after
        b.room(whole + max(whole - (size - 1) * gap, 0) // stride * size)
        line = np.zeros(whole)
        line[before - first : before + length + last] = 1
        windows = np.lib.stride_tricks.sliding_window_view(line, (size - 1) * gap + 1)
        sums.append(windows[::stride, ::gap].sum(axis=1))
    return np.maximum(np.outer(sums[0], sums[1]), 1)
