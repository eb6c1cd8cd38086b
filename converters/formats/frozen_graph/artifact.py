"""An artefact that is a frozen graph: what it takes and gives, its inner tensors, the part that a runtime may be given.

Any node can be fetched, by the graph's own name.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.external_data import Detached
from export_model.converters.files.fetch import read_bytes
from export_model.converters.files.memory_mapped import Mapped
from export_model.converters.formats.format import Port, Ports
from export_model.converters.formats.frozen_graph.reader import from_graph_def, read_graph
from export_model.converters.formats.intermediate_tensors import Feeds, InnerTensors, Loaded, own_names, samplers_of
from export_model.converters.formats.subgraph import subgraph
from export_model.converters.graph.nodes import Graph, node_of
from export_model.converters.graph.ops.table import is_fed


def ports(path: Path) -> Ports:
    """The ports of a file. Raises SourceError, DamagedFileError, GraphError."""
    read = read_graph(read_bytes(path))
    places = [n for n in read.nodes if is_fed(n)]
    inputs = tuple(Port(n.name, n.attrs["dtype"].name if "dtype" in n.attrs else None, n.dims) for n in places)
    return Ports(path, inputs, tuple(Port(n.name) for n in read.nodes), {"kind": "graph"}, open=True)


def graph(path: Path) -> Graph:
    """The graph of a file. Raises SourceError, DamagedFileError, GraphError."""
    return read_graph(path.read_bytes())


def inner(loaded: Loaded) -> AbstractContextManager[InnerTensors]:
    """Those of a ``.bytes``."""
    message = schema.parse(schema.GraphDef, Mapped().read(loaded.path), "GraphDef", Detached())  # for its names

    def run(feeds: Feeds, fetch: Sequence[str]) -> dict[str, np.ndarray]:
        """TensorFlow 1.x refuses to fetch what it is fed, by the same name: it is what was fed."""
        others = [name for name in fetch if name not in feeds]
        values = {name: feeds[name] for name in fetch if name in feeds}
        return {**values, **loaded.run(feeds, others)} if others else values

    samplers = samplers_of({n.name: (n.op, n.input) for n in message.node})
    view = own_names(n.name for n in message.node)
    return contextlib.nullcontext(InnerTensors(view, run, samplers=samplers, opened=loaded.open_any))


def safe_copy(path: Path, wanted: Sequence[str], folder: Path) -> Path:
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
