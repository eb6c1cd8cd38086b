"""Outputs that are drawn: as numbers, with the samplers cut out of the artefact; the samplers themselves apart.

Both sides are given the same noise and classes (exporter/verify/cut.py), so that what comes of these is compared over
every input, and so are the odds that classes are drawn from. What a sampler makes is tested alone, in the artefact as
it is, at inputs of many kinds in one batch. Where an artefact cannot be cut, its outputs are tested by their
distribution. Two starts draw differently, and two calls: with a seed of its own a sampler plays one game each time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing

import numpy as np
from msgspec.structs import replace

from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import RUNTIMES
from export_model.exporter.verify.checks.classes import classes
from export_model.exporter.verify.checks.densities import densities
from export_model.exporter.verify.checks.generators import seen_by, wrong_draws
from export_model.exporter.verify.checks.mixed import (
    DRAWS,
    FEW,
    MIXED,
    has_pictures,
    in_turn,
    one_row_at_a_time,
    places,
    rows_at,
)
from export_model.exporter.verify.checks.numbers import numbers, rank
from export_model.exporter.verify.checks.rollout import rollout
from export_model.exporter.verify.cut import CutArtefact, cut_artefacts
from export_model.exporter.verify.difference import Difference, wrong
from export_model.exporter.verify.excuses import add_forgiven
from export_model.exporter.verify.findings import Bisection, Draws, Finding, Numbers
from export_model.exporter.verify.participants import Feeds, Participant
from export_model.exporter.verify.trial import Cut, Trial
from export_model.signatures.errors import ExportModelError
from export_model.signatures.roles import Role

Arrays = dict[str, np.ndarray]
#: Rows that two starts and two calls are compared by, and in how many of them the reference's own two must differ.
REPEATED, FEW_REPEATED, DIFFERING = 512, 128, 30
STARTED_ALIKE = "its draws are the same after every start: a sampler has a fixed seed"
CALLED_ALIKE = "its draws are the same in every call: the sampler begins anew each time"
STILL_DRAWN = "it draws where the policy does not: its answers differ where all that the policy draws is the same"
#: What tests of a distribution see, with the numbers of draws that they have (docs/agreement.md).
CLASSES_SEEN = "a share of one half that is off by 0.04 is seen, and one of a fiftieth by 0.012"
NUMBERS_SEEN = (
    "a shift of half their spread is seen at one input, of a seventh at all, a spread a seventh too wide at all"
)
MISFED = "it draws from other odds than the policy, though every tensor of the policy agrees"
ODDS = "the log-probabilities that its classes are drawn from differ by {:.3g}"
#: Where all sessions of a process begin alike whatever the model, two processes are what tells.
_ALIKE = frozenset(r.name for r in RUNTIMES if r.sessions_alike)
_POOR = {r.name: r.poor_draws for r in RUNTIMES if r.poor_draws}


def draws(trial: Trial, participant: Participant) -> Iterator[Finding]:
    """What is wrong with the outputs that are drawn, or how well they fit."""
    names = [n for n in participant.outputs if trial.is_drawn(n, participant)]
    if not names:
        return
    poor = _POOR.get(participant.runtime)
    if poor:
        trial.remarks[f"{participant.runtime}: only what is made of its draws is compared, as {poor}"] = None
    repeated = {} if poor else _repetitions(trial, participant, names)
    for name, reason in repeated.items():
        yield trial.finding(Draws, participant, name, wrong(reason), MIXED)
    names = [n for n in names if n not in repeated]
    found, uncut = _cut_findings(trial, participant, names)
    if found is None and not poor:
        found = [*classes(trial, participant, names)]
        known = [f.output for f in found]
        found += densities(trial, participant, [n for n in names if n not in known])
        for output, seen in ((f.output, CLASSES_SEEN if f.output in known else NUMBERS_SEEN) for f in found if uncut):
            where = f"{participant.name} in {participant.runtime}"
            trial.remarks[f"{where}: {output} compared by distribution, as {uncut}: {seen}"] = None
    yield from (f for f in found or () if f.output not in repeated)


def _cut_findings(
    trial: Trial, participant: Participant, names: Sequence[str]
) -> tuple[list[Finding] | None, str | None]:
    """What is found of an artefact that is cut, or None and why it cannot be; no reason where there is no file."""
    if participant.path is None or not names:
        return None, None
    try:
        cut = trial.cut
        if cut is None or (participant.model is trial.reference.model and cut.trial.reference.original is None):
            return None, None
        with closing(cut_artefacts(cut.policy, participant, names, trial.pool)) as ways:
            found = next((f for way in ways if (f := _findings_of(trial, cut, way, names)) is not None), None)
    except (ExportModelError, OSError) as error:  # its draws are tested by their distribution
        return None, str(getattr(error, "why", None) or error)
    return found, "its samplers are not those of the policy"


def _findings_of(trial: Trial, cut: Cut, way: CutArtefact, names: Sequence[str]) -> list[Finding] | None:
    """What is found in one way to cut an artefact; None where another may be the right one."""
    made, participant = way.participant, way.participant
    case, expected = cut.trial.cases[0], cut.trial.expected[0]
    one, other = made.run([case.feeds, case.feeds], list(made.outputs))
    alike = all(np.array_equal(one[n], other[n], equal_nan=one[n].dtype.kind == "f") for n in one)
    if way.foreign and not alike:
        return None
    if not alike:
        return [trial.finding(Numbers, participant, n, wrong(STILL_DRAWN), case.name) for n in names]
    if not way.last:
        fits = (cut.trial.difference(n, expected, one[n], made, case).passed for n in one)
        if not all(fits):
            return None
    found = _by_output(trial, cut, names, numbers(cut.trial, made))
    memory = cut.trial.signature.memory
    if memory is not None and memory.output in names:
        found += _by_output(trial, cut, names, rollout(cut.trial, made))
    failed = {f.output for f in found if not f.passed}
    if made.runtime in _POOR:
        return found
    return [*found, *(f for f in _sampler_findings(trial, cut, way, names) if f.output not in failed)]


def _by_output(trial: Trial, cut: Cut, names: Sequence[str], found: Iterator[Finding]) -> list[Finding]:
    """One finding for each output, that of the odds that it is drawn from where that is the worse; all that forgave."""
    behind = {s.odds.name: s.name for s in cut.policy.samplers if s.odds is not None}
    odds = {name: cut.policy.actions[sampler] for name, sampler in behind.items()}
    worst: dict[str, Finding] = {}
    every: dict[str, list[Finding]] = {}
    for finding in found:
        for output in [n for n in odds.get(finding.output, [finding.output])[:1] if n in names]:
            if finding.output in odds and not finding.passed:
                sampler = _sampler(trial, behind[finding.output], MISFED)
                found_at = finding.bisection if finding.bisection and finding.bisection.tensor else sampler
                reason = finding.reason or ODDS.format(finding.max_abs_diff)
                finding = replace(finding, reason=reason, bisection=found_at)
            finding = replace(finding, output=output)
            every.setdefault(output, []).append(finding)
            before = worst.get(output)
            if before is None or (before.passed, -before.share) > (finding.passed, -finding.share):
                worst[output] = finding
    return [
        replace(
            f, forgiven=add_forgiven(e.forgiven for e in every[name]), elements=sum(e.elements for e in every[name])
        )
        for name, f in worst.items()
    ]


def _sampler_findings(trial: Trial, cut: Cut, way: CutArtefact, names: Sequence[str]) -> Iterator[Finding]:
    """How well each sampler's draws fit what it draws from, for the outputs that hang on it."""
    participant, samplers = way.participant, list(way.own.values())
    single = one_row_at_a_time(participant) and any(s.scores is not None for s in samplers)
    count = trial.allowances.of(participant, "draws").at_most(FEW if single or has_pictures(trial) else DRAWS, "draws")
    if not count or not samplers:
        return
    scores = [s.scores for s in samplers if s.scores is not None]
    fetch = list(dict.fromkeys([*(s.tensor for s in samplers), *scores]))
    answers = way.as_it_is(rows_at(trial, in_turn(trial, places(trial), count), single=single), fetch)
    values = {n: np.concatenate([a[n] for a in answers]) for n in fetch}
    odds = {s.tensor: seen_by(participant, values[s.scores]) for s in samplers if s.scores is not None}
    found = wrong_draws(samplers, values, odds, participant)
    for name in names:
        behind = {n: found[own.tensor] for n, own in way.own.items() if name in cut.policy.actions[n]}
        worst = max(behind, key=lambda n: rank(behind[n]), default=None)
        if worst is not None:
            yield _draws_finding(trial, cut, participant, name, behind[worst], worst)


