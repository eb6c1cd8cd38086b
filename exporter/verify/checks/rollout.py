"""The memory fed back for some steps, in each runtime by itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from msgspec.structs import replace

from export_model.exporter.verify.checks.numbers import largest, rank, sum_differences
from export_model.exporter.verify.difference import Difference
from export_model.exporter.verify.findings import Finding, Rollout
from export_model.exporter.verify.participants import Feeds, Participant
from export_model.exporter.verify.trial import Trial


def rollout(trial: Trial, participant: Participant) -> Iterator[Finding]:
    """How far each output drifts, and the step where that begins."""
    memory = trial.signature.memory
    if not trial.steps or memory is None or memory.output not in participant.outputs:
        return
    fed: list[Feeds] = []

    def step(feeds: Feeds) -> dict[str, np.ndarray]:
        fed.append(feeds)
        return participant.run([feeds], list(participant.outputs))[0]

    got = trial.roll_out(step)
    names = [n for n in participant.outputs if n in trial.expected_steps[0] and not trial.is_drawn(n, participant)]
    numbers = range(len(fed))
    steps = {n: trial.differences(n, trial.expected_steps, [g[n] for g in got], participant, numbers) for n in names}
    where = [f"step {i + 1} of {len(fed)}" for i in range(len(fed))]
    for name, differences in steps.items():
        worst = max(range(len(fed)), key=lambda i: rank(differences[i]))
        least = largest([d.smallest_tolerance for d in differences])
        difference = sum_differences(differences[worst], differences, smallest_tolerance=least, histogram=())
        begins = None
        if not difference.passed:
            # An output that goes wrong after the memory did goes wrong because of it.
            output = min((n for n in (name, memory.output) if n in steps), key=lambda n: _first(steps[n]))
            first = _first(steps[output])
            begins = trial.bisect(participant, output, steps[output][first], fed[first])
            begins = begins and replace(begins, input=where[first])
        drift = tuple(d.max_abs for d in differences)
        yield trial.finding(
            Rollout, participant, output=name, difference=difference, where=where[worst], drift=drift, bisection=begins
        )


def _first(steps: Sequence[Difference]) -> int:
    """The first step that differs; their number where none does."""
    return next((i for i, d in enumerate(steps) if not d.passed), len(steps))
