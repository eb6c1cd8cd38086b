"""Run a policy's formats in their runtimes and compare each with the reference."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from converters.formats import narrows
from converters.graph.nodes import Graph
from converters.graph.ops.samplers import SAMPLERS
from converters.graph.run import run_graph
from converters.runtimes.pool import INDEPENDENT, RuntimePool
from converters.runtimes.process import LoadedModel, RunFailedError
from converters.runtimes.registry import RuntimeInfo
from exporter.verify.bisection import Bisector
from exporter.verify.budget import held_to
from exporter.verify.difference import Difference, compare, floored, ties
from exporter.verify.golden import Golden, read_golden
from exporter.verify.histogram import added
from exporter.verify.original import Original
from exporter.verify.participants import Entrant, Failure, Feeds, entrants, in_order, needed_runtimes, unload
from exporter.verify.report import Bisection, Comparison, ParityReport
from exporter.verify.rounding import Rounding
from exporter.verify.statistics import FALSE_ALARM, fit, same_distribution
from exporter.verify.subject import Subject, VerifyOptions
from exporter.verify.tolerances import Tolerance, ruled, tolerance_for
from signatures.roles import Role
from signatures.sampling import Case, draw_cases, draw_rollout

#: Who takes part beside the reference: given the numpy reference and where failures go.
Field = Callable[[LoadedModel, Failure], Iterable[Entrant]]
#: Rows that a sampler is drawn for.
DRAWS = 512
#: The same for numbers, of policies without cameras: a spread that is a quarter too wide is seen.
DENSITY_DRAWS = 4096


def verify(
    subject: Subject,
    runtimes: Sequence[str],
    known: Iterable[RuntimeInfo],
    pool: RuntimePool,
    options: VerifyOptions | None = None,
    progress: Callable[[str], None] = lambda text: None,
    field: Field | None = None,
) -> ParityReport:
    """The report on one policy. A runtime that fails is a failed comparison, not an exception.

    ``field`` says who takes part, given the numpy reference; without it, the subject's artefacts do.
    """
    options = options or VerifyOptions()
    verification = _Verification(subject, tuple(runtimes), tuple(known), pool, options, progress)
    return held_to(verification.report(field), options.budget)


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
        self.golden = Golden() if options.golden is None else read_golden(options.golden, self.signature)
        drawn = draw_cases(self.signature, seed=options.seed, samples=options.samples)
        self.cases = [*drawn, *self.golden.cases]
        self.steps = self._rollout_feeds()
        self.random = random_outputs(subject.graph, [s.name for s in self.signature.outputs])
        self.expected: list[dict[str, np.ndarray]] = []
        self.unloads: list[LoadedModel] = []
        self._reference = "numpy"
        numbers = [s.name for s in self.signature.outputs if s.name not in self.random and s.dtype == "float32"]
        self.rounding = Rounding(options.seed, numbers, self._settled)
        self.bisector = Bisector(subject, pool, self._is_right, self.rounding.inside)

    def report(self, field: Field | None = None) -> ParityReport:
        if not self.runtimes:
            return self._finished("none")
        self.progress(f"{self.subject.name}: starting the runtimes, running the source")
        self.pool.start(needed_runtimes(self.subject, self.runtimes))
        reference, original = self._references()
        try:
            self.expected = [self._answers(reference, original, case.feeds) for case in self.cases]
            self.expected_steps = self._roll(lambda feeds: self._answers(reference, original, feeds))
        except RunFailedError as error:
            self._failure("reference" if original is None else "source", self._reference.split("/")[-1], error)
            return self._finished(self._reference)
        self._recorded(reference)
        taking_part: Iterable[Entrant]
        if field is None:
            taking_part = entrants(self.subject, self.runtimes, self.pool, reference, self._failure)
        else:
            taking_part = field(reference, self._failure)
        for entrant in taking_part:
            self.progress(f"{self.subject.name}: {entrant.name} in {entrant.runtime}")
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
                with source.loadable() as (path, options):
                    model = self.pool.process(source.runtime).load(path, **options)
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

    def _recorded(self, reference: LoadedModel) -> None:
        """The reference's answers against what the user recorded."""
        names = [s.name for s in self.signature.outputs if s.name not in self.random]
        names = [n for n in names if not self.subject.graph.ancestors([n]) & self.golden.noiseless]
        runtime = self._reference.split("/")[-1]
        entrant = Entrant("golden", runtime, reference.run, names, reference)
        answers = self.expected[len(self.cases) - len(self.golden.cases) :]
        known = [{n: a[n] for n in names if n in a} for a in answers]
        for name, difference, case in self.golden.compared(
            known, lambda name, expected, recorded: self._difference(name, expected, recorded, entrant)
        ):
            self._add(entrant, name, "numbers", difference, case)

    def _examine(self, entrant: Entrant) -> None:
        try:
            self._numbers(entrant)
            self._rollout(entrant)
            self._draws(entrant)
            self._densities(entrant)
        except RunFailedError as error:
            self._failure(entrant.name, entrant.runtime, error)
        finally:
            self.bisector.close()

    def _tolerance(self, output: str, entrant: Entrant) -> Tolerance:
        found = ruled(self.options.rules, self.subject.name, entrant.format, entrant.runtime, output)
        return found or tolerance_for(self.signature, output, self.options.tolerance)

    def _numbers(self, entrant: Entrant) -> None:
        worst: dict[str, tuple[Difference, Case]] = {}
        needed: dict[str, list[float | None]] = {}
        spread: dict[str, tuple[int, ...]] = {}
        for case, expected in zip(self.cases, self.expected, strict=True):
            got = entrant.run(case.feeds, list(entrant.outputs))
            for name in entrant.outputs:
                if name in self.random or name in entrant.drawn:
                    difference = self._plausible(name, got[name], case)
                elif name in expected:
                    difference = self._difference(name, expected, got[name], entrant)
                    if not difference.passed and not difference.reason and got[name].dtype.kind == "f":
                        explained = self._explained(name, case)
                        difference = self._difference(name, expected, got[name], entrant, explained)
                else:
                    continue
                spread[name] = added(spread.get(name, ()), difference.histogram)
                needed.setdefault(name, []).append(difference.smallest_tolerance)
                if name not in worst or _rank(difference) > _rank(worst[name][0]):
                    worst[name] = (difference, case)
        for name, (difference, case) in worst.items():
            kind = "shape" if name in self.random or name in entrant.drawn else "numbers"
            difference = replace(difference, smallest_tolerance=_largest(needed[name]), histogram=spread[name])
            self._add(
                entrant,
                name,
                kind,
                difference,
                case.name,
                bisection=self._bisect(entrant, name, difference, case.feeds),
            )

    def _explained(self, name: str, case: Case) -> np.ndarray | None:
        return self.rounding.outputs(self.numpy_model, case).get(name)

    def _is_right(self, graph: Graph) -> bool:
        """Whether ``graph``, run by the numpy kernels, gives what the reference does."""
        numpy = Entrant("reference", "numpy", self.numpy_model.run, [], self.numpy_model)
        for case, expected in zip(self.cases, self.expected, strict=True):
            got = run_graph(graph, case.feeds, list(expected))
            for name in expected:
                difference = self._difference(name, expected, got[name], numpy)
                if not difference.passed and not difference.reason and got[name].dtype.kind == "f":
                    difference = self._difference(name, expected, got[name], numpy, self._explained(name, case))
                if not difference.passed:
                    return False
        return True

    def _bisect(
        self, entrant: Entrant, output: str, difference: Difference, feeds: Feeds, branch: int = 0
    ) -> Bisection | None:
        """Where a difference begins; None where there is none, or its reason says all there is to say."""
        if difference.passed:
            return None
        found = self.bisector.find(entrant, output, feeds, self._tolerance(output, entrant), branch)
        return None if found.tensor is None and difference.reason else found

    def _difference(
        self, name: str, expected: Feeds, got: np.ndarray, entrant: Entrant, rounding: np.ndarray | None = None
    ) -> Difference:
        return compare(
            self._settled(expected)[name],
            self._settled({name: got})[name],
            self._tolerance(name, entrant),
            free=self._ties(name, expected, entrant),
            narrowed=narrows(entrant.format),
            rounding=rounding,
        )

    def _settled(self, values: Feeds) -> dict[str, np.ndarray]:
        """Values as they are compared: log-probabilities that say "never" are all the same."""
        scores = {s.name for s in self.signature.outputs if s.role is Role.LOG_PROBS}
        return {
            n: floored(a, self.signature.branches) if n in scores and a.dtype.kind == "f" and a.ndim else a
            for n, a in values.items()
        }

    def _ties(self, name: str, expected: Feeds, entrant: Entrant) -> np.ndarray | None:
        """Where an argmax is not decided, because the scores of the reference are too close."""
        spec = self.signature.output(name)
        if spec.role is not Role.DETERMINISTIC or not self.signature.branches or expected[name].dtype.kind == "f":
            return None
        scores = next((s.name for s in self.signature.outputs if s.role in (Role.LOG_PROBS, Role.PROBS)), None)
        if scores is None or scores not in expected:
            return None
        found = ties(expected[scores], self.signature.branches, self._tolerance(scores, entrant))
        return found if found.shape == expected[name].shape else None

    def _plausible(self, name: str, got: np.ndarray, case: Case) -> Difference:
        """A drawn output: shape, dtype and range; ``_draws`` and ``_densities`` test how it is distributed."""
        spec = self.signature.output(name)
        wanted = tuple(case.batch if n is None else n for n in spec.shape)
        if got.shape != wanted:
            return Difference(float("inf"), float("inf"), False, f"shape {list(got.shape)} instead of {list(wanted)}")
        if got.dtype.kind != np.dtype(spec.dtype).kind:
            return Difference(float("inf"), float("inf"), False, f"dtype {got.dtype.name} instead of {spec.dtype}")
        if not np.isfinite(got).all():
            return Difference(float("inf"), float("inf"), False, "NaN or infinity was drawn")
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
        fed: list[Feeds] = []

        def step(feeds: Feeds) -> dict[str, np.ndarray]:
            fed.append(feeds)
            return entrant.run(feeds, list(entrant.outputs))

        got = self._roll(step)
        names = [n for n in entrant.outputs if n in self.expected_steps[0] and n not in entrant.drawn | self.random]
        steps = {
            n: [self._difference(n, e, g[n], entrant) for e, g in zip(self.expected_steps, got, strict=True)]
            for n in names
        }
        where = [f"step {i + 1} of {len(fed)}" for i in range(len(fed))]
        for name, differences in steps.items():
            worst = max(range(len(fed)), key=lambda i: _rank(differences[i]))
            least = _largest([d.smallest_tolerance for d in differences])
            difference = replace(differences[worst], smallest_tolerance=least, histogram=())
            bisection = None
            if not difference.passed:
                # An output that goes wrong after the memory did goes wrong because of it.
                output = min((n for n in (name, memory.output) if n in steps), key=lambda n: _first(steps[n]))
                first = _first(steps[output])
                bisection = self._bisect(entrant, output, steps[output][first], fed[first])
                bisection = bisection and replace(bisection, input=where[first])
            drift = tuple(d.max_abs for d in differences)
            self._add(entrant, name, "rollout", difference, where[worst], drift, bisection)

    def _draws(self, entrant: Entrant) -> None:
        """Draw many times for one input and test the counts against the reference's log-probabilities."""
        drawn_outputs = [s for s in self.signature.outputs if s.role is Role.SAMPLED]
        action = drawn_outputs[0] if drawn_outputs else self.signature.outputs[0]
        scores = next((s.name for s in self.signature.outputs if s.role is Role.LOG_PROBS), None)
        if action.role is not Role.SAMPLED or action.name not in entrant.outputs or scores is None:
            return
        if action.name not in self.random:
            return
        trials = [c for c in self.cases if c.name == "random masks"] + self.cases[:1]
        fits = []
        for case in trials:
            expected = self.expected[self.cases.index(case)].get(scores)
            if expected is None:
                return
            row = {name: array[:1] for name, array in case.feeds.items()}
            p_values = self._fits(entrant, action.name, row, expected[0])
            fits.append((min(p_values), p_values.index(min(p_values)), case, row))
        lowest, branch, case, row = min(fits, key=lambda f: f[0])
        difference = _likely(lowest)
        bisection = self._bisect(entrant, action.name, difference, row, branch)
        self._add(entrant, action.name, "draws", difference, case.name, bisection=bisection)

    def _fits(self, entrant: Entrant, action: str, row: Feeds, log_probs: np.ndarray) -> list[float]:
        """The p-value of each branch, of ``DRAWS`` draws for one row of inputs."""
        if entrant.runtime.startswith("tfjs-cpu"):  # in Node and in Chromium
            # Its Multinomial restarts its generator for every row of a batch: one row at a time.
            drawn = np.concatenate([entrant.run(row, [action])[action] for _ in range(DRAWS)])
        else:
            drawn = entrant.run({n: np.repeat(a, DRAWS, axis=0) for n, a in row.items()}, [action])[action]
        parts = np.split(log_probs, np.cumsum(self.signature.branches)[:-1])
        columns = drawn.reshape(len(drawn), -1)
        return [fit(columns[:, i], part) for i, part in enumerate(parts)]

    def _densities(self, entrant: Entrant) -> None:
        """Numbers that are drawn, from noise in the graph or of a candidate's own, have the reference's distribution.

        Both are drawn many times for one input, the reference by the numpy kernels, and each number of an output is
        tested by itself (Kolmogorov-Smirnov for two samples of one size).
        """
        drawn = [n for n in entrant.outputs if n in self.random or n in entrant.drawn]
        names = [n for n in drawn if self.signature.output(n).dtype == "float32"]
        if not names:
            return
        case = self.cases[0]
        runs = (self.numpy_model.run, entrant.run)
        cameras = any(s.role is Role.VISUAL for s in self.signature.inputs)
        feeds = self._rows(case, DRAWS if cameras else DENSITY_DRAWS)
        samples = [run(feeds, names) for run in runs]
        if any((s[n] == s[n][:1]).all() for s in samples for n in names):
            # One draw for the whole batch, or none: as many runs as draws.
            each = [[run(self._rows(case, 1, i), names) for i in range(DRAWS)] for run in runs]
            samples = [{n: np.concatenate([one[n] for one in every]) for n in names} for every in each]
        for name in names:
            tolerance = self._tolerance(name, entrant)
            columns = (s[name].reshape(len(s[name]), -1).T for s in samples)
            p_values = [same_distribution(a, b, tolerance.atol, tolerance.rtol) for a, b in zip(*columns, strict=True)]
            self._add(entrant, name, "draws", _likely(min(p_values, default=1.0)), case.name)

    def _rows(self, case: Case, count: int, run: int = 0) -> dict[str, np.ndarray]:
        """The first row of a case ``count`` times, with noise drawn for each."""
        rng = np.random.default_rng([self.options.seed, run])
        feeds = {}
        for spec in self.signature.inputs:
            array = case.feeds[spec.name]
            free = bool(spec.shape) and spec.shape[0] is None
            array = np.repeat(array[:1], count, axis=0) if free else array
            noise = spec.role is Role.NOISE
            feeds[spec.name] = rng.standard_normal(array.shape).astype(np.float32) if noise else array
        return feeds

    # ---- results

    def _add(
        self,
        entrant: Entrant,
        output: str,
        kind: str,
        difference: Difference,
        where: str,
        drift: tuple[float, ...] = (),
        bisection: Bisection | None = None,
    ) -> None:
        self.results.append(
            Comparison(
                entrant.name,
                entrant.runtime,
                output,
                kind,
                difference.max_abs,
                difference.max_rel,
                self._tolerance(output, entrant),
                difference.passed,
                where,
                difference.reason,
                drift,
                difference.rounding,
                difference.histogram,
                None if difference.passed else difference.smallest_tolerance,
                bisection,
            )
        )

    def _failure(self, kind: str, runtime: str, error: RunFailedError, output: str = "*") -> None:
        text = error.what if error.why is None else f"{error.what}: {error.why}"
        self.results.append(
            Comparison(
                kind, runtime, output, "failure", float("inf"), float("inf"), Tolerance(), False, None, text.strip()
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
        # A recording held against the source says nothing of what was written.
        independent = any(c.runtime in INDEPENDENT and c.format not in ("golden", "source") for c in self.results)
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
            in_order(self.results, self.subject),
            self.subject.sizes,
            (*self.signature.notes, *self.notes),
            self_consistent=self.subject.source is None,
        )


def random_outputs(graph: Graph, names: Iterable[str]) -> frozenset[str]:
    """The outputs that depend on a sampler inside the graph."""
    samplers = {n.name for n in graph.nodes if n.op in SAMPLERS}
    return frozenset(name for name in names if graph.ancestors([name]) & samplers)


def _likely(p_value: float) -> Difference:
    """What a test of draws says: as a difference, the p-value's complement."""
    if p_value >= FALSE_ALARM:
        return Difference(1 - p_value, 1 - p_value, True)
    reason = f"the draws do not have the distribution they should (p = {p_value:.1e})"
    return Difference(1 - p_value, 1 - p_value, False, reason)


def _rank(difference: Difference) -> tuple[bool, float]:
    return not difference.passed, difference.max_abs


def _largest(needed: Sequence[float | None]) -> float | None:
    """The tolerance that all need; None where one of them has none."""
    known = [t for t in needed if t is not None]
    return max(known) if len(known) == len(needed) else None


def _first(steps: Sequence[Difference]) -> int:
    """The first step that differs; their number where none does."""
    return next((i for i, d in enumerate(steps) if not d.passed), len(steps))
