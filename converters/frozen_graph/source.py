"""A frozen graph as a source."""

from __future__ import annotations

from pathlib import Path

from converters import schema
from converters.bundle.source import facts_of, recalled
from converters.frozen_graph.reader import from_graph_def
from converters.source import OriginalRun, ReadOptions, SourceModel


def read(path: Path, options: ReadOptions) -> list[SourceModel]:
    """The one graph in a file; one that this tool wrote is what its contract says."""
    definition = schema.parse(schema.GraphDef, path.read_bytes(), "TensorFlow graph")
    graph, contract = recalled(from_graph_def(definition))
    original = OriginalRun("tensorflow", path, definition=definition)
    return [SourceModel(graph, (path,), facts_of(graph, contract), original=original)]
