"""float64 numbers of a source as float32, which every target computes in: TensorFlow.js has no other floats."""

from __future__ import annotations

from typing import Any

import numpy as np
from msgspec.structs import replace

from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.types import FLOAT32
from export_model.converters.policy.facts import DOUBLES_NARROWED, SourceFacts

_FLOAT64 = np.dtype(np.float64)


def narrow_doubles(graph: Graph, facts: SourceFacts) -> tuple[Graph, SourceFacts]:
    """Return the graph in float32, and a note where anything was not. Readers that narrow themselves note the same."""
    nodes = tuple(map(_narrow, graph.nodes))
    if all(made is node for made, node in zip(nodes, graph.nodes, strict=True)):
        return graph, facts
    notes = facts.notes if DOUBLES_NARROWED in facts.notes else (*facts.notes, DOUBLES_NARROWED)
    return Graph(nodes), replace(facts, notes=notes)


def _narrow(node: Node) -> Node:
    """The node, or the same in float32; a Cast that has nothing left to do hands on."""
    if node.value is not None and node.value.dtype == _FLOAT64:
        with np.errstate(over="ignore"):
            return replace(node, value=node.value.astype(FLOAT32), attrs=_narrowed_attrs(node))
    attrs = _narrowed_attrs(node)
    if attrs is node.attrs:
        return node
    if node.op == "Cast" and attrs.get("SrcT") == attrs.get("DstT") == FLOAT32:
        return replace(node, op="Identity", attrs={"T": FLOAT32})
    return replace(node, attrs=attrs)


def _narrowed_attrs(node: Node) -> Any:
    """The attributes, themselves where none is float64."""
    attrs = {k: _narrowed_attr(v) for k, v in node.attrs.items()}
    return node.attrs if all(attrs[k] is v for k, v in node.attrs.items()) else attrs


def _narrowed_attr(value: Any) -> Any:
    if isinstance(value, np.dtype):
        return FLOAT32 if value == _FLOAT64 else value
    if isinstance(value, tuple) and any(isinstance(v, np.dtype) and v == _FLOAT64 for v in value):
        return tuple(map(_narrowed_attr, value))
    return value
