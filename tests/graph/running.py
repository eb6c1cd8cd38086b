"""Graphs that are computed with the numpy kernels, before a pass and after it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.types import FLOAT32, INT32
from tests.graph.harness import Array
from tests.graph.making import const, graph, node, placeholder
from tests.graph.samples import f32, floats


def values(made: Graph, feeds: Mapping[str, Array], *names: str) -> list[Array]:
    results = run_graph(made, feeds, names)
    return [results[n] for n in names]


def value(made: Graph, feeds: Mapping[str, Array], name: str) -> Array:
    return values(made, feeds, name)[0]


def same_values(before: Graph, after: Graph, feeds: Mapping[str, Array], moved: Mapping[str, str]) -> None:
    """Fetches of the new graph have the values that they had in the old one, dtypes and shapes too."""
    for old, new in moved.items():
        np.testing.assert_array_equal(value(after, feeds, new), value(before, feeds, old), strict=True)


def gaussian(*, in_graph: bool, scale: Node | None = None, tail: str = "Tanh") -> Graph:
    """``action = tanh(x·W + σ·ε)`` with ε fed or drawn in the graph."""
    source = (
        [
            node("rows", "Shape", "mu", out_type=INT32),
            node("epsilon", "RandomStandardNormal", "rows", dtype=FLOAT32, seed=3),
        ]
        if in_graph
        else [placeholder("epsilon", (None, 2))]
    )
    return graph(
        placeholder("x", (None, 3)),
        const("weights", floats(3, 2)),
        node("mu", "MatMul", "x", "weights"),
        scale or const("sigma", f32(0.5, 2)),
        *source,
        node("noise", "Mul", "epsilon", "sigma"),
        node("sample", "Add", "mu", "noise"),
        node("action", tail, "sample"),
    )


def mean(x: Array) -> Array:
    return np.tanh(x.astype(np.float64) @ floats(3, 2)).astype(np.float32)
