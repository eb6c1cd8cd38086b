"""Dilated convolutions as TensorFlow writes them: SpaceToBatchND, a plain convolution, BatchToSpaceND.

Each row of the batch becomes one per offset, with every n-th pixel. A sequence [B, T, C] is an image of height 1 in
between. Definition: tf.nn.with_space_to_batch (tensorflow/python/ops/nn_ops.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from msgspec import Struct

from export_model.converters.graph.nn.convolution import Window, conv2d
from export_model.signatures.errors import UnsupportedOpError

if TYPE_CHECKING:  # the op table, which the builder asks, writes BatchToSpaceND with these
    from export_model.converters.graph.builder import Builder


class Blocks(Struct, frozen=True):
    """The factors of the axes behind the batch, and what is added before and behind each of these."""

    factors: tuple[int, ...]
    pads: tuple[tuple[int, int], ...]

    def without(self, crops: Blocks) -> Blocks:
        """The pads less what is cut off again. Raises UnsupportedOpError where the factors are others."""
        if self.factors != crops.factors:
            raise UnsupportedOpError(f"it joins blocks of {crops.factors}, made by {self.factors}")
        pairs = zip(self.pads, crops.pads, strict=True)
        return Blocks(self.factors, tuple((a - c, z - d) for (a, z), (c, d) in pairs))


def blocks_of(factors: np.ndarray, pads: np.ndarray) -> Blocks:
    """The two operands of SpaceToBatchND and BatchToSpaceND. Raises UnsupportedOpError."""
    pairs = pads.reshape(-1, 2).tolist()
    if factors.size not in (1, 2) or len(pairs) != factors.size or factors.min() < 1 or pads.min() < 0:
        raise UnsupportedOpError(f"its blocks are {factors.tolist()}, its paddings {pads.tolist()}")
    return Blocks(tuple(int(n) for n in factors.reshape(-1)), tuple((int(a), int(z)) for a, z in pairs))


def space_to_batch(b: Builder, x: str, blocks: Blocks) -> str:
    """[B, H, W, C] as [h·w·B, H/h, W/w, C], rows in the order of their offsets; [B, T, C] likewise."""
    count, rank = len(blocks.factors), b.rank(x)
    if rank != count + 2:
        raise UnsupportedOpError(f"it is given {rank} axes")
    x = b.pad(x, [(0, 0), *blocks.pads, (0, 0)])
    split: list[int] = []
    for axis, factor in enumerate(blocks.factors, 1):
        length = b.length(x, axis)
        if length % factor:
            raise UnsupportedOpError(
                f"its length of {length} must be a multiple of {factor}", why="it is cut into blocks"
            )
        split += [length // factor, factor]
    rows, channels = b.shape(x)[0], b.shape(x)[-1]
    wide = b.reshape(x, (rows, *split, channels))
    order = [*range(2, 2 * count + 1, 2), 0, *range(1, 2 * count, 2), 2 * count + 1]
    return b.reshape(b.transpose(wide, order), (-1, *split[::2], channels))


def batch_to_space(b: Builder, x: str, blocks: Blocks) -> str:
    """The other way round, less what is cut off."""
    count, rank = len(blocks.factors), b.rank(x)
    if rank != count + 2:
        raise UnsupportedOpError(f"it is given {rank} axes")
    lengths, channels = [b.length(x, i) for i in range(1, count + 1)], b.shape(x)[-1]
    wide = b.reshape(x, (*blocks.factors, -1, *lengths, channels))
    pairs = [axis for i in range(count) for axis in (count + 1 + i, i)]
    whole = [n * factor for n, factor in zip(lengths, blocks.factors, strict=True)]
    joined = b.reshape(b.transpose(wide, [count, *pairs, 2 * count + 1]), (-1, *whole, channels))
    return b.pad(joined, [(0, 0), *((-a, -z) for a, z in blocks.pads), (0, 0)])


def convolve_dilated(b: Builder, x: str, kernel: str, bias: str | None, blocks: Blocks, *, depthwise: bool) -> str:
    """The convolution of all pixels with a dilated kernel [height, width, in, out]; negative pads cut off."""
    missing: Sequence[int] = [1] * (2 - len(blocks.factors))
    image = b.expand_dims(x, 1) if missing else x
    height, width, taken, made = (b.length(kernel, i) for i in range(4))
    if missing and height != 1:
        raise UnsupportedOpError("its sequence is an image of width 1")
    down, across = (*missing, *blocks.factors)
    pads = [*[(0, 0) for _ in missing], *blocks.pads]
    window = Window((height, width), (1, 1), (down, across), (pads[0], pads[1]))
    weights: str | np.ndarray = kernel
    groups = b.length(image, 3) // max(taken, 1)
    if depthwise:
        weights = b.needed_constant(kernel, "the kernel").reshape(height, width, 1, taken * made)
        groups = taken
    value = conv2d(b, image, weights, window, groups)
    value = value if bias is None else b.add("BiasAdd", [value, bias])
    return b.squeeze(value, [1]) if missing else value
