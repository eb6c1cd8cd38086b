"""A ``.nn`` as a source."""

from __future__ import annotations

from msgspec.structs import replace

from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.barracuda.format import NnModel, parse
from export_model.converters.formats.barracuda.graph import to_graph
from export_model.converters.formats.barracuda.slices import with_slices
from export_model.converters.formats.barracuda.writer import PRODUCER, contract_of
from export_model.converters.formats.source import ReadOptions, SourceModel
from export_model.converters.policy.facts import SourceFacts
from export_model.signatures.contract import EMBEDDED
from export_model.signatures.roles import ACTION_NAMES, VERSION_NUMBER
from export_model.signatures.spec import PolicySignature

#: Suffixes that ML-Agents' converter gives to memories: the cell state and the hidden state of an LSTM; a GRU has h.
_PARTS = ("_c", "_h")
#: The ``version_number`` of 0.6, which wrote no ``.nn``; the previews of 0.7 still had it.
_BEFORE_NN = 1


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """The one model in a file. Raises DamagedFileError, UnsupportedOpError, GraphError or SignatureError."""
    model, sliced = with_slices(parse(given.data))
    reading = to_graph(model)
    facts = SourceFacts(
        family="ML-Agents 0.7 (preview)" if model.number(VERSION_NUMBER) == _BEFORE_NN else None,
        memory_layout=_memory_layout(model),
        notes=(*_notes(model), *sliced, *reading.notes),
    )
    if model.metadata(EMBEDDED) is not None:
        facts = _facts_of_contract(facts, contract_of(model))
    return [SourceModel(reading.graph, (given.path,), facts)]


def _facts_of_contract(facts: SourceFacts, signature: PolicySignature) -> SourceFacts:
    """What the contract of a file of ours says that its layers do not."""
    return replace(
        facts,
        family=signature.family,
        algorithm=signature.algorithm or "",
        memory_layout=() if signature.memory is None else signature.memory.layout,
        labels=signature.labels,
        interface=signature.interface,
        ours=True,
    )


def _memory_layout(model: NnModel) -> tuple[str, ...]:
    """``("c", "h")`` per LSTM, from the names' suffixes; empty where they do not say."""
    ends = [m.input[-2:] for m in model.memories]
    return tuple(e[1:] for e in ends) if all(e in _PARTS for e in ends) else ()


def _notes(model: NnModel) -> list[str]:
    notes = ["no runtime but Unity's reads a .nn: its formats are compared with each other only (self-consistent)"]
    if model.trailer is not None and model.trailer.producer not in ("", "Script", PRODUCER):
        notes.append(f"Unity wrote this .nn from a model of {model.trailer.producer}")
    if model.half:
        notes.append("the weights were stored as halves (16 bits); they are float32 here")
    if not any(layer.name in ACTION_NAMES for layer in model.layers):
        notes.append("no layer of the .nn is called action; Unity would find no action in it")
    return notes
