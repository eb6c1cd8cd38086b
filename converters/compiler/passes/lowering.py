"""Ops that a target lacks, or computes otherwise, in ops that it has: each op's entry says how."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial

from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops.base import OpDef
from export_model.converters.graph.ops.rewriting import GraphBuilder, Tfjs
from export_model.converters.graph.ops.table import op_of
from export_model.converters.graph.shapes import Types, infer_types
from export_model.signatures.errors import UnsupportedOpError


def lower_for_tfjs(graph: Graph, roots: Collection[str] = ()) -> Graph:
    """Return the graph in ops that TensorFlow.js has and computes rightly; names of the nodes that stay are kept."""
    return _lower(graph, lambda entry: entry.tfjs)


def lower_for_conversion(graph: Graph, roots: Collection[str] = ()) -> Graph:
    """Return the graph in ops that TensorFlow 1.4 has and TensorFlow.js computes rightly, as far as there are such."""

    def rewrite_of(entry: OpDef) -> Tfjs | None:
        return None if entry.tfjs is None else partial(_rewrite_portably, entry.tfjs)

    return _lower(graph, rewrite_of, roots)


def _rewrite_portably(rewrite: Tfjs, builder: GraphBuilder, node: Node, types: Types) -> Node:
    try:
        made = rewrite(builder, node, types)
    except UnsupportedOpError:  # TensorFlow has it all the same
        return node
    return node if op_of(made).since is not None else made


def lower_for_nn(graph: Graph, roots: Collection[str] = ()) -> Graph:
    """Return the graph in ops that a ``.nn`` of Barracuda 1.0 has, where an op's entry says how."""
    return _lower(graph, lambda e: e.barracuda.write if e.barracuda is not None and e.barracuda.nn else None)


def lower_for_importers(graph: Graph, misread: Collection[str] = ()) -> Graph:
    """Return the graph in ops that every importer of Unity's reads rightly, where an op's entry says how.

    Rewritten, too, is what would become one of the ONNX ops ``misread``.
    """

    def rewrite_of(entry: OpDef) -> Tfjs | None:
        how = entry.barracuda
        return how.write if how is not None and (how.everywhere or how.onnx in misread) else None

    return _lower(graph, rewrite_of)


def _lower(graph: Graph, rewrite_of: Callable[[OpDef], Tfjs | None], roots: Collection[str] = ()) -> Graph:
    if not any(rewrite_of(op_of(n)) for n in graph.nodes):
        return graph
    types = infer_types(graph)
    editor = Editor(graph)
    for node in graph.nodes:
        rewrite = rewrite_of(op_of(node))
        editor.keep(node if rewrite is None else rewrite(editor, node, types))
    return editor.prune(roots) if roots else editor.graph()
