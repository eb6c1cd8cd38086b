"""A policy's graph as layers: each op's entry says how it is written (``OpDef.nn``), here is the way through them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from export_model.converters.graph.nodes import Graph, Node, node_of, normal_ref, reachable, ref
from export_model.converters.graph.ops.barracuda.builder import NnBuilder
from export_model.converters.graph.ops.barracuda.elementwise import swish
from export_model.converters.graph.ops.barracuda.values import Value
from export_model.converters.graph.ops.base import MISFIT, OpDef, misfit
from export_model.converters.graph.ops.table import is_fed, op_of, traits
from export_model.converters.graph.shapes import run_kernel
from export_model.converters.graph.types import BATCH
from export_model.signatures.errors import UnsupportedOpError


def lower_graph(b: NnBuilder, graph: Graph, given: dict[str, Value], wanted: Iterable[str]) -> dict[str, Value]:
    """The tensors ``wanted``, by reference, and everything that they need. ``given`` are the placeholders.

    Raises UnsupportedOpError where an op, or a form of it, cannot be written.
    """
    wanted = [normal_ref(r) for r in wanted]
    values = dict(given)
    needed = _needed_nodes(b, graph, wanted, given)
    consumers = graph.consumers()
    for node in graph.nodes:
        if node.name not in needed or node.name in given:
            continue
        b.node = node
        gated = _swish_input(graph, node)
        if gated is not None:
            results: tuple[Value, ...] = (swish(b, [_value(b, values, gated)]),)
        elif (
            _is_gate(node)
            and all(_swish_input(graph, n) is not None for n in consumers[node.name])
            and (node.name not in wanted and consumers[node.name])
        ):
            continue  # every reader multiplies it with its own input
        else:
            results = _lower_node(b, node, values)
        for index, value in enumerate(results):
            values[ref(node.name, index)] = value
    return {r: _value(b, values, r) for r in wanted}


def _needed_nodes(b: NnBuilder, graph: Graph, wanted: Iterable[str], given: dict[str, Value]) -> set[str]:
    """The nodes that data comes from; what is known before the graph runs is a constant and ends the search."""

    def makers(references: Iterable[str]) -> Iterator[str]:
        return (node_of(r) for r in references if b.type_of(r).constant is None)

    def ahead(name: str) -> Iterable[str]:
        if name in given:
            return ()
        node = graph[name]
        entry = traits(node)
        if entry.nn is None or (entry.sampler == "categorical" and not b.draws):
            b.node = node
            raise _unknown_error(b, node)
        return makers(map(normal_ref, _data_of(entry, node)))

    return reachable(makers(wanted), ahead)


def _data_of(entry: OpDef, node: Node) -> Sequence[str]:
    """The operands that are data, by reference."""
    assert entry.nn is not None
    if entry.nn.data is None:
        return entry.data_operands(node.inputs) if entry.moves else node.inputs
    return node.inputs[slice(*entry.nn.data)]


def _unknown_error(b: NnBuilder, node: Node) -> UnsupportedOpError:
    entry = traits(node)
    if is_fed(node):
        return b.nn_error(
            "ML-Agents of those years has nothing to feed it with",
            "it feeds vectors, images, masks, the previous action, noise and memories; lists of entities "
            "and other inputs have no place in version 16 of the format",
            "give it a value with --set NAME=VALUE or its role with --input NAME=ROLE, or leave nn out of --to",
        )
    why = "" if entry.nn is None else entry.nn.why
    return b.nn_error("no layer computes it", why or "no layer that every Barracuda has computes it")


def _value(b: NnBuilder, values: dict[str, Value], reference: str) -> Value:
    reference = normal_ref(reference)
    if reference not in values:
        kind = b.type_of(reference)
        constant = kind.constant
        assert constant is not None and kind.shape is not None, reference
        values[reference] = Value(kind.shape, array=constant)
    return values[reference]


def _lower_node(b: NnBuilder, node: Node, values: dict[str, Value]) -> tuple[Value, ...]:
    entry = op_of(node)
    nn = entry.nn
    assert nn is not None
    args = [_value(b, values, r) for r in _data_of(entry, node)]
    # An op that repeats a constant as often as there are agents gives what is only known when the graph runs.
    if args and entry.moves != "repeat" and all(a.array is not None for a in args):
        return _compute_constant(b, node, values)
    if nn.lower is None:
        raise _unknown_error(b, node)
    try:
        result = nn.lower(b, [a if nn.takes_images else b.flatten_if_due(a) for a in args])
    except MISFIT as error:
        raise misfit(node, error) from error
    return result if isinstance(result, tuple) else (result,)


def _compute_constant(b: NnBuilder, node: Node, values: dict[str, Value]) -> tuple[Value, ...]:
    """What depends on no input: one row of it, which is the same for every agent."""
    entry = op_of(node)
    operands = []
    for reference in node.inputs:
        value = (
            _value(b, values, reference)
            if b.type_of(reference).constant is not None or (normal_ref(reference) in values)
            else None
        )
        if value is None or value.array is None or entry.kernel is None:
            raise b.nn_error("it repeats a constant by a number that is computed", "lengths are known in a .nn")
        operands.append(np.asarray(value.array))
    made = itertools.takewhile(b.types.__contains__, (ref(node.name, i) for i in itertools.count()))
    shapes = [b.shape_of(r) for r in made]
    b.made_up(sum(math.prod(d for d in shape if isinstance(d, int)) for shape in shapes))
    arrays_ = run_kernel(entry, node, operands)
    for array, shape in zip(arrays_, shapes, strict=True):
        if [1 if d == BATCH else d for d in shape] != list(array.shape):
            raise b.nn_error(f"a constant of shape {list(shape)}", "its rows are not the same for every agent")
    return tuple(Value(s, array=a) for s, a in zip(shapes, arrays_, strict=True))


def _is_gate(node: Node) -> bool:
    return traits(node).activation == "sigmoid"


def _swish_input(graph: Graph, node: Node) -> str | None:
    """The x of x·sigmoid(x), None where the node is something else."""
    if traits(node).operand != "factor" or len(node.inputs) != 2:
        return None
    for x, gate in (node.inputs, node.inputs[::-1]):
        made = graph.producer(gate)
        if _is_gate(made) and normal_ref(made.inputs[0]) == normal_ref(x):
            return normal_ref(x)
    return None
