"""The official converter's fused ops as the plain ones that they stand for (tfjs-core ops/fused_util).

``_FusedMatMul``, ``_FusedConv2D`` and ``FusedDepthwiseConv2dNative`` compute a product, and what ``fused_ops`` lists
after it: BiasAdd, then an activation. ``Prelu`` has its slopes as a further input.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from converters.graph.nodes import Graph, NameScope, Node, topological
from signatures.errors import UnsupportedOpError

_PLAIN = {
    "_FusedMatMul": "MatMul",
    "_FusedConv2D": "Conv2D",
    "FusedDepthwiseConv2dNative": "DepthwiseConv2dNative",
}
_ACTIVATIONS = frozenset(("Relu", "Relu6", "Elu", "Sigmoid", "Tanh", "LeakyRelu", "Prelu"))
_OWN = frozenset(("fused_ops", "num_args", "epsilon", "leakyrelu_alpha"))


def unfuse(graph: Graph) -> Graph:
    """See the module; the last op of each keeps the fused one's name."""
    scope = NameScope(n.name for n in graph.nodes)
    nodes: list[Node] = []
    for node in graph.nodes:
        nodes.extend(_Steps(node, scope).nodes() if node.op in _PLAIN or node.op == "Prelu" else [node])
    return Graph(topological(nodes))


class _Steps:
    """The nodes that stand for one, in a row."""

    def __init__(self, node: Node, scope: NameScope) -> None:
        self.node, self.scope = node, scope
        self.made: list[Node] = []

    def add(self, op: str, inputs: Iterable[str], **attrs: Any) -> str:
        self.made.append(Node(self.scope.fresh(f"{self.node.name}/{op}"), op, tuple(inputs), attrs))
        return self.made[-1].name

    def nodes(self) -> list[Node]:
        node = self.node
        if node.op == "Prelu":
            self.prelu(node.inputs[0], node.inputs[1])
        else:
            self.product()
        last = self.made[-1]
        return [*self.made[:-1], replace(last, name=node.name, origin=node.origin)]

    def product(self) -> None:
        node = self.node
        steps = node.attrs.get("fused_ops") or ()
        wanted = 2 + sum(s in ("BiasAdd", "Prelu") for s in steps)
        if any(s != "BiasAdd" and s not in _ACTIVATIONS for s in steps) or len(node.inputs) != wanted:
            raise UnsupportedOpError(
                f"cannot convert {node.op} (node {node.name!r}) with {', '.join(steps) or 'nothing'} fused into it",
                issues=[(node.name, node.op)],
                why=f"it has {len(node.inputs)} inputs, and what is fused is not known here, or takes {wanted}",
                fix="give the SavedModel that the TensorFlow.js model was converted from",
            )
        operands = list(node.inputs[2:])
        attrs = {k: v for k, v in node.attrs.items() if k not in _OWN}
        value = self.add(_PLAIN[node.op], node.inputs[:2], **attrs)
        for step in steps:
            if step == "BiasAdd":
                layout = node.attrs.get("data_format")
                value = self.add(step, [value, operands.pop(0)], **({"data_format": layout} if layout else {}))
            elif step == "Prelu":
                value = self.prelu(value, operands.pop(0))
            elif step == "LeakyRelu":
                value = self.add(step, [value], alpha=float(node.attrs.get("leakyrelu_alpha", 0.2)))
            else:
                value = self.add(step, [value])

    def prelu(self, value: str, slopes: str) -> str:
        """max(x, 0) + slopes · min(x, 0)."""
        zero = self.scope.fresh(f"{self.node.name}/zero")
        self.made.append(Node(zero, "Const", value=np.zeros((), np.float32)))
        below = self.add("Mul", [slopes, self.add("Minimum", [value, zero])])
        return self.add("Add", [self.add("Maximum", [value, zero]), below])
