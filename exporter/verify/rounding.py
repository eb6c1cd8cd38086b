"""What rounding explains of a difference: Monte Carlo arithmetic in the numpy kernels.

A difference is rounding if it is at most ``FACTOR`` times what moving every intermediate result as far as rounding, or
the runtime's approximation of a function, may move it makes (converters/graph/jitter.py), the largest of ``RUNS``, or,
to make sure, of ``MORE_RUNS`` more. It matters for inputs of 1e3, for long sums, where a formula cancels, and where a
memory carries it from step to step; elsewhere the default tolerance is larger. What rests on a number that is not told
from zero lies between two ends (converters/graph/underflow.py).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from msgspec import Struct

from export_model.converters.files.children.process import LoadedModel, RunFailedError
from export_model.converters.graph.jitter import Jitter
from export_model.converters.graph.nodes import Graph
from export_model.converters.graph.run import run_graph
from export_model.converters.runtimes.registry import RUNTIMES
from export_model.exporter.verify.difference import steps
from export_model.exporter.verify.excuses import FLOAT64, NAN_FROM_ZERO, NOT_FROM_ZERO, Excuse
from export_model.exporter.verify.participants import Feeds
from export_model.exporter.verify.tolerances import Tolerance
from export_model.signatures.sampling import Case

FACTOR = 4
RUNS = 6
#: Where these do not explain a difference, so many more: of hundreds of rows one may move little six times by chance.
MORE_RUNS = 18
_ARITHMETIC = {r.name: r.arithmetic for r in RUNTIMES}

Arrays = dict[str, np.ndarray]
Run = Callable[[Feeds], Arrays]
#: One run after the other, each fed what the one before answered (``Trial.roll_out``).
Rolled = Callable[[Run], list[Arrays]]


class Rounding:
    """What rounding explains of a policy's outputs and inner tensors; ``settled`` gives values as they are compared.

    Everything is per output, element by element, for the runtime that is asked about. Where the model itself does not
    run nothing is explained: that it does not is reported as its own failure.
    """

    def __init__(self, seed: int, names: Sequence[str], settled: Callable[[Feeds], Arrays]) -> None:
        every = RUNS + MORE_RUNS
        self._jitters = [seed * every + run for run in range(every)]
        self._names, self._settled = list(names), settled
        self._known: dict[tuple[str, str, bool], list[Arrays]] = {}
        self._scores: dict[tuple[str | int, str, str], np.ndarray] = {}

    def outputs(self, model: LoadedModel, case: Case, runtime: str, *, sure: bool) -> Mapping[str, np.ndarray]:
        """Of the numpy child's ``model`` for one input."""
        key = (case.name, _ARITHMETIC.get(runtime, "processor"), sure)
        if key not in self._known:
            requests = [{}, *({"jitter": [jitter, 1], "arithmetic": key[1]} for jitter in self._runs(sure))]
            try:
                exact, *moved = model.run_all([case.feeds] * len(requests), self._names, requests)
            except RunFailedError:
                self._known[key] = []
            else:
                self._known[key] = self._largest_of([exact], [[m] for m in moved])
        return self._known[key][0] if self._known[key] else {}

    def ends(self, model: LoadedModel, case: Case, runtime: str) -> Sequence[Arrays]:
        """What comes of one input with numbers that are not told from zero as zero, kept, and in float64."""
        key = (case.name, f"the ends of {_ARITHMETIC.get(runtime, 'processor')}", False)
        if key not in self._known:
            arithmetic = _ARITHMETIC.get(runtime, "processor")
            requests = [{"end": end, "arithmetic": arithmetic} for end in ("zero", "kept", "float64")]
            try:
                answers = model.run_all([case.feeds] * len(requests), self._names, requests)
            except RunFailedError:
                self._known[key] = []
            else:
                self._known[key] = [self._settled(answer) for answer in answers]
        return self._known[key]

    def steps(
        self, model: LoadedModel, rolled: Rolled, memory: Sequence[str], number: int, runtime: str, *, sure: bool
    ) -> Mapping[str, np.ndarray]:
        """Of step ``number`` with ``memory`` fed back: what every step before it made is carried along."""
        key = ("", _ARITHMETIC.get(runtime, "processor"), sure)
        if key not in self._known:
            names = list(dict.fromkeys([*self._names, *memory]))
            try:
                exact = rolled(lambda feeds: model.run(feeds, names))
                moved = [_jittered_answers(model, rolled, jitter, key[1], names) for jitter in self._runs(sure)]
            except RunFailedError:
                exact, moved = [], []
            self._known[key] = self._largest_of(exact, moved)
        return self._known[key][number] if self._known[key] else {}

    def inner(self, runtime: str, graph: Graph, feeds: Feeds, tensor: str) -> np.ndarray:
        """Of a tensor inside ``graph``, in this process."""
        exact = run_graph(graph, feeds, [tensor])[tensor]
        arithmetic = _ARITHMETIC.get(runtime, "processor")
        moved = [run_graph(graph, feeds, [tensor], Jitter(j, arithmetic))[tensor] for j in self._runs()]
        return _largest(exact, moved)

    def scores(self, runtime: str, graph: Graph, at: Case | int, feeds: Feeds, tensor: str) -> np.ndarray:
        """Of a tensor inside the policy's own ``graph`` for one input or step, whose outputs all hang on it."""
        key = (at.name if isinstance(at, Case) else at, _ARITHMETIC.get(runtime, "processor"), tensor)
        if key not in self._scores:
            self._scores[key] = self.inner(runtime, graph, feeds, tensor)
        return self._scores[key]

    def _runs(self, sure: bool = False) -> Sequence[int]:
        return self._jitters if sure else self._jitters[:RUNS]

    def _largest_of(self, exact: Sequence[Arrays], moved: Sequence[Sequence[Arrays]]) -> list[Arrays]:
        """Per input or step, of what was found exactly and moved."""
        exact, moved = [self._settled(e) for e in exact], [[self._settled(e) for e in run] for run in moved]
        return [{n: _largest(step[n], [m[i][n] for m in moved]) for n in step} for i, step in enumerate(exact)]


