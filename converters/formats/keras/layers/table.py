"""Every layer that is read as data, by its class; Keras 3's operations apart, which may be called alike."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from export_model.converters.formats.keras.layers import (
    activations,
    attention,
    convolution,
    core,
    encoding,
    normalisation,
    operations,
    recurrent,
    resizing,
)
from export_model.converters.formats.keras.layers.step import Step, Translate
from export_model.converters.formats.keras.model import layer_of
from export_model.signatures.errors import UnsupportedOpError


def _call_wrapped(step: Step, x: str) -> str:
    """What the layer inside makes of ``x``, with the next weights. Raises UnsupportedOpError."""
    inner = layer_of(step.get("layer"))
    if inner.kind not in LAYERS:
        raise UnsupportedOpError(f"it wraps a {inner.kind}")
    inside = step.inner(inner, [x], step.left)
    value = LAYERS[inner.kind](inside)
    step.left = inside.left
    if not isinstance(value, str):
        raise UnsupportedOpError(f"it wraps a {inner.kind} with several results")
    return value


def _time_distributed(step: Step) -> str:
    """The same layer at every step: steps are rows of one batch."""
    b, x = step.net, step.x
    rows, time, *rest = b.shape(x)
    value = _call_wrapped(step, b.reshape(x, (-1, *rest)))
    return b.reshape(value, (rows, time, *b.shape(value)[1:]))


def _spectral_normalization(step: Step) -> str:
    """The layer inside: its kernel was divided by its norm while it was trained.

    A ``.keras`` has the kernel and the vector of the power iteration before the weights of the layer, an ``.h5`` the
    vector behind them.
    """
    first, *rest = step.left
    step.left = rest[1:] if len(rest) > 1 and np.array_equal(first, rest[1]) else step.left[:-1]
    return _call_wrapped(step, step.x)


LAYERS: Mapping[str, Translate] = {
    **activations.LAYERS,
    **core.LAYERS,
    **convolution.LAYERS,
    **normalisation.LAYERS,
    **recurrent.LAYERS,
    **attention.LAYERS,
    **encoding.LAYERS,
    **resizing.LAYERS,
    "TimeDistributed": _time_distributed,
    "SpectralNormalization": _spectral_normalization,
}
OPERATIONS: Mapping[str, Translate] = operations.OPERATIONS
