"""Outputs of which a sampler decides some columns only: a memory with the drawn action behind it (``--for unity6``)."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from converters.compiler.passes.normalise import normalise
from converters.graph.nodes import Graph
from converters.graph.ops.samplers import SAMPLERS
from converters.graph.ops.table import passes_on, traits
from converters.graph.shapes import Types, infer_types


def drawn_columns(graph: Graph, outputs: Collection[str]) -> dict[str, np.ndarray]:
    """Return output → which columns (of the last axis) a sampler decides, for outputs that have both kinds.

    An output that no sampler decides, one that hangs on it throughout, and one whose columns cannot be told apart are
    left out.
    """
    drawn = graph.descendants(n.name for n in graph.nodes if n.op in SAMPLERS)
    asked = [name for name in outputs if name in drawn]
    if not asked:
        return {}
    # A bundle's own .bytes leaves out the attributes that TF 1.4 does not know (a draw's output_dtype).
    graph = normalise(graph.prune(asked), asked)
    drawn = graph.descendants(n.name for n in graph.nodes if n.op in SAMPLERS)
    types = infer_types(graph)
    columns = {name: _columns(graph, types, drawn, name) for name in asked}
    return {name: mask for name, mask in columns.items() if mask is not None and not mask.all()}


def without_draws(array: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return ``array`` with zeros for the finite numbers of the columns that ``mask`` marks."""
    if not array.ndim or array.shape[-1] != mask.size:
        return array
    return np.where(mask & np.isfinite(array), array.dtype.type(0), array)


def _columns(graph: Graph, types: Types, drawn: Collection[str], name: str) -> np.ndarray | None:
    shape = types[name].shape
    if not shape or not isinstance(shape[-1], int):
        return None
    width, node = shape[-1], graph.producer(name)
    if node.name not in drawn:
        return np.zeros(width, bool)
    parts: list[np.ndarray | None] = [None]
    if passes_on(node) or (traits(node).elementwise and len(node.inputs) == 1):
        parts = [_columns(graph, types, drawn, node.inputs[0])]
    elif node.op == "ConcatV2" and _last_axis(types, node.inputs[-1], len(shape)):
        parts = [_columns(graph, types, drawn, part) for part in node.inputs[:-1]]
    known = [part for part in parts if part is not None]
    whole = np.concatenate(known) if len(known) == len(parts) else np.ones(0, bool)
    return whole if whole.size == width else np.ones(width, bool)


def _last_axis(types: Types, axis: str, rank: int) -> bool:
    value = types[axis].value
    return value is not None and int(value) in (-1, rank - 1)
