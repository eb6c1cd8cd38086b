"""What a sampler makes, alone: drawn in the artefact as it is, against the distribution that it reads there."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from export_model.converters.formats.intermediate_tensors import Sampler
from export_model.exporter.verify.checks.mixed import one_row_at_a_time
from export_model.exporter.verify.checks.numbers import rank
from export_model.exporter.verify.difference import Difference, wrong
from export_model.exporter.verify.participants import Participant
from export_model.exporter.verify.statistics import (
    FALSE_ALARM,
    columns_related,
    dependent,
    fit_all,
    odds_of,
    spread_fit,
    uniform_fit,
)

#: Numbers of a sampler that are looked at, of one that makes many.
_COLUMNS = 64
DEPENDENT = "its draws are not independent: rows {} apart draw alike"
RELATED = "its draws are not independent of each other: one draw serves several"
#: A class below this must never come up: ML-Agents leaves masked actions about 10⁻¹⁰.
_NEVER = 1e-9
#: How often a runtime's uniform number is exactly 0, which draws the first class that has any probability at all.
#: TensorFlow.js' WebGL shader makes numbers of 12 bits (measured on 4.22: 36 of 153,600, 2^-12 is 37.5 of them).
_ZEROS = {"tfjs-webgl": 2.0**-12}
#: Where how rows hang together says nothing of an artefact: the same shader hashes a place in a texture times the seed,
#: and with some seeds places at a distance get nearly the same number (seen on 4.22: rows 4 apart).
_LATTICES = frozenset(("tfjs-webgl",))
_erf = np.frompyfunc(math.erf, 1, 1)

#: Kind of sampler → the share of draws below numbers of it.
_BELOW: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "normal": lambda x: _normal(x),
    "truncated normal": lambda x: (_normal(x) - _normal(np.array(-2.0))) / (1 - 2 * _normal(np.array(-2.0))),
    "uniform": lambda x: x,
}


def wrong_draws(
    samplers: Sequence[Sampler],
    drawn: Mapping[str, np.ndarray],
    log_probs: Mapping[str, np.ndarray],
    participant: Participant,
) -> dict[str, Difference]:
    """How well what each of ``samplers`` drew, for rows that are independent, is what it should: by its tensor.

    ``log_probs`` [rows, classes] of those that draw classes. Every draw is brought to the share of draws that are
    smaller, which is uniform whatever the row's odds are: that is tested, and that neither rows (unless each was drawn
    alone) nor samplers tell anything of each other.
    """
    apart = participant.runtime in _LATTICES or (bool(log_probs) and one_row_at_a_time(participant))
    lots = np.random.default_rng(len(samplers))
    shares = {s.tensor: _shares(s, drawn[s.tensor], log_probs.get(s.tensor), lots) for s in samplers}
    found = {s.tensor: _alone(s, drawn[s.tensor], shares[s.tensor], log_probs, apart=apart) for s in samplers}
    if all(d.passed for d in found.values()):
        together = np.concatenate([shares[s.tensor] for s in samplers], axis=1)
        if columns_related(*((each - 0.5) * math.sqrt(12) for each in (lots.random(together.shape), together))):
            return dict.fromkeys(found, wrong(RELATED))
    return found


def wrong_classes(
    drawn: np.ndarray, log_probs: np.ndarray, branches: Sequence[int], participant: Participant
) -> tuple[Difference, int]:
    """(how well classes [rows, branches] fit log-probabilities [rows, ΣB], the branch that fits worst)."""
    parts = np.split(log_probs, np.cumsum(branches)[:-1], axis=1)
    samplers = [Sampler(str(branch), "categorical") for branch in range(len(branches))]
    classes = {s.tensor: drawn[:, [branch]] for branch, s in enumerate(samplers)}
    odds = {s.tensor: seen_by(participant, part) for s, part in zip(samplers, parts, strict=True)}
    found = wrong_draws(samplers, classes, odds, participant)
    worst = max(found, key=lambda tensor: rank(found[tensor]))
    return found[worst], int(worst)


def _shares(sampler: Sampler, drawn: np.ndarray, log_probs: np.ndarray | None, lots: np.random.Generator) -> np.ndarray:
    """The share of draws that are smaller, [rows, numbers]: uniform numbers of a right sampler; among equals by lot."""
    rows = drawn.reshape(len(drawn), -1)[:, :_COLUMNS].astype(np.float64)
    if log_probs is None:
        return _BELOW[sampler.kind]((rows - sampler.mean) / sampler.scale)
    probs = odds_of(log_probs)
    classes = np.clip(rows.astype(int), 0, probs.shape[1] - 1)
    mine = np.take_along_axis(probs, classes, axis=1)
    above = np.take_along_axis(np.cumsum(probs, axis=1), classes, axis=1)
    return np.asarray(above - mine * lots.random(rows.shape))


def _alone(
    sampler: Sampler, drawn: np.ndarray, shares: np.ndarray, log_probs: Mapping[str, np.ndarray], *, apart: bool
) -> Difference:
    if not np.isfinite(drawn).all():
        return wrong("NaN or infinity was drawn")
    odds = log_probs.get(sampler.tensor)
    if odds is not None and np.isnan(odds_of(odds)).any():
        return wrong("the scores that its classes are drawn from are NaN")
    p_values = [fits(column) for column in shares.T for fits in (uniform_fit, spread_fit)]
    if odds is not None:
        classes = drawn.reshape(len(drawn), -1).astype(int)
        if (classes < 0).any() or (classes >= odds.shape[1]).any():
            return wrong("a class outside of its branch was drawn")
        if (np.take_along_axis(odds_of(odds), classes, axis=1) < _NEVER).any():
            return wrong("a class was drawn that never should be")
        p_values += [fit_all(classes, odds)]
    difference = likely(min(1.0, min(p_values) * len(p_values)))
    if difference.passed and not apart:
        deviations = (shares - 0.5) * math.sqrt(12)
        if rows := dependent([deviations], 3.0 * shares.shape[1]):
            return wrong(DEPENDENT.format(rows))
    return difference


def likely(p_value: float) -> Difference:
    """What a test of draws says: as a difference, the p-value's complement."""
    if p_value >= FALSE_ALARM:
        return Difference(1 - p_value, 1 - p_value, True)
    reason = f"the draws do not have the distribution they should (p = {p_value:.1e})"
    return Difference(1 - p_value, 1 - p_value, False, reason)


def _normal(x: np.ndarray) -> np.ndarray:
    return np.asarray((1 + _erf(x / math.sqrt(2))) / 2, np.float64)


def seen_by(participant: Participant, log_probs: np.ndarray) -> np.ndarray:
    """The log-probabilities [rows, classes] with which a runtime draws: of one whose number may be 0, others."""
    rate = _ZEROS.get(participant.runtime)
    return log_probs if rate is None else with_zeros(log_probs, rate)


def with_zeros(log_probs: np.ndarray, rate: float) -> np.ndarray:
    """Log-probabilities [rows, classes] of a sampler whose uniform number is 0 at this rate."""
    probs = odds_of(log_probs) * (1 - rate)
    probs[np.arange(len(probs)), np.argmax(probs > 0, axis=1)] += rate
    with np.errstate(divide="ignore"):
        return np.log(probs)
