"""A model changed in memory so that it can be compared: draws come in as inputs, inner values go out as outputs.

The source's own numbers are what everything else is judged by, so nothing else is touched; what the asked-for values do
not depend on is taken out, so that inputs which only training needs do not have to be fed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from export_model.converters.formats.intermediate_tensors import Sampler
from export_model.converters.formats.onnx.messages import node as new_node
from export_model.converters.formats.onnx.messages import tensor, value_info
from export_model.converters.graph.nodes import reachable
from export_model.converters.graph.types import FLOAT32

_FLOAT, _INT = 1, 2  # AttributeProto.AttributeType; FLOAT is 1 in TensorProto.DataType too
_INT64 = 7  # TensorProto.DataType
_KINDS = {
    "RandomNormal": "normal",
    "RandomNormalLike": "normal",
    "RandomUniform": "uniform",
    "RandomUniformLike": "uniform",
    "Multinomial": "categorical",
}


def samplers_of(model: Any) -> tuple[Sampler, ...]:
    """The samplers of a model's own graph that one draw per class or number comes from."""
    found = []
    for node in model.graph.node:
        kind = _KINDS.get(node.op_type, "")
        numbers = {a.name: a.f for a in node.attribute if a.type == _FLOAT}
        mean, scale = numbers.get("mean", 0.0), numbers.get("scale", 1.0)
        if kind == "uniform":
            mean = numbers.get("low", 0.0)
            scale = numbers.get("high", 1.0) - mean
        if kind:
            scores = node.input[0] if kind == "categorical" else None
            long = any(a.name == "dtype" and a.i == _INT64 for a in node.attribute)
            dtype = "float32" if scores is None else "int64" if long else "int32"
            found.append(Sampler(node.output[0], kind, scores, mean, scale, dtype))
    return tuple(found)


def lift_draws(model: Any, draws: Collection[str] | Mapping[str, int]) -> Any:
    """The model with draws as inputs, of ranks that may be known, and integer seeds (tf2onnx 1.5.5) as floats.

    A sampler of N(mean, scale²) becomes the input times ``scale`` plus ``mean``, one of other numbers likewise.
    """
    samplers = {sampler.tensor: sampler for sampler in samplers_of(model)}
    wanted, ranks = frozenset(draws), draws if isinstance(draws, Mapping) else {}
    graph = model.graph
    nodes: list[Any] = []
    for node in graph.node:
        if node.op_type not in _KINDS or not wanted.intersection(node.output):
            repair_seed(node)
            nodes.append(node)
            continue
        (name,) = node.output
        sampler = samplers[name]
        dims = [f"{name}/{axis}" for axis in range(ranks[name])] if name in ranks else None
        graph.input.append(value_info(name, np.dtype(sampler.dtype), dims))
        moved = name
        for key, op, number, plain in (("scale", "Mul", sampler.scale, 1.0), ("mean", "Add", sampler.mean, 0.0)):
            if number != plain:
                value = tensor(np.array(number, FLOAT32), f"{name}/{key}")
                graph.initializer.append(value)
                nodes.append(new_node(op, [moved, value.name], [f"{name}/{op}"]))
                moved = f"{name}/{op}"
        if moved != name:
            _rename_reads(graph.node, name, moved)
    del graph.node[:]
    graph.node.extend(nodes)
    return model


def repair_seed(node: Any) -> None:
    """Make an integer seed (tf2onnx 1.5.5) the float that ONNX says, in place."""
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
