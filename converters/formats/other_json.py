"""JSON that other projects write and people give: what it is, by its keys, and which file has the model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from msgspec import Struct

from export_model.converters.files.file_probe import Content

_SAVE_BINARY = "save it in binary: SerializeToString"
_NETWORK_IN_JAVASCRIPT = "build the same layers in Keras or PyTorch, set the weights from this file, and export that"


class Kind(Struct, frozen=True):
    """A kind of file: ``keys`` that all its files have, and ``also``, what else must hold."""

    key: str
    label: str
    advice: str
    keys: frozenset[str]
    also: Callable[[Mapping[str, Any]], bool] = lambda content: True


def _has(path: str) -> Callable[[Mapping[str, Any]], bool]:
    """Whether the first object of a list has a key: ``layers.layer_type``."""
    name, _, inner = path.partition(".")

    def holds(content: Mapping[str, Any]) -> bool:
        items = content.get(name)
        return isinstance(items, list) and bool(items) and isinstance(items[0], dict) and inner in items[0]

    return holds


def _kind(key: str, label: str, keys: str, advice: str, also: Callable[..., bool] = lambda content: True) -> Kind:
    return Kind(key, label, advice, frozenset(keys.split()), also)


#: The particular before the general. Sources: keras Model.to_json; brain.js toJSON (src/neural-network.ts,
#: src/recurrent); synaptic Network.toJSON; neataptic Network.toJSON; ConvNetJS Net.toJSON; ML-Agents timers.py and
#: training_status.py; transformers config.json; google.protobuf.json_format of ONNX and TensorFlow; npm.
KINDS = (
    _kind(
        "keras_json",
        "the layers of a Keras model without their weights (model.to_json)",
        "class_name config",
        "save both in one file: model.save('policy.keras')",
    ),
    _kind("brain_js", "a network of brain.js", "sizes layers", _NETWORK_IN_JAVASCRIPT),
    _kind("brain_js_recurrent", "a recurrent network of brain.js", "type options hiddenLayers", _NETWORK_IN_JAVASCRIPT),
    _kind("synaptic", "a network of synaptic", "neurons connections", _NETWORK_IN_JAVASCRIPT),
    _kind("neataptic", "a network of neataptic", "nodes connections input output", _NETWORK_IN_JAVASCRIPT),
    _kind("convnetjs", "a network of ConvNetJS", "layers", _NETWORK_IN_JAVASCRIPT, _has("layers.layer_type")),
    _kind("onnx_json", "an ONNX model as JSON", "irVersion graph", _SAVE_BINARY),
    _kind("graph_json", "a TensorFlow graph as JSON", "node", _SAVE_BINARY, _has("node.op")),
    _kind(
        "mlagents_timers",
        "the timers.json of ML-Agents: measured times",
        "name gauges children",
        "give the run's folder, or the .onnx or .pt in it",
    ),
    _kind(
        "mlagents_status",
        "the training_status.json of ML-Agents: a record of its checkpoints",
        "metadata",
        "give the run's folder, or the .onnx or .pt in it",
        lambda content: isinstance(content["metadata"], dict) and "stats_format_version" in content["metadata"],
    ),
    _kind(
        "hugging_face",
        "the config.json of a Hugging Face model: settings without weights",
        "architectures model_type",
        "its weights are in other files: export the model to ONNX, and give that",
    ),
    _kind("notebook", "a Jupyter notebook", "cells nbformat", "give the model file that it saves"),
    _kind("npm", "the package.json of an npm package", "name version dependencies", "give a model file"),
)


def is_kind(kind: Kind, file: Content) -> bool:
    """Whether a file is of a kind."""
    content = file.json
    return content is not None and kind.keys <= content.keys() and kind.also(content)


def keys_of(file: Content) -> str:
    """The first keys of an object in JSON, for a message."""
    content = file.json or {}
    shown = ", ".join(repr(k[:40]) for k in [*content][:6])
    return f"its keys are {shown}" + (", …" if len(content) > 6 else "") if content else "it is empty"
