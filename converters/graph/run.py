"""Run a straight graph with the kernels of the op table: the numpy reference."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from converters.graph.jitter import Jitter
from converters.graph.nodes import Graph, node_of, normal_ref, ref
from converters.graph.ops.table import op_of
from converters.graph.shapes import run_kernel
from signatures.errors import GraphError


def _needed(graph: Graph, fetch: Sequence[str], fed: Collection[str]) -> set[str]:
    """Names of the nodes that must be computed: those upstream of ``fetch``, not behind tensors that are fed."""
    needed: set[str] = set()
    stack = [normal_ref(name) for name in fetch]
    while stack:
        reference = stack.pop()
        if reference in fed or node_of(reference) in needed:
            continue
        needed.add(node_of(reference))
        stack.extend(graph.producer(reference).inputs)
    return needed


def run_graph(
    graph: Graph,
    feeds: Mapping[str, np.ndarray],
    fetch: Sequence[str],
    jitter: Jitter | None = None,
) -> dict[str, np.ndarray]:
    """Values of the tensors in ``fetch``, by the names they were asked under.

    ``feeds`` may name any tensor, not only placeholders: a recorded draw can stand for a sampler's output, and one of
    an op's outputs for itself while the others are computed. Raises GraphError when a placeholder is not fed or a
    kernel fails.

    With ``jitter`` whatever an op computes is moved as far as rounding may move it, at random (Monte Carlo arithmetic).
    How far the outputs then move is what rounding explains.
    """
    values: dict[str, np.ndarray] = {normal_ref(name): array for name, array in feeds.items()}
    needed = _needed(graph, fetch, values)
    for node in graph.nodes:
        if node.name not in needed:
            continue
        if node.op == "Placeholder":
            raise GraphError(
                f"the input {node.name!r} is not fed", fix="feed every input that the outputs asked for depend on"
            )
        if node.op == "Const":
            assert node.value is not None
            values[node.name] = node.value
            continue
        entry = op_of(node)
        arguments = [values[r] for r in node.inputs]
        if jitter is not None:
            arguments = jitter.operands(entry, arguments)
        results: Sequence[np.ndarray] = run_kernel(entry, node, arguments)
        if jitter is not None:
            results = jitter.results(entry, node, arguments, results)
        for index, result in enumerate(results):
            values.setdefault(ref(node.name, index), result)
    return {name: values[normal_ref(name)] for name in fetch}
