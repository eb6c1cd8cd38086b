"""A graph that anyone may have made, as far as a runtime may be given it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from converters import schema
from converters.detached import Detached
from converters.fetch import read_bytes
from converters.frozen_graph.reader import from_graph_def
from converters.frozen_graph.subgraph import subgraph
from converters.graph.nodes import node_of


def vetted(path: Path, wanted: Sequence[str], folder: Path) -> Path:
    """A copy in ``folder`` of what the nodes ``wanted`` are computed from; those that are not there are left out.

    Raises UnsupportedOpError where an op does more than compute, DamagedFileError, GraphError.
    """
    detached = Detached()
    definition = schema.parse(schema.GraphDef, read_bytes(path), "TensorFlow graph", detached)
    from_graph_def(definition, detached)  # its constants are bounded, its names are names
    there = {n.name for n in definition.node}
    copy = folder / path.name
    part = subgraph(definition, [w for w in wanted if node_of(w) in there])
    schema.pieces(part, detached).write(copy)
    return copy
