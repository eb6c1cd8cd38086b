"""The last pass: inputs and outputs get the names of the signature."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from converters.graph.nodes import Graph, NameScope, Node, node_of, ref, split_ref, topological
from converters.graph.ops.table import traits


def name_tensors(
    graph: Graph, feeds: Mapping[str, str], fetches: Mapping[str, str], reserved: tuple[str, ...] = ()
) -> Graph:
    """Rename so that ``feeds`` and ``fetches`` (name → node or tensor) both map names to themselves.

    The node that makes an output takes its name; where that cannot be (an input passed through, a constant, one
    tensor for two outputs, output 1 of a node) an Identity does. An inner node that has one of the names, or one in
    ``reserved``, is renamed.
    """
    wanted = {*feeds, *fetches, *reserved}
    renamed: dict[str, str] = {node: name for name, node in feeds.items()}
    identities: list[tuple[str, str]] = []
    multiple = {n for n, index in (split_ref(r) for node in graph.nodes for r in node.inputs) if index}
    multiple |= {node_of(r) for r in fetches.values() if split_ref(r)[1]}
    for name, reference in fetches.items():
        node = graph.producer(reference)
        if node.name in renamed or node.name in multiple or traits(node).start:
            identities.append((name, reference))
        else:
            renamed[node.name] = name
    names = NameScope([*(n.name for n in graph.nodes), *wanted])
    for node in graph.nodes:
        if node.name in wanted and renamed.get(node.name) is None:
            renamed[node.name] = names.fresh(f"{node.name}/inner")

    def moved(reference: str) -> str:
        name, index = split_ref(reference)
        return ref(renamed.get(name, name), index)

    nodes = [
        replace(n, name=renamed.get(n.name, n.name), inputs=tuple(moved(r) for r in n.inputs)) for n in graph.nodes
    ]
    for name, reference in identities:
        origin = graph.producer(reference).origin if split_ref(reference)[1] == 0 else None
        nodes.append(Node(name, "Identity", (moved(reference),), origin=origin))
    return Graph(topological(nodes))
