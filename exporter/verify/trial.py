"""What the checks of one policy share: inputs, the reference's answers to them, and how an answer is judged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from msgspec import Struct

from converters.formats.bundle.embed import runnable
from converters.formats.registry import narrows
from converters.graph.nodes import Graph
from converters.graph.run import run_graph
from converters.runtimes.pool import RuntimePool
from exporter.verify.bisection import Bisector
from exporter.verify.choices import Choices, broken_ties
from exporter.verify.difference import ONE_SIDED, SHARE, Difference, compare, compare_all, floor_log_probs, spread, ties
from exporter.verify.drawn_columns import without_draws
from exporter.verify.findings import Bisection, Finding, Shape
from exporter.verify.golden import Golden, read_golden
from exporter.verify.options import VerifyOptions
from exporter.verify.participants import Feeds, Participant, PolicyUnderTest
from exporter.verify.reference import Reference
from exporter.verify.rounding import Rounding
from exporter.verify.tolerances import Tolerance, tolerance_by_rules, tolerance_for
from exporter.verify.work import Allowance, products
from signatures.roles import Role
from signatures.sampling import FAR_CASES, Case, draw_cases, draw_rollout, unknown_ids

Arrays = dict[str, np.ndarray]
#: Give up above this multiple of the rounding bound.
_GIVE_UP_FACTOR = 8
#: Outputs that an argmax is taken of.
_SCORES = (Role.LOG_PROBS, Role.PROBS, Role.Q_VALUES)


class Inputs(Struct, frozen=True):
    """What a policy is asked in place of inputs that are drawn: states that were met, and steps in a row."""

    cases: Sequence[Case]
    steps: Sequence[Feeds] = ()


class Trial:
    """One policy that is tried. Raises UsageError where a recording does not fit it."""

    def __init__(self, tested: PolicyUnderTest, pool: RuntimePool, options: VerifyOptions) -> None:
        self.tested, self.pool, self.options = tested, pool, options
        self.signature = tested.signature
        self.golden = Golden() if options.golden is None else read_golden(Path(options.golden), self.signature)
        drawn = draw_cases(self.signature, seed=options.seed, samples=options.samples)
        self.cases = [*drawn, *self.golden.cases]
        recurrent = bool(self.signature.recurrences)
        self.steps: list[Feeds] = []
        if recurrent:
            self.steps += draw_rollout(self.signature, seed=options.seed, steps=options.steps)
        #: cases that tell how far an output varies
        self._typical = [case for case in drawn if case.name.startswith("typical")]
        #: the others of those that were drawn: nobody is known to feed them, and float32 need not have an answer
        self._edges = {id(case) for case in drawn} - {id(case) for case in self._typical}
        self._scores = {s.name for s in self.signature.outputs if s.role is Role.LOG_PROBS}
        self.choices = Choices(tested.graph)
        self._cost = 0
        self._allowances: dict[tuple[str, str], Allowance] = {}
        #: format → the runtime that is given the dearest input
        self._first: dict[str, str] = {}
        #: files that were started twice, to see whether they draw alike
        self.started: set[Path] = set()
        self.expected: list[Arrays] = []
        self.expected_steps: list[Arrays] = []

    def replace_inputs(self, inputs: Inputs) -> None:
        """Ask these in place of what was drawn."""
        self.cases, self.steps, self._typical = list(inputs.cases), list(inputs.steps), list(inputs.cases)
        self._edges = set()

    def ask(self, reference: Reference) -> None:
        """Have every input answered by the reference. Raises RunFailedError."""
        self.reference = reference
        inputs = [case.feeds for case in self.cases]
        reference.remember(inputs)
        self.expected = reference.answers(inputs)
        self._apart = reference.apart()
        drawn = {*reference.drawn, *reference.partly_drawn}
        if self.signature.memory is not None and self.signature.memory.output in drawn:
            self.steps = []  # it keeps what was drawn: every run goes another way
        self.expected_steps = self.roll_out(lambda feeds: reference.answers([feeds])[0])
        numbers = [s.name for s in self.signature.outputs if s.name not in reference.drawn and s.dtype == "float32"]
        self.rounding = Rounding(self.options.seed, numbers, self._comparable)
        self.bisector = Bisector(self.tested, self.pool, self._is_right, self.rounding.inner)
        self._spreads: dict[str, np.ndarray | None] = {}
        self._flushed: dict[str, Arrays] = {}

    def allowance(self, participant: Participant, purpose: str = "inputs") -> Allowance:
        """What time there is for an artefact in a runtime; there is as much for inputs as for draws."""
        key = (f"{participant.name} in {participant.runtime}", purpose)
        if key not in self._allowances:
            self._cost = self._cost or products(self.tested.graph)
            self._allowances[key] = Allowance(self._cost, participant.runtime)
        return self._allowances[key]

    def first_of(self, participant: Participant) -> bool:
        """Whether this runtime is the first of its format."""
        return self._first.setdefault(participant.name, participant.runtime) == participant.runtime

    def notes(self) -> list[str]:
        """What was left out, for the report, and what could not be fed."""
        unknown = [
            f"which integers {name} takes is not known: 0 and 1 were tried, and no others"
            for name in unknown_ids(self.signature)
        ]
        return [*unknown, *self._left_out()]

    def _left_out(self) -> list[str]:
        return [note for (who, _), each in self._allowances.items() if (note := each.note(who)) is not None]

    def is_drawn(self, name: str, participant: Participant) -> bool:
        """Whether the reference or the participant draws an output: there is no number to compare then."""
        return name in self.reference.drawn or name in participant.drawn

    def tolerance(self, output: str, participant: Participant) -> Tolerance:
        """How far apart they may be: what a user said, an exception of the table, or the default."""
        found = tolerance_by_rules(
            self.options.rules, self.tested.name, participant.format, participant.runtime, output
        )
        return found or tolerance_for(self.signature, output, self.options.tolerance)

    def difference(
        self, name: str, expected: Feeds, got: np.ndarray, participant: Participant, at: Case | int | None = None
    ) -> Difference:
        """The difference of ``got`` from the reference's answer.

        What rounding explains is looked at where it matters, for an input or a step of the rollout.
        """
        found = self._compare(name, expected, got, participant)
        if at is None or found.passed:
            return found
        explained = found if found.reason else self._with_rounding(name, expected, got, participant, at)
        if explained.passed or found.reason not in ("", ONE_SIDED) or id(at) not in self._edges:
            return explained
        assert isinstance(at, Case)
        undetermined = self.rounding.open_elements(self.reference.model, at, participant.runtime)
        if not any(a.any() for a in undetermined.values()):
            return explained
        rounding = self._rounding_bounds(at, participant, sure=True)
        bounds = {n: np.maximum(a, rounding.get(n, 0)) for n, a in undetermined.items()}
        return self._compare(name, expected, got, participant, bounds)

    def _with_rounding(
        self, name: str, expected: Feeds, got: np.ndarray, participant: Participant, at: Case | int
    ) -> Difference:
        """A difference that is larger than the tolerance, with what rounding explains of it."""
        if isinstance(at, Case) and (flushed := at.flush_denormals()) is not None:
            if at.name not in self._flushed:
                (self._flushed[at.name],) = self.reference.answers([flushed])
            if (other := self._compare(name, self._flushed[at.name], got, participant)).passed:
                return other
        rounding = self._rounding_bounds(at, participant)
        explained = self._compare(name, expected, got, participant, rounding)
        if not explained.passed and (settled := self._broken_ties(name, expected, got, participant, at)) is not None:
            expected = {**expected, name: settled}
            explained = self._compare(name, expected, got, participant, rounding)
        far = {n: _GIVE_UP_FACTOR * a for n, a in rounding.items()}
        if explained.passed or not self._compare(name, expected, got, participant, far).passed:
            return explained
        return self._compare(name, expected, got, participant, self._rounding_bounds(at, participant, sure=True))

    def _broken_ties(
        self, name: str, expected: Feeds, got: np.ndarray, participant: Participant, at: Case | int
    ) -> np.ndarray | None:
        """The reference's answer with choices among scores that are as good made as ``got`` makes them."""
        tolerance = self.tolerance(name, participant)
        if expected[name].shape != got.shape or not self.choices.behind(name):
            return None
        feeds = at.feeds if isinstance(at, Case) else self._fed_at(at)
        graph = runnable(self.tested.graph)
        moved = partial(self.rounding.inner, participant.runtime, graph)
        scores = tolerance if tolerance.atol > Tolerance().atol else Tolerance()
        return broken_ties(expected[name], self.choices.others(name, feeds, scores, moved), got, tolerance)

    def _fed_at(self, step: int) -> Feeds:
        """What the reference was fed at a step of the rollout."""
        if not step:
            return self.steps[step]
        return {**self.steps[step], **self.signature.fed_back(self.expected_steps[step - 1])}

    def differences(
        self,
        name: str,
        expected: Sequence[Feeds],
        got: Sequence[np.ndarray],
        participant: Participant,
        at: Sequence[Case] | Sequence[int],
    ) -> list[Difference]:
        """``difference`` of several inputs or steps. What passes as it is, nearly all, is compared at once."""
        found = compare_all(
            [self._comparable({name: e[name]})[name] for e in expected],
            [self._comparable({name: g})[name] for g in got],
            self.tolerance(name, participant),
            narrowed=narrows(participant.format),
            most=self._most(name, participant),
        )
        return [
            self.difference(name, expected[i], got[i], participant, at[i]) if known is None else known
            for i, known in enumerate(found)
        ]

    def _rounding_bounds(self, at: Case | int, participant: Participant, *, sure: bool = False) -> Feeds:
        """Per output, what rounding explains of it."""
        if isinstance(at, Case):
            return self.rounding.outputs(self.reference.model, at, participant.runtime, sure=sure)
        kept, runtime = [given for _, given in self.signature.recurrences], participant.runtime
        return self.rounding.steps(self.reference.model, self.roll_out, kept, at, runtime, sure=sure)

    def _compare(
        self, name: str, expected: Feeds, got: np.ndarray, participant: Participant, rounding: Feeds | None = None
    ) -> Difference:
        return compare(
            self._comparable({name: expected[name]})[name],
            self._comparable({name: got})[name],
            self.tolerance(name, participant),
            free=self._open_choices(name, expected, participant, rounding or {}),
            narrowed=narrows(participant.format),
            rounding=None if rounding is None or got.dtype.kind != "f" else rounding.get(name),
            most=self._most(name, participant),
        )

    def _most(self, name: str, participant: Participant) -> np.ndarray | None:
        """What an output that hardly varies may be off, column by column: a share of how far it varies.

        A tolerance that a user or the table gave stays as it is, and so does that of a column that is always the same.
        """
        if self.tolerance(name, participant) != Tolerance():
            return None
        if name not in self._spreads:
            typical = {id(case) for case in self._typical}
            made = [
                self._comparable(answers)[name]
                for case, answers in zip(self.cases, self.expected, strict=True)
                if name in answers and id(case) in typical
            ]
            self._spreads[name] = spread(made)
        return self._spreads[name]

    def bisect(
        self, participant: Participant, output: str, difference: Difference, feeds: Feeds, branch: int = 0
    ) -> Bisection | None:
        """Where a difference begins; None where there is none, or its reason says all there is to say."""
        if difference.passed:
            return None
        found = self.bisector.find(participant, output, feeds, self._judged_by(output, participant, difference), branch)
        return None if found.tensor is None and difference.reason else found

    def finding(
        self,
        kind: type[Finding],
        participant: Participant,
        output: str,
        difference: Difference,
        where: str,
        drift: tuple[float, ...] = (),
        bisection: Bisection | None = None,
    ) -> Finding:
        """What a check says, from the difference that it found."""
        return kind(
            format=participant.name,
            runtime=participant.runtime,
            output=output,
            max_abs_diff=difference.max_abs,
            max_rel_diff=difference.max_rel,
            tolerance=self._judged_by(output, participant, difference),
            passed=difference.passed,
            worst_input=where,
            reason=difference.reason,
            drift=drift,
            rounding=difference.rounding,
            histogram=difference.histogram,
            smallest_tolerance=None if difference.passed else difference.smallest_tolerance,
            bisection=bisection,
            against="numpy" if output in self._apart and kind is not Shape else "",
            share=difference.share,
        )

    def _judged_by(self, output: str, participant: Participant, difference: Difference) -> Tolerance:
        """The tolerance, or what went before it: a share of how far the output varies."""
        tolerance, most = self.tolerance(output, participant), self._most(output, participant)
        least = difference.smallest_tolerance
        if most is None or difference.passed or difference.reason or least is None or least > tolerance.atol:
            return tolerance
        share = float(most.min())
        return Tolerance(share, 0.0, f"a thousandth of how far it varies (a column by {share / SHARE:.2g} only)")

    def roll_out(self, run: Callable[[Feeds], Arrays]) -> list[Arrays]:
        """Outputs of each step, the memory fed back."""
        answers: list[Arrays] = []
        for feeds in self.steps:
            if answers:
                feeds = {**feeds, **self.signature.fed_back(answers[-1])}
            answers.append(run(feeds))
        return answers

    def _is_right(self, graph: Graph) -> bool:
        """Whether ``graph``, run by the numpy kernels, gives what the reference does.

        Where inputs are far, rounding alone may make a difference, which the model that rounds may be too wrong to
        explain.
        """
        numpy = self.reference.participant("reference", [])
        for case, expected in zip(self.cases, self.expected, strict=True):
            if case.name in FAR_CASES:
                continue
            got = run_graph(graph, case.feeds, list(expected))
            if not all(self.difference(name, expected, got[name], numpy, case).passed for name in expected):
                return False
        return True

    def _comparable(self, values: Feeds) -> Arrays:
        """Values as they are compared: log-probabilities that say "never" are all the same, drawn columns are zeros."""
        partly = self.reference.partly_drawn
        return {
            n: floor_log_probs(a, self.signature.branches)
            if n in self._scores and a.dtype.kind == "f" and a.ndim
            else without_draws(a, partly[n])
            if n in partly
            else a
            for n, a in values.items()
        }

    def _open_choices(self, name: str, expected: Feeds, participant: Participant, rounding: Feeds) -> np.ndarray | None:
        """Where an argmax is not decided, because the scores of the reference are too close.

        So, too, where no noise times a deviation that overflows is NaN in a source that is fed zeros: the policy gives
        its mean there.
        """
        spec = self.signature.output(name)
        if spec.role is not Role.DETERMINISTIC:
            return None
        if expected[name].dtype.kind == "f" and self.signature.noise:
            return np.isnan(expected[name])
        if not self.signature.branches or expected[name].dtype.kind == "f":
            return None
        scores = next((s.name for s in self.signature.outputs if s.role in _SCORES), None)
        if scores is None or scores not in expected or expected[scores].shape[-1] != sum(self.signature.branches):
            return None
        found = ties(
            expected[scores], self.signature.branches, self.tolerance(scores, participant), rounding.get(scores)
        )
        return found if found.shape == expected[name].shape else None
