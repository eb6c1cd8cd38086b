"""Run a straight graph with the kernels of the op table: the numpy reference."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from converters.graph.nodes import Graph, Node, node_of, normal_ref, ref
from converters.graph.ops.base import OpDef
from converters.graph.ops.table import op_of
from converters.graph.shapes import run_kernel
from signatures.errors import GraphError

#: Functions that runtimes approximate are right to a few units in the last place (Eigen's tanh: 3 to 4).
_APPROXIMATION_ULPS = 4


def _moved(array: np.ndarray, jitter: np.random.Generator, ulps: int = 1) -> np.ndarray:
    """Every float moved up or down by ``ulps`` units in its last place; zeros stay."""
    if array.dtype.kind != "f":
        return array
    with np.errstate(all="ignore"):
        step = np.where(np.isfinite(array), np.spacing(np.abs(array)), 0) * ulps
        sign = np.where(jitter.random(array.shape) < 0.5, -1, 1)
        return np.asarray(np.where(array == 0, array, array + sign * step)).astype(array.dtype)


def _added_up(
    entry: OpDef,
    node: Node,
    arguments: Sequence[np.ndarray],
    results: Sequence[np.ndarray],
    jitter: np.random.Generator,
) -> tuple[np.ndarray, ...]:
    """Sums of products moved by what rounding every partial sum makes, where they are added one after the other.

    Partial sums of n terms walk: on average their square is half of ‖terms‖², and each is rounded by about a quarter
    of a unit, so the total is about ε/4·√n·‖terms‖. The kernel itself, run on squares, gives ‖terms‖².
    """
    if any(r.dtype.kind != "f" for r in results):
        return tuple(results)
    if not entry.layer:
        terms = arguments[0].size / max(1, results[0].size)
    else:  # the second operand is the kernel: its last axis is the result's (a transposed one has as many elements)
        terms = arguments[1].size / max(1, results[0].shape[-1])
    with np.errstate(all="ignore"):
        squares = run_kernel(entry, node, [np.square(a) if a.dtype.kind == "f" else a for a in arguments])
        moved = []
        for result, square in zip(results, squares, strict=True):
            step = np.finfo(result.dtype).eps / 4 * np.sqrt(terms * np.maximum(square, 0))
            sign = np.where(jitter.random(result.shape) < 0.5, -1, 1)
            moved.append(np.where(np.isfinite(step), result + sign * step, result).astype(result.dtype))
    return tuple(moved)


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
    jitter: np.random.Generator | None = None,
) -> dict[str, np.ndarray]:
    """Values of the tensors in ``fetch``, by the names they were asked under.

    ``feeds`` may name any tensor, not only placeholders: a recorded draw can stand for a sampler's output, and one of
    an op's outputs for itself while the others are computed. Raises GraphError when a placeholder is not fed or a
    kernel fails.

    With ``jitter`` every float that an op computes, and every term of a sum of products, is moved by one unit in its
    last place, up or down at random (Monte Carlo arithmetic), a sum by what rounding its partial sums makes, the result
    of a function that runtimes approximate by four units. How far the outputs then move is what rounding explains.
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
        if jitter is not None and entry.precision == "summed":
            arguments = [_moved(a, jitter) for a in arguments]
        results = run_kernel(entry, node, arguments)
        if jitter is not None and entry.precision == "summed":
            results = _added_up(entry, node, arguments, results, jitter)
        if jitter is not None and not entry.exact:
            ulps = _APPROXIMATION_ULPS if entry.precision == "approximate" else 1
            results = tuple(_moved(r, jitter, ulps) for r in results)
        for index, result in enumerate(results):
            values.setdefault(ref(node.name, index), result)
    return {name: values[normal_ref(name)] for name in fetch}
