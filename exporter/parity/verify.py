"""Run a policy's formats in their runtimes and compare each with the reference."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from converters.graph.ops.chance import SAMPLERS
from converters.runner.process import LoadedModel, RunFailedError
from exporter.parity.compare import Difference, compare, floored, ties
from exporter.parity.entrants import Entrant, Feeds, entrants, unload
from exporter.parity.original import Original
from exporter.parity.pool import INDEPENDENT, RuntimePool
from exporter.parity.report import Comparison, ParityReport
from exporter.parity.statistics import FALSE_ALARM, fit
from exporter.parity.subject import Subject, VerifyOptions
from exporter.parity.tolerances import Tolerance, tolerance_for
from exporter.runtimes import RuntimeInfo
from signatures.graph import Graph
from signatures.roles import Role
from signatures.sampling import Case, draw_cases, draw_rollout

#: A difference is rounding if it is at most this many times what moving every intermediate result by one unit in its
#: last place makes (Monte Carlo arithmetic in the numpy reference, the largest of ``_ROUNDING_RUNS``). It matters for
#: inputs of 1e3 and where a formula cancels; elsewhere the default tolerance is larger.
ROUNDING_FACTOR = 4
_ROUNDING_RUNS = 6
#: Rows that a sampler is drawn for.
DRAWS = 512


def verify(
    subject: Subject,
    runtimes: Sequence[str],
    known: Iterable[RuntimeInfo],
    pool: RuntimePool,
    options: VerifyOptions | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> ParityReport:
    """The report on one policy. A runtime that fails is a failed comparison, not an exception."""
    return _Verification(subject, tuple(runtimes), tuple(known), pool, options or VerifyOptions(), progress).report()


class _Verification:
    def __init__(
        self,
        subject: Subject,
        runtimes: tuple[str, ...],
        known: tuple[RuntimeInfo, ...],
        pool: RuntimePool,
        options: VerifyOptions,
        progress: Callable[[str], None],
    ) -> None:
        self.subject, self.runtimes, self.known, self.pool = subject, runtimes, known, pool
        self.options, self.progress = options, progress
        self.signature = subject.signature
        self.results: list[Comparison] = []
        self.notes: list[str] = []
        self.cases = draw_cases(self.signature, seed=options.seed, samples=options.samples)
        self.steps = self._rollout_feeds()
        self.random = random_outputs(subject.graph, [s.name for s in self.signature.outputs])
        self.expected: list[dict[str, np.ndarray]] = []
        self.unloads: list[LoadedModel] = []
        self._reference = "numpy"
        self._floors: dict[str, dict[str, np.ndarray]] = {}

    def report(self) -> ParityReport:
        if not self.runtimes:
            return self._finished("none")
        reference, original = self._references()
        try:
            self.expected = [self._answers(reference, original, case.feeds) for case in self.cases]
            self.expected_steps = self._roll(lambda feeds: self._answers(reference, original, feeds))
        except RunFailedError as error:
            self._failure("reference" if original is None else "source", self._reference.split("/")[-1], error)
            return self._finished(self._reference)
        for entrant in entrants(self.subject, self.runtimes, self.pool, reference, self._failure):
            self.progress(f"{self.subject.name}: {entrant.format} in {entrant.runtime}")
            self._examine(entrant)
        for model in self.unloads:
            unload(model)
        return self._finished(self._reference)

    # ---- who takes part

    def _references(self) -> tuple[LoadedModel, Original | None]:
        numpy_model = self.pool.process("numpy").load(str(self.subject.reference), seed=self.options.seed)
        self.unloads.append(numpy_model)
        self.numpy_model = numpy_model
        original = None
        source = self.subject.source
        if source is not None and source.runtime in self.runtimes:
            try:
                model = self.pool.process(source.runtime).load(str(source.path), **source.options)
            except RunFailedError as error:
                self._failure("source", source.runtime, error)
            else:
                self.unloads.append(model)
                original = Original(model, self.signature, self.subject.source_map)
                self._reference = f"source/{source.runtime}"
        return numpy_model, original

    def _answers(self, reference: LoadedModel, original: Original | None, feeds: Feeds) -> dict[str, np.ndarray]:
        """The reference's outputs; the numpy kernels answer for what the source cannot be asked."""
        answers = {} if original is None else original.run(feeds)
        rest = [s.name for s in self.signature.outputs if s.name not in answers and s.name not in self.random]
        if rest:
            answers.update(reference.run(feeds, rest))
        return answers

    # ---- comparisons

    def _examine(self, entrant: Entrant) -> None:
        try:
            self._numbers(entrant)
            self._rollout(entrant)
            self._draws(entrant)
        except RunFailedError as error:
            self._failure(entrant.format, entrant.runtime, error)

    def _tolerance(self, output: str) -> Tolerance:
        return tolerance_for(self.signature, output, self.options.tolerance)

    def _numbers(self, entrant: Entrant) -> None:
        worst: dict[str, tuple[Difference, str]] = {}
        for case, expected in zip(self.cases, self.expected, strict=True):
            got = entrant.run(case.feeds, list(entrant.outputs))
            for name in entrant.outputs:
                if name in self.random:
                    difference = self._plausible(name, got[name], case)
                elif name in expected:
                    difference = self._difference(name, expected, got[name], entrant)
                    if not difference.passed and not difference.reason and got[name].dtype.kind == "f":
                        rounding = self._rounding(case)[name]
                        difference = self._difference(name, expected, got[name], entrant, rounding)
                else:
                    continue
                if name not in worst or _rank(difference) > _rank(worst[name][0]):
                    worst[name] = (difference, case.name)
        for name, (difference, case_name) in worst.items():
            self._add(entrant, name, "numbers" if name not in self.random else "shape", difference, case_name)

    def _rounding(self, case: Case) -> dict[str, np.ndarray]:
        """Per output, what rounding explains, element by element (the largest of a row counts for all of it)."""
        if case.name not in self._floors:
            names = [s.name for s in self.signature.outputs if s.name not in self.random and s.dtype == "float32"]
            exact = self._settled(self.numpy_model.run(case.feeds, names))
            floors = {name: np.zeros(exact[name].shape) for name in names}
            for run in range(_ROUNDING_RUNS):
                jitter = self.options.seed * _ROUNDING_RUNS + run
                moved = self._settled(self.numpy_model.run(case.feeds, names, jitter=jitter))
                for name in names:
                    step = np.abs(moved[name].astype(np.float64) - exact[name])
                    row = step.max(axis=tuple(range(1, step.ndim)), keepdims=True)
                    floors[name] = np.maximum(floors[name], np.where(np.isfinite(row), row, 0.0))
            self._floors[case.name] = {name: ROUNDING_FACTOR * floor for name, floor in floors.items()}
        return self._floors[case.name]

    def _difference(
        self, name: str, expected: Feeds, got: np.ndarray, entrant: Entrant, rounding: np.ndarray | None = None
    ) -> Difference:
        return compare(
            self._settled(expected)[name],
            self._settled({name: got})[name],
            self._tolerance(name),
            free=self._ties(name, expected),
            narrowed=entrant.format == "tfjs",
            rounding=rounding,
        )

    def _settled(self, values: Feeds) -> dict[str, np.ndarray]:
        """Values as they are compared: log-probabilities that say "never" are all the same."""
        scores = {s.name for s in self.signature.outputs if s.role is Role.LOG_PROBS}
        return {
            n: floored(a, self.signature.branches) if n in scores and a.dtype.kind == "f" and a.ndim else a
            for n, a in values.items()
        }

    def _ties(self, name: str, expected: Feeds) -> np.ndarray | None:
        """Where an argmax is not decided, because the scores of the reference are too close."""
        spec = self.signature.output(name)
        if spec.role is not Role.DETERMINISTIC or not self.signature.branches or expected[name].dtype.kind == "f":
            return None
        scores = next((s.name for s in self.signature.outputs if s.role in (Role.LOG_PROBS, Role.PROBS)), None)
        if scores is None or scores not in expected:
            return None
        found = ties(expected[scores], self.signature.branches, self._tolerance(scores))
        return found if found.shape == expected[name].shape else None

    def _plausible(self, name: str, got: np.ndarray, case: Case) -> Difference:
        """A drawn output: shape and range only; its distribution is tested by ``_draws``."""
        spec = self.signature.output(name)
        wanted = tuple(case.batch if n is None else n for n in spec.shape)
        if got.shape != wanted:
            return Difference(float("inf"), float("inf"), False, f"shape {list(got.shape)} instead of {list(wanted)}")
        if spec.role is Role.SAMPLED and self.signature.branches:
            sizes = np.array(self.signature.branches)
            if (got < 0).any() or (got >= sizes).any():
                return Difference(float("inf"), float("inf"), False, "a class outside of its branch was drawn")
        return Difference(0.0, 0.0, True)

    def _rollout_feeds(self) -> list[dict[str, np.ndarray]]:
        memory = self.signature.memory
        if memory is None or memory.input is None or memory.output is None:
            return []
        return draw_rollout(self.signature, seed=self.options.seed, steps=self.options.steps)

    def _roll(self, run: Callable[[Feeds], dict[str, np.ndarray]]) -> list[dict[str, np.ndarray]]:
        """Outputs of each step, the memory fed back."""
        memory = self.signature.memory
        answers: list[dict[str, np.ndarray]] = []
        for feeds in self.steps:
            assert memory is not None and memory.input is not None and memory.output is not None
            if answers:
                feeds = {**feeds, memory.input: answers[-1][memory.output]}
            answers.append(run(feeds))
        return answers

    def _rollout(self, entrant: Entrant) -> None:
        memory = self.signature.memory
        if not self.steps or memory is None or memory.output not in entrant.outputs:
            return
        got = self._roll(lambda feeds: entrant.run(feeds, list(entrant.outputs)))
        for name in entrant.outputs:
            if name in self.random or name not in self.expected_steps[0]:
                continue
            steps = [self._difference(name, e, g[name], entrant) for e, g in zip(self.expected_steps, got, strict=True)]
            worst = max(steps, key=_rank)
            drift = tuple(d.max_abs for d in steps)
            self._add(entrant, name, "rollout", worst, f"step {steps.index(worst) + 1} of {len(steps)}", drift)

    def _draws(self, entrant: Entrant) -> None:
        """Draw many times for one input and test the counts against the reference's log-probabilities."""
        drawn_outputs = [s for s in self.signature.outputs if s.role is Role.SAMPLED]
        action = drawn_outputs[0] if drawn_outputs else self.signature.outputs[0]
        scores = next((s.name for s in self.signature.outputs if s.role is Role.LOG_PROBS), None)
        if action.role is not Role.SAMPLED or action.name not in entrant.outputs or scores is None:
            return
        case = next((c for c in self.cases if c.name.startswith("random masks")), self.cases[0])
        expected = self.expected[self.cases.index(case)].get(scores)
        if expected is None or action.name not in self.random:
            return
        row = {name: array[:1] for name, array in case.feeds.items()}
        if entrant.runtime == "tfjs-cpu":
            # Its Multinomial restarts its generator for every row of a batch: one row at a time.
            drawn = np.concatenate([entrant.run(row, [action.name])[action.name] for _ in range(DRAWS)])
        else:
            drawn = entrant.run({n: np.repeat(a, DRAWS, axis=0) for n, a in row.items()}, [action.name])[action.name]
        edges = np.cumsum(self.signature.branches)[:-1]
        parts = np.split(expected[0], edges)
        columns = drawn.reshape(len(drawn), -1)
        p_values = [fit(columns[:, i], part) for i, part in enumerate(parts)]
        lowest = min(p_values)
        reason = (
            "" if lowest >= FALSE_ALARM else f"the draws do not have the distribution they should (p = {lowest:.1e})"
        )
        self._add(
            entrant, action.name, "draws", Difference(1 - lowest, 1 - lowest, lowest >= FALSE_ALARM, reason), case.name
        )

    # ---- results

    def _add(
        self,
        entrant: Entrant,
        output: str,
        kind: str,
        difference: Difference,
        where: str,
        drift: tuple[float, ...] = (),
    ) -> None:
        self.results.append(
            Comparison(
                entrant.format,
                entrant.runtime,
                output,
                kind,
                difference.max_abs,
                difference.max_rel,
                self._tolerance(output),
                difference.passed,
                where,
                difference.reason,
                drift,
                difference.rounding,
            )
        )

    def _failure(self, kind: str, runtime: str, error: RunFailedError) -> None:
        text = error.what if error.why is None else f"{error.what}: {error.why}"
        self.results.append(
            Comparison(
                kind, runtime, "*", "failure", float("inf"), float("inf"), Tolerance(), False, None, text.strip()
            )
        )

    def _finished(self, reference: str) -> ParityReport:
        versions = self.pool.versions()
        tried = {c.runtime for c in self.results}  # one that died has no version any more, but it ran
        states: dict[str, dict[str, str | None]] = {}
        for info in self.known:
            ran = info.name in self.runtimes and (info.name in versions or info.name in tried)
            reason = None if ran else "not asked for" if info.installed else f"not installed; {info.how}"
            states[info.name] = {
                "version": versions.get(info.name, info.version),
                "status": "ran" if ran else "not run",
                "reason": reason,
            }
        independent = any(c.runtime in INDEPENDENT for c in self.results)
        passed = all(c.passed for c in self.results) if independent else None
        if any(not c.passed for c in self.results):
            passed = False
        return ParityReport(
            self.subject.name,
            passed,
            self.options.seed,
            self.options.samples,
            reference,
            states,
            tuple(self.results),
            self.subject.sizes,
            (*self.signature.notes, *self.notes),
            self_consistent=self.subject.source is None,
        )


def random_outputs(graph: Graph, names: Iterable[str]) -> frozenset[str]:
    """The outputs that depend on a sampler inside the graph."""
    samplers = {n.name for n in graph.nodes if n.op in SAMPLERS}
    return frozenset(name for name in names if graph.ancestors([name]) & samplers)


def _rank(difference: Difference) -> tuple[bool, float]:
    return not difference.passed, difference.max_abs
