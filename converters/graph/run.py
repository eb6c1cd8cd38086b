"""Run a straight graph with the kernels of the op table: the numpy reference."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

import numpy as np
from msgspec import Struct

from export_model.converters.graph.jitter import Jitter
from export_model.converters.graph.nodes import Graph, Node, node_of, normal_ref, reachable, ref
from export_model.converters.graph.ops.base import OpDef
from export_model.converters.graph.ops.table import op_of
from export_model.converters.graph.shapes import run_kernel_as_it_is
from export_model.signatures.errors import GraphError


def _upstream_nodes(graph: Graph, fetch: Sequence[str], fed: Collection[str]) -> set[str]:
    """Names of the nodes that must be computed: those upstream of ``fetch``, not behind tensors that are fed."""

    def makers(references: Iterable[str]) -> Iterator[str]:
        return (node_of(r) for r in references if r not in fed)

    return reachable(makers(map(normal_ref, fetch)), lambda name: makers(graph[name].inputs))


class _Plan(Struct, frozen=True):
    """What is to be computed for some tensors, where some are fed."""

    constants: Mapping[str, np.ndarray]
    #: each with the tensors that nothing after it reads
    steps: Sequence[tuple[OpDef, Node, Sequence[str]]]


def _plan(graph: Graph, fed: Collection[str], fetch: Sequence[str]) -> _Plan:
    """The graph's own for these tensors: a policy is run hundreds of times for the same ones."""
    key = _plan, tuple(fed), tuple(fetch)
    if key not in graph.cache:
        needed = _upstream_nodes(graph, fetch, fed)
        constants, steps = dict[str, np.ndarray](), list[Node]()
        for node in graph.nodes:
            if node.name not in needed:
                continue
            if node.op == "Placeholder":
                raise GraphError(
                    f"the input {node.name!r} is not fed", fix="feed every input that the outputs asked for depend on"
                )
            if node.op == "Const":
                assert node.value is not None
                constants[node.name] = node.value
            else:
                steps.append(node)
        last = {r: number for number, node in enumerate(steps) for r in node.inputs}
        kept = {*constants, *map(normal_ref, fetch)}
        done: list[list[str]] = [[] for _ in steps]
        for reference, number in last.items():
            if reference not in kept:
                done[number].append(reference)
        graph.cache[key] = _Plan(constants, [(op_of(n), n, d) for n, d in zip(steps, done, strict=True)])
    plan: _Plan = graph.cache[key]
    return plan


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
    plan = _plan(graph, values, fetch)
    values = {**plan.constants, **values}
    with np.errstate(all="ignore"):  # infinities and NaNs are numbers to a model
        for entry, node, done in plan.steps:
            arguments = [values[r] for r in node.inputs]
            if jitter is not None:
                arguments = jitter.operands(entry, arguments)
            results: Sequence[np.ndarray] = run_kernel_as_it_is(entry, node, arguments)
            if jitter is not None:
                results = jitter.results(entry, node, arguments, results)
            for index, result in enumerate(results):
                values.setdefault(ref(node.name, index), result)
            for reference in done:  # thousands of rows of every tensor at once do not fit into a child
                del values[reference]
    return {name: values[normal_ref(name)] for name in fetch}
