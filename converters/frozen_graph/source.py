"""A frozen graph as a source."""

from __future__ import annotations

from pathlib import Path

from converters.frozen_graph.reader import read_graph
from converters.source import OriginalRun, ReadOptions, SourceModel


def read(path: Path, options: ReadOptions) -> list[SourceModel]:
    """The one graph in a file."""
    graph = read_graph(path.read_bytes())
    return [SourceModel(graph, (path,), original=OriginalRun("tensorflow", path, {"kind": "graph"}))]
