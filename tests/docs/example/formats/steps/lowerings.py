"""Ops as steps. What is not here is refused by name."""

from __future__ import annotations

from typing import Any

from export_model.converters.graph.nodes import Graph, Node
from export_model.signatures.errors import UnsupportedOpError

#: Op → the step that computes it number by number; an operand of one number is repeated.
STEPS = {
    "Add": "add",
    "BiasAdd": "add",
    "Sub": "subtract",
    "Mul": "multiply",
    "RealDiv": "divide",
    "Maximum": "larger",
    "Minimum": "smaller",
    "SquaredDifference": "squared_difference",
    "Square": "square",
    "Tanh": "tanh",
    "Sigmoid": "sigmoid",
    "Relu": "relu",
    "Identity": "same",
}


def lower(node: Node, graph: Graph) -> dict[str, Any]:
    """Return the step that a node becomes. Raises UnsupportedOpError."""
    if node.op == "Placeholder" and node.dims is not None and len(node.dims) == 2:
        return {"name": node.name, "do": "input", "width": node.dims[1]}
    if node.value is not None and node.value.ndim < 2:
        return {"name": node.name, "do": "numbers", "numbers": node.value.reshape(-1).tolist()}
    if node.op in STEPS:
        return {"name": node.name, "do": STEPS[node.op], "of": list(node.inputs)}
    kernel = graph.constant(node.inputs[1]) if node.op == "MatMul" else None
    if kernel is not None:
        return {"name": node.name, "do": "product", "of": [node.inputs[0]], "kernel": kernel.tolist()}
    raise UnsupportedOpError(
        f"no step computes {node.op} (node {node.name!r})",
        issues=[(node.name, node.op)],
        fix="leave steps out of --to",
    )
