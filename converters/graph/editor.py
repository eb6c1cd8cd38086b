"""Building a new graph out of an old one: what every pass does, in one place."""

from __future__ import annotations

import contextlib
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from msgspec.structs import replace

from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nodes import Graph, NameScope, Node, SourceName, topological
from export_model.converters.graph.ops.rewriting import Older, Shape
from export_model.converters.graph.ops.table import is_fed, op_of
from export_model.converters.graph.shapes import add_types
from export_model.converters.graph.types import TensorType
from export_model.signatures.errors import ExportModelError, UnsupportedOpError


class Editor(Builder):
    """A builder whose names keep off an old graph's; tensors of that may be redirected on the way.

    It infers types when it is asked for one: not every op of a graph that is not normalised yet is in the op table.
    """

    typed = False

    def __init__(self, graph: Graph) -> None:
        super().__init__(NameScope(n.name for n in graph.nodes))
        self._old = graph
        self._redirected: dict[str, str] = {}
        #: Of how many of the new nodes the types are inferred.
        self._told = 0

    def resolve(self, reference: str) -> str:
        """Where a tensor of the old graph is now."""
        while reference in self._redirected:
            reference = self._redirected[reference]
        return reference

    def constant_of(self, reference: str) -> np.ndarray | None:
        """The value of a tensor of the old graph that is a Const."""
        return self._old.constant(reference)

    def producer(self, reference: str) -> Node:
        """The node of the old graph that makes a tensor."""
        return self._old.producer(reference)

    def keep_all(self) -> None:
        """Take over every node of the old graph."""
        for node in self._old.nodes:
            self.keep(node)

    def type_of(self, reference: str) -> TensorType:
        """dtype, shape and value by what was made so far. Raises UnsupportedOpError where nothing is known of it."""
        kind = self._kind_of(reference)
        if kind is None:
            raise UnsupportedOpError(f"the type of {reference!r} is not known before the graph runs")
        return kind

    def shape_of(self, reference: str) -> Shape:
        """What is known of the shape of a tensor of the old graph by what was made so far; None: nothing."""
        kind = self._kind_of(reference)
        return None if kind is None else kind.shape

    def constant(self, reference: str) -> np.ndarray | None:
        """The value of a tensor that is the same in every run, by what was made so far; None: it is not known."""
        kind = self._kind_of(reference)
        return None if kind is None else kind.constant

    def known_value(self, reference: str, meaning: str) -> np.ndarray:
        """The value of a tensor of the old graph that no input changes; raises UnsupportedOpError."""
        value = self.constant(reference)
        if value is None:
            why = f"{meaning} must be known before, in every target"
            raise UnsupportedOpError(f"{meaning} is computed while the graph runs", why=why)
        return value

    def write(self, operands: Sequence[str], layer: Callable[..., Sequence[str]], name: str) -> Sequence[str]:
        """What a layer of ``graph/nn`` makes of tensors of the old graph. Raises UnsupportedOpError."""
        typed = Builder(self.names)
        typed.prefix, typed.symbols = name, self.symbols
        for reference in operands:
            typed.types[self.resolve(reference)] = self.type_of(reference)
        made = layer(typed, *map(self.resolve, operands))
        for node in typed.nodes:
            older = op_of(node).older
            if older is None:
                self.append(self._with_redirected_inputs(node))
            else:
                self.write_older(replace(node, attrs={**node.attrs, "T": typed.dtype(node.inputs[-1])}), older)
        return [self.resolve(reference) for reference in made]

    def write_older(self, node: Node, older: Older) -> None:
        """Let every later reader of a node read what it is in older ops, under names that begin with its own."""
        outer, self.prefix = self.prefix, node.name
        self.redirect(node.name, older(self, node))
        self.prefix = outer

    def _kind_of(self, reference: str) -> TensorType | None:
        while self._told < len(self.nodes):
            node = self._with_redirected_inputs(self.nodes[self._told])
            self._told += 1
            with contextlib.suppress(ExportModelError, KeyError):  # of a loop, or of what nothing may need: not known
                add_types(self.types, node, self.symbols, self.allowance)
        return self.types.get(self.resolve(reference))

    def redirect(self, reference: str, to: str) -> None:
        """Let every later reader of ``reference`` read ``to``."""
        if reference != to:
            self._redirected[reference] = to

    def keep(self, node: Node) -> None:
        """Take a node over, its inputs redirected."""
        if self._redirected:
            node = self._with_redirected_inputs(node)
        self.position[node.name] = len(self.nodes)
        self.nodes.append(node)

    def _with_redirected_inputs(self, node: Node) -> Node:
        if self._redirected.keys().isdisjoint(node.inputs):
            return node
        return node.with_inputs(self.resolve(r) for r in node.inputs)

    def add(
        self,
        op: str,
        inputs: Iterable[str],
        name: str = "",
        origin: SourceName = None,
        **attrs: Any,
    ) -> str:
        """A new node with the op's default attributes under a fresh name like ``name``; returns its output 0."""
        return super().add(op, [self.resolve(r) for r in inputs], name, origin, **attrs)

    def add_name(self, wish: str) -> str:
        """A free node name like ``wish``."""
        return self.names.fresh(wish)

    def replace_const(self, name: str, array: np.ndarray, origin: SourceName) -> str:
        """A Const under the name of the node of the old graph that it stands for."""
        return self.append(Node(name, "Const", value=array, origin=origin))

    def prune(self, outputs: Iterable[str]) -> Graph:
        """``graph``, where anything changed only what the outputs need, and what is fed."""
        made = self.graph()
        return made if made is self._old else made.prune([*outputs, *(n.name for n in made.nodes if is_fed(n))])

    def graph(self) -> Graph:
        """The new graph, redirections applied to all nodes, in topological order; the old one where nothing changed."""
        nodes = [self._with_redirected_inputs(n) for n in self.nodes] if self._redirected else self.nodes
        if len(nodes) == len(self._old.nodes) and all(map(operator.is_, nodes, self._old.nodes)):
            return self._old
        return Graph(topological(nodes))
