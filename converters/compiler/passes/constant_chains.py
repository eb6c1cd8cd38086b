"""Arithmetic in fewer ops, for runtimes in which the start of an op is most of its cost.

Factors in a row are one factor, summands one summand; a factor of 1 and a summand of 0 are none; what is computed twice
is computed once; the square of a difference is one op. Results are rounded once where they were rounded twice.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable

import numpy as np

from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node, node_of, ref, split_ref
from export_model.converters.graph.ops.table import op_of
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import FLOAT32

#: A constant above as many elements is left alone, and not compared with others.
_SMALL = 1 << 12
#: What two summands may cancel of each other: whoever adds 2²³ and takes it away again wants the rounding.
_CANCELLED = 8
#: How much of the smaller one may be lost: where a tensor takes the larger away again, a logarithm hangs on the rest.
_LOST = 2.0**-20


def share(graph: Graph, roots: Iterable[str]) -> Graph:
    """The graph with one node for those that compute the same of the same."""
    outputs, editor = {node_of(r) for r in roots}, Editor(graph)
    readers = graph.consumers()
    known: dict[Hashable, str] = {}
    for node in graph.nodes:
        entry = op_of(node)
        if entry.start == "fed" or entry.sampler or (node.value is not None and node.value.size > _SMALL):
            editor.keep(node)
            continue
        given = tuple(editor.resolve(r) for r in node.inputs)
        key: Hashable = (node.op, given, tuple(sorted((k, repr(v)) for k, v in node.attrs.items())))
        if node.value is not None:
            key = (node.value.dtype.str, node.value.shape, node.value.tobytes())
        same = known.setdefault(key, node.name)
        if same == node.name or node.name in outputs:
            editor.keep(node)
        else:
            for reference in {r for reader in readers[node.name] for r in reader.inputs if node_of(r) == node.name}:
                editor.redirect(reference, ref(same, split_ref(reference)[1]))
    return editor.prune(outputs)


def merge_constants(graph: Graph, roots: Iterable[str]) -> Graph:
    """The graph with chains of factors, and of summands, that are constants merged, and neutral ones left out."""
    outputs, editor = {node_of(r) for r in roots}, Editor(graph)
    types, readers = infer_types(graph), graph.consumers()
    chains: dict[str, tuple[str, str, np.ndarray]] = {}
    for node in graph.nodes:
        found = _operand(graph, node)
        if found is None:
            editor.keep(node)
            continue
        kind, value, number = found
        before = chains.get(value)
        if before is not None and before[0] == kind and len(readers[value]) == 1 and value not in outputs:
            merged = _merge(kind, before[2], number)
            if merged is not None:
                value, number = before[1], merged
        chains[node.name] = (kind, value, number)
        neutral = bool((number == (1 if kind == "Mul" else 0)).all())
        shape = types[value].shape
        if neutral and shape is not None and shape == types[node.name].shape and node.name not in outputs:
            editor.redirect(node.name, editor.resolve(value))
        elif value == found[1]:
            editor.keep(node)
        else:
            operand = editor.const(number.astype(FLOAT32), f"{node.name}/constant")
            editor.keep(Node(node.name, kind, (value, operand), origin=node.origin))
    return editor.prune(outputs)


def drop_zero_biases(graph: Graph, roots: Iterable[str]) -> Graph:
    """The graph without the biases that are zeros: what is read as a sum with zeros has none either."""
    outputs, editor = {node_of(r) for r in roots}, Editor(graph)
    for node in graph.nodes:
        bias = graph.constant(node.inputs[1]) if node.op == "BiasAdd" and node.name not in outputs else None
        if bias is None or bias.any():
            editor.keep(node)
        else:
            editor.redirect(node.name, editor.resolve(node.inputs[0]))
    return editor.prune(outputs)


def square_differences(graph: Graph, roots: Iterable[str]) -> Graph:
    """The graph with SquaredDifference for a Square of a Sub that nothing else reads."""
    outputs, readers = {node_of(r) for r in roots}, graph.consumers()
    editor = Editor(graph)
    for node in graph.nodes:
        inner = graph.producer(node.inputs[0]) if node.op == "Square" else None
        if inner is None or inner.op != "Sub" or len(readers[inner.name]) > 1 or inner.name in outputs:
            editor.keep(node)
        else:
            editor.keep(Node(node.name, "SquaredDifference", inner.inputs, origin=node.origin))
    return editor.prune(outputs)


def _operand(graph: Graph, node: Node) -> tuple[str, str, np.ndarray] | None:
    """("Mul" or "Add", tensor, constant in float64) of a node that multiplies a tensor by a constant, or adds one."""
    kind = op_of(node).operand
    if not kind:
        return None
    left, right = (graph.constant(r) for r in node.inputs)
    if kind in ("factor", "summand") and right is None:
        value, number = node.inputs[1], left
    else:
        value, number = node.inputs[0], right if left is None else None
    if number is None or number.dtype != FLOAT32 or number.size > _SMALL or not np.isfinite(number).all():
        return None
    wide = number.astype(np.float64)
    if kind == "divisor":
        return ("Mul", value, 1 / wide) if wide.all() else None
    return ("Mul" if kind == "factor" else "Add"), value, -wide if kind == "subtrahend" else wide


def _merge(kind: str, first: np.ndarray, second: np.ndarray) -> np.ndarray | None:
    """One constant in place of two; None where float32 has none that does the same, or rounding is what they do."""
    try:
        made = first * second if kind == "Mul" else first + second
    except ValueError:  # they broadcast against the tensor, and not against each other
        return None
    if made.size > _SMALL:
        return None
    size = np.abs(made)
    if kind == "Mul":
        limits = np.finfo(FLOAT32)
        fine = (size == 0) | ((size > limits.tiny) & (size < limits.max))
    else:
        least = np.minimum(np.abs(first), np.abs(second))
        fine = size * _CANCELLED >= np.maximum(np.abs(first), np.abs(second))
        fine &= np.abs(made.astype(FLOAT32) - made) <= least * _LOST
    return made if bool(fine.all()) else None
