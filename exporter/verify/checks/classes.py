"""Classes of an artefact that is not cut, against the log-probabilities of the reference.

The inputs take turns in one batch, so that a sampler that serves all rows by the odds of one is seen. Of ``DRAWS``
draws a share that is off by 0.04 is seen where half of all are expected, and by 0.012 where one of fifty is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from export_model.exporter.verify.checks.generators import wrong_classes
from export_model.exporter.verify.checks.mixed import (
    DRAWS,
    FEW,
    MIXED,
    Place,
    has_pictures,
    in_turn,
    one_row_at_a_time,
    places,
    rows_at,
)
from export_model.exporter.verify.findings import Draws, Finding
from export_model.exporter.verify.participants import Participant
from export_model.exporter.verify.tolerances import Tolerance
from export_model.exporter.verify.trial import Trial
from export_model.signatures.roles import Role
from export_model.signatures.sampling import Case


def classes(trial: Trial, participant: Participant, names: Sequence[str]) -> Iterator[Finding]:
    """How well the classes fit of each output whose log-probabilities the reference has; see the module."""
    scores, branches = trial.signature.log_probs, trial.signature.branches
    if scores is None or any(scores.name not in e for e in trial.expected):
        return
    odds = {id(case): answers[scores.name] for case, answers in zip(trial.cases, trial.expected, strict=True)}
    for name in names:
        spec = trial.signature.output(name)
        if spec.role is not Role.SAMPLED or (*spec.shape, 1)[1] != len(branches):
            continue
        single = one_row_at_a_time(participant)
        wanted = FEW if single or has_pictures(trial) else DRAWS
        count = trial.allowances.of(participant, "draws").at_most(wanted, "draws")
        known = [(c, r) for c, r in _decided_places(trial, scores.name) if not np.isnan(odds[id(c)][r]).any()]
        if not count or not known:
            continue
        rows = in_turn(trial, known, count)
        answers = participant.run(rows_at(trial, rows, single=single), [name])
        drawn = np.concatenate([a[name] for a in answers]).reshape(len(rows), -1)
        log_probs = np.stack([odds[id(case)][row] for case, row in rows])
        difference, branch = wrong_classes(drawn, log_probs, branches, participant)
        begins = trial.bisect(participant, name, difference, rows_at(trial, rows[:1])[0], branch)
        yield trial.finding(Draws, participant, name, difference, MIXED, bisection=begins)


def _decided_places(trial: Trial, scores: str) -> list[Place]:
    """The places at which no choice that the odds hang on is open: another is right there too."""
    found = places(trial)
    if not trial.choices.behind(scores):
        return found
    tied: dict[int, np.ndarray] = {}

    def is_open(case: Case, row: int) -> bool:
        if id(case) not in tied:
            tied[id(case)] = trial.choices.tied_rows(scores, case.feeds, Tolerance(), case.batch)
        return bool(tied[id(case)][row])

    return [place for place in found if not is_open(*place)]
