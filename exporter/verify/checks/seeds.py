"""Two starts of an artefact draw differently: with a seed of its own a sampler plays the same game every time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from converters.runtimes.pool import RuntimePool
from converters.runtimes.registry import RUNTIMES
from exporter.verify.participants import Participant, Run
from exporter.verify.trial import Trial

Arrays = dict[str, np.ndarray]

REPEATED = "its draws are the same after every start: a sampler has a fixed seed"
#: Where all sessions of a process begin alike whatever the model, two processes are what tells.
_ALIKE = frozenset(r.name for r in RUNTIMES if r.sessions_alike)


def repeated(trial: Trial, participant: Participant, ask: Callable[[Run], Arrays]) -> set[str]:
    """What of the answers of ``ask`` is drawn alike after two starts, by its key.

    Nothing where it cannot be started again. A file that another runtime has drawn from is not started in a second
    process for it: the seed would be the file's.
    """
    if participant.again is None or participant.path is None:
        return set()
    apart = participant.runtime in _ALIKE
    if apart and participant.path in trial.started:
        return set()
    trial.started.add(participant.path)
    one = _first(participant, trial.pool, ask)
    if not apart:
        other = _first(participant, trial.pool, ask)
    else:
        with RuntimePool() as second:
            other = _first(participant, second, ask)
    return {name for name, drawn in one.items() if np.array_equal(drawn, other[name])}


def _first(participant: Participant, pool: RuntimePool, ask: Callable[[Run], Arrays]) -> Arrays:
    assert participant.again is not None
    model, run = participant.again(pool)
    with model:
        return ask(run)
