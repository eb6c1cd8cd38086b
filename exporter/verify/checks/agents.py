"""Source code as its callers call it: several agents act in turn, each with noise, a state and a seed of its own.

Noise and state are read back, and the reference is fed them: every output is a number then. Noise, and classes that are
drawn, are tested by their distribution; an episode that begins with the same seed must be the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.formats.programs.artifact import contract_held
from export_model.converters.formats.programs.members import Header, header_of
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.runtimes.agents import (
    AGENTS,
    CHOSEN,
    EVERY,
    SIZES,
    UNUSUAL,
    fields_of_agent,
    fields_with_size,
)
from export_model.exporter.verify.checks.generators import DEPENDENT, likely, wrong_classes
from export_model.exporter.verify.checks.numbers import rank, sum_differences
from export_model.exporter.verify.difference import Difference, wrong
from export_model.exporter.verify.findings import Acting, Bisection, Draws, Finding
from export_model.exporter.verify.participants import Feeds, Participant
from export_model.exporter.verify.statistics import (
    FALSE_ALARM,
    columns_related,
    dependent,
    normal_fit,
    ranks,
    same_distribution,
)
from export_model.exporter.verify.tolerances import Tolerance
from export_model.exporter.verify.trial import Trial
from export_model.signatures.code import CodeOptions
from export_model.signatures.masks import random_masks
from export_model.signatures.roles import Role
from export_model.signatures.sampling import Case, draw_rollout

Arrays = Mapping[str, np.ndarray]
ANEW = "an episode that begins with the same seed again does not go as it did"
ALIKE = "agents whose draws begin with other seeds draw alike"
SHARED = "its numbers hang together: one draw serves several"
#: Decisions of each agent in each step where something is drawn, and as an episode begins.
DRAWS, STARTS = 512, 48
#: Numbers of noise that are looked at, all steps and agents together.
_NOISE = 4096


def agents(trial: Trial, participant: Participant) -> Iterator[Finding]:
    """What ``act``, ``act_all`` and ``choose`` of source code give, and its constants."""
    form = WRITTEN.get(participant.format.partition(":")[0])
    if form is None or not form.program or participant.path is None:
        return
    played = _Played(trial, participant)
    for check in (played.constants, played.beginnings, played.numbers, played.noise, played.classes, played.densities):
        yield from check()


class _DrivenStep(Struct, frozen=True):
    """What agents were fed, noise and state included; what they answered; what the reference does."""

    case: Case
    answer: Arrays
    expected: Feeds


class _Played:
    """Some steps of an episode of the agents of one program."""

    def __init__(self, trial: Trial, participant: Participant) -> None:
        assert participant.path is not None
        contract = contract_held(participant.path)
        self.trial, self.participant, self.signature = trial, participant, contract.signature
        self.code = CodeOptions.of(contract.tool)
        self.header: Header = header_of(contract.name, contract.signature, self.code)
        self.chosen = self.header.choice_field(self.signature.branches)
        called = [n for n in participant.outputs if trial.is_drawn(n, participant)]
        self.drawn = [n for n in called if trial.signature.output(n).batched]
        self.observed = list(_observations(trial, trial.options.steps))
        alike = {n: np.repeat(a[:1], AGENTS, axis=0) if len(a) == AGENTS else a for n, a in self.observed[0].items()}
        self.begun = self._step("an episode begins", alike, {}, seed=True, repeat=STARTS, choose=STARTS)
        self.repeat = self._repeat()
        self.steps, state = list[_DrivenStep](), dict[str, np.ndarray]()
        for number, feeds in enumerate(self.observed):
            where = f"act, step {number + 1} of {len(self.observed)}"
            self.steps.append(self._step(where, feeds, state, seed=not number, repeat=self.repeat, choose=DRAWS))
            state = self.trial.signature.fed_back({n: self._answer(self.steps[-1], n) for n in self._returned_outputs})
        self.again = self._step("an episode begins", alike, {}, seed=True, repeat=STARTS, choose=STARTS)
        made = trial.reference.answers([s.case.feeds for s in (*self.steps, self.begun)])
        *self.steps, self.begun = [replace(s, expected=e) for s, e in zip((*self.steps, self.begun), made, strict=True)]

    # ------------------------------------------------------------------ what is played

    @property
    def _returned_outputs(self) -> list[str]:
        """The outputs that the program feeds back by itself."""
        given = self.header.next_state.spec.name if self.header.state and self.header.next_state else None
        return [out for _, out in self.trial.signature.recurrences if self._own(out) == given]

    def _own(self, name: str) -> str:
        """What the program calls an input or output of the policy."""
        return self.participant.called.get(name, name)

    def _answer(self, step: _DrivenStep, name: str) -> np.ndarray:
        """An output, or noise, in the shape that the policy has it in."""
        signature = self.trial.signature
        spec = signature.input(name) if signature.has_input(name) else signature.output(name)
        array = step.answer[self._own(name)]
        shape = (AGENTS, *(n or 1 for n in spec.shape[1:]))
        return array.reshape(shape) if array.size == math.prod(shape) else array

    def _repeat(self) -> int:
        """Decisions of each step: enough draws of numbers that are drawn, as far as there is time for them."""
        steps = len(self.observed) * AGENTS
        wanted = max([DRAWS if self.drawn else 1, *(-(-_NOISE // (steps * f.size)) for f in self.header.noise)])
        allowance = self.trial.allowances.of(self.participant, "draws")
        if allowance.takes(wanted * steps, f"{wanted * steps} decisions of agents"):
            return wanted
        return max(1, allowance.left // steps)

    def _step(self, where: str, feeds: Feeds, state: Feeds, *, seed: bool, repeat: int, choose: int) -> _DrivenStep:
        """A decision of each agent, several times from the same state."""
        header, outer = self.header, self.trial.signature
        names = [f.spec.name for f in fields_of_agent(header)]
        own = {self._own(n): a for n, a in feeds.items()}
        answer = self.participant.model.run(
            {f.spec.name: own[f.spec.name] for f in header.inputs},
            [*names, *(f"{EVERY}{n}" for n in names), CHOSEN, SIZES, UNUSUAL],
            drive={
                "seed": self.trial.options.seed + 2**33 if seed else None,
                "repeat": repeat,
                "choose": choose if self.chosen else 0,
                "noise": [f.spec.name for f in header.noise],
                "state": [header.state.spec.name, header.next_state.spec.name]
                if header.state and header.next_state
                else None,
                "sized": [f.spec.name for f in fields_with_size(header)],
            },
        )
        step = _DrivenStep(Case(where, {}, AGENTS), answer, {})
        noise = [s for s in outer.noise if self._own(s.name) in answer]
        drawn = {s.name: self._answer(step, s.name).astype(s.dtype) for s in noise}
        return replace(step, case=Case(where, {**feeds, **state, **drawn}, AGENTS))

    # ------------------------------------------------------------------ what it is held to

    def constants(self) -> Iterator[Finding]:
        """The sizes and branches that the file states, and how many numbers it calls unusual."""
        branches = self.signature.branches
        stated = {f"the size of {f.name}": f.size for f in fields_with_size(self.header)}
        stated |= {f"the actions of branch {i}": n for i, n in enumerate(branches, 1)} | {"branches": len(branches)}
        found = self.begun.answer[SIZES].tolist()
        for (what, right), got in zip(stated.items(), found, strict=True):
            if got != right:
                yield self._finding(
                    Acting, "*", wrong(f"its constant for {what} is {got}, and there are {right}"), SIZES
                )
                return
        for step in self.steps if self.code.guard is not None else ():
            unusual, said_so = self._unusual(step, self.code.guard or 0.0), step.answer[UNUSUAL].tolist()
            if unusual != said_so:
                said = wrong(f"it calls {said_so} numbers of three agents unusual, and {unusual} are")
                yield self._finding(Acting, "*", said, step.case.name)
                return

    def _unusual(self, step: _DrivenStep, most: float) -> list[int]:
        counts = np.zeros(AGENTS, int)
        ours = {self._own(n): a for n, a in step.case.feeds.items()}
        for f in self.header.inputs:
            said = f.spec.distribution or {}
            if said.get("kind") == "normal" and f.spec.dtype == "float32":
                mean, std = (np.resize(np.asarray(said[key], np.float32), f.size) for key in ("mean", "std"))
                limit = np.asarray(most * std.astype(np.float64), np.float32)
                far = ~(np.abs(ours[f.spec.name].reshape(AGENTS, -1).astype(np.float32) - mean) <= limit)
                counts += far.sum(axis=1)
        return list(map(int, counts))

    def beginnings(self) -> Iterator[Finding]:
        """Whether a seed decides how an episode goes, and another one otherwise."""
        for name, array in self.begun.answer.items():
            again = self.again.answer[name]
            if not np.array_equal(array, again, equal_nan=array.dtype.kind == "f"):
                yield self._finding(Acting, name.removeprefix(EVERY), wrong(ANEW), self.begun.case.name)
                return
        alike = [f.spec.name for f in self.header.noise if _equal(self.begun.answer[f"{EVERY}{f.spec.name}"], axis=1)]
        alike += [CHOSEN] if self.chosen and _equal(self.begun.answer[CHOSEN], axis=0) and self._would_differ() else []
        sampled = [n for n in self.drawn if _equal(self.begun.answer[f"{EVERY}{self._own(n)}"], axis=1)]
        alike += sampled if self._would_differ() else []
        for name in alike:
            yield self._finding(Draws, name, wrong(ALIKE), self.begun.case.name)

    def _would_differ(self) -> bool:
        """Whether draws of classes would differ if they were independent."""
        scores = self.trial.signature.log_probs
        if scores is None or scores.name not in self.begun.expected:
            return False
        probs = np.exp(self.begun.expected[scores.name][0].astype(np.float64))
        parts = np.split(probs, np.cumsum(self.trial.signature.branches)[:-1])
        same = math.prod(float(np.square(p / p.sum()).sum()) for p in parts)
        return same**STARTS < FALSE_ALARM

    def numbers(self) -> Iterator[Finding]:
        """Every output that is not drawn, beside the reference's for the noise and state that were read back."""
        trial, participant = self.trial, self.participant
        for name in participant.outputs:
            spec = trial.signature.output(name)
            steps = [s for s in self.steps if name in s.expected and self._own(name) in s.answer]
            if trial.is_drawn(name, participant) or not spec.batched or not steps:
                continue
            got, expected = [self._answer(s, name) for s in steps], [s.expected for s in steps]
            found = trial.differences(name, expected, got, participant, [s.case for s in steps])
            difference, step = max(zip(found, steps, strict=True), key=lambda pair: rank(pair[0]))
            begins = trial.bisect(participant, name, difference, step.case.feeds)
            difference = sum_differences(difference, found)
            yield trial.finding(Acting, participant, name, difference, step.case.name, bisection=begins)

    def noise(self) -> Iterator[Finding]:
        """The noise of all agents: N(0, 1), and no draw like another."""
        for f in self.header.noise:
            drawn = np.concatenate([s.answer[f"{EVERY}{f.spec.name}"] for s in self.steps])
            yield self._finding(Draws, f.spec.name, noise_difference(drawn.reshape(len(drawn), -1)), "act, all steps")

    def classes(self) -> Iterator[Finding]:
        """Classes that ``choose`` draws, and those that ``act`` does."""
        scores = self.trial.signature.log_probs
        if (
            scores is None
            or not self.trial.signature.branches
            or any(scores.name not in s.expected for s in self.steps)
        ):
            return
        made = {CHOSEN: [s.answer[CHOSEN] for s in self.steps]} if self.chosen else {}
        for name in self.drawn:
            if self.trial.signature.output(name).role is Role.SAMPLED:
                every = [s.answer[f"{EVERY}{self._own(name)}"] for s in self.steps]
                made[name] = [each.swapaxes(0, 1) for each in every]
        odds = np.concatenate([s.expected[scores.name].reshape(AGENTS, -1) for s in self.steps])
        decided = np.isfinite(odds).any(axis=1) & ~np.isnan(odds).any(axis=1)
        for name, drawn in made.items():
            every = np.concatenate(drawn)[decided].astype(np.int64)
            rows, log_probs = np.concatenate([*every.swapaxes(0, 1)]), np.tile(odds[decided], (every.shape[1], 1))
            branches = self.trial.signature.branches
            difference, branch = wrong_classes(rows, log_probs, branches, self.participant)
            alone = [
                rank(wrong_classes(each, np.tile(row, (len(each), 1)), branches, self.participant)[0])
                for each, row in zip(every, odds[decided], strict=True)
            ]
            place = int(np.flatnonzero(decided)[max(range(len(alone)), key=lambda i: alone[i])])
            step, agent, begins = self.steps[place // AGENTS], place % AGENTS, None
            if name != CHOSEN:
                row = {n: a[agent : agent + 1] if len(a) == AGENTS else a for n, a in step.case.feeds.items()}
                begins = self.trial.bisect(self.participant, name, difference, row, branch)
            yield self._finding(Draws, name, difference, f"{step.case.name}, agent {agent + 1}", begins)

    def densities(self) -> Iterator[Finding]:
        """Numbers that a sampler inside draws: as the reference draws them, for each agent."""
        names = [n for n in self.drawn if self.trial.signature.output(n).dtype == "float32"]
        step, rng = self.steps[0], np.random.default_rng((self.trial.options.seed, 4))
        for agent in range(AGENTS if names and self.repeat >= STARTS else 0):
            rows = {
                n: np.repeat(a[agent : agent + 1], self.repeat, axis=0) if self.trial.signature.input(n).batched else a
                for n, a in step.case.feeds.items()
            }
            rows |= {
                s.name: rng.standard_normal(rows[s.name].shape).astype(s.dtype) for s in self.trial.signature.noise
            }
            (other,) = self.trial.reference.run([rows], names)
            for name in names:
                tolerance = self.trial.tolerance(name, self.participant)
                drawn = step.answer[f"{EVERY}{self._own(name)}"][:, agent].reshape(self.repeat, -1)
                pairs = zip(other[name].reshape(self.repeat, -1).T, drawn.T, strict=True)
                p_value = min(same_distribution(a, b, tolerance.atol, tolerance.rtol) for a, b in pairs)
                yield self._finding(Draws, name, likely(p_value), f"{step.case.name}, agent {agent + 1}")

    def _finding(
        self,
        kind: type[Finding],
        output: str,
        difference: Difference,
        where: str,
        begins: Bisection | None = None,
    ) -> Finding:
        return kind(
            format=self.participant.name,
            runtime=self.participant.runtime,
            output=output,
            max_abs_diff=difference.max_abs,
            max_rel_diff=difference.max_rel,
            tolerance=Tolerance(),
            passed=difference.passed,
            worst_input=where,
            reason=difference.reason,
            bisection=begins,
        )


def _observations(trial: Trial, count: int) -> Iterator[dict[str, np.ndarray]]:
    """What agents observe, step by step; no state yet, and after the first step some actions are forbidden."""
    signature, seed = trial.signature, trial.options.seed
    rng = np.random.default_rng((seed, 3))
    for number, feeds in enumerate(draw_rollout(signature, seed=seed, steps=count, batch=AGENTS)):
        for spec in signature.inputs:
            if spec.role is Role.MEMORY_IN:
                feeds[spec.name] = np.zeros_like(feeds[spec.name])
            elif spec.role is Role.MASKS and number:
                width = int(spec.shape[-1] or 0)
                branches = signature.branches if sum(signature.branches) == width else (width,)
                feeds[spec.name] = random_masks(rng, AGENTS, branches).astype(spec.dtype)
        yield feeds


def _equal(array: np.ndarray, axis: int) -> bool:
    """Whether two agents have the same throughout."""
    rows = np.moveaxis(array, axis, 0)
    return any(np.array_equal(rows[i], rows[j]) for i in range(AGENTS) for j in range(i))


def noise_difference(drawn: np.ndarray) -> Difference:
    """How far noise [draws, numbers of all agents] is from independent draws of N(0, 1)."""
    if not np.isfinite(drawn).all():
        return wrong("NaN or infinity was drawn")
    difference = likely(normal_fit(drawn))
    if not difference.passed or len(drawn) < STARTS:
        return difference
    if apart := dependent([ranks(drawn)], 3.0 * drawn.shape[1]):
        return wrong(DEPENDENT.format(apart))
    independent = np.random.default_rng(0).standard_normal(drawn.shape)
    return wrong(SHARED) if columns_related(ranks(independent), ranks(drawn)) else difference
