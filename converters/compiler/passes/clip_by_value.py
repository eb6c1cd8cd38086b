"""Two nodes that TensorFlow.js has one for: the start of an op is most of a small policy's run."""

from __future__ import annotations

from collections.abc import Iterable

from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node, node_of
from export_model.converters.graph.types import FLOAT32


def clip_by_value(graph: Graph, roots: Iterable[str]) -> Graph:
    """The graph with ClipByValue for a Maximum of a Minimum, each with one number, that nothing else reads."""
    outputs, readers = {node_of(r) for r in roots}, graph.consumers()
    editor = Editor(graph)
    left_out: set[str] = set()
    for node in graph.nodes:
        above = _limit_of(graph, node, "Maximum")
        inner = graph.producer(above[0]) if above is not None else None
        below = _limit_of(graph, inner, "Minimum") if inner is not None else None
        if above is None or inner is None or below is None or len(readers[inner.name]) > 1 or inner.name in outputs:
            editor.keep(node)
        elif above[1] <= below[1]:
            left_out.add(inner.name)
            bounds = [editor.floats(b, f"{node.name}/bound") for b in (above[1], below[1])]
            editor.keep(Node(node.name, "ClipByValue", (below[0], *bounds), origin=node.origin))
        else:
            editor.keep(node)
    return Graph(tuple(n for n in editor.graph().nodes if n.name not in left_out)) if left_out else graph


def _limit_of(graph: Graph, node: Node, op: str) -> tuple[str, float] | None:
    """(tensor, number) of a Maximum or Minimum of a tensor and one number."""
    if node.op != op:
        return None
    for value, bound in (node.inputs, node.inputs[::-1]):
        number = graph.constant(bound)
        if number is not None and number.shape == () and number.dtype == FLOAT32:
            return value, float(number)
    return None
