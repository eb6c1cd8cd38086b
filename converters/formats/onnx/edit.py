"""A model changed in memory so that it can be compared: draws come in as inputs, inner values go out as outputs.

The source's own numbers are what everything else is judged by, so nothing else is touched; what the asked-for values do
not depend on is taken out, so that inputs which only training needs do not have to be fed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Any

import numpy as np

from converters.formats.onnx import messages
from converters.graph.nodes import reachable
from converters.graph.types import FLOAT32

_FLOAT, _INT = 1, 2  # AttributeProto.AttributeType; FLOAT is 1 in TensorProto.DataType too
_NORMAL = ("RandomNormal", "RandomNormalLike")


def lift_draws(model: Any, draws: Collection[str]) -> Any:
    """The model with N(0, 1) draws as inputs, and integer seeds (tf2onnx 1.5.5) as the floats that ONNX asks for.

    A sampler of N(mean, scale²) becomes the input times ``scale`` plus ``mean``.
    """
    wanted = frozenset(draws)
    graph = model.graph
    nodes: list[Any] = []
    for node in graph.node:
        if node.op_type not in _NORMAL or not wanted.intersection(node.output):
            _repair_seed(node)
            nodes.append(node)
            continue
        (name,) = node.output
        graph.input.append(messages.value_info(name, FLOAT32, None))
        numbers = {a.name: a.f for a in node.attribute if a.type == _FLOAT}
        moved = name
        for key, op, plain in (("scale", "Mul", 1.0), ("mean", "Add", 0.0)):
            if numbers.get(key, plain) != plain:
                value = messages.tensor(np.array(numbers[key], FLOAT32), f"{name}/{key}")
                graph.initializer.append(value)
                nodes.append(messages.node(op, [moved, value.name], [f"{name}/{op}"]))
                moved = f"{name}/{op}"
        if moved != name:
            _rename_reads(graph.node, name, moved)
    del graph.node[:]
    graph.node.extend(nodes)
    return model


def _repair_seed(node: Any) -> None:
    for attribute in node.attribute:
        if attribute.name == "seed" and attribute.type == _INT:
            attribute.f, attribute.type = float(attribute.i), _FLOAT
            attribute.ClearField("i")


def _rename_reads(nodes: Iterable[Any], old: str, new: str) -> None:
    for node in nodes:
        for index, name in enumerate(node.input):
            if name == old:
                node.input[index] = new
        for attribute in node.attribute:
            if attribute.HasField("g"):
                _rename_reads(attribute.g.node, old, new)


def cut(model: Any, fetch: Sequence[str]) -> Any:
    """The part of a model that makes the values in ``fetch``, with these as its outputs."""
    part = type(model)()
    part.CopyFrom(model)
    graph = part.graph
    makers = {output: index for index, node in enumerate(graph.node) for output in node.output if output}
    needed = reachable(fetch, lambda name: _reads(graph.node[makers[name]]) if name in makers else ())
    kept = {makers[name] for name in needed if name in makers}
    nodes = [n for i, n in enumerate(graph.node) if i in kept]
    inputs = [v for v in graph.input if v.name in needed]
    constants = [t for t in graph.initializer if t.name in needed]
    types = {v.name: v for v in (*graph.output, *graph.value_info) if v.HasField("type")}
    fresh = type(graph)(name=graph.name or "graph", node=nodes, input=inputs, initializer=constants)
    for name in dict.fromkeys(fetch):
        fresh.output.add(name=name)
        if name in types:
            fresh.output[-1].CopyFrom(types[name])
    part.graph.CopyFrom(fresh)
    return part


def _reads(node: Any) -> list[str]:
    """What a node reads, its bodies' outer values included."""
    names = [name for name in node.input if name]
    for attribute in node.attribute:
        if attribute.HasField("g"):
            body = attribute.g
            inner = {v.name for v in body.input} | {t.name for t in body.initializer}
            inner |= {o for n in body.node for o in n.output}
            outer = [r for n in body.node for r in _reads(n)] + [o.name for o in body.output]
            names.extend(r for r in outer if r not in inner)
    return names
