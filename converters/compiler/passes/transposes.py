"""Take transposes out that cancel, between layers that are each framed by a change of layout.

A convolution of a model with channels first is computed NHWC between two transposes; behind an activation the next one
turns back. Here a transpose is held back, moved through what works element by element, joined with the next one, and
made only where a tensor is read in its own order of axes.

Precondition: folded graph. Postcondition: the same tensors in ``fetches``, with as many transposes or fewer.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node, split_ref
from export_model.converters.graph.ops.table import op_of
from export_model.converters.graph.shapes import Types, infer_types

#: (a tensor, the order in which its axes are read)
_Turned = tuple[str, tuple[int, ...]]


def cancel_transposes(graph: Graph, fetches: Mapping[str, str]) -> tuple[Graph, dict[str, str]]:
    """The graph with fewer transposes (unchanged if there is nothing to gain), and where the fetched tensors are."""
    before = sum(1 for n in graph.nodes if n.op == "Transpose")
    if before < 2:
        return graph, dict(fetches)
    sinking = _Sinking(graph)
    moved = sinking.run(fetches)
    result = sinking.editor.graph().prune(moved.values())
    if sum(1 for n in result.nodes if n.op == "Transpose") >= before:
        return graph, dict(fetches)
    return result, moved


class _Sinking:
    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.types: Types = infer_types(graph)
        self.editor = Editor(graph)
        self.held: dict[str, _Turned] = {}
        self.made: dict[str, str] = {}

    def run(self, fetches: Mapping[str, str]) -> dict[str, str]:
        for node in self.graph.nodes:
            if not (self._hold(node) or self._pass_through(node)):
                self.editor.nodes.append(node.with_inputs(self.plain(r) for r in node.inputs))
        return {name: self.plain(reference) for name, reference in fetches.items()}

    def plain(self, reference: str) -> str:
        """The tensor in its own order of axes; the transpose that was held back is made here."""
        name, index = split_ref(reference)
        if name not in self.held:
            return reference
        if name not in self.made:
            base, order = self.held[name]
            if list(order) == sorted(order):
                self.made[name] = base
            else:
                operand = self.editor.ints(order, f"{name}/order")
                origin = self.graph[name].origin
                self.editor.nodes.append(Node(name, "Transpose", (base, operand), origin=origin))
                self.made[name] = name
        assert index == 0
        return self.made[name]

    def _hold(self, node: Node) -> bool:
        """A transpose of a known order is held back, joined with the one before it."""
        order = self.types[node.inputs[1]].constant if node.op == "Transpose" else None
        if order is None:
            return False
        inner = self.held.get(node.inputs[0])
        base, first = inner if inner is not None else (node.inputs[0], tuple(range(len(order))))
        self.held[node.name] = (base, tuple(first[int(axis)] for axis in order))
        return True

    def _pass_through(self, node: Node) -> bool:
        """An elementwise op of held tensors works on what they are made of; its result is held in their place."""
        orders = {self.held[r][1] for r in node.inputs if r in self.held}
        if not op_of(node).elementwise or len(orders) != 1:
            return False
        (order,) = orders
        operands = [self._turned_operand(r, order) for r in node.inputs]
        if list(order) == sorted(order) or any(o is None for o in operands):
            return False
        inputs = tuple(
            o if isinstance(o, str) else self.editor.const(o, f"{node.name}/operand") for o in operands if o is not None
        )
        name = self.editor.add_name(f"{node.name}/turned")
        self.editor.nodes.append(Node(name, node.op, inputs, node.attrs))
        self.held[node.name] = (name, order)
        return True

    def _turned_operand(self, reference: str, order: tuple[int, ...]) -> str | np.ndarray | None:
        """An operand in the order of the held tensors' bases: a tensor, a new constant, or None where it has none."""
        if reference in self.held:
            return self.held[reference][0]
        kind = self.types[reference]
        if kind.shape is not None and all(d == 1 for d in kind.shape) and len(kind.shape) <= len(order):
            return reference if kind.constant is None or kind.rank == 0 else kind.constant.reshape(())
        if kind.constant is None or kind.constant.ndim > len(order):
            return None
        value = kind.constant.reshape((1,) * (len(order) - kind.constant.ndim) + kind.constant.shape)
        return np.asarray(value.transpose(np.argsort(order)), order="C")
