"""A slice of a concatenation that is one of its parts is that part.

The discrete policies of ML-Agents 0.5 and later put their branches' scores together and take them apart again.
``.bytes`` and SavedModel keep that; runtimes in which the start of an op is most of its cost do without.
"""

from __future__ import annotations

from collections.abc import Iterable

from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node, node_of
from export_model.converters.graph.ops.slicing import strided_steps
from export_model.converters.graph.shapes import Types, infer_types

_WHOLE = (("slice", None, None, 1), ("slice", 0, None, 1))


def parts_for_slices(graph: Graph, roots: Iterable[str]) -> Graph:
    """The graph with those slices left out, and what only they read; outputs and inputs stay."""
    outputs = {node_of(r) for r in roots}
    slices = {n.name for n in graph.nodes if n.op == "StridedSlice" and n.name not in outputs}
    if not any(graph.producer(graph[n].inputs[0]).op == "ConcatV2" for n in slices):
        return graph
    types, editor = infer_types(graph), Editor(graph)
    for node in graph.nodes:
        part = _part(graph, types, node) if node.name in slices else None
        if part is None:
            editor.keep(node)
        else:
            editor.redirect(node.name, editor.resolve(part))
    made = editor.graph()
    inputs = [n.name for n in graph.nodes if n.op == "Placeholder"]  # those that nothing reads stay
    return graph if made is graph else made.prune([*outputs, *inputs])


def _part(graph: Graph, types: Types, node: Node) -> str | None:
    """What a slice takes, where it is a part that goes into a concatenation."""
    joined = graph.producer(node.inputs[0])
    axis = graph.constant(joined.inputs[-1]) if joined.op == "ConcatV2" else None
    found = None if axis is None else _slice(graph, types, node, int(axis))
    if found is None:
        return None
    at, first, last = found
    start = 0
    for part in joined.inputs[:-1]:
        dims = types[part].shape
        size = None if dims is None else dims[at]
        if not isinstance(size, int):
            return None
        if (first, last) == (start, start + size):
            return part
        start += size
    return None


def slice_of_columns(graph: Graph, types: Types, node: Node) -> tuple[str, int, int] | None:
    """(tensor, first, end) where a node takes columns of a matrix, all its rows."""
    shape = types[node.inputs[0]].shape if node.op == "StridedSlice" else None
    found = None if shape is None or len(shape) != 2 else _slice(graph, types, node, 1)
    return None if found is None else (node.inputs[0], *found[1:])


def _slice(graph: Graph, types: Types, node: Node, axis: int) -> tuple[int, int, int] | None:
    """(axis, first, end) of a slice that takes all of every axis but one, of known length."""
    shape = types[node.inputs[0]].shape
    bounds = [graph.constant(r) for r in node.inputs[1:]]
    begin, end, strides = (b.tolist() if b is not None else None for b in bounds)
    if shape is None or begin is None or end is None or strides is None:
        return None
    at = axis % len(shape)
    steps, whole = strided_steps(node, len(shape), begin, end, strides), shape[at]
    if len(steps) != len(shape) or any(step not in _WHOLE for i, step in enumerate(steps) if i != at):
        return None
    if steps[at][0] != "slice" or steps[at][3] != 1 or not isinstance(whole, int):
        return None
    first, last, _ = slice(*steps[at][1:]).indices(whole)
    return at, first, max(first, last)
