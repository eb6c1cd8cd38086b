"""Images made smaller or larger: Resizing, CenterCrop, UpSampling (keras/src/layers/preprocessing, reshaping)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from export_model.converters.formats.keras.layers.step import Step, Translate
from export_model.converters.graph.nn.resizing import Resampling, resample
from export_model.converters.graph.types import FLOAT32
from export_model.signatures.errors import UnsupportedOpError

#: tf.image.resize, pixels in their middle, by ONNX's names. Its bicubic has weights from a table of 1024 (1e-3 off).
_RESAMPLING = {
    "nearest": Resampling("nearest", "tf_half_pixel_for_nn", "floor"),
    "bilinear": Resampling("linear"),
}

#: Layers that are called with training=True, which changes nothing in them.
UNTRAINED = frozenset(("Resizing", "CenterCrop"))


def _first_axis(step: Step) -> int:
    """The first axis of pixels."""
    return 2 if step.get("data_format") == "channels_first" else 1


def _resize(step: Step, value: str, lengths: Mapping[int, int]) -> str:
    """``value`` with so many pixels on each axis."""
    mode = str(step.get("interpolation", "bilinear"))
    if mode not in _RESAMPLING:
        raise UnsupportedOpError(f"its interpolation is {mode[:60]!r}")
    for axis, length in lengths.items():
        before = step.net.length(value, axis)
        if length != before:
            value = resample(step.net, value, axis, length, length / max(before, 1), _RESAMPLING[mode])
    return value


def _resizing(step: Step) -> str:
    for key in ("crop_to_aspect_ratio", "pad_to_aspect_ratio", "antialias"):
        step.refuse_unless(key, False)
    first = _first_axis(step)
    lengths = {first: int(step.get("height")), first + 1: int(step.get("width"))}
    if not step.net.is_float(step.x):
        raise UnsupportedOpError("it rounds pixels", why="which way one between two numbers is rounded is chance")
    return _resize(step, step.x, lengths)


def _center_crop(step: Step) -> str:
    value, first = step.net.cast(step.x, FLOAT32), _first_axis(step)
    for axis, key in ((first, "height"), (first + 1, "width")):
        length, wanted = step.net.length(value, axis), int(step.get(key))
        if not 1 <= wanted <= length:
            raise UnsupportedOpError(f"it crops {length} pixels to {wanted}")
        start = (length - wanted) // 2
        value = step.net.slice(value, axis, start, start + wanted)
    return value


def _up_sampling(step: Step) -> str:
    size = step.get("size", 2)
    axes, first = step.rank - 2, _first_axis(step)
    counts = [int(size)] * axes if isinstance(size, int) else [int(n) for n in size]
    value = step.x
    for axis, count in enumerate(counts, first):
        length = step.net.length(value, axis)
        if not count >= 1 or count * length > 1 << 16:
            raise UnsupportedOpError(f"it makes {count * length} rows or columns")
        step.net.room(count * length)
        if step.get("interpolation", "nearest") != "nearest":
            value = _resize(step, value, {axis: count * length})
        elif count != 1:
            value = step.net.take(value, np.repeat(np.arange(length), count).tolist(), axis)
    return value


LAYERS: Mapping[str, Translate] = {
    "Resizing": _resizing,
    "CenterCrop": _center_crop,
    **dict.fromkeys(("UpSampling1D", "UpSampling2D"), _up_sampling),
}
