"""A frozen graph as a source."""

from __future__ import annotations

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.external_data import Detached
from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.embed import facts_of, split_contract
from export_model.converters.formats.frozen_graph.reader import from_graph_def
from export_model.converters.formats.source import OriginalRun, ReadOptions, SourceModel


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """The one graph in a file; one that this tool wrote is what its contract says."""
    detached = Detached()
    definition = schema.parse(schema.GraphDef, given.data, "TensorFlow graph", detached)
    graph, contract = split_contract(from_graph_def(definition, detached))
    original = OriginalRun("tensorflow", given.path, definition=definition, detached=detached)
    return [SourceModel(graph, (given.path,), facts_of(graph, contract), original=original)]
