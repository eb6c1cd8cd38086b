"""A change between channels first and channels last, written as a Reshape, as the Transpose that it is.

An image of one channel, or of one pixel, has the same numbers in both layouts, so that its Transpose became a Reshape
(``simplify``). A convolution beside it, which is computed channels first, then cannot cancel it. Barracuda 1.3 lays the
input out wrongly (../shared/unity/r3/cases/gray_camera_barracuda-1.0: 11 of 11 right without the pair), 3.0.0 takes the
whole file for channels last (../shared/unity/r4, ``cam_buffer``, whose last convolution leaves one pixel).
"""

from __future__ import annotations

from collections.abc import Collection

from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import Dim

_TO_LAST, _TO_FIRST = (0, 2, 3, 1), (0, 3, 1, 2)


def transpose_layout_views(graph: Graph, roots: Collection[str] = ()) -> Graph:
    """Return the graph with a Transpose for each Reshape that moves axes of length 1 alone."""
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
    """The order of axes by which an image of one channel, or of one pixel, became the same in the other layout."""
    if before is None or after is None or len(before) != 4 or len(after) != 4:
        return None
    for order, channel in ((_TO_LAST, 1), (_TO_FIRST, 3)):
        pixels = [before[axis] for axis in (1, 2, 3) if axis != channel]
        same = before[channel] == 1 or pixels == [1, 1]
        if same and after == tuple(before[axis] for axis in order) != before:
            return order
    return None
