"""Constants that are repeated for every agent: an op that broadcasts takes the one row.

``logstd.expand_as(mean)`` of a torch policy is a Tile by the number of agents, which it takes a Shape to know.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

from export_model.converters.graph.nodes import Graph, NameScope, Node, normal_ref
from export_model.converters.graph.ops.table import op_of
from export_model.converters.graph.shapes import Types, infer_types, run_kernel
from export_model.converters.graph.size_limits import Allowance
from export_model.converters.graph.types import BATCH


def broadcast_rows(graph: Graph, fetches: Iterable[str]) -> Graph:
    """The graph upstream of ``fetches``, whose binary ops take one row in place of the same row for every agent."""
    types, names = infer_types(graph), NameScope(n.name for n in graph.nodes)
    rows: dict[str, np.ndarray] = {}
    allowance = Allowance()
    nodes: list[Node] = []
    for node in graph.nodes:
        row = _row(node, rows, types, allowance)
        if row is not None:
            rows[node.name] = row
        elif len(node.inputs) == 2 and op_of(node).elementwise:
            node = _broadcast(node, rows, types, names, nodes)
        nodes.append(node)
    return Graph(tuple(nodes)).prune(fetches) if rows else graph


def _row(node: Node, rows: Mapping[str, np.ndarray], types: Types, allowance: Allowance) -> np.ndarray | None:
    """The row [1, …] that a tensor has for every agent; None where it is another tensor."""
    shape = types[node.name].shape if node.name in types else None
    if not shape or shape[0] != BATCH or any(isinstance(d, str) for d in shape[1:]):
        return None
    lengths = [1, *(int(d) for d in shape[1:])]
    entry = op_of(node)
    if entry.moves == "repeat" or entry.full_of is not None or node.op == "Fill":
        if entry.full_of is not None:
            value: np.ndarray | None = np.array(entry.full_of, types[node.name].dtype)
        else:
            value = types[node.inputs[1 if node.op == "Fill" else 0]].constant
        if value is None or (node.op == "Tile" and list(value.shape) != lengths):
            return None
        return np.array(np.broadcast_to(value, lengths)) if allowance.take(math.prod(lengths)) else None
    operands = [rows.get(normal_ref(r), types[r].constant) for r in node.inputs]
    known = [o for o in operands if o is not None]
    repeats = any(normal_ref(r) in rows for r in node.inputs)
    if not repeats or len(known) < len(operands) or not entry.elementwise or entry.kernel is None:
        return None
    if not allowance.take(math.prod(lengths)):
        return None
    return run_kernel(entry, node, known)[0]


def _broadcast(node: Node, rows: Mapping[str, np.ndarray], types: Types, names: NameScope, nodes: list[Node]) -> Node:
    inputs = list(node.inputs)
    for at, other in ((0, 1), (1, 0)):
        row = rows.get(normal_ref(inputs[at]))
        if row is not None and types[inputs[other]].shape == types[node.name].shape:
            name = names.fresh(f"{inputs[at]}/row")
            nodes.append(Node(name, "Const", value=row))
            inputs[at] = name
    return node.with_inputs(inputs)
