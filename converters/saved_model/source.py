"""A SavedModel as a source: its folder, or its saved_model.pb."""

from __future__ import annotations

from pathlib import Path

from converters.bundle.source import facts_of, recalled
from converters.checkpoint.definition import with_values
from converters.checkpoint.freeze import freeze
from converters.checkpoint.tensor_bundle import Checkpoint
from converters.checkpoint.training_graph import training_graph
from converters.fetch import Fetched
from converters.frozen_graph.reader import read_graph
from converters.saved_model.functions import frozen_by_tensorflow
from converters.saved_model.reader import Saved, read_saved_model
from converters.saved_model.signature import expose, fed_by_signature
from converters.source import OriginalRun, SourceModel
from converters.understand.facts import SourceFacts

FILE = "saved_model.pb"


def read(given: Fetched) -> list[SourceModel]:
    """The policy behind ``serving_default`` (else the first signature)."""
    path = given.path
    folder = path if path.is_dir() else path.parent
    file = folder / FILE if path.is_dir() else path
    saved = read_saved_model(given.bytes_of(file))
    values = sorted(p for p in folder.glob("variables/variables.*") if p.is_file())
    if saved.calls:
        return [_of_functions(folder, (file, *values), saved)]
    prefix = folder / "variables" / "variables"
    checkpoint = Checkpoint(prefix) if prefix.with_name("variables.index").is_file() else None
    training = training_graph(saved.graph_def)
    frozen = freeze(training, checkpoint, saved.signature.roots or None)
    graph, contract = recalled(frozen.graph)
    facts = facts_of(graph, contract)
    if contract is None:
        graph, roles = expose(frozen.graph, saved.signature)
        facts = SourceFacts(roles=roles, notes=_notes(saved))
    files = (file, *(() if checkpoint is None else checkpoint.files))
    definition = fed_by_signature(with_values(training.definition, frozen.values), saved.signature)
    original = OriginalRun("tensorflow", folder, definition=definition)
    return [SourceModel(graph, files, facts, None if contract is None else contract.name, original)]


def _of_functions(folder: Path, files: tuple[Path, ...], saved: Saved) -> SourceModel:
    """A SavedModel of TensorFlow 2: frozen by TensorFlow, then read as any graph."""
    data, signature = frozen_by_tensorflow(folder, "saved_model", saved.signature.key)
    graph, roles = expose(read_graph(data), signature)
    original = OriginalRun(
        "tensorflow", folder, {"kind": "function", "form": "saved_model", "signature": signature.key}
    )
    return SourceModel(graph, files, SourceFacts(roles=roles, notes=_notes(saved)), None, original)


def _notes(saved: Saved) -> tuple[str, ...]:
    others = [k for k in saved.keys if k != saved.signature.key]
    if not others:
        return ()
    return (f"the signature {saved.signature.key} was read; there are also {', '.join(others[:8])}",)
