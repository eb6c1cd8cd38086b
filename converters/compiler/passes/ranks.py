"""Products and softmaxes of ranks that TensorFlow 1.x lacks: what BatchMatMulV2 and TensorFlow 2's Softmax do.

Precondition: no control flow. Postcondition: both operands of a BatchMatMul have the same axes before the last two, and
a Softmax or LogSoftmax is over rows of a matrix, as far as the shapes are known.
"""

from __future__ import annotations

from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn.linear import matmul
from export_model.converters.graph.nn.reduction import over_last_axis
from export_model.converters.graph.nodes import Graph, NameScope, Node
from export_model.converters.graph.ops.table import traits
from export_model.converters.graph.shapes import Types, infer_types

_SIDES = ("adj_x", "adj_y")
_MATRIX = 2


def settle_ranks(graph: Graph) -> Graph:
    """See the module."""
    found = [n for n in graph.nodes if n.op == "BatchMatMul" or traits(n).activation == "softmax"]
    types = infer_types(graph) if found else {}
    odd = {n.name for n in found if _is_odd(types, n)}
    if not odd:
        return graph
    b = Builder(NameScope(n.name for n in graph.nodes))
    for node in graph.nodes:
        if node.name not in odd:
            b.append(node)
            continue
        b.prefix = node.name
        if traits(node).activation == "softmax":
            made = over_last_axis(b, node.op, node.inputs[0])
        else:
            sides = zip(node.inputs, _SIDES, strict=True)
            made = matmul(b, *(_transpose(b, r) if node.attrs.get(key) else r for r, key in sides))
        b.rename(made, node.name, node.origin)
        b.prefix = ""
    return b.graph()


def _is_odd(types: Types, node: Node) -> bool:
    shapes = [s for r in node.inputs if (s := types[r].shape) is not None]
    if traits(node).activation == "softmax":
        return any(len(s) > _MATRIX and isinstance(s[-1], int) for s in shapes)
    if len(shapes) != _MATRIX or any(len(s) < _MATRIX for s in shapes):
        return False
    return shapes[0][:-2] != shapes[1][:-2]


def _transpose(b: Builder, matrix: str) -> str:
    rank = b.rank(matrix)
    return b.transpose(matrix, [*range(rank - 2), rank - 1, rank - 2])
