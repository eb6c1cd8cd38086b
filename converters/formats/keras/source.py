"""Keras models as sources: ``.keras``, ``.h5`` and TensorFlow.js layers models, a list of layers and their weights.

They are read as data. What is more than the layers of ``layers/table.py`` is left to Keras itself, for ``.keras`` and
``.h5`` whose giver the caller trusts: it is frozen by TensorFlow (children.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.fetch import Fetched
from export_model.converters.files.file_probe import json_in
from export_model.converters.formats.frozen_graph.reader import from_graph_def
from export_model.converters.formats.keras.children import frozen_by_tensorflow, stored_in
from export_model.converters.formats.keras.config import (
    config_of,
    loss_of,
    no_configuration,
    refuse_code,
    stateful_layer,
)
from export_model.converters.formats.keras.model import model_of
from export_model.converters.formats.keras.network import KerasNetwork, UnknownLayerError
from export_model.converters.formats.keras.weights import Groups, KerasWeights, Listed
from export_model.converters.formats.saved_model.signature import (
    declared_outputs,
    expose,
    expose_signature,
    output_names,
)
from export_model.converters.formats.source import OriginalRun, ReadOptions, SourceModel
from export_model.converters.graph.nodes import Graph
from export_model.converters.graph.ops.base import MISFIT
from export_model.converters.graph.ops.table import is_fed
from export_model.converters.policy.facts import SourceFacts
from export_model.signatures.errors import DamagedFileError, RuntimeUnavailableError

_SAVE_AGAIN = "save the model again: model.save('policy.keras')"


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """What calling the model computes, with ``training=False``.

    Raises NotAPolicyError where the file is made of code, or of layers that are not read as data and is not trusted;
    RuntimeUnavailableError without h5py; SourceError and its kinds.
    """
    try:
        config, weights, version, loss = _read_stored(given)
    except RuntimeUnavailableError:
        if options.trust_source:
            return [_through_keras(given.path)]
        raise
    stateful = stateful_layer(config)
    try:
        model = build_layered((given.path,), config, weights, version, loss)
    except UnknownLayerError as error:
        if not options.trust_source:
            fix = "--trust-source (trust_source=True) has Keras itself load it, if you know where it comes from"
            raise UnknownLayerError(error.what, why=error.why, fix=f"{fix}; or save it without that layer") from error
        if stateful is None:
            return [_through_keras(given.path)]
        raise UnknownLayerError(
            error.what,
            why=f"Keras itself could load it, but its layer {stateful!r} keeps its state in itself: what TensorFlow "
            "freezes of that has no memory",
            fix="save it with the state as an input and an output (initial_state=…, return_state=True)",
        ) from error
    if not options.trust_source:
        return [model]
    if stateful is None:
        return [_beside_keras(model, given.path)]
    note = f"not compared with Keras' own run: its layer {stateful} keeps its state in itself"
    return [replace(model, facts=replace(model.facts, notes=(*model.facts.notes, note)))]


def _read_stored(given: Fetched) -> tuple[Any, KerasWeights, str, str]:
    """Return the configuration, the weights, Keras' version and the loss of a file.

    Raises NotAPolicyError where it names code.
    """
    path = given.path
    if given.data.startswith(b"PK"):
        config = config_of(path)
        refuse_code(config)
        stored = stored_in(path)
        metadata = config_of(path, "metadata.json")
        version = str(metadata.get("keras_version", "")) if isinstance(metadata, dict) else ""
        compiled = config.get("compile_config") if isinstance(config, dict) else None
        return config, Groups({name: a for (_, name), a in stored.arrays.items()}), version, loss_of(compiled)
    stored = stored_in(path)
    if stored.config is None:
        raise no_configuration(stored.names)
    config = _configuration(stored.config)
    refuse_code(config)
    entries = [(name, array) for (_, name), array in stored.arrays.items()]
    weights = Listed(entries, [layer for layer, _ in stored.arrays])
    return config, weights, stored.version or "", loss_of(_configuration(stored.training or "null"))


def build_layered(
    files: tuple[Path, ...], config: Any, weights: KerasWeights, version: str, loss: str = ""
) -> SourceModel:
    """The model of a configuration with its weights; ``loss`` is what it was compiled with.

    Raises UnknownLayerError, SourceError and its kinds.
    """
    try:
        net = KerasNetwork(version)
        model = model_of(config)
        signature = net.whole(model, weights)
        graph, roles = expose(net.graph(), signature)
    except UnknownLayerError as error:
        error.fix = error.fix or "save the model without that layer, or give a SavedModel or an ONNX of it"
        raise
    except (*MISFIT, StopIteration, RecursionError) as error:
        raise DamagedFileError(
            "its layers are not in Keras' form", why=f"{type(error).__name__}: {error}"[:200], fix=_SAVE_AGAIN
        ) from error
    names = output_names(signature)
    facts = SourceFacts(
        roles=roles,
        outputs=declared_outputs(signature),
        memories=net.memories(names) or None,
        notes=tuple(net.notes),
        model_name=model.name,
        loss=loss if len(signature.outputs) == 1 else "",
    )
    return SourceModel(graph, files, facts)


def of_web_model(
    files: tuple[Path, ...], topology: Mapping[str, Any], weights: KerasWeights, training: Any = None
) -> SourceModel:
    """A TensorFlow.js layers model; ``topology`` is its ``modelTopology``, ``training`` its ``trainingConfig``.

    Raises what ``build_layered`` raises.
    """
    config = topology.get("model_config") or topology
    loss = loss_of(training) or loss_of(topology.get("training_config"))
    version = str(topology.get("keras_version") or "tfjs-layers")
    return build_layered(files, _configuration(config) if isinstance(config, str) else config, weights, version, loss)


def _configuration(text: str) -> Any:
    try:
        return json_in(text)
    except (ValueError, RecursionError) as error:
        raise DamagedFileError("its configuration is not JSON", why=str(error)[:200], fix=_SAVE_AGAIN) from error


def _beside_keras(model: SourceModel, path: Path) -> SourceModel:
    """The model with Keras' own beside it, which it is verified against; as it is where there is no TensorFlow."""
    try:
        data, signature = frozen_by_tensorflow(path)
    except RuntimeUnavailableError:
        return model
    fed, given, nodes = {**signature.inputs}, {**signature.outputs}, []
    for node in model.graph.nodes:
        ends = fed if is_fed(node) else given if node.name in model.facts.outputs else {}
        tensor = ends.pop(str(node.origin), None)
        nodes.append(node if tensor is None else replace(node, origin=tensor.name))
    if fed or given:  # what Keras calls its outputs does not tell them apart
        return model
    original = OriginalRun("tensorflow", path, definition=schema.parse(schema.GraphDef, data, "TensorFlow graph"))
    return replace(model, graph=Graph(tuple(nodes)), original=original)


def _through_keras(path: Path) -> SourceModel:
    """What TensorFlow freezes of the model that Keras builds."""
    data, signature = frozen_by_tensorflow(path)
    definition = schema.parse(schema.GraphDef, data, "TensorFlow graph")
    graph, facts = expose_signature(from_graph_def(definition), signature)
    return SourceModel(graph, (path,), facts, None, OriginalRun("tensorflow", path, definition=definition))
