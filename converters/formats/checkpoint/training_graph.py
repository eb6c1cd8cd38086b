"""The graph that belongs to a checkpoint: ``raw_graph_def.pb`` (a GraphDef) or ``.meta`` (a MetaGraphDef, field 2).

Which tensor of a checkpoint is a variable's value is what the graph's own saver says: ``Assign(variable, RestoreV2:k)``
restores the k-th of the names that RestoreV2 is given, or a slice of it (``"10 4 0,5:-"``: the whole shape, then start
and length per axis; saver.py, checkpoint_ops.cc). Where there is no saver, a variable's own name is its key.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from msgspec import Struct, field

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.external_data import Detached
from export_model.converters.files.fetch import read_bytes
from export_model.converters.formats.checkpoint.tensor_bundle import Extents
from export_model.converters.formats.frozen_graph.reader import from_graph_def
from export_model.converters.formats.frozen_graph.tensors import to_array
from export_model.converters.graph.nodes import Graph, node_of, split_ref
from export_model.converters.graph.ops.table import ASSIGNS, RESTORES
from export_model.signatures.errors import DamagedFileError, NotAPolicyError


class SavedVariable(Struct, frozen=True):
    """Where a variable's value is in a checkpoint: a tensor, or a part of one."""

    key: str
    extents: Extents | None = None


class TrainingGraph(Struct, frozen=True):
    """A graph with variables, and where their values are kept (for those that the graph's saver names)."""

    graph: Graph
    saved: Mapping[str, SavedVariable] = field(default_factory=dict)
    #: the GraphDef as it was read; None where there is none (a live session)
    definition: Any = None


def read_training_graph(path: Path) -> TrainingGraph:
    """The graph in ``raw_graph_def.pb`` or a ``.meta``. Raises DamagedFileError, NotAPolicyError, GraphError."""
    data = read_bytes(path)
    if path.name.endswith(".meta"):
        graph_def = schema.parse(schema.MetaGraphDef, data, "MetaGraph").graph_def
    else:
        graph_def = schema.parse(schema.GraphDef, data, "TensorFlow graph")
    if not graph_def.node:
        raise NotAPolicyError(
            "the graph has no nodes", where=path.name, fix="give raw_graph_def.pb or the .meta of a checkpoint"
        )
    return training_graph(graph_def)


def training_graph(graph_def: Any, detached: Detached | None = None) -> TrainingGraph:
    """The same of a GraphDef message, of which some may be ``detached``."""
    saved = saved_places(graph_def)
    rest = SimpleNamespace(
        node=_without_initial_values(graph_def), library=graph_def.library, versions=graph_def.versions
    )
    return TrainingGraph(from_graph_def(rest, detached), saved, graph_def)


def _inputs(proto: Any) -> list[str]:
    return [i for i in proto.input if not i.startswith("^")]


def _without_initial_values(graph_def: Any) -> list[Any]:
    """All nodes but the Assign whose result nobody reads, and the constants that only these read."""
    readers: dict[str, list[Any]] = {}
    for proto in graph_def.node:
        for reference in _inputs(proto):
            readers.setdefault(node_of(reference), []).append(proto)
    dropped = {p.name for p in graph_def.node if p.op in ASSIGNS and p.name not in readers}
    return [
        proto
        for proto in graph_def.node
        if proto.name not in dropped
        and not (proto.op == "Const" and proto.name in readers and all(r.name in dropped for r in readers[proto.name]))
    ]


# ------------------------------------------------------------------ the graph's saver


def saved_places(graph_def: Any) -> dict[str, SavedVariable]:
    """Variable's node → its place in a checkpoint, by the first saver that restores it."""
    nodes = {proto.name: proto for proto in graph_def.node}
    found: dict[str, SavedVariable] = {}
    producers: dict[str, tuple[Any, int]] = {}
    for proto in graph_def.node:
        inputs = _inputs(proto)
        if proto.op not in ASSIGNS or len(inputs) != 2:
            continue
        restore, index = _producer(nodes, inputs[1], producers)
        if restore is None or restore.op not in RESTORES:
            continue
        names, slices = (_strings(nodes, restore, position) for position in (1, 2))
        if index < len(names):
            place = SavedVariable(names[index], _extents(slices[index]) if index < len(slices) else None)
            found.setdefault(node_of(inputs[0]), place)
    return found


def _producer(nodes: Mapping[str, Any], reference: str, known: dict[str, tuple[Any, int]]) -> tuple[Any, int]:
    """The node behind a reference, through Identity, and the output it is; ``known`` keeps what was found."""
    passed: dict[str, None] = {}
    while True:
        name, index = split_ref(reference)
        proto = nodes.get(name)
        ends = proto is None or proto.op != "Identity" or name in passed or not _inputs(proto)
        if ends or name in known:
            found = (proto, index) if ends else known[name]
            known.update(dict.fromkeys(passed, found))
            return found
        passed[name] = None
        reference = _inputs(proto)[0]


def _strings(nodes: Mapping[str, Any], proto: Any, position: int) -> list[str]:
    inputs = _inputs(proto)
    source = nodes.get(node_of(inputs[position])) if position < len(inputs) else None
    if source is None or source.op != "Const":
        return []
    array = to_array(source.attr["value"].tensor)
    if array.dtype.kind != "S":
        return []
    return [text.decode("utf-8", "replace") for text in np.atleast_1d(array).ravel().tolist()]


def _extents(text: str) -> Extents | None:
    """``"10 4 0,5:-"`` as ((0, 5), (0, 0)); None for the empty text, which is the whole tensor."""
    if not text.strip():
        return None
    extents: list[tuple[int, int]] = []
    for part in text.split()[-1].split(":"):
        start, _, length = part.partition(",")
        if part != "-" and not (start.isascii() and start.isdigit() and length.isascii() and length.isdigit()):
            raise DamagedFileError(
                f"the graph's saver restores the slice {text[:80]!r}, which is none",
                fix="give the graph that training wrote, raw_graph_def.pb or the checkpoint's .meta",
            )
        extents.append((0, 0) if part == "-" else (int(start), int(length)))
    return tuple(extents)
