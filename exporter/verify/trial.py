"""What the checks of one policy share: inputs, the reference's answers to them, and how an answer is judged."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.files.folders import scratch_folder
from export_model.converters.formats.embed import runnable
from export_model.converters.formats.registry import narrows
from export_model.converters.graph.nodes import Graph
from export_model.converters.graph.run import run_graph
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.verify.asked import Inputs, Question
from export_model.exporter.verify.bisection import Bisector
from export_model.exporter.verify.choices import Choices, broken_ties
from export_model.exporter.verify.cut import CutPolicy, cut_policy
from export_model.exporter.verify.difference import (
    ONE_SIDED,
    OPEN,
    SHARE,
    Difference,
    compare,
    compare_all,
    floor_log_probs,
    is_marked,
    near_best,
    score_bounds,
)
from export_model.exporter.verify.excuses import (
    CHAOS,
    NEVER,
    NO_DEVIATION,
    NOT_FROM_ZERO,
    TIE,
    ZERO_INPUTS,
    Excuse,
    Forgiven,
)
from export_model.exporter.verify.findings import Bisection, Finding, Shape
from export_model.exporter.verify.golden import Golden, read_golden
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.participants import Feeds, Participant, PolicyUnderTest
from export_model.exporter.verify.reference import Reference
from export_model.exporter.verify.rounding import Hull, Rounding, hull
from export_model.exporter.verify.spreads import Spreads
from export_model.exporter.verify.tolerances import Tolerance, tolerance_by_rules, tolerance_for
from export_model.exporter.verify.work import Allowances
from export_model.signatures.roles import Role
from export_model.signatures.sampling import FAR_CASES, HUGE_BATCH, Case, draw_cases, draw_rollout, unknown_ids

Arrays = dict[str, np.ndarray]
Hulls = Mapping[str, Hull]
#: Give up above this multiple of the rounding bound.
_GIVE_UP_FACTOR = 8
#: Outputs that an argmax is taken of.
_SCORES = (Role.LOG_PROBS, Role.PROBS, Role.Q_VALUES)


class Cut(Struct, frozen=True, eq=False):
    """A policy with its samplers as inputs, and its trial."""

    policy: CutPolicy
    trial: Trial


class Trial:
    """One policy that is tried. Raises UsageError where a recording does not fit it."""

    def __init__(self, tested: PolicyUnderTest, pool: RuntimePool, options: VerifyOptions) -> None:
        self.tested, self.pool, self.options = tested, pool, options
        self.signature = tested.signature
        self.golden = Golden() if options.golden is None else read_golden(Path(options.golden), self.signature)
        rows = tested.source_map.rows if tested.source is not None else None
        # An original for a fixed number of rows would run thousands of times for the largest batch.
        drawn = [
            case
            for case in draw_cases(self.signature, seed=options.seed, samples=options.samples)
            if rows is None or case.batch < HUGE_BATCH
        ]
        self.cases = [*drawn, *self.golden.cases]
        recurrent = bool(self.signature.recurrences)
        self.steps: list[Feeds] = []
        if recurrent:
            self.steps += draw_rollout(self.signature, seed=options.seed, steps=options.steps)
        #: cases that tell how far an output varies
        self._typical = [case for case in drawn if case.name.startswith("typical")]
        self._scores = {s.name for s in self.signature.outputs if s.role is Role.LOG_PROBS}
        self.choices = Choices(tested.graph)
        #: what time there is for each artefact in each runtime
        self.allowances = Allowances(tested.graph)
        #: files that were started twice, to see whether they draw alike
        self.started: set[Path] = set()
        #: what is to be known of a runtime, for the report
        self.remarks: dict[str, None] = {}
        self.expected: list[Arrays] = []
        self.expected_steps: list[Arrays] = []
        self._stack = ExitStack()

    @cached_property
    def cut(self) -> Cut | None:
        """The policy with its samplers as inputs, tried on as many inputs; None where it cannot be cut.

        Raises RunFailedError.
        """
        policy = cut_policy(self.tested, Path(self._stack.enter_context(scratch_folder())))
        if policy is None:
            return None
        if policy.tested is self.tested:  # its noise is an input as it is
            return Cut(policy, self)
        trial = Trial(policy.tested, self.pool, replace(self.options, golden=None))
        source = policy.tested.source
        given = [source.runtime] if source is not None and self.reference.original is not None else []
        reference = self._stack.enter_context(Reference(policy.tested, given, self.pool, self.options.seed))
        steps = [dict(feeds) for feeds in trial.steps]
        trial.steps = [*steps]
        policy.draw([*(case.feeds for case in trial.cases), *steps], reference.model, self.options.seed)
        trial.ask(reference)
        trial.bisector.compared = self.bisector.compared
        return Cut(policy, trial)

    def close(self) -> None:
        """Free what was loaded to answer for the policy without its samplers, and to look inside."""
        self._stack.close()

    def replace_inputs(self, inputs: Inputs) -> None:
        """Ask these in place of what was drawn."""
        self.cases, self.steps, self._typical = list(inputs.cases), list(inputs.steps), list(inputs.cases)

    def ask(self, reference: Reference) -> None:
        """Have every input answered by the reference. Raises RunFailedError."""
        self.reference = reference
        inputs = [case.feeds for case in self.cases]
        reference.remember(inputs)
        self.expected = reference.answers(inputs)
        self._apart = reference.apart()
        if self.signature.memory is not None and self.signature.memory.output in reference.drawn:
            self.steps = []  # it keeps what was drawn: every run goes another way
        self.expected_steps = self.roll_out(lambda feeds: reference.answers([feeds])[0])
        numbers = [s.name for s in self.signature.outputs if s.name not in reference.drawn and s.dtype == "float32"]
        self.rounding = Rounding(self.options.seed, numbers, self._comparable)
        self.bisector = Bisector(self.tested, self.pool, self._is_right, self.rounding.inner)
        self._spreads = Spreads(self._typical_answers)
        self._flushed: dict[str, Arrays] = {}

    def notes(self) -> list[str]:
        """What was left out, for the report, and what could not be fed."""
        unknown = [
            f"which integers {name} takes is not known: 0 and 1 were tried, and no others"
            for name in unknown_ids(self.signature)
        ]
        return [*unknown, *self.allowances.notes(), *self.remarks]

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

        What may forgive it is asked where it matters, for an input or a step of the rollout, one after the other.
        """
        found = self._compare(name, expected, got, participant)
        if at is None or found.passed or found.reason not in ("", ONE_SIDED):
            return found
        asked = Question(name, expected, got, participant, at, found)
        # Beside infinity no rounding is any.
        forgiving = (self._zero_inputs, self._rounding, self._choices, self._far_rounding) if not found.reason else ()
        for forgive in (*forgiving, self._ends):
            found = forgive(asked) or found
            if found.passed:
                break
        return found

    def _zero_inputs(self, asked: Question) -> Difference | None:
        """Held against the reference's answers to the same inputs with zeros for denormals; None where it differs."""
        if not isinstance(asked.at, Case) or (flushed := asked.at.flush_denormals()) is None:
            return None
        if asked.at.name not in self._flushed:
            (self._flushed[asked.at.name],) = self.reference.answers([flushed])
        other = self._compare(asked.name, self._flushed[asked.at.name], asked.got, asked.participant)
        forgiven = (Forgiven(ZERO_INPUTS, asked.found.beyond, asked.found.max_abs), *other.forgiven)
        return replace(other, forgiven=forgiven) if other.passed else None

    def _rounding(self, asked: Question, *, sure: bool = False) -> Difference:
        bounds = self._rounding_bounds(asked.at, asked.participant, sure=sure)
        return self._compare(asked.name, asked.expected, asked.got, asked.participant, bounds)

    def _far_rounding(self, asked: Question) -> Difference | None:
        """With rounding measured more often; None where what was measured is not near."""
        bounds = self._rounding_bounds(asked.at, asked.participant)
        far = {n: _GIVE_UP_FACTOR * a for n, a in bounds.items()}
        near = self._compare(asked.name, asked.expected, asked.got, asked.participant, far).passed
        return self._rounding(asked, sure=True) if near else None

    def _choices(self, asked: Question) -> Difference | None:
        """Held against the reference's answer with choices among scores that are as good made as the answer has them.

        None where there are none.
        """
        name, expected, participant = asked.name, asked.expected, asked.participant
        if expected[name].shape != asked.got.shape or not self.choices.behind(name):
            return None
        feeds = asked.at.feeds if isinstance(asked.at, Case) else self._fed_at(asked.at)
        moved = partial(self.rounding.scores, participant.runtime, runnable(self.tested.graph), asked.at)
        others = self.choices.others(name, feeds, self._choice_tolerance(name, participant), moved)
        made = broken_ties(expected[name], others, asked.got, self.tolerance(name, participant))
        if made is None or not (turned := made != expected[name]).any():
            return None
        bounds = self._rounding_bounds(asked.at, participant)
        other = self._compare(name, {**expected, name: made}, asked.got, participant, bounds)
        most = float(np.abs(made - expected[name])[turned].max()) if made.dtype.kind == "f" else np.inf
        return replace(other, forgiven=(Forgiven(TIE, int(turned.sum()), most), *other.forgiven))

    def _ends(self, asked: Question) -> Difference | None:
        """Held against what comes of numbers that are not told from zero: at ordinary inputs in float64 alone."""
        if not isinstance(asked.at, Case):
            return None
        ordinary = asked.at.ordinary
        ends = self.rounding.ends(self.reference.model, asked.at, asked.participant.runtime)
        bounds = self._rounding_bounds(asked.at, asked.participant, sure=not ordinary)
        expected = self._comparable(asked.expected)
        names = [n for n in (ends[0] if ends else ()) if n in expected and expected[n].shape == ends[0][n].shape]
        hulls = {n: hull([end[n] for end in ends], expected[n], bounds.get(n, 0.0)) for n in names}
        if not any(each.open.any() for each in hulls.values()):
            return None
        return self._compare(asked.name, asked.expected, asked.got, asked.participant, bounds, hulls, ordinary=ordinary)

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
        wanted = [self._comparable({name: e[name]})[name] for e in expected]
        made = [self._comparable({name: a})[name] for a in got]
        known = compare_all(
            wanted,
            made,
            self.tolerance(name, participant),
            narrowed=narrows(participant.format),
            most=self._most(name, participant),
        )
        found = [
            self.difference(name, expected[i], got[i], participant, at[i]) if each is None else each
            for i, each in enumerate(known)
        ]
        if name not in self._scores:
            return found
        for i, each in enumerate(found):
            if each.passed and (never := int(((expected[i][name] != got[i]) & (wanted[i] == made[i])).sum())):
                found[i] = replace(each, forgiven=(*each.forgiven, Forgiven(NEVER, never, np.inf)))
        return found

    def _rounding_bounds(self, at: Case | int, participant: Participant, *, sure: bool = False) -> Feeds:
        """Per output, what rounding explains of it."""
        if isinstance(at, Case):
            return self.rounding.outputs(self.reference.model, at, participant.runtime, sure=sure)
        kept, runtime = [given for _, given in self.signature.recurrences], participant.runtime
        return self.rounding.steps(self.reference.model, self.roll_out, kept, at, runtime, sure=sure)

    def _compare(
        self,
        name: str,
        expected: Feeds,
        got: np.ndarray,
        participant: Participant,
        rounding: Feeds | None = None,
        hulls: Hulls | None = None,
        *,
        ordinary: bool = False,
    ) -> Difference:
        reference, candidate = self._comparable({name: expected[name]})[name], self._comparable({name: got})[name]
        open_hulls = {} if ordinary else hulls or {}
        free = self._open_choices(name, expected, got, participant, rounding or {}, open_hulls)
        if hulls and name in hulls and got.dtype.kind == "f" and got.shape == reference.shape:
            free = [*free, *hulls[name].forgive(candidate, reference, ordinary=ordinary)]
        return compare(
            reference,
            candidate,
            self.tolerance(name, participant),
            free=free,
            narrowed=narrows(participant.format),
            rounding=None if rounding is None or got.dtype.kind != "f" else rounding.get(name),
            most=self._most(name, participant),
            ceiling=self._spreads.ceiling(name, reference),
        )

    def _most(self, name: str, participant: Participant) -> np.ndarray | None:
        """What an output that hardly varies may be off, column by column, where no other tolerance was given."""
        return self._spreads.share(name) if self.tolerance(name, participant) == Tolerance() else None

    def _typical_answers(self, name: str) -> list[np.ndarray]:
        typical = {id(case) for case in self._typical}
        return [
            self._comparable(answers)[name]
            for case, answers in zip(self.cases, self.expected, strict=True)
            if name in answers and id(case) in typical
        ]

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
            elements=difference.elements,
            forgiven=difference.forgiven,
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
        """Values as they are compared: log-probabilities that say "never" are all the same."""
        return {
            n: floor_log_probs(a, self.signature.branches)
            if n in self._scores and a.dtype.kind == "f" and a.ndim
            else a
            for n, a in values.items()
        }

    def _open_choices(
        self,
        name: str,
        expected: Feeds,
        got: np.ndarray,
        participant: Participant,
        rounding: Feeds,
        hulls: Hulls,
    ) -> list[tuple[Excuse, np.ndarray]]:
        """Where the class that was chosen may be the best one as well, because the reference's scores are too close.

        So, too, where no noise times a deviation that overflows is NaN in a source that is fed zeros: the policy gives
        its mean there.
        """
        spec, branches = self.signature.output(name), self.signature.branches
        if spec.role is not Role.DETERMINISTIC or got.shape != expected[name].shape:
            return []
        if expected[name].dtype.kind == "f":
            return [(NO_DEVIATION, np.isnan(expected[name]))] if self.signature.noise else []
        scores = next((s.name for s in self.signature.outputs if s.role in _SCORES), None)
        if scores is None or scores not in expected or expected[scores].shape[-1] != sum(branches):
            return []
        if got.shape != (len(expected[scores]), len(branches)):
            return []
        made = self._comparable({scores: expected[scores]})[scores]
        tolerance, explained = self._choice_tolerance(name, participant), rounding.get(scores, 0.0)
        ceiling = self._spreads.ceiling(scores, made)
        told = score_bounds(made, branches, tolerance, np.where(explained < OPEN * ceiling, explained, 0.0))
        widest = score_bounds(made, branches, tolerance, np.minimum(explained, ceiling))
        found = [(TIE, is_marked(near_best(*told, branches), got, branches))]
        found.append((CHAOS, is_marked(near_best(*widest, branches), got, branches)))
        if scores in hulls:
            wide, there = hulls[scores], hulls[scores].open
            low, high = np.where(there, wide.low, told[0]), np.where(there, wide.high, told[1])
            found.append((NOT_FROM_ZERO, is_marked(near_best(low, high, branches), got, branches)))
        return found

    def _choice_tolerance(self, name: str, participant: Participant) -> Tolerance:
        """How near scores are that decide nothing: a tolerance of numbers frees no decision, a rule for it does."""
        rules = [rule for rule in self.options.rules if rule.output == name]
        found = tolerance_by_rules(rules, self.tested.name, participant.format, participant.runtime, name)
        return found or Tolerance()
