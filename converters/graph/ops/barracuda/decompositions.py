"""What a Barracuda or another of Unity's importers lacks or computes otherwise, in ops that all of them have.

They are those of Barracuda 1.0 to the Inference Engine: one formula for ``.nn`` and for ONNX. Which importer lacks what
stands in ``consumers/unity/readings.py``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from export_model.converters.graph.nn.choosing import MAX_TABLE
from export_model.converters.graph.nodes import Node, ref
from export_model.converters.graph.ops.base import axis_within
from export_model.converters.graph.ops.rewriting import Decomposition, GraphBuilder, Tfjs
from export_model.converters.graph.types import BATCH, BOOL, FLOAT32, INT32, TensorType
from export_model.signatures.errors import UnsupportedOpError

#: Times this, every difference that float32 tells apart from 0 near 1 is beyond ±1.
_STEEP = 1e30
_LARGEST = float(np.finfo(np.float32).max)


class _Formula:
    """Nodes of one decomposition; each is called as its op, its numbers ``const``."""

    def __init__(
        self, builder: GraphBuilder, node: Node, types: Mapping[str, TensorType], dtype: np.dtype | None = None
    ) -> None:
        self._builder, self.node = builder, node
        self.dtype = types[node.inputs[0]].dtype if dtype is None else dtype
        self._numbers: dict[float, str] = {}

    def number(self, value: float) -> str:
        if value not in self._numbers:
            self._numbers[value] = self.array(np.array(value, self.dtype))
        return self._numbers[value]

    def array(self, values: np.ndarray) -> str:
        """Return the value of a new constant."""
        return self._builder.const(values, f"{self.node.name}/const")

    def do(self, op: str, *operands: str | float, **attrs: Any) -> str:
        """Return the value of a new node; a number is a constant."""
        inputs = [o if isinstance(o, str) else self.number(o) for o in operands]
        return self._builder.add(op, inputs, f"{self.node.name}/{op}", **attrs)

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


def whole_rows(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> str:
    """Return the condition of a Select; TensorFlow 1's takes whole rows where that is a vector."""
    condition, choice, _ = node.inputs
    wide = types[choice].rank
    if node.op != "Select" or types[condition].rank != 1 or wide is None or wide < 2:
        return condition
    shape = builder.const(np.array([-1] + [1] * (wide - 1), INT32), f"{node.name}/rows")
    return builder.add("Reshape", [condition, shape], f"{node.name}/condition")


