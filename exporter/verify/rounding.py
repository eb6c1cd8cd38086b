"""What rounding explains of a difference: Monte Carlo arithmetic in the numpy kernels.

A difference is rounding if it is at most ``FACTOR`` times what moving every intermediate result by one unit in its last
place makes, the largest of ``RUNS``. It matters for inputs of 1e3, for long sums and where a formula cancels; elsewhere
the default tolerance is larger.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from converters.graph.nodes import Graph
from converters.graph.run import run_graph
from converters.runtimes.process import LoadedModel, RunFailedError
from exporter.verify.difference import row_steps
from exporter.verify.participants import Feeds
from signatures.sampling import Case

FACTOR = 4
RUNS = 6

Settled = Callable[[Feeds], dict[str, np.ndarray]]


class Rounding:
    """What rounding explains of a policy's outputs and inner tensors; ``settled`` gives values as they are compared."""

    def __init__(self, seed: int, names: Sequence[str], settled: Settled) -> None:
        self._jitters = [seed * RUNS + run for run in range(RUNS)]
        self._names, self._settled = list(names), settled
        self._known: dict[str, dict[str, np.ndarray]] = {}

    def outputs(self, model: LoadedModel, case: Case) -> dict[str, np.ndarray]:
        """Per output, element by element (the largest of a row counts for all of it), by the numpy child's ``model``.

        Nothing is explained where the model itself does not run: that it does not is reported as its own failure.
        """
        if case.name not in self._known:
            try:
                exact = self._settled(model.run(case.feeds, self._names))
                moved = [self._settled(model.run(case.feeds, self._names, jitter=j)) for j in self._jitters]
            except RunFailedError:
                exact, moved = {}, []
            self._known[case.name] = {n: _largest(exact[n], [m[n] for m in moved]) for n in exact}
        return self._known[case.name]

    def inner(self, graph: Graph, feeds: Feeds, tensor: str) -> np.ndarray:
        """The same for a tensor inside ``graph``, in this process."""
        exact = run_graph(graph, feeds, [tensor])[tensor]
        moved = [run_graph(graph, feeds, [tensor], np.random.default_rng(j))[tensor] for j in self._jitters]
        return _largest(exact, moved)


def _largest(exact: np.ndarray, moved: Sequence[np.ndarray]) -> np.ndarray:
    floor = np.zeros(exact.shape)
    for each in moved:
        floor = np.maximum(floor, row_steps(exact, each))
    return FACTOR * floor
