"""The part of a GraphDef that a runtime is given: what the tensors asked for depend on, and nothing else.

A model file is untrusted, and a runtime runs whatever hangs on a node it is asked for: behind a control input of
``action`` an op can write any file. So a graph is never loaded as it is. It is pruned to what the fetched tensors are
computed from, every op is held against the ops that compute and do nothing else, and control inputs are left out. Those
that say which frame of a while loop a constant is in (``^while/Switch``) are kept: they carry no effect, only order.

What is refused, is refused wherever it hangs: behind a control input, too, though it would not have been run.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.graph.nodes import Node, node_of, reachable
from export_model.converters.graph.ops.table import (
    CONTROL_FLOW,
    OF_VALUES,
    ORDERING,
    SPELLINGS,
    TABLE,
    unsupported_error,
)
from export_model.signatures.errors import GraphError

#: Ops that compute a value from their inputs (or draw one) and do nothing else.
COMPUTING = frozenset((*TABLE, *CONTROL_FLOW, *SPELLINGS))


def check(graph_def: Any, fetches: Iterable[str], feeds: Iterable[str] = ()) -> None:
    """Raise what ``subgraph`` raises."""
    _checked_nodes(graph_def, fetches, feeds)


def _checked_nodes(graph_def: Any, fetches: Iterable[str], feeds: Iterable[str]) -> tuple[dict[str, Any], list[str]]:
    """The nodes by their names, and those that are asked for."""
    nodes = {n.name: n for n in graph_def.node}
    roots = list(dict.fromkeys([*map(node_of, fetches), *(f for f in map(node_of, feeds) if f in nodes)]))
    _check(nodes, roots)
    return nodes, roots


def subgraph(graph_def: Any, fetches: Iterable[str], feeds: Iterable[str] = ()) -> Any:
    """A GraphDef of what the tensors ``fetches`` are computed from, and of the nodes of ``feeds`` that are there.

    Raises UnsupportedOpError that names every node upstream, behind a control input or not, whose op does anything but
    compute; GraphError where a tensor that is asked for, or an input of a node, is not there.
    """
    nodes, roots = _checked_nodes(graph_def, fetches, feeds)
    looping = any(n.op in CONTROL_FLOW for n in graph_def.node)
    kept = reachable(roots, lambda n: (node_of(i.removeprefix("^")) for i in _inputs(nodes, nodes[n], looping)))
    part = schema.GraphDef()
    part.versions.CopyFrom(graph_def.versions)
    for node in graph_def.node:
        if node.name in kept:
            part.node.append(_bare(node, _inputs(nodes, node, looping)))
    return part


def _check(nodes: Mapping[str, Any], roots: Iterable[str]) -> None:
    """Raise unless all that is upstream of ``roots`` by any edge is there and does no more than compute."""
    seen: set[str] = set()
    refused: list[Any] = []
    stack = [(root, False) for root in roots]
    while stack:
        name, ordering = stack.pop()
        if name in seen:
            continue
        seen.add(name)
        node = nodes.get(name)
        if node is None:
            raise GraphError(
                f"the tensor {name!r} is not in the graph",
                why="it is read, or asked for, and no node makes it",
                fix="freeze the graph again from its checkpoint",
            )
        if node.op not in COMPUTING and node.op not in OF_VALUES and not (ordering and node.op in ORDERING):
            refused.append(node)
        ordered = node.op in ORDERING
        stack.extend((node_of(i.removeprefix("^")), ordered or i.startswith("^")) for i in node.input)
    if refused:
        refused.sort(key=lambda n: n.name)
        raise unsupported_error(Node(n.name, n.op) for n in refused)


def _inputs(nodes: Mapping[str, Any], node: Any, looping: bool) -> list[str]:
    """A node's inputs without control inputs, those apart that say in which frame of a loop it is."""
    return [i for i in node.input if not i.startswith("^") or (looping and is_pivot(nodes[i[1:]]))]


def is_pivot(node: Any) -> bool:
    """Whether a constant in a while loop or a branch may be pinned to a node by a control input."""
    return node.op == "Identity" or CONTROL_FLOW.get(node.op) in ("switch", "merge")


def _bare(node: Any, inputs: Iterable[str]) -> Any:
    """A node without device, place and hints: its op, inputs, and the attributes that the op itself has."""
    bare = schema.NodeDef(name=node.name, op=OF_VALUES.get(node.op, node.op))
    bare.input.extend(inputs)
    for key, value in node.attr.items():
        if not key.startswith("_"):
            bare.attr[key].CopyFrom(value)
    return bare
