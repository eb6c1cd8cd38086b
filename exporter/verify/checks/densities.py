"""Numbers that are drawn, from noise in the graph or of a candidate's own, have the reference's distribution."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from exporter.verify.checks.draws import DEPENDENT, DRAWS, REPEATED, likely, repeated
from exporter.verify.difference import Difference, wrong
from exporter.verify.findings import Draws, Finding
from exporter.verify.participants import Participant
from exporter.verify.statistics import dependent, ranks, related, same_distribution
from exporter.verify.trial import Trial
from signatures.roles import Role
from signatures.sampling import Case

#: Rows of policies without cameras, instead of ``DRAWS``: a spread that is a quarter too wide is seen.
DENSITY_DRAWS = 4096


def densities(trial: Trial, participant: Participant) -> Iterator[Finding]:
    """Both are drawn many times for one input, the reference by the numpy kernels, and each number of an output is
    tested by itself (Kolmogorov-Smirnov for two samples of one size).
    """
    names = [
        n for n in participant.outputs if trial.drawn(n, participant) and trial.signature.output(n).dtype == "float32"
    ]
    if not names:
        return
    case = trial.cases[0]
    runs = (trial.reference.run, participant.run)
    cameras = any(s.role is Role.VISUAL for s in trial.signature.inputs)
    count = DRAWS if cameras else DENSITY_DRAWS
    if not trial.allowance(participant, "draws").takes(count, f"{count} draws of numbers"):
        return
    feeds = _rows(trial, case, count)
    samples = [run([feeds], names)[0] for run in runs]
    if any((s[n] == s[n][:1]).all() for s in samples for n in names):
        # One draw for the whole batch, or none: as many runs as draws.
        each = [run([_rows(trial, case, 1, i) for i in range(DRAWS)], names) for run in runs]
        samples = [{n: np.concatenate([one[n] for one in every]) for n in names} for every in each]
    # Where all rows are the same nothing was drawn, or once for all of them: the distribution says so.
    alike = {
        n
        for n in repeated(trial, participant, lambda run: run([feeds], names)[0])
        if (samples[1][n] != samples[1][n][:1]).any()
    }
    for name in names:
        if name in alike:
            yield trial.finding(Draws, participant, name, wrong(REPEATED), case.name)
            continue
        one, other = (s[name].reshape(len(s[name]), -1) for s in samples)
        if one.shape == other.shape and (difference := _joint(one, other)) is not None:
            yield trial.finding(Draws, participant, name, difference, case.name)
            continue
        tolerance = trial.tolerance(name, participant)
        pairs = zip(one.T, other.T, strict=True)
        p_values = [same_distribution(a, b, tolerance.atol, tolerance.rtol) for a, b in pairs]
        yield trial.finding(Draws, participant, name, likely(min(p_values, default=1.0)), case.name)


def _joint(reference: np.ndarray, drawn: np.ndarray) -> Difference | None:
    """What is wrong with numbers [draws, columns] together, whatever each is by itself."""
    if np.isfinite(drawn).all() and (apart := dependent([ranks(drawn)], 3.0 * drawn.shape[1])):
        return wrong(DEPENDENT.format(apart))
    if related(reference, drawn):
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
