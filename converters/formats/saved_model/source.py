"""A SavedModel as a source: its folder, or its saved_model.pb."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.compiler.passes.unjoined_products import rejoin_biases
from export_model.converters.files.fetch import Fetched, read_bytes
from export_model.converters.files.file_probe import Content
from export_model.converters.formats.checkpoint.freeze import freeze, with_values
from export_model.converters.formats.checkpoint.tensor_bundle import Checkpoint
from export_model.converters.formats.checkpoint.training_graph import SavedVariable as Place
from export_model.converters.formats.checkpoint.training_graph import TrainingGraph, saved_places, training_graph
from export_model.converters.formats.embed import contract_text, facts_of, split_contract
from export_model.converters.formats.frozen_graph.reader import from_graph_def
from export_model.converters.formats.frozen_graph.source import read as read_frozen
from export_model.converters.formats.saved_model.inlining import flat
from export_model.converters.formats.saved_model.lengths import without_counted
from export_model.converters.formats.saved_model.reader import SavedMetaGraph, read_saved_model
from export_model.converters.formats.saved_model.signature import ModelSignature, expose_signature, fed_by_signature
from export_model.converters.formats.source import OriginalRun, ReadOptions, SourceModel
from export_model.converters.graph.nodes import Graph, node_of
from export_model.signatures.errors import NotAPolicyError

FILE = "saved_model.pb"
_WITHOUT_VARIABLES = (
    f"the values of a SavedModel are in the folder variables/, which is not next to its {FILE}",
    f"give the whole folder as it was saved: {FILE}, variables/",
)


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """The policy behind ``serving_default`` (else the first signature)."""
    path = given.path
    folder = path if path.is_dir() else path.parent
    file = folder / FILE if path.is_dir() else path
    if Content(given.bytes_of(file)).is_graph:  # some give a frozen graph this name
        return read_frozen(given.inside(file), options)
    saved = read_saved_model(given.bytes_of(file))
    frozen = frozen_model(saved, values_beside(folder))
    graph, contract = split_contract(frozen.graph)
    facts = facts_of(graph, contract)
    if contract is None:
        graph, facts = expose_signature(frozen.graph, frozen.signature, _notes(saved))
    else:
        graph = rejoin_biases(graph)
    original = OriginalRun("tensorflow", folder, definition=frozen.definition, detached=saved.detached)
    return [SourceModel(graph, (file, *frozen.files), facts, None if contract is None else contract.name, original)]


def embedded_contract(folder: Path) -> str | None:
    """The contract that a model of ours embeds. Raises SourceError, DamagedFileError."""
    saved = read_saved_model(read_bytes(folder / FILE))
    return contract_text(from_graph_def(saved.graph_def, saved.detached))


class FrozenModel(Struct, frozen=True):
    """A SavedModel without functions and variables: its graph, its definition, its signature on these.

    ``files`` are those that the variables' values were read from.
    """

    graph: Graph
    definition: Any
    signature: ModelSignature
    files: tuple[Path, ...]


def values_beside(folder: Path) -> Checkpoint | None:
    """The values of a SavedModel's variables. Raises SourceError, DamagedFileError."""
    prefix = folder / "variables" / "variables"
    return Checkpoint(prefix) if prefix.with_name("variables.index").is_file() else None


def frozen_model(saved: SavedMetaGraph, checkpoint: Checkpoint | None) -> FrozenModel:
    """What a signature computes, flat and frozen. Raises NotAPolicyError, DamagedFileError, GraphError."""
    detached = saved.detached
    training, signature = (
        _inline_signature(saved) if saved.calls else (training_graph(saved.graph_def, detached), saved.signature)
    )
    if checkpoint is not None and saved.calls:
        named = {name: Place(key) for name, key in checkpoint.by_variable().items()}
        training = replace(training, saved={**named, **training.saved})
    frozen = freeze(training, checkpoint, signature.roots or None, _WITHOUT_VARIABLES)
    definition = fed_by_signature(with_values(training.definition, frozen.values, detached), signature)
    return FrozenModel(frozen.graph, definition, signature, () if checkpoint is None else checkpoint.files)


def _inline_signature(saved: SavedMetaGraph) -> tuple[TrainingGraph, ModelSignature]:
    """The graph that the signature's functions are, and the signature on it; its inputs are called as their keys.

    Which tensor of ``variables/`` is a variable's value is said by the function that restores them.
    """
    signature = saved.signature
    if not signature.outputs:
        raise NotAPolicyError(
            "the SavedModel has functions and no signature",
            why="which of them is the policy is not said",
            fix="save it with signatures={'serving_default': …}",
        )
    keys = {node_of(t.name): key for key, t in signature.inputs.items()}
    tensors = [t.name for t in (*signature.inputs.values(), *signature.outputs.values())]
    flattened = flat(saved.graph_def, tensors, keys)
    inputs, outputs = (
        {key: replace(t, name=flattened.tensor(t.name)) for key, t in side.items()}
        for side in (signature.inputs, signature.outputs)
    )
    flat_signature = without_counted(flattened.definition, ModelSignature(inputs, outputs, signature.key))
    restored = {}
    if saved.restore:
        restoring = flat(saved.graph_def, [saved.restore], restoring=True)
        restored = saved_places(restoring.definition)
    training = replace(training_graph(flattened.definition, saved.detached), saved=restored)
    return training, flat_signature


def _notes(saved: SavedMetaGraph) -> tuple[str, ...]:
    others = [k for k in saved.keys if k != saved.signature.key]
    if not others:
        return ()
    return (f"the signature {saved.signature.key} was read; there are also {', '.join(others[:8])}",)
