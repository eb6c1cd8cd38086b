"""Every output's numbers, for inputs that are given one at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from converters.formats import narrows
from exporter.verify.difference import Difference, wrong
from exporter.verify.findings import Bisection, Finding, Numbers, Shape
from exporter.verify.histogram import added
from exporter.verify.participants import Participant
from exporter.verify.trial import Trial
from signatures.roles import Role
from signatures.sampling import Case
from signatures.spec import PolicySignature


def numbers(trial: Trial, participant: Participant) -> Iterator[Finding]:
    """The worst difference of each output, and where it begins; of a drawn one its shape, dtype and range.

    Every runtime is given the first input and what was recorded; a slow one of the others as many as it has time for.
    """
    worst: dict[str, tuple[Difference, Case]] = {}
    needed: dict[str, list[float | None]] = {}
    spread: dict[str, tuple[int, ...]] = {}
    allowance, recorded = trial.allowance(participant), len(trial.golden.cases)
    for number, (case, expected) in enumerate(zip(trial.cases, trial.expected, strict=True)):
        optional = 0 < number < len(trial.cases) - recorded
        if optional and not allowance.takes(case.batch, case.name):
            continue
        got = participant.run(case.feeds, list(participant.outputs))
        for name in participant.outputs:
            if trial.drawn(name, participant):
                difference = plausible(trial.signature, name, got[name], case, narrowed=narrows(participant.format))
            elif name in expected:
                difference = trial.difference(name, expected, got[name], participant, case)
            else:
                continue
            spread[name] = added(spread.get(name, ()), difference.histogram)
            needed.setdefault(name, []).append(difference.smallest_tolerance)
            if name not in worst or rank(difference) > rank(worst[name][0]):
                worst[name] = (difference, case)
    rounded = trial.bisector.constants(participant, trial.cases[0].feeds)
    for name, (difference, case) in worst.items():
        kind = Shape if trial.drawn(name, participant) else Numbers
        difference = replace(difference, smallest_tolerance=largest(needed[name]), histogram=spread[name])
        begins = trial.bisected(participant, name, difference, case.feeds)
        if difference.passed and (other := _upstream(trial, name, rounded)) is not None:
            difference = replace(difference, passed=False, reason=f"the constant {other.tensor} has another value")
            begins = other
        yield trial.finding(kind, participant, name, difference, case.name, bisection=begins)


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


def rank(difference: Difference) -> tuple[bool, float]:
    """Of two differences, the larger is the worse."""
    return not difference.passed, difference.max_abs


def largest(needed: Sequence[float | None]) -> float | None:
    """The tolerance that all need; None where one of them has none."""
    known = [t for t in needed if t is not None]
    return max(known) if len(known) == len(needed) else None
