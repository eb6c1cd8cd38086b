"""Ops that a target lacks, or computes otherwise, in ops that it has: each op's entry says how."""

from __future__ import annotations

from collections.abc import Collection

from converters.graph.editor import Editor
from converters.graph.nodes import Graph
from converters.graph.ops.table import op_of
from converters.graph.shapes import infer_types


def lower_for_tfjs(graph: Graph, roots: Collection[str] = ()) -> Graph:
    """Return the graph in ops that TensorFlow.js has and computes rightly; names of the nodes that stay are kept."""
    if not any(op_of(n).tfjs for n in graph.nodes):
        return graph
    types = infer_types(graph)
    editor = Editor(graph)
    for node in graph.nodes:
        rewrite = op_of(node).tfjs
        editor.keep(node if rewrite is None else rewrite(editor, node, types))
    return editor.graph()
