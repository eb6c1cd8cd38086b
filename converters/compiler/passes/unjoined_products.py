"""Sums behind products in a form that no converter joins with them, for what comes of a SavedModel elsewhere.

The official ``tensorflowjs_converter`` (4.22) lets TensorFlow's remapper (grappler, 2.21) make one op of a product, its
bias and an activation, whether TensorFlow.js has a kernel for it or not: cpu and wasm throw for tanh and for a GELU in
``_FusedMatMul`` and for a hard swish in ``_FusedConv2D``, and wasm adds the bias of a transposed product wrongly.
Before that it turns an ``Add`` whose first operand is a product into ``BiasAdd`` (normalize_bias_add.py), the sum of a
recurrent cell's two products, too, which wasm refuses: its biases are vectors.

The remapper looks for ``BiasAdd`` and ``Add``. So a bias is subtracted with its sign turned, which is the same number
to the bit, and a sum of two tensors is ``AddN``. Sums that TensorFlow.js has a kernel for stay as they are.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops.table import op_of, traits
from export_model.converters.graph.shapes import Types, infer_types

Readers = Mapping[str, list[Node]]


def keep_products_unjoined(graph: Graph, roots: Collection[str] = ()) -> Graph:
    """Return the graph with each sum that must not be joined written as ``Sub`` or ``AddN``, under its own name."""
    sums = {n.name: p for n in graph.nodes if _is_sum(n) and (p := _product(graph, n)) is not None}
    if not sums:
        return graph
    types, readers, editor = infer_types(graph), graph.consumers(), Editor(graph)
    for node in graph.nodes:
        product = sums.get(node.name)
        editor.keep(node if product is None else _rewrite_sum(editor, node, product, types, readers))
    return editor.prune(roots)


def rejoin_biases(graph: Graph) -> Graph:
    """Return a graph of ours with the biases that were subtracted from products added again."""
    editor = Editor(graph)
    for node in graph.nodes:
        bias = _subtracted_bias(graph, node)
        if bias is not None:
            node = Node(node.name, "BiasAdd", (node.inputs[0], _add_negative(editor, node, bias)), origin=node.origin)
        editor.keep(node)
    return editor.graph()


def _subtracted_bias(graph: Graph, node: Node) -> np.ndarray | None:
    """What a ``Sub`` takes off a product of a known width, a number of each column; a damaged one takes nothing off."""
    product = _product(graph, node) if node.op == "Sub" and len(node.inputs) == 2 else None
    if product is None or len(product.inputs) != 2:
        return None
    kernel, bias = (graph.constant(each.inputs[1]) for each in (product, node))
    if kernel is None or kernel.ndim < 2 or bias is None:
        return None
    return bias if bias.shape == (kernel.shape[0 if product.attrs.get("transpose_b") else -1],) else None


def _is_sum(node: Node) -> bool:
    return node.op == "BiasAdd" or traits(node).operand == "summand"


def _product(graph: Graph, node: Node) -> Node | None:
    """The matrix product or convolution that a sum reads, its first operand or, where that is none, its second."""
    for reference in node.inputs:
        made = graph.get(reference)
        if made is not None and traits(made).layer in ("dense", "convolution") and made.op != "BatchMatMul":
            return made
    return None


def _rewrite_sum(editor: Editor, node: Node, product: Node, types: Types, readers: Readers) -> Node:
    if node.attrs.get("data_format", "NHWC") != "NHWC":
        return node
    other = next((r for r in node.inputs if r != product.name), product.name)
    bias, (mine, theirs) = editor.constant_of(other), (types[r].shape for r in (product.name, other))
    if bias is None:
        if node.op != "BiasAdd" and mine is not None and mine == theirs:
            return Node(node.name, "AddN", node.inputs, origin=node.origin)
        return node
    plain = node.op == "BiasAdd" or (bias.ndim == 1 and mine is not None and bias.shape == mine[-1:])
    if plain and not _is_misread(editor, node, product, readers):
        return node
    return Node(node.name, "Sub", (product.name, _add_negative(editor, node, bias)), origin=node.origin)


def _is_misread(editor: Editor, node: Node, product: Node, readers: Readers) -> bool:
    """Whether TensorFlow.js has no right kernel for a product joined with its bias and what follows."""
    if product.attrs.get("transpose_a") or product.attrs.get("transpose_b"):
        return True
    layer, following = op_of(product).layer, readers[node.name]
    behind = (
        reader
        for each in following
        if op_of(each).operand and any(editor.constant_of(r) is not None for r in each.inputs)
        for reader in readers[each.name]
    )
    return any(op_of(n).remapped == layer for n in following) or any(op_of(n).remapped_behind == layer for n in behind)


def _add_negative(editor: Editor, node: Node, bias: np.ndarray) -> str:
    return editor.const(-bias, f"{node.name}/negative")
