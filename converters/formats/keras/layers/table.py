"""Every layer that is read as data, by its class; Keras 3's operations apart, which may be called alike."""

from __future__ import annotations

from collections.abc import Mapping

from converters.formats.keras.layers import (
    activations,
    attention,
    convolution,
    core,
    normalisation,
    operations,
    recurrent,
)
from converters.formats.keras.layers.step import Step, Translate
from converters.formats.keras.model import layer_of
from signatures.errors import UnsupportedOpError


def _time_distributed(step: Step) -> str:
    """The same layer at every step: steps are rows of one batch."""
    b, x = step.net, step.x
    inner = layer_of(step.get("layer"))
    if inner.kind not in LAYERS:
        raise UnsupportedOpError(f"it wraps a {inner.kind}")
    rows, time, *rest = b.shape(x)
    flat = b.reshape(x, (-1, *rest))
    inside = step.inner(inner, [flat], step.left)
    value = LAYERS[inner.kind](inside)
    step.left = inside.left
    if not isinstance(value, str):
        raise UnsupportedOpError(f"it wraps a {inner.kind} with several results")
    return b.reshape(value, (rows, time, *b.shape(value)[1:]))


LAYERS: Mapping[str, Translate] = {
    **activations.LAYERS,
    **core.LAYERS,
    **convolution.LAYERS,
    **normalisation.LAYERS,
    **recurrent.LAYERS,
    **attention.LAYERS,
    "TimeDistributed": _time_distributed,
}
OPERATIONS: Mapping[str, Translate] = operations.OPERATIONS
