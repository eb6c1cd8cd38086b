"""Ops for any number of agents: the form in which one leaves an axis in front alone; one that has none is refused."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn.linear import matmul
from export_model.converters.graph.nn.reduction import over_last_axis
from export_model.converters.graph.nodes import Graph, NameScope, Node, ref
from export_model.converters.graph.ops.table import op_of
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import BATCH, BOOL, INT32, Dim
from export_model.signatures.errors import UnsupportedOpError


class Rows:
    """A graph for one agent on its way to one for many: what is known of its tensors, and where they are now."""

    def __init__(self, graph: Graph) -> None:
        self.types = infer_types(graph)
        self.b = Builder(NameScope(n.name for n in graph.nodes))
        #: tensor → where it is in the new graph
        self.at: dict[str, str] = {}
        #: tensors that each agent has its own of
        self.own: set[str] = set()

    def rank(self, reference: str) -> int:
        """The axes of a tensor, for one agent."""
        return len(self.shape(reference))

    def shape(self, reference: str) -> tuple[int, ...]:
        """The shape of a tensor, for one agent; raises UnsupportedOpError where it is not known."""
        shape = self.types[reference].shape
        if shape is None or any(isinstance(d, str) for d in shape):
            raise UnsupportedOpError(
                f"the shape of {reference!r} is not known before the graph runs",
                issues=[(reference, "")],
                why="rows can be added to a model for one agent where all its lengths are known",
                fix="export the model with a free batch axis",
            )
        return tuple(int(d) for d in shape)

    def constant(self, node: Node, position: int) -> np.ndarray:
        """An operand that must be the same for all agents."""
        value = self.types[node.inputs[position]].constant
        if value is None:
            raise batching_error(node, "an operand that says how it works is computed while the graph runs")
        return value

    def common(self, node: Node, position: int) -> str:
        """An operand that is the same for all agents; raises UnsupportedOpError where each has its own."""
        if node.inputs[position] in self.own:
            raise batching_error(node, "an operand that says how it works is computed while the graph runs")
        return self.at[node.inputs[position]]

    def batched_tensor(self, reference: str, rank: int | None = None) -> str:
        """A tensor with the agents' axis, repeated for each where it is the same for all, with axes up to ``rank``."""
        dims = self.shape(reference)
        wide = (*(1,) * ((rank or 0) - len(dims)), *dims)
        if reference not in self.own:
            return self.b.broadcast(self.b.reshape(self.at[reference], (1, *wide)), (BATCH, *wide))
        return self.at[reference] if wide == dims else self.b.reshape(self.at[reference], (BATCH, *wide))

    def align_ranks(self, references: Sequence[str]) -> list[str]:
        """Operands that broadcast: those of the agents with as many axes as the longest."""
        rank = max(self.rank(r) for r in references)
        return [self.batched_tensor(r, rank) if r in self.own else self.at[r] for r in references]


Rule = Callable[[Rows, Node], str | Sequence[str]]


def batching_error(node: Node, why: str) -> UnsupportedOpError:
    """The error that a node cannot be computed for several agents."""
    return UnsupportedOpError(
        f"cannot convert {node.op} (node {node.name!r}) of a model for one agent",
        issues=[(node.name, node.op)],
        why=why,
        fix="export the model with a free batch axis",
    )


def _first(rows: Rows, node: Node) -> str:
    return rows.batched_tensor(node.inputs[0])


# ------------------------------------------------------------------ each element by itself


def _elementwise(rows: Rows, node: Node) -> str:
    operands = rows.align_ranks(node.inputs)
    if node.op != "AddN":
        return rows.b.add(node.op, operands, **node.attrs)
    total = operands[0]
    for operand in operands[1:]:
        total = rows.b.add("Add", [total, operand])
    return total


def _same(rows: Rows, node: Node) -> str:
    return rows.b.add(node.op, [_first(rows, node)], **node.attrs)


