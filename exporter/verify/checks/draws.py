"""Classes that are drawn: many times for one input, against the reference's log-probabilities."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from exporter.verify.difference import Difference
from exporter.verify.findings import Draws, Finding
from exporter.verify.participants import Feeds, Participant
from exporter.verify.statistics import FALSE_ALARM, fit
from exporter.verify.trial import Trial
from signatures.roles import Role

#: Rows that a sampler is drawn for.
DRAWS = 512


def draws(trial: Trial, participant: Participant) -> Iterator[Finding]:
    """The goodness of fit of each branch, at the input and the branch where it is worst."""
    sampled = [s for s in trial.signature.outputs if s.role is Role.SAMPLED]
    scores = next((s.name for s in trial.signature.outputs if s.role is Role.LOG_PROBS), None)
    if not sampled or scores is None or sampled[0].name not in participant.outputs:
        return
    action = sampled[0].name
    if action not in trial.reference.drawn:
        return
    fits = []
    for case in [c for c in trial.cases if c.name == "random masks"] + trial.cases[:1]:
        expected = trial.expected[trial.cases.index(case)].get(scores)
        if expected is None:
            return
        row = {name: array[:1] for name, array in case.feeds.items()}
        p_values = _fits(trial, participant, action, row, expected[0])
        fits.append((min(p_values), p_values.index(min(p_values)), case, row))
    lowest, branch, case, row = min(fits, key=lambda f: f[0])
    difference = likely(lowest)
    begins = trial.bisected(participant, action, difference, row, branch)
    yield trial.finding(Draws, participant, action, difference, case.name, bisection=begins)


def _fits(trial: Trial, participant: Participant, action: str, row: Feeds, log_probs: np.ndarray) -> list[float]:
    """The p-value of each branch, of ``DRAWS`` draws for one row of inputs."""
    if participant.runtime.startswith("tfjs-cpu"):  # in Node and in Chromium
        # Its Multinomial restarts its generator for every row of a batch: one row at a time.
        drawn = np.concatenate([participant.run(row, [action])[action] for _ in range(DRAWS)])
    else:
        drawn = participant.run({n: np.repeat(a, DRAWS, axis=0) for n, a in row.items()}, [action])[action]
    parts = np.split(log_probs, np.cumsum(trial.signature.branches)[:-1])
    columns = drawn.reshape(len(drawn), -1)
    return [fit(columns[:, i], part) for i, part in enumerate(parts)]


def likely(p_value: float) -> Difference:
    """What a test of draws says: as a difference, the p-value's complement."""
    if p_value >= FALSE_ALARM:
        return Difference(1 - p_value, 1 - p_value, True)
    reason = f"the draws do not have the distribution they should (p = {p_value:.1e})"
    return Difference(1 - p_value, 1 - p_value, False, reason)