def _jittered_answers(
    model: LoadedModel, rolled: Rolled, jitter: int, arithmetic: str, names: Sequence[str]
) -> list[Arrays]:
    count = 0

    def run(feeds: Feeds) -> Arrays:
        nonlocal count
        count += 1  # no step's chance is another's
        return model.run(feeds, names, jitter=[jitter, count], arithmetic=arithmetic)

    return rolled(run)


def _largest(exact: np.ndarray, moved: Sequence[np.ndarray]) -> np.ndarray:
    floor = np.zeros(exact.shape)
    for each in moved:
        floor = np.maximum(floor, steps(exact, each))
    return FACTOR * floor


class Hull(Struct, frozen=True):
    """Between what an answer lies where numbers rest on what is not told from zero.

    That is what both ends, float64 and the reference make of them, and as far again beyond, as what is computed from
    several of them has no order. ``open`` and ``nan`` say where the ends are apart, and where one of them is NaN;
    ``whole`` is what float64 makes of it.
    """

    open: np.ndarray
    nan: np.ndarray
    low: np.ndarray
    high: np.ndarray
    whole: np.ndarray

    def forgive(self, answer: np.ndarray, reference: np.ndarray, *, ordinary: bool) -> list[tuple[Excuse, np.ndarray]]:
        """Mark what is forgiven of an answer: at ordinary inputs what float64 says itself, and nothing else."""
        if ordinary:
            default = Tolerance()
            with np.errstate(invalid="ignore"):
                near = np.abs(answer - self.whole) <= default.atol + default.rtol * np.abs(self.whole)
            return [(FLOAT64, self.open & near & np.isfinite(self.whole))]
        numbers = np.isfinite(answer), np.isfinite(reference)
        none = self.nan & ~(numbers[0] | numbers[1])
        one = self.nan & (numbers[0] ^ numbers[1])
        return [(NOT_FROM_ZERO, self.holds(answer) | none), (NAN_FROM_ZERO, one)]

    def holds(self, answer: np.ndarray) -> np.ndarray:
        """Where an answer is one of those."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.open & (answer >= self.low) & (answer <= self.high))


def hull(ends: Sequence[np.ndarray], reference: np.ndarray, rounding: np.ndarray | float) -> Hull:
    """Return what ``ends`` say of an output: of numbers as zero, kept, and in float64."""
    zero, kept, whole = (e.astype(np.float64) for e in ends)
    default = Tolerance()
    with np.errstate(invalid="ignore"):
        apart = ~(np.abs(zero - kept) <= default.atol + default.rtol * np.abs(kept)) & (zero != kept)
        every = np.stack([*ends, reference.astype(np.float64)])
        low, high = np.fmin.reduce(every), np.fmax.reduce(every)
        width = high - low
        beyond = np.where(np.isfinite(width), width, 0.0) + rounding
    nan = np.isnan(zero), np.isnan(kept)
    apart &= ~(nan[0] & nan[1])
    nothing = np.isnan(low)
    low, high = np.where(nothing, -np.inf, low - beyond), np.where(nothing, np.inf, high + beyond)
    return Hull(apart, apart & (nan[0] | nan[1]), low, high, whole)
