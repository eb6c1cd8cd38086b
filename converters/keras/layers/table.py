"""Every layer that is read as data, by its class; Keras 3's operations apart, which may be called alike."""

from __future__ import annotations

from collections.abc import Mapping

from converters.keras.layers import activations, attention, convolution, core, normalisation, operations, recurrent
from converters.keras.layers.step import Translate

LAYERS: Mapping[str, Translate] = {
    **activations.LAYERS,
    **core.LAYERS,
    **convolution.LAYERS,
    **normalisation.LAYERS,
    **recurrent.LAYERS,
    **attention.LAYERS,
}
OPERATIONS: Mapping[str, Translate] = operations.OPERATIONS
