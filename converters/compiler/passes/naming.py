"""The last pass: inputs and outputs get the names of the signature."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from msgspec.structs import replace

from export_model.converters.compiler.compilation import Compilation
from export_model.converters.graph.nodes import Graph, NameScope, Node, node_of, renamed_ref, split_ref, topological
from export_model.converters.graph.ops.table import traits
from export_model.signatures.contract import EMBEDDED
from export_model.signatures.roles import Constant, Role


def name_ports(c: Compilation) -> Compilation:
    """Inputs and outputs under the signature's names.

    With ``--names source`` the trainer's constants are kept too, and ``sequence_length``, read by nothing: Unity's
    internal brain of 0.3 to 0.5 feeds it to every recurrent policy without asking whether it is there.
    """
    scope, source = c.brain.scope, c.options.names == "source"
    kept = {**c.facts.constants, **c.brain.constants} if source else {}
    unread = [n for n, r in c.roles.items() if r is Role.SEQUENCE_LENGTH and source]
    reserved = (EMBEDDED, *(scope + k for k in kept), *unread)
    graph = name_tensors(c.graph, c.feeds, c.fetches, reserved)
    torch = c.facts.family is not None and "PyTorch" in c.facts.family
    constants = [
        Node(scope + key, "Const", value=_constant(value, torch=torch), origin=f"{scope}{key}:0")
        for key, value in kept.items()
    ]
    graph = Graph((*graph.nodes, *constants, *(c.original[n] for n in unread)))
    return replace(c, graph=graph, feeds={n: n for n in c.feeds}, fetches={n: n for n in c.fetches})


def _constant(value: Constant, *, torch: bool) -> np.ndarray:
    """A constant as the trainer writes it: TensorFlow's are int32 scalars, torch's rows of float32."""
    if isinstance(value, list):
        return np.array([value], np.float32)
    return np.array([value], np.float32) if torch else np.array(value, np.int32)


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

    nodes = [*graph.rename(renamed).nodes]
    for name, reference in identities:
        origin = graph.producer(reference).origin if split_ref(reference)[1] == 0 else None
        nodes.append(Node(name, "Identity", (renamed_ref(reference, renamed),), origin=origin))
    return Graph(topological(nodes))
