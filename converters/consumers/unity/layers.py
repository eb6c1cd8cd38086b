"""Layers of a ``.nn`` that some releases of Barracuda run otherwise than the file says."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from msgspec import Struct

from export_model.converters.consumers.unity.players import PlayOutcome
from export_model.converters.formats.barracuda.assemble import FLATTENS_ITSELF
from export_model.converters.formats.barracuda.format import Layer, NnModel
from export_model.converters.graph.ops.barracuda.vocabulary import Activation, LayerType

#: Activations that go by the channels.
_BY_CHANNELS = frozenset({Activation.SOFTMAX, Activation.LOG_SOFTMAX})


class LayerRow(Struct, frozen=True):
    """A form of a layer, the consumers that trip over it, and what comes of it."""

    consumers: frozenset[str]
    outcome: PlayOutcome
    when: Callable[[Layer, NnModel], bool]
    says: str
    fix: str
    evidence: str
    exception: Callable[[Layer, NnModel], str]


def trips(model: NnModel, consumer: str) -> Iterator[tuple[LayerRow, Layer]]:
    """The layers that a consumer trips over, the first of each row."""
    for row in _ROWS:
        if consumer in row.consumers:
            found = next((layer for layer in model.layers if row.when(layer, model)), None)
            if found is not None:
                yield row, found


def _is_flatten_in_need(layer: Layer, model: NnModel) -> bool:
    """A Flatten that more than matrix products and other views read: dropped, they get the four axes before it."""
    return layer.type == LayerType.FLATTEN and _is_missed(layer.name, model)


def _is_missed(name: str, model: NnModel) -> bool:
    """Whether a layer reads it, directly or behind activations, that goes by its axes; an output is kept flat."""
    for reader in model.layers:
        if name not in reader.inputs or reader.type in (*FLATTENS_ITSELF, LayerType.FLATTEN):
            continue
        each = reader.type == LayerType.ACTIVATION and reader.activation not in _BY_CHANNELS
        if not each or _is_missed(reader.name, model):
            return True
    return False


def _is_reshape_of_memory(layer: Layer, model: NnModel) -> bool:
    memories = {m.input for m in model.memories}
    return layer.type == LayerType.RESHAPE and len(model.inputs) == 1 and bool(memories.intersection(layer.inputs))


def _off_shape(layer: Layer, model: NnModel) -> str:
    readers = {reader.type for reader in model.layers if layer.name in reader.inputs}
    if LayerType.CONCAT in readers:
        return "ArgumentException: Off-axis dimensions must match"
    return "AssertionException: Assertion failure. Value was False"


def _off_size(layer: Layer, model: NnModel) -> str:
    del model
    size = math.prod(n for n in layer.pool if n > 0)
    return f"ArgumentException: Cannot reshape array of size 1 into shape with multiple of {size} elements"


_ROWS = (
    LayerRow(
        consumers=frozenset({"1.0.8", "1.9.1", "2.0.1"}),
        outcome=PlayOutcome.FIRST,
        when=_is_flatten_in_need,
        says="Barracuda before 2.3 leaves a Flatten out, and what reads it gets the axes before it",
        fix="write a Reshape to [-1, 1, 1, C] in its place; --for {profile} does, or write the .onnx",
        evidence="cases/recurrent_nn_barracuda-1.4; cases/other_nn_barracuda-1.0",
        exception=_off_shape,
    ),
    LayerRow(
        consumers=frozenset({"1.0.8", "1.9.1"}),
        outcome=PlayOutcome.FIRST,
        when=_is_reshape_of_memory,
        says="in a file with one input Barracuda 1.x looks at shapes before it knows the memories':"
        " a Reshape of one fails",
        fix="cut the memory as it is, along C; --for {profile} does",
        evidence="cases/other_nn_barracuda-1.0",
        exception=_off_size,
    ),
)
