"""Numbers that are drawn, from noise in the graph or of a candidate's own, have the reference's distribution."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from exporter.verify.checks.draws import (
    DEPENDENT,
    DRAWS,
    REPEATED,
    REPEATED_CALLS,
    STARTS,
    Arrays,
    likely,
    repeated_draws,
)
from exporter.verify.difference import Difference, wrong
from exporter.verify.findings import Draws, Finding
from exporter.verify.participants import Participant
from exporter.verify.statistics import columns_related, dependent, ranks, same_distribution
from exporter.verify.trial import Trial
from signatures.roles import Role
from signatures.sampling import Case

#: Rows of policies that see vectors alone, instead of ``DRAWS``: a spread that is a quarter too wide is seen. So many
#: pictures or lists of entities do not fit into the memory that a runtime is given.
DENSITY_DRAWS = 4096
#: Draws of which so many are one number may be it all by chance.
_NEARLY_ALL = 0.95


def densities(trial: Trial, participant: Participant) -> Iterator[Finding]:
    """Compare draws of numbers: each number of an output by itself (Kolmogorov-Smirnov for two samples of one size).

    Both are drawn many times for one input, the reference by the numpy kernels.
    """
    names = _drawn_numbers(trial, participant)
    vectors = all(len(s.shape) <= 2 for s in trial.signature.observations)
    count = DENSITY_DRAWS if vectors else DRAWS
    if not names or not trial.allowance(participant, "draws").takes(count, f"{count} draws of numbers"):
        return
    case = trial.cases[0]
    feeds = _rows(trial, case, count)
    samples = [run([feeds], names)[0] for run in (trial.reference.run, participant.run)]
    said = {n: text for n in names if (text := _shared_otherwise(*(_columns(s[n]) for s in samples)))}
    _draw_shared_anew(trial, participant, [n for n in names if n not in said], samples)
    said = {**_repetitions(trial, participant, feeds, names, samples), **said}
    for name in names:
        difference = wrong(said[name]) if name in said else _difference(trial, participant, name, samples)
        yield trial.finding(Draws, participant, name, difference, case.name)


def _drawn_numbers(trial: Trial, participant: Participant) -> list[str]:
    """The participant's outputs of which all or some numbers are drawn."""
    drawn = [n for n in participant.outputs if trial.is_drawn(n, participant) or n in trial.reference.partly_drawn]
    return [n for n in drawn if trial.signature.output(n).dtype == "float32"]


def _draw_shared_anew(trial: Trial, participant: Participant, names: list[str], samples: list[Arrays]) -> None:
    """Replace samples of which all rows share one draw, or that none was drawn for: by as many runs as draws."""
    shared = [n for n in names if any((s[n] == s[n][:1]).all() for s in samples)]
    if not shared:
        return
    rows = [_rows(trial, trial.cases[0], 1, i) for i in range(DRAWS)]
    each = [run(rows, shared) for run in (trial.reference.run, participant.run)]
    for sample, every in zip(samples, each, strict=True):
        sample.update({n: np.concatenate([one[n] for one in every]) for n in shared})


def _repetitions(
    trial: Trial, participant: Participant, feeds: Arrays, names: list[str], samples: list[Arrays]
) -> dict[str, str]:
    """Output → what is wrong with draws that come again: after every start, or in every call."""
    reference, own = samples
    starts = repeated_draws(trial, participant, lambda run: run([feeds], names)[0])
    # Where all rows are the same nothing was drawn, or once for all of them: the distribution says so.
    said = {n: REPEATED for n in starts if (own[n] != own[n][:1]).any()}
    if participant.runtime == "numpy":
        return said
    again = _rows(trial, trial.cases[0], STARTS)
    one, other = participant.run([again, again], names)
    alike = [n for n in names if np.array_equal(one[n], other[n]) and _varies(reference[n])]
    return {**dict.fromkeys(alike, REPEATED_CALLS), **said}


def _difference(trial: Trial, participant: Participant, name: str, samples: list[Arrays]) -> Difference:
    """How far the distribution of an output is from the reference's, its numbers together and each by itself."""
    one, other = (_columns(s[name]) for s in samples)
    if one.shape == other.shape and (difference := _joint(one, other)) is not None:
        return difference
    tolerance = trial.tolerance(name, participant)
    pairs = zip(one.T, other.T, strict=True)
    p_values = [same_distribution(a, b, tolerance.atol, tolerance.rtol) for a, b in pairs]
    return likely(min(p_values, default=1.0))


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


def _joint(reference: np.ndarray, drawn: np.ndarray) -> Difference | None:
    """What is wrong with numbers [draws, columns] together, whatever each is by itself."""
    if np.isfinite(drawn).all() and (apart := dependent([ranks(drawn)], 3.0 * drawn.shape[1])):
        return wrong(DEPENDENT.format(apart))
    if columns_related(reference, drawn):
        return wrong("its numbers hang together otherwise than the reference's: one draw serves several")
    return None


def _rows(trial: Trial, case: Case, count: int, run: int = 0) -> dict[str, np.ndarray]:
    """The first row of a case ``count`` times, with noise drawn for each."""
    rng = np.random.default_rng([trial.options.seed, run])
    feeds = {}
    for spec in trial.signature.inputs:
        array = case.feeds[spec.name]
        array = np.repeat(array[:1], count, axis=0) if spec.batched else array
        noise = spec.role is Role.NOISE
        feeds[spec.name] = rng.standard_normal(array.shape).astype(np.float32) if noise else array
    return feeds
