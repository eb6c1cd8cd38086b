"""Models that were exported for one row without saying so: whether they are right for more, once the row is left free.

A constant that was made for one row (torch's ``arange`` over the batch, an index) cannot be told from any other, so it
is tried: what several rows give together is what each gives alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from converters.graph.nodes import Graph, TensorShape
from converters.graph.ops.samplers import SAMPLERS
from converters.graph.passes.normalise import normalise
from converters.graph.run import run_graph
from signatures.errors import SignatureError

_ROWS = 3


def check_rows(graph: Graph, outputs: Sequence[str]) -> None:
    """Raise SignatureError that names the first output which is wrong for more rows than one. Draws are left out."""
    chance = {n.name for n in graph.nodes if n.op in SAMPLERS}
    judged = [o for o in outputs if not graph.ancestors([o]) & chance]
    graph = normalise(graph.pruned(judged)) if judged else graph
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


def _rows(shape: TensorShape, dtype: np.dtype) -> np.ndarray:
    dims = [_ROWS if d is None else d for d in shape.dims or ()]
    numbers = np.random.Generator(np.random.PCG64(0)).normal(size=dims)
    return (np.abs(numbers) if dtype.kind in "iub" else numbers).astype(dtype)
