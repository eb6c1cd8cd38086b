"""Numbers that are drawn, from noise in the graph or of a candidate's own, have the reference's distribution."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from exporter.verify.checks.draws import DEPENDENT, DRAWS, REPEATED, REPEATED_CALLS, STARTS, likely, repeated_draws
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
    """Both are drawn many times for one input, the reference by the numpy kernels, and each number of an output is
    tested by itself (Kolmogorov-Smirnov for two samples of one size).
    """
    names = [
        n
        for n in participant.outputs
        if (trial.is_drawn(n, participant) or n in trial.reference.partly_drawn)
        and trial.signature.output(n).dtype == "float32"
    ]
    if not names:
        return
    case = trial.cases[0]
    runs = (trial.reference.run, participant.run)
    vectors = all(len(s.shape) <= 2 for s in trial.signature.observations)
    count = DENSITY_DRAWS if vectors else DRAWS
    if not trial.allowance(participant, "draws").takes(count, f"{count} draws of numbers"):
        return
    feeds = _rows(trial, case, count)
    samples = [run([feeds], names)[0] for run in runs]
    apart = {n: said for n in names if (said := _shared_otherwise(*(_columns(s[n]) for s in samples)))}
    shared = [n for n in names if n not in apart and any((s[n] == s[n][:1]).all() for s in samples)]
    if shared:
        # One draw for the whole batch, or none: as many runs as draws.
        each = [run([_rows(trial, case, 1, i) for i in range(DRAWS)], shared) for run in runs]
        for sample, every in zip(samples, each, strict=True):
            sample.update({n: np.concatenate([one[n] for one in every]) for n in shared})
    # Where all rows are the same nothing was drawn, or once for all of them: the distribution says so.
    alike = {
        n
        for n in repeated_draws(trial, participant, lambda run: run([feeds], names)[0])
        if (samples[1][n] != samples[1][n][:1]).any()
    }
    again = _rows(trial, case, STARTS) if participant.runtime != "numpy" else None
    calls = [] if again is None else participant.run([again, again], names)
    called_alike = {n for n in names if calls and np.array_equal(calls[0][n], calls[1][n]) and _varies(samples[0][n])}
    for name in names:
        said = apart.get(name) or (REPEATED if name in alike else REPEATED_CALLS if name in called_alike else None)
        if said is not None:
            yield trial.finding(Draws, participant, name, wrong(said), case.name)
            continue
        one, other = (_columns(s[name]) for s in samples)
        if one.shape == other.shape and (difference := _joint(one, other)) is not None:
            yield trial.finding(Draws, participant, name, difference, case.name)
            continue
        tolerance = trial.tolerance(name, participant)
        pairs = zip(one.T, other.T, strict=True)
        p_values = [same_distribution(a, b, tolerance.atol, tolerance.rtol) for a, b in pairs]
        yield trial.finding(Draws, participant, name, likely(min(p_values, default=1.0)), case.name)


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
