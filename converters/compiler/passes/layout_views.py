"""A change between channels first and channels last, written as a Reshape, as the Transpose that it is.

An image of one channel has the same numbers in both layouts, so that its Transpose became a Reshape (``simplify``).
A convolution behind it, which is computed channels first, then cannot cancel it, and Barracuda 1.3 lays the input out
wrongly (../shared/unity/r3/cases/gray_camera_barracuda-1.0: 11 of 11 right without the pair).
"""

from __future__ import annotations

from collections.abc import Collection

from converters.graph.editor import Editor
from converters.graph.nodes import Graph, Node
from converters.graph.shapes import infer_types
from converters.graph.types import Dim

_TO_LAST, _TO_FIRST = (0, 2, 3, 1), (0, 3, 1, 2)


def transpose_layout_views(graph: Graph, roots: Collection[str] = ()) -> Graph:
    """Return the graph with a Transpose for each Reshape that moves a channel axis of length 1."""
    types = infer_types(graph)
    editor = Editor(graph)
    for node in graph.nodes:
        order = _order(types[node.inputs[0]].shape, types[node.name].shape) if node.op == "Reshape" else None
        if order is not None:
            operand = editor.ints(order, f"{node.name}/order")
            node = Node(node.name, "Transpose", (node.inputs[0], operand), origin=node.origin)
        editor.keep(node)
    return editor.graph()


def _order(before: tuple[Dim, ...] | None, after: tuple[Dim, ...] | None) -> tuple[int, ...] | None:
    """The order of axes by which an image of one channel [B, 1, H, W] or [B, H, W, 1] became the other."""
    if before is None or after is None or len(before) != 4 or len(after) != 4:
        return None
    for order, channel in ((_TO_LAST, 1), (_TO_FIRST, 3)):
        if before[channel] == 1 and after == tuple(before[axis] for axis in order) != before:
            return order
    return None
