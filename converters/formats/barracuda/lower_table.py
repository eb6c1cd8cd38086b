"""Which function writes which op, which of its inputs are data, and the walk over a graph."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import numpy as np

from converters.formats.barracuda import lower_arrays as arrays
from converters.formats.barracuda import lower_elementwise as elementwise
from converters.formats.barracuda import lower_linear as linear
from converters.formats.barracuda.lower_base import NnBuilder
from converters.formats.barracuda.lower_values import Value
from converters.graph.nodes import Graph, Node, node_of, normal_ref, reachable, ref
from converters.graph.ops.base import MISFIT, misfit
from converters.graph.ops.table import op_of
from converters.graph.shapes import run_kernel
from converters.graph.types import BATCH
from signatures.errors import UnsupportedOpError

#: Takes (builder, the op's data inputs) and gives its output, or all of them.
Lower = Callable[[NnBuilder, Sequence[Value]], "Value | tuple[Value, ...]"]


def _layerless(b: NnBuilder, args: Sequence[Value]) -> Value:
    """Raise UnsupportedOpError: an op that is decomposed, in a form that cannot be."""
    raise _unknown_error(b, b.node)


_FIRST = slice(0, 1)
_ALL = slice(None)

#: Op → (function, the inputs that are data: the others are read as constants).
_OPS: Mapping[str, tuple[Lower, slice]] = {
    **dict.fromkeys(elementwise.ACTIVATIONS, (elementwise.activation, _ALL)),
    **dict.fromkeys(elementwise.FORMULAS, (elementwise.formula, _ALL)),
    **dict.fromkeys(elementwise.TWO, (elementwise.both, _ALL)),
    **dict.fromkeys(elementwise.COMPARED, (elementwise.compare, _ALL)),
    "Sub": (elementwise.subtract, _ALL),
    "RealDiv": (elementwise.divide, _ALL),
    "Pow": (elementwise.power, _ALL),
    "FloorDiv": (elementwise.floor_divide, _ALL),
    "SquaredDifference": (elementwise.squared_difference, _ALL),
    "ClipByValue": (elementwise.clip, _ALL),
    "AddN": (elementwise.add_n, _ALL),
    **dict.fromkeys(
        ("Cast", "Identity", "StopGradient", "PreventGradient", "Snapshot", "CheckNumerics"), (arrays.same, _FIRST)
    ),
    **dict.fromkeys(("Reshape", "Squeeze", "ExpandDims"), (arrays.reshape, _FIRST)),
    "Transpose": (arrays.transpose, _FIRST),
    "ConcatV2": (arrays.concat, slice(0, -1)),
    "Pack": (arrays.pack, _ALL),
    "Unpack": (arrays.unpack, _ALL),
    "Split": (arrays.split, slice(1, 2)),
    "SplitV": (arrays.split, _FIRST),
    "Slice": (arrays.slice_, _FIRST),
    "StridedSlice": (arrays.strided_slice, _FIRST),
    "Gather": (arrays.gather, slice(0, 2)),
    "GatherV2": (arrays.gather, slice(0, 2)),
    "OneHot": (_layerless, _FIRST),
    **dict.fromkeys(("Select", "SelectV2"), (_layerless, _ALL)),
    "Tile": (arrays.tile, _FIRST),
    "BroadcastTo": (arrays.broadcast_to, _FIRST),
    **dict.fromkeys(("Fill", "ZerosLike", "OnesLike"), (arrays.fill_constant, slice(0, 0))),
    **dict.fromkeys(("Pad", "PadV2"), (arrays.pad, _FIRST)),
    **dict.fromkeys(("MatMul", "BatchMatMul"), (linear.matmul, _ALL)),
    "Conv2D": (linear.conv2d, _ALL),
    **dict.fromkeys(("_FusedMatMul", "_FusedConv2D"), (linear.fused_layer, _ALL)),
    "DepthwiseConv2dNative": (linear.depthwise, _ALL),
    **dict.fromkeys(("MaxPool", "AvgPool"), (linear.pool, _FIRST)),
    **dict.fromkeys(("Sum", "Mean", *linear.REDUCED), (linear.reduce, _FIRST)),
    **dict.fromkeys(("Softmax", "LogSoftmax"), (linear.softmax, _ALL)),
    **dict.fromkeys(("ArgMax", "ArgMin"), (linear.arg_best, _FIRST)),
    "Multinomial": (linear.drawn_class, _FIRST),
    **dict.fromkeys(("RandomStandardNormal", "RandomUniform"), (linear.random, slice(0, 0))),
}

_WHY: Mapping[str, str] = {
    "Multinomial": "a drawn class is read on inside the policy, and ML-Agents draws it from the scores itself",
    "OneHot": "it takes a row of indices per agent, and gives the classes on the last axis",
    **dict.fromkeys(("Select", "SelectV2"), "it chooses an infinite number, and infinity times 0 is NaN"),
}


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
        swish = _swish_input(graph, node)
        if swish is not None:
            results: tuple[Value, ...] = (elementwise.swish(b, [_value(b, values, swish)]),)
        elif (
            node.op == "Sigmoid"
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
        if node.op not in _OPS or (node.op == "Multinomial" and not b.draws):
            b.node = node
            raise _unknown_error(b, node)
        return makers(map(normal_ref, node.inputs[_OPS[node.op][1]]))

    return reachable(makers(wanted), ahead)


def _unknown_error(b: NnBuilder, node: Node) -> UnsupportedOpError:
    if node.op == "Placeholder":
        return b.nn_error(
            "ML-Agents of those years has nothing to feed it with",
            "it feeds vectors, images, masks, the previous action, noise and memories; lists of entities "
            "and other inputs have no place in version 16 of the format",
            "give it a value with --set NAME=VALUE or its role with --input NAME=ROLE, or leave nn out of --to",
        )
    return b.nn_error("no layer computes it", _WHY.get(node.op, "no layer that every Barracuda has computes it"))


def _value(b: NnBuilder, values: dict[str, Value], reference: str) -> Value:
    reference = normal_ref(reference)
    if reference not in values:
        kind = b.type_of(reference)
        constant = kind.constant
        assert constant is not None and kind.shape is not None, reference
        values[reference] = Value(kind.shape, array=constant)
    return values[reference]


def _lower_node(b: NnBuilder, node: Node, values: dict[str, Value]) -> tuple[Value, ...]:
    function, data = _OPS[node.op]
    args = [_value(b, values, r) for r in node.inputs[data]]
    # An op that repeats a constant as often as there are agents gives what is only known when the graph runs.
    entry = op_of(node)
    if args and entry.moves != "repeat" and all(a.array is not None for a in args):
        return _compute_constant(b, node, values)
    flattens = entry.layer == "dense" and node.op != "BatchMatMul"
    try:
        result = function(b, [a if flattens else b.flatten_if_due(a) for a in args])
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


def _swish_input(graph: Graph, node: Node) -> str | None:
    """The x of x·sigmoid(x), None where the node is something else."""
    if node.op != "Mul" or len(node.inputs) != 2:
        return None
    for x, gate in (node.inputs, node.inputs[::-1]):
        made = graph.producer(gate)
        if made.op == "Sigmoid" and normal_ref(made.inputs[0]) == normal_ref(x):
            return normal_ref(x)
    return None
