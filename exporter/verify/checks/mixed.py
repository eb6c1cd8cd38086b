"""Inputs of many kinds in one batch, as draws are asked for: a sampler may serve all rows by what it reads of one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from export_model.exporter.verify.participants import Participant
from export_model.exporter.verify.trial import Trial
from export_model.signatures.roles import Role
from export_model.signatures.sampling import FAR_CASES, ONE_FORBIDDEN, Case

#: What a report says was fed.
MIXED = "rows of many inputs"
#: Rows that draws are asked for, and fewer where a run takes long (pictures, one row at a time).
DRAWS, FEW = 4096, 1024
#: Where float32 has few digits left, a runtime's probabilities may be others within rounding.
_LEFT_OUT = frozenset(("1e3", "denormals", *FAR_CASES))
#: Rows of a case that take part; of the masks all do.
_ROWS = 16

Place = tuple[Case, int]


def places(trial: Trial) -> list[Place]:
    """Rows of the drawn cases at which odds are numbers that every runtime has alike, a row of each case in turn."""
    made = trial.cases[: len(trial.cases) - len(trial.golden.cases)]
    cases = [case for case in made if case.name not in _LEFT_OUT] or made[:1]
    counts = {id(c): c.batch if c.name == ONE_FORBIDDEN else min(_ROWS, c.batch) for c in cases}
    return [(case, row) for row in range(max(counts.values())) for case in cases if row < counts[id(case)]]


def in_turn(trial: Trial, rows: Sequence[Place], count: int) -> list[Place]:
    """``count`` places of ``rows``, all as often as others, in an order of chance."""
    order = np.random.default_rng(trial.options.seed).permutation(np.arange(max(count, len(rows))) % len(rows))
    return [rows[i] for i in order[:count]]


def rows_at(trial: Trial, rows: Sequence[Place], *, single: bool = False, run: int = 0) -> list[dict[str, np.ndarray]]:
    """What is fed for ``rows``, noise drawn for each ``run``: in one input, or each a ``single`` row in its own."""
    rng = np.random.default_rng([trial.options.seed, run])
    feeds: dict[str, np.ndarray] = {}
    for spec in trial.signature.inputs:
        array = rows[0][0].feeds[spec.name]
        if spec.batched:
            array = np.stack([case.feeds[spec.name][row] for case, row in rows])
        noise = spec.role is Role.NOISE
        feeds[spec.name] = rng.standard_normal(array.shape).astype(np.float32) if noise else array
    if not single:
        return [feeds]
    batched = {s.name for s in trial.signature.inputs if s.batched}
    return [{n: a[i : i + 1] if n in batched else a for n, a in feeds.items()} for i in range(len(rows))]


def has_pictures(trial: Trial) -> bool:
    """Whether a row takes long for what it holds."""
    return any(s.role is Role.VISUAL for s in trial.signature.inputs)


def one_row_at_a_time(participant: Participant) -> bool:
    """In Node and in Chromium TensorFlow.js' cpu Multinomial restarts its generator for every row of a batch."""
    return participant.runtime.startswith("tfjs-cpu")
