"""Convolutions of images [B, H, W, C], kernels [height, width, in, out].

A padding that is TensorFlow's SAME is written so; another one is a Pad of its own, because TF 1.x has no explicit
paddings. Definition: onnx/docs/Operators.md (Conv, ConvTranspose), tf.nn.conv2d; Unity's is the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.graph.ops.loops.layers import window_padding
from export_model.signatures.errors import UnsupportedOpError

if TYPE_CHECKING:  # the op table, which the builder asks, writes dilated convolutions with these
    from export_model.converters.graph.builder import Builder

MAX_GROUPS = 256
Pair = tuple[int, int]


class Window(Struct, frozen=True):
    """A window that slides over height and width; ``same``: as TensorFlow pads, whatever ``pads`` says."""

    size: Pair
    strides: Pair = (1, 1)
    dilations: Pair = (1, 1)
    pads: tuple[Pair, Pair] = ((0, 0), (0, 0))
    same: bool = False

    @property
    def span(self) -> Pair:
        """What the window covers, its dilation counted in."""
        height, width = ((k - 1) * d + 1 for k, d in zip(self.size, self.dilations, strict=True))
        return height, width

    def same_pads(self, lengths: Sequence[int]) -> tuple[Pair, Pair]:
        """What SAME pads an image of these lengths with, the odd element behind."""
        top, left = (
            window_padding(n, k, s, "SAME")[1:] for n, k, s in zip(lengths, self.span, self.strides, strict=True)
        )
        return top, left

    def with_pads(self, lengths: Sequence[int]) -> Window:
        """The same with its paddings as numbers."""
        return replace(self, same=False, pads=self.same_pads(lengths)) if self.same else self

    def lengths(self, image: Sequence[int]) -> Pair:
        """Height and width of the result on an image of these."""
        height, width = (
            (n + sum(pair) - span) // stride + 1
            for n, pair, span, stride in zip(image, self.pads, self.span, self.strides, strict=True)
        )
        return height, width


def pad_image(b: Builder, image: str, window: Window, fill: float = 0.0) -> tuple[str, str]:
    """(the image, TensorFlow's padding): padded with ``fill`` by a node of its own unless it is SAME or VALID."""
    if window.same:
        return image, "SAME"
    if not any(map(any, window.pads)):
        return image, "VALID"
    known = [n for n in b.shape(image)[1:3] if isinstance(n, int)]
    if len(known) == len(window.pads) and window.pads == window.same_pads(known):
        return image, "SAME"
    return b.pad(image, [(0, 0), *window.pads, (0, 0)], fill), "VALID"


def conv2d(b: Builder, image: str, kernel: str | np.ndarray, window: Window, groups: int = 1) -> str:
    """[B, H, W, groups·in] by [height, width, in, out]: group g of the input makes the g-th part of the out channels.

    ``kernel`` is a tensor, or an array that becomes one.
    """
    data, padding = pad_image(b, image, window)
    attrs: dict[str, Any] = {
        "strides": (1, *window.strides, 1),
        "dilations": (1, *window.dilations, 1),
        "padding": padding,
    }
    if groups == 1:
        return b.add("Conv2D", [data, kernel if isinstance(kernel, str) else b.const(kernel, "kernel")], **attrs)
    array = b.needed_constant(kernel, "the kernel") if isinstance(kernel, str) else kernel
    *size, each, out = array.shape
    if not 1 <= groups <= MAX_GROUPS or out % groups:
        raise UnsupportedOpError(
            f"it has {groups} groups for {out} channels", why=f"up to {MAX_GROUPS} of equal size are written"
        )
    if each == 1 and len(set(window.strides)) == 1 and set(window.dilations) == {1}:
        # TensorFlow's CPU kernel takes no other strides and dilations.
        shaped = array.reshape(*size, groups, out // groups)
        return b.add("DepthwiseConv2dNative", [data, b.const(shaped, "kernel")], **attrs)
    parts = []
    for group in range(groups):
        part = b.slice(data, 3, group * each, (group + 1) * each)
        chosen = array[..., group * out // groups : (group + 1) * out // groups]
        parts.append(b.add("Conv2D", [part, b.const(chosen, "kernel")], **attrs))
    return b.concat(parts, 3)


def conv2d_transposed(
    b: Builder, image: str, kernel: np.ndarray, window: Window, extra: Pair = (0, 0), groups: int = 1
) -> str:
    """Every pixel paints the kernel [height, width, in, out per group], times its value; the pads are then cut off.

    Written as zeros between the pixels and a plain convolution with the kernel turned round: no target needs an op for
    it. ``extra`` rows and columns are added behind (ONNX's output_padding).
    """
    *size, channels, each = kernel.shape
    if groups < 1 or channels % groups:
        raise UnsupportedOpError(f"it has {groups} groups for {channels} channels", why="the model is damaged")
    pairs = []
    for axis in range(2):
        stride, span, (before, after) = window.strides[axis], window.span[axis], window.pads[axis]
        image = _spread(b, image, axis + 1, stride)
        # the spread image ends with stride - 1 zeros that belong to no pixel
        pairs.append((span - 1 - before, span - 1 - after + extra[axis] - (stride - 1)))
    image = b.pad(image, [(0, 0), *pairs, (0, 0)])
    turned = kernel[::-1, ::-1].reshape(*size, groups, channels // groups, each)
    turned = np.moveaxis(turned, 2, 3).reshape(*size, channels // groups, groups * each)
    return conv2d(b, image, turned, replace(window, strides=(1, 1), pads=((0, 0), (0, 0)), same=False), groups)


def transposed_window(
    size: Pair, strides: Pair, image: Sequence[int], result: Sequence[int], *, same: bool
) -> tuple[Window, Pair]:
    """(The window, the rows and columns behind) that make ``result`` pixels of ``image``, as TensorFlow pads.

    Raises UnsupportedOpError where a plain convolution of the result would not give the image.
    """
    pads, extra = [], []
    for k, s, n, whole in zip(size, strides, image, result, strict=True):
        if n != (-(-whole // s) if same else (whole - k) // s + 1):
            raise UnsupportedOpError(f"it makes {whole} pixels of {n}", why="the model is damaged")
        over = (n - 1) * s + k - whole
        before = max(over, 0) // 2 if same else 0
        pads.append((before, max(over - before, 0)))
        extra.append(max(before - over, 0))
    return Window(size, strides, (1, 1), (pads[0], pads[1])), (extra[0], extra[1])


def _spread(b: Builder, image: str, axis: int, stride: int) -> str:
    """``stride`` - 1 zeros after each pixel of an axis, on three axes: what is before, the zeros, what is behind."""
    if stride == 1:
        return image
    shape = b.shape(image)
    behind = math.prod(b.length(image, i) for i in range(axis + 1, 4))
    wide = b.pad(b.reshape(image, (-1, 1, behind)), [(0, 0), (0, stride - 1), (0, 0)])
    return b.reshape(wide, (*shape[:axis], b.length(image, axis) * stride, *shape[axis + 1 :]))
