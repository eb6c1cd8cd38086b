"""int8 weights in TensorFlow.js, whose files know no step for each output of a layer: the model multiplies by them.

Of a dense layer its product is multiplied, which is as wide as the layer, and not its matrix, which has as many times
that as the layer has inputs: ``x·(steps × step)`` is ``(x·steps) × step`` but for rounding. The bias is added after
that, as it is, so that it keeps every digit. A convolution's kernel is multiplied itself: its result is larger than it.

The matrix itself is a node all the same, which nothing reads: who looks inside finds it, to the bit
(``join_products``).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from export_model.converters.compiler.passes.weights import are_steps, compact
from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node


def multiply_products(graph: Graph, roots: Collection[str] = ()) -> Graph:
    """Return the graph with weights that were rounded as whole numbers, multiplied where it costs least."""
    readers = graph.consumers()
    editor = Editor(graph)
    steps: dict[str, tuple[str, str]] = {}
    for node in graph.nodes:
        found = None if node.value is None else compact(node.value, "int8")
        if found is not None and found[1] is not None:
            narrow = editor.const(found[0].astype(np.float32), f"{node.name}/int8")
            scale = editor.const(found[1], f"{node.name}/step")
            editor.keep(Node(node.name, "Mul", (narrow, scale), origin=node.origin))
            if _are_products(node.name, found[1], readers[node.name]):
                steps[node.name] = narrow, scale
        elif len(node.inputs) > 1 and node.inputs[1] in steps:
            narrow, scale = steps[node.inputs[1]]
            product = editor.append(node.rewire(editor.add_name(f"{node.name}/product"), (node.inputs[0], narrow)))
            editor.keep(Node(node.name, "Mul", (product, scale), origin=node.origin))
        else:
            editor.keep(node)
    return editor.graph()


def _are_products(name: str, step: np.ndarray, readers: Sequence[Node]) -> bool:
    """Whether all that read a matrix are products with a step for each of their columns."""
    return (
        step.ndim == 2
        and step.shape[0] == 1
        and all(r.op == "MatMul" and r.inputs[1] == name != r.inputs[0] and not _is_turned(r) for r in readers)
    )


def join_products(graph: Graph) -> Graph:
    """Return the graph with the matrices in their products again; whoever may have written it."""
    whole = {node.inputs: node.name for node in graph.nodes if _is_matrix(graph, node)}
    if not whole:
        return graph
    editor = Editor(graph)
    for node in graph.nodes:
        product = graph.producer(node.inputs[0]) if node.op == "Mul" and len(node.inputs) == 2 else node
        plain = product.op == "MatMul" and len(product.inputs) == 2 and not _is_turned(product)
        matrix = whole.get((product.inputs[1], node.inputs[1])) if product is not node and plain else None
        editor.keep(node if matrix is None else product.rewire(node.name, (product.inputs[0], matrix)))
    return editor.graph()


def _is_matrix(graph: Graph, node: Node) -> bool:
    """Whether a node is steps times a step for each of their columns."""
    if node.op != "Mul" or len(node.inputs) != 2:
        return False
    value, step = map(graph.constant, node.inputs)
    if value is None or step is None or value.ndim != 2 or step.shape != (1, value.shape[1]):
        return False
    return are_steps(value)


def _is_turned(product: Node) -> bool:
    return bool(product.attrs.get("transpose_a") or product.attrs.get("transpose_b"))
