"""Building a new graph out of an old one: what every pass does, in one place."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from converters.graph.nodes import Graph, NameScope, Node, ref, split_ref, topological
from converters.graph.ops.base import REQUIRED
from converters.graph.ops.table import TABLE


class Editor:
    """Collects nodes for a new graph; tensors of the old one may be redirected on the way."""

    def __init__(self, graph: Graph) -> None:
        self.nodes: list[Node] = []
        self._names = NameScope(n.name for n in graph.nodes)
        self._redirected: dict[str, str] = {}

    def resolve(self, reference: str) -> str:
        """Where a tensor of the old graph is now."""
        while reference in self._redirected:
            reference = self._redirected[reference]
        return reference

    def redirect(self, reference: str, to: str) -> None:
        """Let every later reader of ``reference`` read ``to``."""
        if reference != to:
            self._redirected[reference] = to

    def keep(self, node: Node) -> None:
        """Take a node over, its inputs redirected."""
        self.nodes.append(node.with_inputs(self.resolve(r) for r in node.inputs))

    def add(
        self, op: str, inputs: Iterable[str], name: str, origin: str | tuple[str, ...] | None = None, **attrs: Any
    ) -> str:
        """A new node with the op's default attributes under a fresh name like ``name``; returns its output 0."""
        defaults = {a.name: a.default for a in TABLE[op].attrs if a.derive is None and a.default is not REQUIRED}
        fresh = self._names.fresh(name)
        self.nodes.append(Node(fresh, op, tuple(self.resolve(r) for r in inputs), {**defaults, **attrs}, origin=origin))
        return fresh

    def add_name(self, wish: str) -> str:
        """A free node name like ``wish``."""
        return self._names.fresh(wish)

    def const(self, array: np.ndarray, name: str) -> str:
        """A new Const."""
        fresh = self._names.fresh(name)
        self.nodes.append(Node(fresh, "Const", value=array))
        return fresh

    def replace_const(self, name: str, array: np.ndarray, origin: str | tuple[str, ...] | None) -> str:
        """A Const under the name of the node of the old graph that it stands for."""
        self.nodes.append(Node(name, "Const", value=array, origin=origin))
        return name

    def placeholder(self, name: str, node: Node) -> str:
        """A new Placeholder that is ``node`` under a fresh name like ``name``."""
        fresh = self._names.fresh(name)
        self.nodes.append(replace(node, name=fresh))
        return fresh

    def graph(self) -> Graph:
        """The new graph, redirections applied to all nodes, in topological order."""
        nodes = [n.with_inputs(self.resolve(r) for r in n.inputs) for n in self.nodes]
        return Graph(topological(nodes))


def outputs_of(node: Node, count: int) -> list[str]:
    """References to the first ``count`` outputs of a node."""
    return [ref(node.name, i) for i in range(count)]


def same_tensor(a: str, b: str) -> bool:
    """Whether two references name one tensor."""
    return split_ref(a) == split_ref(b)