def _select(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    """Condition·a + (1 − condition)·b. What is computed is bounded first: infinity times 0 would be no number."""
    kinds = [types[choice] for choice in node.inputs[1:]]
    if any(k.constant is not None and not np.isfinite(k.constant).all() for k in kinds):
        return node
    f = _Formula(builder, node, types, kinds[0].dtype)
    condition, (a, b) = whole_rows(builder, node, types), node.inputs[1:]
    if f.dtype == BOOL:
        other = f.do("Equal", condition, 0.0)
        return f.end("LogicalOr", f.do("LogicalAnd", condition, a), f.do("LogicalAnd", other, b))
    holds = f.do("Cast", condition, DstT=f.dtype)
    other = f.do("Add", f.do("Mul", holds, -1.0), 1.0)
    if f.dtype.kind == "f":
        a, b = (
            choice if kind.constant is not None else f.do("ClipByValue", choice, -_LARGEST, _LARGEST)
            for choice, kind in zip((a, b), kinds, strict=True)
        )
    return f.end("Add", f.do("Mul", a, holds), f.do("Mul", b, other))


def _logical_not(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    return _Formula(builder, node, types).end("Equal", node.inputs[0], 0.0)


def _floor_mod(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    """A − ⌊a / b⌋·b."""
    f, (a, b) = _Formula(builder, node, types), node.inputs
    return f.end("Sub", a, f.do("Mul", f.do("FloorDiv", a, b), b))


def _cast(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    """Take the fraction off before a cast to an integer, and compare with zero in place of a cast to bool.

    Unity's importers keep the value of the number (Cast_01 to Cast_03; Sentis and the Inference Engine for bool).
    """
    f, x, target = _Formula(builder, node, types), node.inputs[0], node.attrs["DstT"]
    if target == BOOL and f.dtype != BOOL:
        return f.end("NotEqual", x, 0.0)
    if f.dtype.kind != "f" or target.kind not in "iu":
        return node
    above = f.do("Floor", f.do("Maximum", x, 0.0))
    whole = f.do("Add", above, f.do("Ceil", f.do("Minimum", x, 0.0)))
    return node.with_inputs([whole])


def _classes(f: _Formula, indices: str, kind: TensorType, depth: int) -> str:
    """Return [B, n·depth] for n indices of each agent: 1 at an index, 0 elsewhere, in float32.

    1 − (index − class)² is 1 there, and at most 0 for every other whole number. Not by Barracuda's OneHot, which gives
    another shape at batch 1 in 3.0.0 (and an error behind it).
    """
    assert kind.shape is not None
    columns = _columns(kind)
    if columns * columns * depth > MAX_TABLE:
        raise UnsupportedOpError(
            f"node {f.node.name!r} ({f.node.op}) cannot be written for Barracuda: "
            f"a table of {columns}×{columns * depth} numbers",
            issues=[(f.node.name, f.node.op)],
            why=f"each is compared with each, and no more than {MAX_TABLE} pairs are",
            fix="leave nn out of --to: the ONNX of the same policy holds it",
        )
    flat = f.do("Reshape", indices, f.array(np.array([-1, columns], INT32))) if len(kind.shape) != 2 else indices
    number = flat if kind.dtype == FLOAT32 else f.do("Cast", flat, DstT=FLOAT32)
    spread = f.array(np.kron(np.eye(columns), np.ones((1, depth))).astype(FLOAT32))
    classes = f.array(-np.tile(np.arange(depth, dtype=FLOAT32), columns))
    distance = f.do("_FusedMatMul", number, spread, classes, fused_ops=("BiasAdd",))
    return f.do("Relu", f.do("Add", f.do("Mul", f.do("Square", distance), -1.0), 1.0))


def _columns(kind: TensorType) -> int:
    return math.prod(d for d in kind.shape or () if isinstance(d, int))


def _has_row_per_agent(kind: TensorType) -> bool:
    shape = kind.shape or ()
    return shape[:1] == (BATCH,) and all(isinstance(d, int) for d in shape[1:])


def _cast_to(f: _Formula, value: str, dtype: np.dtype) -> str:
    return value if dtype == FLOAT32 else f.do("Cast", value, DstT=dtype)


def _one_hot(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    """A product and comparisons, where every agent has its indices; the result is cast from float32."""
    indices, *numbers = node.inputs
    kind, result = types[indices], types[node.name]
    depth, on, off = (types[n].constant for n in numbers)
    if depth is None or on is None or off is None or result.shape is None or not _has_row_per_agent(kind):
        return node
    if axis_within(int(node.attrs["axis"]), len(result.shape)) != len(result.shape) - 1:
        return node
    f = _Formula(builder, node, types, FLOAT32)
    hot = _classes(f, indices, kind, int(depth))
    high, low = float(on.reshape(())), float(off.reshape(()))
    hot = hot if high - low == 1 else f.do("Mul", hot, high - low)
    hot = hot if low == 0 else f.do("Add", hot, low)
    return f.end("Reshape", _cast_to(f, hot, result.dtype), f.array(np.array([-1, *result.shape[1:]], INT32)))


def _gather(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    """A row of a constant table for a number of each agent: the classes of the number times the table."""
    table, kind, result = types[node.inputs[0]].constant, types[node.inputs[1]], types[node.name]
    axis = types[node.inputs[2]].constant if len(node.inputs) > 2 else np.array(0)
    if table is None or table.ndim != 2 or axis is None or axis_within(int(axis), 2) or result.shape is None:
        return node
    if kind.constant is not None or not _has_row_per_agent(kind) or _columns(kind) != 1:
        return node
    f = _Formula(builder, node, types, FLOAT32)
    row = f.do("MatMul", _classes(f, node.inputs[1], kind, len(table)), f.array(table.astype(FLOAT32)))
    return f.end("Reshape", _cast_to(f, row, result.dtype), f.array(np.array([-1, *result.shape[1:]], INT32)))


def _split(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    """A Slice for each piece: Barracuda reads the sizes of a Split from its attribute alone, which opset 13 lacks."""
    data, axis_at = (node.inputs[1], node.inputs[0]) if node.op == "Split" else (node.inputs[0], node.inputs[2])
    rank, at = types[data].rank, types[axis_at].constant
    if rank is None or at is None:
        return node
    axis = axis_within(int(at), rank)
    shapes = [types[ref(node.name, i)].shape or () for i in range(int(node.attrs["num_split"]))]
    lengths = [shape[axis] for shape in shapes]
    begin, pieces = 0, []
    for length in lengths:
        if isinstance(length, str):
            return node
        first, size = np.zeros(rank, INT32), np.full(rank, -1, INT32)
        first[axis], size[axis] = begin, length
        pieces.append((data, *(builder.const(v, f"{node.name}/bounds") for v in (first, size))))
        begin += length
    for index, piece in enumerate(pieces[1:], 1):
        builder.redirect(ref(node.name, index), builder.add("Slice", piece, f"{node.name}/{index}"))
    return Node(node.name, "Slice", pieces[0], origin=node.origin)


def _zeros_like(builder: GraphBuilder, node: Node, types: Mapping[str, TensorType]) -> Node:
    """A bounded number times 0."""
    f, x = _Formula(builder, node, types), node.inputs[0]
    if f.dtype != FLOAT32:
        return node
    return f.end("Mul", x if types[x].constant is not None else f.do("ClipByValue", x, -_LARGEST, _LARGEST), 0.0)


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
SELECT = Decomposition("Where", _select)
LOGICAL_NOT = Decomposition("Not", _logical_not)
FLOOR_MOD = Decomposition("Mod", _floor_mod)
#: In plain ONNX, too, which people put into Unity as it is.
CAST = Decomposition("Cast", _cast, everywhere=True)
ONE_HOT = Decomposition("", _one_hot)
GATHER = Decomposition("", _gather)
#: A ``.nn`` cuts and fills without layers of their own.
SPLIT = Decomposition("Split", _split, nn=False)
ZEROS_LIKE = Decomposition("Expand", _zeros_like, nn=False)
#: In a ``.nn`` the layout of both operands decides (``elementwise.subtract``).
SUB = Decomposition("Sub", _undo("Neg", "Add"), nn=False)
DIV = Decomposition("Div", _undo("Reciprocal", "Mul"), nn=False)
