"""Inputs of 8 and 16 bits (boards of games) as int32, which every target is fed: TensorFlow.js has no smaller ones."""

from __future__ import annotations

import numpy as np
from msgspec.structs import replace

from export_model.converters.graph.nodes import Graph, NameScope, Node, node_of
from export_model.converters.graph.types import INT32
from export_model.converters.policy.facts import SourceFacts
from export_model.converters.policy.inputs import is_board, placeholder_rank

_SMALL = tuple(map(np.dtype, (np.int8, np.uint8, np.int16, np.uint16)))
_OF_IMAGES = 4


def widen_small_integers(graph: Graph, facts: SourceFacts) -> tuple[Graph, SourceFacts]:
    """Return the graph with int32 in place of such inputs, cast behind them, and the bounds that they had.

    The bytes of a camera stay bytes, and so does what a contract says of this tool's own files.
    """
    small = [
        n
        for n in graph.nodes
        if n.op == "Placeholder"
        and n.attrs.get("dtype") in _SMALL
        and (placeholder_rank(n) != _OF_IMAGES or is_board(n.name, n))
    ]
    if not small or facts.algorithm is not None:
        return graph, facts
    names = NameScope(n.name for n in graph.nodes)
    casts = {n.name: names.fresh(f"{n.name}/as_stored") for n in small}
    nodes, bounds = [], {}
    for node in graph.nodes:
        if node.name in casts:
            dtype = node.attrs["dtype"]
            nodes.append(replace(node, attrs={**node.attrs, "dtype": INT32}))
            nodes.append(Node(casts[node.name], "Cast", (node.name,), {"DstT": dtype}))
            bounds[node.name] = (int(np.iinfo(dtype).min), int(np.iinfo(dtype).max))
        else:
            nodes.append(node.with_inputs(casts.get(node_of(r), r) for r in node.inputs))
    return Graph(tuple(nodes)), replace(facts, bounds=bounds)
