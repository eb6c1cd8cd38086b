"""Classes that are drawn: many times for one input, against the reference's log-probabilities."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from exporter.verify.difference import Difference
from exporter.verify.findings import Draws, Finding
from exporter.verify.participants import Feeds, Participant
from exporter.verify.statistics import FALSE_ALARM, fit, fit_all
from exporter.verify.trial import Trial
from signatures.roles import Role

#: Draws for one input; all draws together, where a run takes long.
DRAWS = 512
FEW = 2 * DRAWS
#: Where float32 has few digits left, a runtime's probabilities may be others within rounding.
_LEFT_OUT = frozenset(("1e3", "denormals"))
#: How often a runtime's uniform number is exactly 0, which draws the first class that has any probability at all.
#: TensorFlow.js' WebGL shader makes numbers of 12 bits (measured on 4.22: 36 of 153,600, 2^-12 is 37.5 of them).
_ZEROS = {"tfjs-webgl": 2.0**-12}


def draws(trial: Trial, participant: Participant) -> Iterator[Finding]:
    """How well classes fit, one input at a time and all together, branch by branch and two branches at once."""
    sampled = [s for s in trial.signature.outputs if s.role is Role.SAMPLED]
    scores = next((s.name for s in trial.signature.outputs if s.role is Role.LOG_PROBS), None)
    if not sampled or scores is None or sampled[0].name not in participant.outputs:
        return
    action = sampled[0].name
    if action not in trial.reference.drawn or any(scores not in e for e in trial.expected):
        return
    made = zip(trial.cases[: len(trial.cases) - len(trial.golden.cases)], trial.expected, strict=False)
    known = [(c, e[scores][0]) for c, e in made if c.name not in _LEFT_OUT and not np.isnan(e[scores][0]).any()]
    if not known:
        return
    cases = [case for case, _ in known]
    rows = [{name: array[:1] for name, array in case.feeds.items()} for case in cases]
    log_probs = np.stack([scores for _, scores in known])
    if participant.runtime in _ZEROS:
        log_probs = with_zeros(log_probs, trial.signature.branches, _ZEROS[participant.runtime])
    drawn = _drawn(trial, participant, action, rows)
    p_value, branch, worst = least_likely(drawn, log_probs, trial.signature.branches)
    difference = likely(p_value)
    begins = trial.bisected(participant, action, difference, rows[worst], branch)
    yield trial.finding(Draws, participant, action, difference, cases[worst].name, bisection=begins)


def _drawn(trial: Trial, participant: Participant, action: str, rows: Sequence[Feeds]) -> np.ndarray:
    """[inputs, draws, branches]: classes drawn for each of ``rows``."""
    # In Node and in Chromium its Multinomial restarts its generator for every row of a batch: one row at a time.
    single = participant.runtime.startswith("tfjs-cpu")
    cameras = any(s.role is Role.VISUAL for s in trial.signature.inputs)
    count = max(1, FEW // len(rows)) if single or cameras else DRAWS
    drawn = []
    for row in rows:
        feeds = row if single else {n: np.repeat(a, count, axis=0) for n, a in row.items()}
        runs = [participant.run(feeds, [action])[action] for _ in range(count if single else 1)]
        drawn.append(np.concatenate(runs).reshape(count, -1))
    return np.stack(drawn)


def with_zeros(log_probs: np.ndarray, branches: Sequence[int], rate: float) -> np.ndarray:
    """Log-probabilities [inputs, ΣB] of a sampler whose uniform number is 0 at this rate."""
    probs = np.exp(log_probs.astype(np.float64)) * (1 - rate)
    start = 0
    for size in branches:
        part = probs[:, start : start + size]
        part[np.arange(len(part)), np.argmax(part > 0, axis=1)] += rate
        start += size
    with np.errstate(divide="ignore"):
        return np.log(probs)


def least_likely(drawn: np.ndarray, log_probs: np.ndarray, branches: Sequence[int]) -> tuple[float, int, int]:
    """(the p-value, the branch and the input that it is of) of classes [inputs, draws, branches] that were drawn.

    Each input by itself, all of them together, two branches at once; the smallest p counts as often as it was looked
    for. Together, a class that is rare everywhere is expected often enough, and a temperature shows; two branches that
    are drawn from one seed are right each, and not together.
    """
    parts = np.split(log_probs, np.cumsum(branches)[:-1], axis=1)
    found = [(fit(drawn[i, :, b], part[i]), b, i) for b, part in enumerate(parts) for i in range(len(drawn))]
    found += [(fit_all(drawn[:, :, b], part), b, 0) for b, part in enumerate(parts)]
    for b, (first, second) in enumerate(pairwise(parts)):
        joint = drawn[:, :, b] * branches[b + 1] + drawn[:, :, b + 1]
        both = (first[:, :, None] + second[:, None, :]).reshape(len(first), -1)
        found.append((fit_all(joint, both), b + 1, 0))
    p_value, branch, worst = min(found)
    return min(1.0, p_value * len(found)), branch, worst


def likely(p_value: float) -> Difference:
    """What a test of draws says: as a difference, the p-value's complement."""
    if p_value >= FALSE_ALARM:
        return Difference(1 - p_value, 1 - p_value, True)
    reason = f"the draws do not have the distribution they should (p = {p_value:.1e})"
    return Difference(1 - p_value, 1 - p_value, False, reason)
