"""Every output's numbers, for inputs that are given one at a time; and the reference's for what a user recorded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from msgspec.structs import replace

from export_model.converters.formats.registry import narrows
from export_model.exporter.verify.difference import Difference, add_histograms, wrong
from export_model.exporter.verify.excuses import BOTH_NAN, add_forgiven
from export_model.exporter.verify.findings import Bisection, Finding, Numbers, Shape, undecided_finding
from export_model.exporter.verify.participants import Feeds, Participant
from export_model.exporter.verify.trial import Trial
from export_model.signatures.roles import Role
from export_model.signatures.sampling import HUGE_BATCH, Case
from export_model.signatures.spec import PolicySignature


def numbers(trial: Trial, participant: Participant) -> Iterator[Finding]:
    """The worst difference of each output, and where it begins; of a drawn one its shape, dtype and range.

    Every runtime is given the first input, what was recorded and the steps with memory; a slow one of the other inputs
    as many as it has time for.
    """
    worst: dict[str, tuple[Difference, Case]] = {}
    every: dict[str, list[Difference]] = {}
    allowance, recorded = trial.allowances.of(participant), len(trial.golden.cases)
    allowance.left -= 2 * len(trial.steps)
    tried: list[tuple[Case, Feeds]] = []
    for number, (case, expected) in enumerate(zip(trial.cases, trial.expected, strict=True)):
        optional = 0 < number < len(trial.cases) - recorded
        if case.batch >= HUGE_BATCH and not trial.allowances.is_first(participant):
            continue
        if not optional or allowance.takes(case.batch, case.name):
            tried.append((case, expected))
    cases, expectations = [case for case, _ in tried], [expected for _, expected in tried]
    answers = participant.run([case.feeds for case in cases], list(participant.outputs))
    for name in participant.outputs:
        got = [answer[name] for answer in answers]
        if trial.is_drawn(name, participant):
            narrowed = narrows(participant.format)
            pairs = zip(cases, got, strict=True)
            found = [plausible(trial.signature, name, array, case, narrowed=narrowed) for case, array in pairs]
        elif name in expectations[0]:
            found = trial.differences(name, expectations, got, participant, cases)
        else:
            continue
        every[name] = found
        worst[name] = max(zip(found, cases, strict=True), key=lambda pair: rank(pair[0]))
    rounded = trial.bisector.constants(participant, trial.cases[0].feeds)
    for name, (difference, case) in worst.items():
        kind = Shape if trial.is_drawn(name, participant) else Numbers
        needed = largest([d.smallest_tolerance for d in every[name]])
        counted = add_histograms(d.histogram for d in every[name])
        difference = sum_differences(difference, every[name], smallest_tolerance=needed, histogram=counted)
        begins = trial.bisect(participant, name, difference, case.feeds)
        if difference.passed and (other := _upstream(trial, name, rounded)) is not None:
            difference = replace(difference, passed=False, reason=f"the constant {other.tensor} has another value")
            begins = other
        yield trial.finding(kind, participant, name, difference, case.name, bisection=begins)
        if difference.passed:
            yield from _mostly_open(
                participant, name, [d for d, c in zip(every[name], cases, strict=True) if c.ordinary]
            )


def _mostly_open(participant: Participant, name: str, ordinary: Sequence[Difference]) -> Iterator[Finding]:
    """A finding where rules that hold an answer to no number forgave half the elements at ordinary inputs."""
    forgiven = [f for f in add_forgiven(d.forgiven for d in ordinary) if f.excuse.leaves_open]
    count, left = sum(d.elements for d in ordinary), sum(f.elements for f in forgiven)
    if forgiven and 2 * left >= count and (left < count or forgiven[0].excuse is not BOTH_NAN):  # else: check_defined
        titles = " and ".join(f.excuse.title for f in forgiven)
        reason = f"{left:,} of {count:,} elements of {name} were left open at ordinary inputs: {titles}"
        yield undecided_finding(participant.name, participant.runtime, name, reason)


def sum_differences(worst: Difference, every: Sequence[Difference], **changes: Any) -> Difference:
    """The worst of several differences, with the elements, shares and what was forgiven of all of them."""
    return replace(
        worst,
        share=max(d.share for d in every),
        elements=sum(d.elements for d in every),
        forgiven=add_forgiven(d.forgiven for d in every),
        **changes,
    )


def _upstream(trial: Trial, name: str, constants: Sequence[Bisection]) -> Bisection | None:
    """The first of ``constants`` that an output is made of."""
    upstream = trial.tested.graph.ancestors([name]) if constants else frozenset()
    return next((c for c in constants if c.tensor in upstream), None)


def plausible(
    signature: PolicySignature, name: str, got: np.ndarray, case: Case, *, narrowed: bool = False
) -> Difference:
    """A drawn output: shape, dtype and range; how it is distributed is for other checks.

    ``narrowed``: the format lacks dtypes, and only the kind of number is its own.

    An action without chance that is drawn is wrong, whatever it is.
    """
    spec = signature.output(name)
    wanted = tuple(case.batch if n is None else n for n in spec.shape)
    if spec.role is Role.DETERMINISTIC:
        return wrong("it is the action without chance, and it is drawn")
    if got.shape != wanted:
        return wrong(f"shape {list(got.shape)} instead of {list(wanted)}")
    if got.dtype.kind != np.dtype(spec.dtype).kind or (got.dtype != spec.dtype and not narrowed):
        return wrong(f"dtype {got.dtype.name} instead of {spec.dtype}")
    if not np.isfinite(got).all():
        return wrong("NaN or infinity was drawn")
    if spec.role is Role.SAMPLED and signature.branches:
        sizes = np.array(signature.branches)
        if (got < 0).any() or (got >= sizes).any():
            return wrong("a class outside of its branch was drawn")
    return Difference(0.0, 0.0, True)


def check_recording(trial: Trial) -> Iterator[Finding]:
    """The reference beside what a user recorded (exporter/verify/golden.py).

    What hangs on noise that was not recorded is left out.
    """
    golden, reference = trial.golden, trial.reference
    names = [s.name for s in trial.signature.outputs if s.name not in reference.drawn]
    noisy = trial.tested.graph.descendants(golden.noiseless)
    names = [n for n in names if n not in noisy]
    participant = reference.participant("golden", names, runtime=reference.runtime)
    every: dict[str, list[tuple[Difference, str]]] = {}
    answers = trial.expected[len(trial.cases) - len(golden.cases) :]
    for case, expected, arrays in zip(golden.cases, answers, golden.answers, strict=True):
        for name in (n for n in arrays if n in names and n in expected):
            found = trial.difference(name, expected, arrays[name], participant)
            every.setdefault(name, []).append((found, case.name))
    for name, pairs in every.items():
        worst, where = max(pairs, key=lambda pair: rank(pair[0]))
        difference = sum_differences(worst, [found for found, _ in pairs])
        yield trial.finding(Numbers, participant, name, difference, where)


def rank(difference: Difference) -> tuple[bool, float]:
    """Of two differences, the larger is the worse."""
    return not difference.passed, difference.max_abs


def largest(needed: Sequence[float | None]) -> float | None:
    """The tolerance that all need; None where one of them has none."""
    known = [t for t in needed if t is not None]
    return max(known) if len(known) == len(needed) else None