def _select(rows: Rows, node: Node) -> str:
    """A condition with one axis chooses whole rows of the tensors."""
    rank = rows.rank(node.inputs[1])
    dims = rows.shape(node.inputs[0])
    condition, a, b = (rows.batched_tensor(r, None) for r in node.inputs)
    if len(dims) < rank:
        condition = rows.b.reshape(condition, (BATCH, *dims, *(1,) * (rank - len(dims))))
        condition = rows.b.broadcast(rows.b.cast(condition, INT32), (BATCH, *rows.shape(node.inputs[1])))
        condition = rows.b.cast(condition, BOOL)
    return rows.b.add("Select", [condition, a, b])


def _bias(rows: Rows, node: Node) -> str:
    if node.inputs[1] in rows.own:
        return rows.b.add("Add", rows.align_ranks(node.inputs))
    return rows.b.add("BiasAdd", [_first(rows, node), rows.at[node.inputs[1]]])


# ------------------------------------------------------------------ the same elements elsewhere


def _view(rows: Rows, node: Node) -> str:
    return rows.b.reshape(_first(rows, node), (BATCH, *rows.shape(node.name)))


def _transpose(rows: Rows, node: Node) -> str:
    order = [int(a) % rows.rank(node.inputs[0]) for a in rows.constant(node, 1)]
    return rows.b.transpose(_first(rows, node), [0, *(a + 1 for a in order)])


def _concat(rows: Rows, node: Node) -> str:
    parts = node.inputs[:-1]
    at = int(rows.constant(node, len(parts))) % rows.rank(parts[0])
    return rows.b.concat([rows.batched_tensor(p) for p in parts], at + 1)


def _pack(rows: Rows, node: Node) -> str:
    at = int(node.attrs["axis"]) % len(rows.shape(node.name))
    return rows.b.add("Pack", [rows.batched_tensor(p) for p in node.inputs], axis=at + 1)


def _split(rows: Rows, node: Node) -> Sequence[str]:
    """Split (axis, value), SplitV (value, sizes, axis)."""
    value, axis = (1, 0) if node.op == "Split" else (0, 2)
    at = rows.b.ints(int(rows.constant(node, axis)) % rows.rank(node.inputs[value]) + 1, "axis")
    x = rows.batched_tensor(node.inputs[value])
    operands = [at, x] if node.op == "Split" else [x, rows.common(node, 1), at]
    return _several(rows, node, operands, dict(node.attrs))


def _unpack(rows: Rows, node: Node) -> Sequence[str]:
    at = int(node.attrs["axis"]) % rows.rank(node.inputs[0])
    return _several(rows, node, [_first(rows, node)], {**node.attrs, "axis": at + 1})


def _several(rows: Rows, node: Node, operands: Sequence[str], attrs: dict[str, Any]) -> Sequence[str]:
    made = rows.b.append(Node(node.name, node.op, tuple(operands), attrs, origin=node.origin))
    return [ref(made, i) for i in range(rows.b.outputs(made))]


def _slice(rows: Rows, node: Node) -> str:
    begin, size = (rows.constant(node, i).tolist() for i in (1, 2))
    operands = [rows.b.ints([0, *begin], "begin"), rows.b.ints([-1, *size], "size")]
    return rows.b.add("Slice", [_first(rows, node), *operands])


def _strided_slice(rows: Rows, node: Node) -> str:
    begin, end, steps = (rows.constant(node, i).tolist() for i in (1, 2, 3))
    operands = [rows.b.ints(v, n) for v, n in (([0, *begin], "begin"), ([0, *end], "end"), ([1, *steps], "steps"))]
    masks: dict[str, Any] = {name: int(mask) << 1 for name, mask in node.attrs.items()}
    masks["begin_mask"] |= 1
    masks["end_mask"] |= 1
    return rows.b.add("StridedSlice", [_first(rows, node), *operands], **masks)


