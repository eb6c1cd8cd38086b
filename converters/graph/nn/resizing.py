"""Axes resampled to another length: each element of the result is a weighted sum of the axis' elements.

The weights follow from the lengths alone (onnx/docs/Operators.md, Resize), so they are computed here, and
what is left is a gather or a product with a matrix.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn.choosing import last, moved_back
from export_model.converters.graph.nn.linear import matmul
from export_model.signatures.errors import UnsupportedOpError

Places = npt.NDArray[np.float32]
Weights = npt.NDArray[np.float64]
_MAX_WEIGHTS = 1 << 22
_WHOLE = 1e-4


class Resampling(Struct, frozen=True):
    """How, by ONNX's names; ``region`` is what tf_crop_and_resize takes of the axis, from 0 to 1."""

    mode: str = "nearest"
    coordinates: str = "half_pixel"
    nearest: str = "round_prefer_floor"
    cubic: float = -0.75
    exclude_outside: bool = False
    antialias: bool = False
    outside: float = 0.0
    region: tuple[float, float] = (0.0, 1.0)


def resample(b: Builder, x: str, axis: int, length: int, scale: float, how: Resampling) -> str:
    """``x`` with ``length`` elements on an axis, ``scale`` times as many as it has."""
    before = b.length(x, axis)
    if length < 1 or before < 1 or before * length > _MAX_WEIGHTS:
        raise UnsupportedOpError(f"it makes {length} elements of {before}", why="the model is damaged")
    b.room(before * length)
    places = _places(before, length, scale, how)
    left_out = _outside(places, before, how)
    if how.mode == "nearest":
        index = _nearest(places, how.nearest, before)
        if not left_out.any():
            return x if index == list(range(before)) else b.take(x, index, axis)
        weights = np.eye(before)[index]
    else:
        weights = _weights(places, before, scale, how)
    weights[left_out] = 0
    value = matmul(b, last(b, x, axis), b.floats(weights.T.copy(), "weights"))
    if left_out.any() and how.outside:
        value = b.add("Add", [value, b.floats(np.where(left_out, how.outside, 0), "outside")])
    return moved_back(b, value, axis)


def _places(before: int, length: int, scale: float, how: Resampling) -> Weights:
    """Where the elements of the result lie among those that are there."""
    exact = abs(scale * before - length) <= _WHOLE
    if not exact and (how.coordinates == "align_corners" or _is_symmetric_nearest(how)):
        raise UnsupportedOpError(
            f"{before} times {scale:g} must be a whole number",
            why=f"ONNX and onnxruntime differ on {how.coordinates} there",
        )
    # in float32, as onnxruntime has them: which of two neighbours is the nearest depends on it
    return _ideal_places(np.arange(length, dtype=np.float32), np.float32(scale), before, how).astype(np.float64)


def _is_symmetric_nearest(how: Resampling) -> bool:
    return how.coordinates == "half_pixel_symmetric" and how.mode == "nearest"


def _ideal_places(at: Places, scale: np.float32, before: int, how: Resampling) -> Places:
    length, span = len(at), np.float32(before - 1)
    match how.coordinates:
        case "half_pixel":
            return (at + 0.5) / scale - 0.5
        case "half_pixel_symmetric":
            shift = np.float32(before / 2 * (1 - length / (scale * before)))
            return shift + (at + 0.5) / scale - 0.5
        case "pytorch_half_pixel":
            return (at + 0.5) / scale - 0.5 if length > 1 else np.zeros(1, np.float32)
        case "align_corners":
            return at * span / np.float32(length - 1) if length > 1 else np.zeros(1, np.float32)
        case "asymmetric":
            return at / scale
        case "tf_half_pixel_for_nn":
            return (at + 0.5) / scale
        case "tf_crop_and_resize":
            start, end = map(np.float32, how.region)
            if length > 1:
                return at * (end - start) * span / np.float32(length - 1) + start * span
            return at + (start + end) / 2 * span
        case other:
            raise UnsupportedOpError(f"its coordinates are {other!r}", why="the model is damaged")


def _outside(places: Weights, before: int, how: Resampling) -> npt.NDArray[np.bool_]:
    if how.coordinates != "tf_crop_and_resize":
        return np.zeros(len(places), bool)
    return (places < 0) | (places > before - 1)


def _nearest(places: Weights, rule: str, before: int) -> list[int]:
    functions: dict[str, Callable[[Weights], Weights]] = {
        "round_prefer_floor": lambda p: np.ceil(p - 0.5),
        "round_prefer_ceil": lambda p: np.floor(p + 0.5),
        "floor": np.floor,
        "ceil": np.ceil,
    }
    if rule not in functions:
        raise UnsupportedOpError(f"its rule is {rule!r}", why="the model is damaged")
    index: list[int] = np.clip(functions[rule](places), 0, before - 1).astype(int).tolist()
    return index


def _weights(places: Weights, before: int, scale: float, how: Resampling) -> Weights:
    """[length, before]: a bump around each place, its tails folded onto the edges, or left out and the rest scaled."""
    narrow = min(scale, 1.0) if how.antialias else 1.0
    reach = (1 if how.mode == "linear" else 2) / narrow
    margin = math.ceil(reach) + 1
    numbers = np.arange(-margin, before + margin)
    with np.errstate(all="ignore"):
        distance = np.abs(places[:, None] - numbers[None, :]) * narrow
    values = _bump(distance, how)
    inside = (numbers >= 0) & (numbers < before)
    if how.exclude_outside:
        values = np.where(inside, values, 0)
    values = values / values.sum(axis=1, keepdims=True)
    weights = np.zeros((len(places), before))
    for column, number in zip(values.T, np.clip(numbers, 0, before - 1), strict=True):
        weights[:, number] += column
    # a place beyond the margin stands at the edge
    weights[places < -margin + reach] = np.eye(before)[0]
    weights[places > before - 1 + margin - reach] = np.eye(before)[-1]
    return weights


def _bump(distance: Weights, how: Resampling) -> Weights:
    if how.mode == "linear":
        return np.maximum(1 - distance, 0)
    if how.mode != "cubic":
        raise UnsupportedOpError(f"its mode is {how.mode!r}", why="the model is damaged")
    a, d = how.cubic, distance
    near = ((a + 2) * d - (a + 3)) * d * d + 1
    far = ((d - 5) * d + 8) * d * a - 4 * a
    return np.where(d <= 1, near, np.where(d < 2, far, 0.0))
