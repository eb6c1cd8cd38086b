"""What a frozen graph takes and gives: its placeholders, and any node."""

from __future__ import annotations

from pathlib import Path

from converters.fetch import read_bytes
from converters.format import Dims, Port, Ports
from converters.frozen_graph.reader import read_graph
from converters.graph.nodes import Node
from converters.graph.ops.table import is_fed


def ports(path: Path) -> Ports:
    """The ports of a file. Raises SourceError, DamagedFileError, GraphError."""
    graph = read_graph(read_bytes(path))
    places = [n for n in graph.nodes if is_fed(n)]
    inputs = tuple(Port(n.name, n.attrs["dtype"].name if "dtype" in n.attrs else None, _dims(n)) for n in places)
    return Ports(path, inputs, tuple(Port(n.name) for n in graph.nodes), {"kind": "graph"}, open=True)


def _dims(node: Node) -> Dims | None:
    shape = node.attrs.get("shape")
    return None if shape is None or shape.dims is None else tuple(shape.dims)
