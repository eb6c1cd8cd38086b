"""A .tflite file as a source; one that this tool wrote is what its contract says."""

from __future__ import annotations

from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.embed import facts_of, redrawn
from export_model.converters.formats.litert.reader import LitertModel, read_litert
from export_model.converters.formats.saved_model.signature import expose_signature
from export_model.converters.formats.source import OriginalRun, ReadOptions, SourceModel
from export_model.converters.graph.ops.table import traits
from export_model.converters.policy.facts import DOUBLES_NARROWED


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """The one policy of a file. Raises SourceError, GraphError and their kinds.

    The file itself is run by LiteRT's own kernels, which keep the tensors inside; not where it draws numbers by
    itself, which cannot be fed from outside.
    """
    model = read_litert(given.data)
    original = None
    if not any(traits(n).sampler in ("normal", "uniform") for n in model.graph.nodes):
        run = {"numbers": dict(model.tensors), "ports": dict(model.ports), "function": model.function}
        original = OriginalRun("litert-plain", given.path, run)
    if model.contract is not None:
        contract = model.contract
        graph = redrawn(model.graph, contract)
        return [SourceModel(graph, (given.path,), facts_of(graph, contract), contract.name, original)]
    graph, facts = expose_signature(model.graph, model.signature, _notes(model))
    return [SourceModel(graph, (given.path,), facts, original=original, producer=model.description)]


def _notes(model: LitertModel) -> list[str]:
    notes = []
    if model.others:
        notes.append(f"the signature {model.key!r} was read; also here, not used: {', '.join(model.others)}")
    if model.widened:
        notes.append("the weights are stored in fewer bits; they are float32 here")
    if model.narrowed:
        notes.append(DOUBLES_NARROWED)
    return notes
