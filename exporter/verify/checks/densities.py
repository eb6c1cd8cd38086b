"""Numbers of an artefact that is not cut have the reference's distribution, at inputs that take turns in one batch.

With ``DENSITY_DRAWS`` draws, a shift of half the spread at one of ``KINDS`` inputs is seen, and at all of a seventh; so
is a spread a seventh too wide.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from export_model.exporter.verify.checks.generators import DEPENDENT, likely
from export_model.exporter.verify.checks.mixed import MIXED, Place, places, rows_at
from export_model.exporter.verify.difference import Difference, wrong
from export_model.exporter.verify.findings import Draws, Finding
from export_model.exporter.verify.participants import Participant
from export_model.exporter.verify.statistics import columns_related, dependent, ranks, same_distribution, same_spread
from export_model.exporter.verify.trial import Trial

#: Rows of policies that see vectors alone, instead of ``DRAWS``. So many
#: pictures or lists of entities do not fit into the memory that a runtime is given.
DENSITY_DRAWS, DRAWS = 4096, 512
#: Inputs that take turns.
KINDS = 8
#: Draws of which so many are one number may be it all by chance.
_NEARLY_ALL = 0.95
#: Draws this near, as a share of their spread, count as equal where those of all inputs are looked at together.
_NEAR = 1e-3
Arrays = dict[str, np.ndarray]


def densities(trial: Trial, participant: Participant, names: Sequence[str]) -> Iterator[Finding]:
    """Compare draws of numbers: each number of an output by itself (Kolmogorov-Smirnov for two samples of one size).

    Both are drawn many times, the reference by the numpy kernels; classes are taken for numbers.
    """
    vectors = all(len(s.shape) <= 2 for s in trial.signature.observations)
    count = DENSITY_DRAWS if vectors else DRAWS
    if not names or not trial.allowances.of(participant, "draws").takes(count, f"{count} draws of numbers"):
        return
    kinds = places(trial)[:KINDS]
    rows = [kinds[i % len(kinds)] for i in range(count)]
    runs = (trial.reference.run, participant.run)
    samples = [run(rows_at(trial, rows, run=i), names)[0] for i, run in enumerate(runs)]
    said = {n: text for n in names if (text := _shared_otherwise(*(_columns(s[n]) for s in samples)))}
    _draw_shared_anew(trial, participant, rows[:KINDS], [n for n in names if n not in said], samples)
    for name in names:
        difference = wrong(said[name]) if name in said else _difference(trial, participant, name, samples)
        yield trial.finding(Draws, participant, name, difference, MIXED)


def _draw_shared_anew(
    trial: Trial, participant: Participant, rows: Sequence[Place], names: list[str], samples: list[Arrays]
) -> None:
    """Replace samples of which all rows share one draw, or that none was drawn for: by as many runs as draws."""
    shared = [n for n in names if any(any((s[n][k::KINDS] == s[n][k]).all() for k in range(KINDS)) for s in samples)]
    if not shared:
        return
    for number, (sample, run) in enumerate(zip(samples, (trial.reference.run, participant.run), strict=True)):
        every = run([rows_at(trial, rows, run=number * DRAWS + i)[0] for i in range(DRAWS)], shared)
        sample.update({n: np.concatenate([one[n] for one in every]) for n in shared})


def _difference(trial: Trial, participant: Participant, name: str, samples: list[Arrays]) -> Difference:
    """How far the distribution of an output is from the reference's: for each input, and all together.

    Its numbers together and each by itself. All together, what is at one input is brought to one mean and spread.
    """
    one, other = (_columns(s[name]) for s in samples)
    if one.shape != other.shape:
        return wrong(f"shape {list(samples[1][name].shape)} instead of {list(samples[0][name].shape)}")
    alike = [_of_one_input(a, b) for a, b in ((one[k::KINDS], other[k::KINDS]) for k in range(KINDS))]
    a, b = (np.concatenate(each) for each in zip(*alike, strict=True))
    if np.isfinite(other).all() and (difference := _joint(_ranks(one), _ranks(other))) is not None:
        return difference
    tolerance = trial.tolerance(name, participant)
    p_values = [same_distribution(x, y, _NEAR, 0.0) for x, y in zip(a.T, b.T, strict=True)]
    p_values += [same_spread(x, y, _NEAR) for x, y in zip(a.T, b.T, strict=True)]
    for k in range(KINDS):
        pairs = zip(one[k::KINDS].T, other[k::KINDS].T, strict=True)
        p_values += [same_distribution(x, y, tolerance.atol, tolerance.rtol) for x, y in pairs]
    return likely(min(1.0, min(p_values) * len(p_values)))


def _of_one_input(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two samples of one input, brought to their common mean and spread; zeros where they hardly vary."""
    both = np.concatenate([one, other]).astype(np.float64)
    spread = both.std(axis=0)
    varies = spread > _NEAR * (1 + np.abs(both).max(axis=0))
    made = np.divide(both - both.mean(axis=0), spread, out=np.zeros_like(both), where=varies)
    return made[: len(one)], made[len(one) :]


def _columns(drawn: np.ndarray) -> np.ndarray:
    return drawn.reshape(len(drawn), -1)


def _varies(drawn: np.ndarray) -> bool:
    """Whether rows drawn each for itself are never all the same: no number is nearly all there is."""
    return any(np.unique(c, return_counts=True)[1].max() < _NEARLY_ALL * len(c) for c in _columns(drawn).T)


def _shared_otherwise(reference: np.ndarray, drawn: np.ndarray) -> str | None:
    """What is wrong with draws [rows, columns] of which all rows share one, where the reference's do not, or do."""
    if reference.shape != drawn.shape:
        return None
    for one, other in zip(reference.T, drawn.T, strict=True):
        alike = [bool((column == column[0]).all()) for column in (one, other)]
        if alike == [False, True] and _varies(one):
            return "all rows of a batch get one draw, and the reference draws for each row"
        if alike == [True, False] and _varies(other):
            return "each row is drawn for itself, and all rows of the reference's batch get one draw"
    return None


def _ranks(drawn: np.ndarray) -> np.ndarray:
    """The rank of each draw among those of its input, in the order of the rows."""
    made = np.empty(drawn.shape)
    for k in range(KINDS):
        made[k::KINDS] = ranks(drawn[k::KINDS])
    return made


def _joint(reference: np.ndarray, drawn: np.ndarray) -> Difference | None:
    """What is wrong with the ranks of numbers [draws, columns] together, whatever each is by itself."""
    if apart := dependent([drawn], 3.0 * drawn.shape[1]):
        return wrong(DEPENDENT.format(apart))
    if columns_related(reference, drawn):
        return wrong("its numbers hang together otherwise than the reference's: one draw serves several")
    return None
