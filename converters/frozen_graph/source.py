"""A frozen graph as a source."""

from __future__ import annotations

from converters import schema
from converters.bundle.embed import facts_of, recalled
from converters.detached import Detached
from converters.fetch import Fetched
from converters.frozen_graph.reader import from_graph_def
from converters.source import OriginalRun, ReadOptions, SourceModel


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """The one graph in a file; one that this tool wrote is what its contract says."""
    detached = Detached()
    definition = schema.parse(schema.GraphDef, given.data, "TensorFlow graph", detached)
    graph, contract = recalled(from_graph_def(definition, detached))
    original = OriginalRun("tensorflow", given.path, definition=definition, detached=detached)
    return [SourceModel(graph, (given.path,), facts_of(graph, contract), original=original)]