def _gather(rows: Rows, node: Node) -> str:
    """Out of one table for all, or the same elements for all; elements of its own out of an agent's are compared."""
    x, indices = node.inputs[:2]
    axis = int(rows.constant(node, 2)) % rows.rank(x) if len(node.inputs) > 2 else 0
    b = rows.b
    if indices not in rows.own:
        return b.add("GatherV2", [rows.at[x], rows.at[indices], b.ints(axis + 1, "axis")])
    if x not in rows.own:
        rank = rows.rank(x)
        table = b.transpose(rows.at[x], [axis, *(i for i in range(rank) if i != axis)])
        found = b.add("GatherV2", [table, rows.at[indices], b.ints(0, "axis")])  # [B, indices, rest of x]
        return _between(rows, found, rows.rank(indices), axis)
    dims, places = rows.shape(x), rows.shape(indices)
    length, rest = dims[axis], [d for i, d in enumerate(dims) if i != axis]
    table = b.transpose(rows.at[x], [0, axis + 1, *(i + 1 for i in range(len(dims)) if i != axis)])
    table = b.reshape(table, (BATCH, 1, length, int(np.prod(rest or [1]))))
    chosen = b.reshape(b.cast(rows.at[indices], INT32), (BATCH, int(np.prod(places or [1])), 1, 1))
    numbers = b.const(np.arange(length, dtype=INT32).reshape(length, 1), "numbers")
    kept = b.where(b.add("Equal", [chosen, numbers]), table, b.number(table, 0, "nothing"))
    found = b.reshape(b.reduce("Sum", kept, [2], keep=False), (BATCH, *places, *rest))
    return _between(rows, found, len(places), axis)


def _between(rows: Rows, found: str, count: int, axis: int) -> str:
    """[B, ``count`` axes, others] with the ``count`` axes behind the first ``axis`` of the others."""
    rest = rows.b.rank(found) - 1 - count
    front = [1 + count + i for i in range(axis)]
    back = [1 + count + i for i in range(axis, rest)]
    return rows.b.transpose(found, [0, *front, *range(1, 1 + count), *back])


def _tile(rows: Rows, node: Node) -> str:
    return rows.b.add("Tile", [_first(rows, node), rows.b.ints([1, *rows.constant(node, 1).tolist()], "times")])


def _pad(rows: Rows, node: Node) -> str:
    pairs = rows.b.ints([[0, 0], *rows.constant(node, 1).tolist()], "paddings")
    return rows.b.add(node.op, [_first(rows, node), pairs, *(rows.common(node, i) for i in range(2, len(node.inputs)))])


# ------------------------------------------------------------------ along axes


def _reduction(rows: Rows, node: Node) -> str:
    rank = rows.rank(node.inputs[0])
    axes = sorted({int(a) % rank for a in rows.constant(node, 1).reshape(-1)}) if rank else []
    return rows.b.add(node.op, [_first(rows, node), rows.b.ints([a + 1 for a in axes], "axes")], **node.attrs)


def _arg(rows: Rows, node: Node) -> str:
    axis = int(rows.constant(node, 1)) % rows.rank(node.inputs[0])
    return rows.b.add(node.op, [_first(rows, node), rows.b.ints(axis + 1, "axis")], **node.attrs)


def _softmax(rows: Rows, node: Node) -> str:
    return over_last_axis(rows.b, node.op, _first(rows, node))


def _one_hot(rows: Rows, node: Node) -> str:
    axis = int(node.attrs["axis"])
    operands = [_first(rows, node), *(rows.common(node, i) for i in (1, 2, 3))]
    return rows.b.add("OneHot", operands, axis=axis if axis < 0 else axis + 1)


