"""A frozen graph as a source."""

from __future__ import annotations

from pathlib import Path

from converters.bundle.source import facts_of, recalled
from converters.frozen_graph.reader import read_graph
from converters.source import OriginalRun, ReadOptions, SourceModel


def read(path: Path, options: ReadOptions) -> list[SourceModel]:
    """The one graph in a file; one that this tool wrote is what its contract says."""
    graph, contract = recalled(read_graph(path.read_bytes()))
    original = OriginalRun("tensorflow", path, {"kind": "graph"})
    return [SourceModel(graph, (path,), facts_of(graph, contract), original=original)]
