"""Choices among scores that may be no output: where two are as good, another choice is right as well.

A Q-network whose action is its best value, a mixture that draws around the best class: the tensor before the ArgMax
says how near the next score is, and the graph what would follow from it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from export_model.converters.formats.embed import runnable
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops.table import traits
from export_model.converters.graph.run import run_graph
from export_model.exporter.verify.participants import Feeds
from export_model.exporter.verify.tolerances import Tolerance
from export_model.signatures.errors import GraphError

Arrays = dict[str, np.ndarray]
#: A tensor of scores, for inputs → how far rounding moves it, element by element.
Moved = Callable[[Feeds, str], np.ndarray]
#: Scores that are tried beside the best.
_RIVALS = 4


class Choices:
    """The choices of a graph of a policy."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph

    def behind(self, output: str) -> list[Node]:
        """The choices that an output hangs on."""
        graph = runnable(self._graph)
        if output not in graph:
            return []
        upstream = graph.ancestors([output])
        return [n for n in graph.nodes if n.name in upstream and traits(n).chooses]

    def others(self, output: str, feeds: Feeds, tolerance: Tolerance, moved: Moved | None) -> Iterator[np.ndarray]:
        """Yield what ``output`` is with the best choice, then with the next best wherever that is as good, and so on.

        Nothing where no other choice is as good as the best one.
        """
        choices, graph = self.behind(output), runnable(self._graph)
        if not choices:
            return
        try:
            ranked = [self._rank(node, feeds, tolerance, moved) for node in choices]
            if not any(near[..., 1:].any() for _, near in ranked):
                return
            for rival in range(_RIVALS + 1):
                made, changed = dict(feeds), False
                for node, (order, near) in zip(choices, ranked, strict=True):
                    if changed:  # its scores may hang on a choice that was made otherwise
                        order, near = self._rank(node, made, tolerance, None)
                    place = min(rival, order.shape[-1] - 1)
                    chosen = np.where(near[..., place], order[..., place], order[..., 0])
                    changed = changed or bool((chosen != order[..., 0]).any())
                    made[node.name] = chosen.astype(_dtype(node))
                if rival and not changed:
                    return
                yield run_graph(graph, made, [output])[output]
        except GraphError:  # what does not run explains nothing
            return

    def tied_rows(self, output: str, feeds: Feeds, tolerance: Tolerance, rows: int) -> np.ndarray:
        """Whether a choice that ``output`` hangs on is open, for each of ``rows``."""
        found = np.zeros(rows, bool)
        try:
            for node in self.behind(output):
                _, near = self._rank(node, feeds, tolerance, None)
                if len(near) == rows:
                    found |= near[..., 1:].reshape(rows, -1).any(axis=1)
        except GraphError:
            return found
        return found

    def has_only_nan_scores(self, output: str, feeds: Feeds) -> bool:
        """Whether all scores that ``output`` is chosen by are NaN."""
        graph, choices = runnable(self._graph), self.behind(output)
        try:
            scores = run_graph(graph, feeds, [n.inputs[0] for n in choices])
        except GraphError:
            return False
        return bool(choices) and all(np.isnan(s).all() for s in scores.values())

    def _rank(
        self, node: Node, feeds: Feeds, tolerance: Tolerance, moved: Moved | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Places from the best on along the last axis, and which are as good as it."""
        graph, source = runnable(self._graph), node.inputs[0]
        axis = graph.constant(node.inputs[1]) if len(node.inputs) > 1 else np.array(0)
        if axis is None:
            raise GraphError("an axis is computed", fix="this is a fault of export-model")
        scores = run_graph(graph, feeds, [source])[source].astype(np.float64)
        off = np.zeros(scores.shape) if moved is None else moved(feeds, source)
        scores, off = (np.moveaxis(a, int(axis), -1) for a in (scores, off))
        best_first = np.argsort(-scores if traits(node).chooses == "largest" else scores, axis=-1, kind="stable")
        ordered = np.take_along_axis(scores, best_first, axis=-1)[..., : _RIVALS + 1]
        best = ordered[..., :1]
        bound = np.maximum(
            tolerance.atol + tolerance.rtol * np.abs(best),
            np.take_along_axis(off, best_first, axis=-1)[..., : _RIVALS + 1],
        )
        with np.errstate(invalid="ignore"):
            near = ~(np.abs(best - ordered) > bound + bound[..., :1])
        return best_first[..., : _RIVALS + 1], near


def _dtype(node: Node) -> np.dtype:
    return np.dtype(node.attrs.get("output_type", np.int64))


def broken_ties(
    expected: np.ndarray, others: Sequence[np.ndarray] | Iterator[np.ndarray], got: np.ndarray, tolerance: Tolerance
) -> np.ndarray | None:
    """Return ``expected`` with the ties broken as ``got`` breaks them; None where none is.

    An integer is taken from whichever of ``others`` has it, where another has the expected one; rows of numbers, which
    hang together, one by one.
    """
    alike = [o for o in others if o.shape == got.shape and o.dtype.kind == expected.dtype.kind]
    made, found = expected, False
    for other in alike:
        if expected.dtype.kind == "f":
            off = np.abs(got.astype(np.float64) - other) <= tolerance.atol + tolerance.rtol * np.abs(other)
            same = (off | (got == other)).reshape(len(got), -1).all(axis=1)
            same = same.reshape(-1, *(1,) * (got.ndim - 1)) & np.ones(got.shape, bool)
        else:
            same = (got == other) & np.any([o == expected for o in alike], axis=0)
        differs = same & (made != got)
        found = found or bool(differs.any())
        made = np.where(differs, other, made)
    return made.astype(expected.dtype) if found else None