def _draws_finding(
    trial: Trial, cut: Cut, participant: Participant, name: str, difference: Difference, sampler: str
) -> Finding:
    begins = None
    if not difference.passed:
        begins = _sampler(trial, sampler, "what it draws from agrees, what it draws does not")
    return trial.finding(Draws, participant, name, difference, MIXED, bisection=begins)


def _sampler(trial: Trial, name: str, reason: str) -> Bisection:
    """Where a difference begins that is a sampler's."""
    node = next((n for n in trial.tested.graph.nodes if n.name == name), None)
    return Bisection(name) if node is None else Bisection(name, node.op, trial.bisector.source_of(node), reason=reason)


# ---- draws that come again


def _repetitions(trial: Trial, participant: Participant, names: Sequence[str]) -> dict[str, str]:
    """Output → what is wrong with draws that come again: after every start, or in every call."""
    if participant.runtime == "numpy":  # its child draws from one seed
        return {}
    single = one_row_at_a_time(participant)
    count = FEW_REPEATED if single or has_pictures(trial) else REPEATED
    if not trial.allowances.of(participant, "draws").takes(4 * count, "draws of two starts and two calls"):
        return {}
    rows = in_turn(trial, places(trial), count)
    pair = [rows_at(trial, rows, single=single, run=run) for run in range(2)]
    one, other = (_join_rows(trial.reference.run(inputs, names)) for inputs in pair)
    telling = {n: (one[n] != other[n]).sum(axis=0) >= DIFFERING for n in names}
    if not any(t.any() for t in telling.values()):
        return {}
    one, other = (_join_rows(participant.run(pair[0], names)) for _ in range(2))
    called = _alike(one, other, telling)
    said = {n: CALLED_ALIKE + _which(trial, n, columns) for n, columns in called.items()}
    starts = _starts(trial, participant, pair[0], names, telling)
    if starts and trial.tested.seeded:
        trial.remarks[f"{participant.name}: {STARTED_ALIKE}, as the reference's has"] = None
        starts = {}
    return {**said, **{n: STARTED_ALIKE + _which(trial, n, columns) for n, columns in starts.items()}}


