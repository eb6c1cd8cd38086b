"""Nodes under other names; readers use it where a name would say the wrong thing."""

from __future__ import annotations

from collections.abc import Mapping

from converters.graph.nodes import Graph, ref, split_ref


def renamed(graph: Graph, names: Mapping[str, str]) -> Graph:
    """The graph with the nodes of ``names`` (old → new) renamed; their ``origin`` stays."""
    if not names:
        return graph

    def moved(reference: str) -> str:
        name, index = split_ref(reference)
        return ref(names.get(name, name), index)

    return Graph(tuple(n.moved(names.get(n.name, n.name), map(moved, n.inputs)) for n in graph.nodes))
