"""Models that were exported for one row without saying so: whether they are right for more, once the row is left free.

A constant that was made for one row (torch's ``arange`` over the batch, an index) cannot be told from any other, so it
is tried: what several rows give together is what each gives alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from converters.graph.nodes import Graph, TensorShape
from converters.graph.ops.samplers import SAMPLERS
from converters.graph.passes.normalise import normalise
from converters.graph.run import run_graph
from converters.graph.shapes import infer_types
from signatures.errors import SignatureError

_ROWS = 3
#: Numbers that the trial may make: all tensors of all rows together. A policy has some thousands, a camera's a million.
_MAX_NUMBERS = 1 << 24


def check_rows(graph: Graph, outputs: Sequence[str]) -> None:
    """Raise SignatureError that names the first output which is wrong for more rows than one. Draws are left out."""
    chance = {n.name for n in graph.nodes if n.op in SAMPLERS}
    judged = [o for o in outputs if not graph.ancestors([o]) & chance]
    if not judged:
        return
    graph = normalise(graph.pruned(judged))
    _check_size(graph)
    feeds = {n.name: _rows(n.attrs["shape"], n.attrs["dtype"]) for n in graph.nodes if n.op == "Placeholder"}
    together = run_graph(graph, feeds, judged)
    for row in range(_ROWS):
        alone = run_graph(graph, {n: a[row : row + 1] for n, a in feeds.items()}, judged)
        for name in judged:
            got = together[name]
            same = got.ndim > 0 and len(got) == _ROWS and np.allclose(got[row : row + 1], alone[name], 1e-4, 1e-4)
            if not same:
                raise SignatureError(
                    f"the output {graph[name].origin or name!r} is computed for one row only",
                    why="the model says that it takes any number of rows, but a constant inside was made for one: with "
                    f"{_ROWS} rows, row {row} comes out otherwise than alone",
                    fix="export it again with the batch left free everywhere, or name the outputs that you need: "
                    "--output action=action",
                )


def _check_size(graph: Graph) -> None:
    """Raise SignatureError where the trial would take more than a policy ever does: shapes are what a file claims."""
    count = 0
    for kind in infer_types(graph).values():
        count += math.prod(d if isinstance(d, int) else _ROWS for d in kind.shape or ())
    if count > _MAX_NUMBERS:
        raise SignatureError(
            "the model was exported for one row, and is too large to be tried with more",
            why=f"its tensors hold {count} numbers for {_ROWS} rows, and {_MAX_NUMBERS} are tried",
            fix="export it again with the batch left free everywhere",
        )


def _rows(shape: TensorShape, dtype: np.dtype) -> np.ndarray:
    dims = [_ROWS if d is None else d for d in shape.dims or ()]
    numbers = np.random.Generator(np.random.PCG64(0)).normal(size=dims)
    return (np.abs(numbers) if dtype.kind in "iub" else numbers).astype(dtype)