def _starts(
    trial: Trial,
    participant: Participant,
    inputs: Sequence[Feeds],
    names: Sequence[str],
    telling: Mapping[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """Output → the columns that two starts draw alike.

    Nothing where it cannot be started again. A file that another runtime has drawn from is not started in a second
    process for it: the seed would be the file's.
    """
    apart = participant.runtime in _ALIKE
    if participant.again is None or participant.path is None or (apart and participant.path in trial.started):
        return {}
    trial.started.add(participant.path)
    one = _start_again(participant, trial.pool, inputs, names)
    if not apart:
        return _alike(one, _start_again(participant, trial.pool, inputs, names), telling)
    with RuntimePool() as second:
        return _alike(one, _start_again(participant, second, inputs, names), telling)


def _start_again(participant: Participant, pool: RuntimePool, inputs: Sequence[Feeds], names: Sequence[str]) -> Arrays:
    assert participant.again is not None
    model, run = participant.again(pool, True)
    with model:
        return _join_rows(run(inputs, names))


def _join_rows(answers: Sequence[Mapping[str, np.ndarray]]) -> Arrays:
    """[rows, columns] of each output."""
    together = {n: np.concatenate([a[n] for a in answers]) for n in answers[0]}
    return {n: a.reshape(len(a), -1) for n, a in together.items()}


def _alike(one: Arrays, other: Arrays, telling: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Output → its columns that are the same in every row, of those that ``telling`` says should not be."""
    found = {
        n: (one[n] == other[n]).all(axis=0) & t
        for n, t in telling.items()
        if one[n].shape == other[n].shape and one[n].shape[1:] == t.shape
    }
    return {n: np.flatnonzero(columns) for n, columns in found.items() if columns.any()}


def _which(trial: Trial, name: str, columns: np.ndarray) -> str:
    """The branches, where some of several are meant."""
    branches = trial.signature.branches
    if trial.signature.output(name).role is not Role.SAMPLED or len(branches) < 2:
        return ""
    return f" (branch {', '.join(map(str, columns))} of {len(branches)})"
