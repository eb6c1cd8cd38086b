"""What changes the size of an image: pools to a given size, resampling, borders, channels laid out as pixels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, cast

import numpy as np

from export_model.converters.formats.torchscript.machine import Machine
from export_model.converters.formats.torchscript.values import ScriptTensor
from export_model.converters.graph.nn.resizing import Resampling, resample
from export_model.signatures.errors import UnsupportedOpError

_FIRST = 2  # a batch and channels go before the axes of an image


def _sizes(value: Any, axes: int) -> list[int | None]:
    given = [value] if isinstance(value, int) else value
    found = [None if n is None else int(n) for n in given]
    return found * axes if len(found) == 1 else found


def _adaptive_pool(kind: str, axes: int) -> Callable[..., Any]:
    """Each element of the result is the mean or largest of an even share of the axis, one axis after the other."""

    def translate(m: Machine, x: Any, output_size: Any) -> Any:
        value = m.ref(x)
        for number, size in enumerate(_sizes(output_size, axes)):
            axis = m.b.rank(value) - axes + number
            length = m.b.length(value, axis)
            if size is None or size == length:
                continue
            if not 1 <= size <= length:
                raise UnsupportedOpError(f"a pool of {length} elements to {size}", why="fewer than there are are known")
            shares = [(i * length // size, -(-(i + 1) * length // size)) for i in range(size)]
            parts = [m.b.reduce(kind, m.b.slice(value, axis, *share), [axis], keep=True) for share in shares]
            value = m.b.concat(parts, axis)
        # what a pool of the largest gives beside, the indices, is never used by a policy
        return ScriptTensor(value) if kind == "Mean" else (ScriptTensor(value), None)

    return translate


def _upsample(axes: int, mode: str) -> Callable[..., ScriptTensor]:
    """``output_size`` or factors (one for all, or one for each axis), and ``align_corners`` where it is weighted."""

    def translate(m: Machine, x: Any, output_size: Any, *rest: Any) -> ScriptTensor:
        value, given = m.ref(x), list(rest)
        corners = bool(given.pop(0)) if mode != "nearest" else False
        numbers = [n for item in given for n in (item if isinstance(item, list | tuple) else [item])]
        scales = [None if n is None else float(n) for n in numbers] or [None] * axes
        scales = scales * axes if len(scales) == 1 else scales
        if mode == "nearest":
            how = Resampling("nearest", "asymmetric", "floor")
        else:
            how = Resampling(mode, "align_corners" if corners else "half_pixel")
        for number in range(axes):
            axis = _FIRST + number
            before, scale = m.b.length(value, axis), scales[number]
            length = int(output_size[number]) if output_size else int(before * (scale or 1))
            value = resample(m.b, value, axis, length, scale or length / before, how)
        return ScriptTensor(value)

    return translate


def _pad(m: Machine, x: Any, pad: Sequence[int], mode: Any = "constant", value: Any = None) -> ScriptTensor:
    """``pad`` begins with the last axis, and has what goes before and behind it."""
    made, pads = m.ref(x), [int(n) for n in pad]
    pairs = [(0, 0)] * m.b.rank(made)
    for number in range(len(pads) // 2):
        pairs[-1 - number] = (pads[2 * number], pads[2 * number + 1])
    if mode == "constant":
        return ScriptTensor(m.b.pad(made, pairs, None if value is None else float(value)))
    kind = {"reflect": "reflect", "replicate": "edge", "circular": "wrap"}.get(str(mode))
    if kind is None:
        raise UnsupportedOpError(f"a border that is called {str(mode)[:20]!r}", why="four kinds are known")
    for axis, (before, after) in enumerate(pairs):
        if before or after:
            length = m.b.length(made, axis)
            m.b.room(before + length + after)
            of_numpy = cast(Literal["reflect", "edge", "wrap"], kind)
            made = m.b.take(made, np.pad(np.arange(length), (before, after), mode=of_numpy).tolist(), axis)
    return ScriptTensor(made)


def _pad_by_mode(mode: str) -> Callable[..., ScriptTensor]:
    return lambda m, x, padding: _pad(m, x, padding, mode)


def _pixel_shuffle(m: Machine, x: Any, factor: Any) -> ScriptTensor:
    """[B, C·r², H, W] as [B, C, H·r, W·r]."""
    value, r = m.ref(x), int(factor)
    rows, (channels, height, width) = m.b.shape(value)[0], (m.b.length(value, i) for i in (1, 2, 3))
    if r < 1 or channels % (r * r):
        raise UnsupportedOpError(f"{channels} channels are laid out by {r}", why="its code is damaged")
    wide = m.b.reshape(value, (rows, channels // (r * r), r, r, height, width))
    moved = m.b.transpose(wide, (0, 1, 4, 2, 5, 3))
    return ScriptTensor(m.b.reshape(moved, (rows, channels // (r * r), height * r, width * r)))


OPS: Mapping[str, Callable[..., Any]] = {
    **{f"adaptive_avg_pool{n}d": _adaptive_pool("Mean", n) for n in (1, 2)},
    **{f"adaptive_max_pool{n}d": _adaptive_pool("Max", n) for n in (1, 2)},
    "upsample_nearest1d": _upsample(1, "nearest"),
    "upsample_nearest2d": _upsample(2, "nearest"),
    "upsample_bilinear2d": _upsample(2, "linear"),
    "pad": _pad,
    "constant_pad_nd": lambda m, x, pad, value=0: _pad(m, x, pad, "constant", value),
    **{f"reflection_pad{n}d": _pad_by_mode("reflect") for n in (1, 2)},
    **{f"replication_pad{n}d": _pad_by_mode("replicate") for n in (1, 2)},
    "pixel_shuffle": _pixel_shuffle,
}