def _product(rows: Rows, node: Node) -> str:
    """An agent's matrix by one for all goes on two axes; else a product for each agent."""
    operands, b = [], rows.b
    for reference, flags in zip(node.inputs, (("transpose_a", "adj_x"), ("transpose_b", "adj_y")), strict=True):
        rank = rows.rank(reference)
        value = rows.at[reference]
        own = reference in rows.own
        if any(node.attrs.get(flag) for flag in flags):
            order = [*range(rank - 2), rank - 1, rank - 2]
            value = b.transpose(value, [0, *(a + 1 for a in order)] if own else order)
        operands.append(value)
    return matmul(b, operands[0], operands[1])


def _batch_window(rows: Rows, node: Node) -> str:
    """An image of each agent as one of as many images; the kernel is the same for all."""
    n, *image = rows.shape(node.inputs[0])
    x = rows.b.reshape(_first(rows, node), _merge_batch(n, image))
    kernel = [rows.common(node, i) for i in range(1, len(node.inputs))]
    made = rows.b.add(node.op, [x, *kernel], **node.attrs)
    return rows.b.reshape(made, (BATCH, *rows.shape(node.name)))


def _merge_batch(count: int, rest: Sequence[int]) -> list[Dim]:
    """The agents' axis and the next one, of ``count``, as one."""
    return [BATCH if count == 1 else -1, *rest]


# ------------------------------------------------------------------ chance


def _draw(rows: Rows, node: Node) -> str:
    """A first axis of 1 is that of the agents: what the file draws is then what each agent's row of the draw is."""
    dims = [int(d) for d in rows.constant(node, 0)]
    own = dims[1:] if len(dims) > 1 and dims[0] == 1 else dims
    drawn = rows.b.add(node.op, [rows.b.vector((BATCH, *own))], origin=node.origin, **node.attrs)
    return drawn if own is dims else rows.b.reshape(drawn, (BATCH, *dims))


def _multinomial(rows: Rows, node: Node) -> str:
    count, classes = rows.shape(node.inputs[0])
    logits = rows.b.reshape(_first(rows, node), _merge_batch(count, [classes]))
    drawn = rows.b.add("Multinomial", [logits, rows.common(node, 1)], origin=node.origin, **node.attrs)
    return rows.b.reshape(drawn, (BATCH, *rows.shape(node.name)))


_RULES: Mapping[str, Rule] = {
    **dict.fromkeys(("Identity", "CheckNumerics", "PreventGradient", "Snapshot", "StopGradient"), _same),
    "Select": _select,
    "BiasAdd": _bias,
    **dict.fromkeys(("Reshape", "ExpandDims", "Squeeze"), _view),
    "Transpose": _transpose,
    "ConcatV2": _concat,
    "Pack": _pack,
    **dict.fromkeys(("Split", "SplitV"), _split),
    "Unpack": _unpack,
    "Slice": _slice,
    "StridedSlice": _strided_slice,
    **dict.fromkeys(("Gather", "GatherV2"), _gather),
    "Tile": _tile,
    **dict.fromkeys(("Pad", "PadV2"), _pad),
    **dict.fromkeys(("Sum", "Mean", "Prod", "Max", "Min", "All", "Any"), _reduction),
    **dict.fromkeys(("ArgMax", "ArgMin"), _arg),
    **dict.fromkeys(("Softmax", "LogSoftmax"), _softmax),
    "OneHot": _one_hot,
    **dict.fromkeys(("MatMul", "BatchMatMul"), _product),
    **dict.fromkeys(("Conv2D", "DepthwiseConv2dNative", "MaxPool", "AvgPool"), _batch_window),
    **dict.fromkeys(("RandomStandardNormal", "RandomUniform", "TruncatedNormal"), _draw),
    "Multinomial": _multinomial,
}


def rule_of(node: Node) -> Rule:
    """How a node is done for many agents; raises UnsupportedOpError."""
    rule = _RULES.get(node.op) or (_elementwise if op_of(node).elementwise else None)
    if rule is None:
        raise batching_error(node, "it has no form for several agents")
    return rule
