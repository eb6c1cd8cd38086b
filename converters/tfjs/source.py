"""A TensorFlow.js graph model as a source: its folder, or its model.json."""

from __future__ import annotations

from converters.bundle.source import contract_of, facts_of, redrawn, retyped
from converters.fetch import Fetched
from converters.saved_model.signature import expose
from converters.source import SourceModel
from converters.tfjs.reader import read_model
from converters.tfjs.unfuse import unfuse
from converters.understand.facts import SourceFacts


def read(given: Fetched) -> list[SourceModel]:
    """The model's signature as a policy; one that this tool wrote is what its contract says."""
    model = read_model(given)
    graph = unfuse(model.graph)
    if model.contract is None:
        graph, roles = expose(graph, model.signature)
        return [SourceModel(graph, model.files, SourceFacts(roles=roles))]
    contract = contract_of(model.contract)
    graph = retyped(redrawn(graph, contract), contract)
    return [SourceModel(graph, model.files, facts_of(graph, contract), contract.name)]
