"""Several rows, tried: what they give together is what each gives alone.

A constant that was made for one row (torch's ``arange`` over the batch, an index) cannot be told from any other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from converters.graph.nodes import Graph, TensorShape, node_of
from converters.graph.ops.samplers import SAMPLERS
from converters.graph.passes.normalise import normalise
from converters.graph.run import run_graph
from converters.graph.shapes import infer_types
from converters.graph.types import TensorType
from signatures.errors import SignatureError

ROWS = 3
#: Numbers that the trial may make: all tensors of all rows together. A policy has some thousands, a camera's a million.
MAX_NUMBERS = 1 << 24


def check_rows(graph: Graph, outputs: Sequence[str]) -> None:
    """Raise SignatureError that names the first output which is wrong for more rows than one."""
    drawn = graph.descendants(n.name for n in graph.nodes if n.op in SAMPLERS)
    judged = [o for o in outputs if node_of(o) not in drawn]
    if not judged:
        return
    graph = normalise(graph.pruned(judged), judged)
    types = infer_types(graph)
    axes = {name: _free(kind) for name, kind in types.items()}
    feeds = {n.name: _rows(n.attrs["shape"], n.attrs["dtype"]) for n in graph.nodes if n.op == "Placeholder"}
    together = run_graph(graph, feeds, judged)
    for row in range(ROWS):
        alone = run_graph(graph, {name: _row(a, row, axes[name]) for name, a in feeds.items()}, judged)
        for name in judged:
            axis = axes[name] or 0
            got = together[name]
            same = got.ndim > axis and got.shape[axis] == ROWS
            same = same and np.allclose(_row(got, row, axis), alone[name], 1e-4, 1e-4)
            if not same:
                raise SignatureError(
                    f"the output {graph[name].origin or name!r} is computed for one row only",
                    why="the model says that it takes any number of rows, but a constant inside was made for one: with "
                    f"{ROWS} rows, row {row} comes out otherwise than alone",
                    fix="export it again with the batch left free everywhere, or name the outputs that you need: "
                    "--output action=action",
                )


def too_large(graph: Graph) -> bool:
    """Whether a trial takes more numbers than any policy does: shapes are what a file claims."""
    shapes = (kind.shape or () for kind in infer_types(normalise(graph)).values())
    return sum(math.prod(d if isinstance(d, int) else ROWS for d in shape) for shape in shapes) > MAX_NUMBERS


def _free(kind: TensorType) -> int | None:
    """The axis of the agents: of a memory [layers, B, n] it is not the first."""
    return next((i for i, d in enumerate(kind.shape or ()) if isinstance(d, str)), None)


def _row(array: np.ndarray, row: int, axis: int | None) -> np.ndarray:
    return array if axis is None else np.take(array, [row], axis)


def _rows(shape: TensorShape, dtype: np.dtype) -> np.ndarray:
    dims = [ROWS if d is None else d for d in shape.dims or ()]
    numbers = np.random.Generator(np.random.PCG64(0)).normal(size=dims)
    return (np.abs(numbers) if dtype.kind in "iub" else numbers).astype(dtype)
