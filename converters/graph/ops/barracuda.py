"""What a Barracuda lacks or computes otherwise, in ops that all of them have (1.0 to 3.0): one formula for ``.nn`` and
for ONNX. Which importer lacks what stands in ``consumers/unity/readings.py``.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from converters.graph.nodes import Node
from converters.graph.ops.base import Decomposition, GraphBuilder, Tfjs
from converters.graph.types import TensorType

#: Times this, every difference that float32 tells apart from 0 near 1 is beyond ±1.
_STEEP = 1e30


class _Formula:
    """Nodes of one decomposition; each is called as its op, its numbers ``const``."""

    def __init__(self, builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> None:
        self._builder, self.node = builder, node
        self.dtype = types[node.inputs[0]].dtype
        self._numbers: dict[float, str] = {}

    def number(self, value: float) -> str:
        if value not in self._numbers:
            self._numbers[value] = self._builder.const(np.array(value, self.dtype), f"{self.node.name}/const")
        return self._numbers[value]

    def do(self, op: str, *operands: str | float) -> str:
        """Return the value of a new node; a number is a constant."""
        inputs = [o if isinstance(o, str) else self.number(o) for o in operands]
        return self._builder.add(op, inputs, f"{self.node.name}/{op}")

    def end(self, op: str, *operands: str | float) -> Node:
        """Return the last node, which takes the place of the one that is decomposed."""
        inputs = tuple(o if isinstance(o, str) else self.number(o) for o in operands)
        return Node(self.node.name, op, inputs, origin=self.node.origin)


def _erf(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    """Abramowitz and Stegun 7.1.26, right to 1.5e-7."""
    f, x = _Formula(builder, node, types), node.inputs[0]
    size = f.do("Abs", x)
    t = f.do("Reciprocal", f.do("Add", f.do("Mul", size, 0.3275911), 1.0))
    series = f.do("Mul", t, 1.061405429)
    for factor in (-1.453152027, 1.421413741, -0.284496736, 0.254829592):
        series = f.do("Mul", f.do("Add", series, factor), t)
    bell = f.do("Exp", f.do("Mul", f.do("Mul", x, x), -1.0))
    upper = f.do("Add", f.do("Mul", f.do("Mul", series, bell), -1.0), 1.0)
    return f.end("Mul", upper, f.do("Maximum", f.do("Minimum", f.do("Mul", x, _STEEP), 1.0), -1.0))


def _rsqrt(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    f = _Formula(builder, node, types)
    return f.end("Reciprocal", f.do("Sqrt", node.inputs[0]))


def _expm1(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    f = _Formula(builder, node, types)
    return f.end("Add", f.do("Exp", node.inputs[0]), -1.0)


def _log1p(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    f = _Formula(builder, node, types)
    return f.end("Log", f.do("Add", node.inputs[0], 1.0))


def _softplus(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    """Max(x, 0) + log(1 + e^−|x|)."""
    f, x = _Formula(builder, node, types), node.inputs[0]
    small = f.do("Exp", f.do("Mul", f.do("Abs", x), -1.0))
    return f.end("Add", f.do("Maximum", x, 0.0), f.do("Log", f.do("Add", small, 1.0)))


def _softsign(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    f, x = _Formula(builder, node, types), node.inputs[0]
    return f.end("RealDiv", x, f.do("Add", f.do("Abs", x), 1.0))


def _sign(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    f, x = _Formula(builder, node, types), node.inputs[0]
    steep = f.do("Mul", x, _STEEP) if f.dtype.kind == "f" else x
    return f.end("Maximum", f.do("Minimum", steep, 1.0), -1.0)


def _round(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    """To the nearest whole number, halves to the even one: floor, plus 1 above a half, plus 1 at a half if odd."""
    f, x = _Formula(builder, node, types), node.inputs[0]
    if f.dtype.kind != "f":
        return f.end("Identity", x)
    low = f.do("Floor", x)
    over = f.do("Add", f.do("Sub", x, low), -0.5)
    odd = f.do("Sub", low, f.do("Mul", f.do("Floor", f.do("Mul", low, 0.5)), 2.0))
    far = f.do("Minimum", f.do("Mul", f.do("Abs", over), _STEEP), 1.0)
    tie = f.do("Add", f.do("Mul", far, -1.0), 1.0)
    above = f.do("Maximum", f.do("Minimum", f.do("Mul", over, _STEEP), 1.0), 0.0)
    return f.end("Add", low, f.do("Add", above, f.do("Mul", tie, odd)))


def _undo(inverse: str, op: str) -> Tfjs:
    """``op`` of an ``inverse`` of the second operand, where the first is a constant."""

    def write(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
        first, second = node.inputs
        if types[first].constant is None:
            return node
        inverted = builder.add(inverse, [second], f"{node.name}/{inverse}")
        return Node(node.name, op, (inverted, first), origin=node.origin)

    return write


ERF = Decomposition("Erf", _erf)
SIGN = Decomposition("Sign", _sign)
ROUND = Decomposition("Round", _round)
SOFTPLUS = Decomposition("Softplus", _softplus)
SOFTSIGN = Decomposition("Softsign", _softsign)
RSQRT = Decomposition("", _rsqrt)
EXPM1 = Decomposition("", _expm1)
LOG1P = Decomposition("", _log1p)
#: In a ``.nn`` the layout of both operands decides (formats/barracuda).
SUB = Decomposition("Sub", _undo("Neg", "Add"), nn=False)
DIV = Decomposition("Div", _undo("Reciprocal", "Mul"), nn=False)
