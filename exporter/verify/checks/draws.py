"""Classes that are drawn: many times for one input, against the reference's log-probabilities; and after two starts.

Two starts draw differently: with a seed of its own a sampler plays the same game every time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import combinations

import numpy as np
from msgspec import Struct

from converters.runtimes.pool import RuntimePool
from converters.runtimes.registry import RUNTIMES
from exporter.verify.difference import Difference, wrong
from exporter.verify.findings import Draws, Finding
from exporter.verify.participants import Feeds, Participant, Run
from exporter.verify.statistics import FALSE_ALARM, dependent, fit, fit_all
from exporter.verify.tolerances import Tolerance
from exporter.verify.trial import Trial
from signatures.roles import Role
from signatures.sampling import ONE_ALLOWED, ONE_FORBIDDEN, Case

Arrays = dict[str, np.ndarray]
#: Draws for one input; all draws together, where a run takes long.
DRAWS = 512
FEW = 2 * DRAWS
#: Draws for all masks together that forbid one action or two, in one run.
FORBIDDEN = 4 * DRAWS
#: Draws that two starts are compared by, where a run takes long.
STARTS = 48
REPEATED = "its draws are the same after every start: a sampler has a fixed seed"
REPEATED_CALLS = "its draws are the same in every call: the sampler begins anew each time"
#: Where all sessions of a process begin alike whatever the model, two processes are what tells.
_ALIKE = frozenset(r.name for r in RUNTIMES if r.sessions_alike)
DEPENDENT = "its draws are not independent: rows {} apart draw alike"
#: Where float32 has few digits left, a runtime's probabilities may be others within rounding.
_LEFT_OUT = frozenset(("1e3", "denormals", "one number far away"))
#: How often a runtime's uniform number is exactly 0, which draws the first class that has any probability at all.
#: TensorFlow.js' WebGL shader makes numbers of 12 bits (measured on 4.22: 36 of 153,600, 2^-12 is 37.5 of them).
_ZEROS = {"tfjs-webgl": 2.0**-12}
#: Where how rows hang together says nothing of an artefact: the same shader hashes a place in a texture times the seed,
#: and with some seeds places at a distance get nearly the same number (seen on 4.22: rows 4 apart).
_LATTICES = frozenset(("tfjs-webgl",))


class _Asked(Struct, frozen=True):
    """What is drawn for: the classes' output and that of their log-probabilities; inputs, a row each, with these."""

    action: str
    scores: str
    cases: list[Case]
    rows: Sequence[Feeds]
    log_probs: np.ndarray


def draws(trial: Trial, participant: Participant) -> Iterator[Finding]:
    """How well classes fit, one input at a time and all together, branch by branch and two branches at once."""
    asked = _questions(trial, participant)
    if asked is None:
        return
    action, cases = asked.action, asked.cases
    branches = trial.signature.branches
    for branch, row in _started_alike(trial, participant, action, asked.rows, asked.log_probs).items():
        which = f" (branch {branch} of {len(branches)})" if len(branches) > 1 else ""
        yield trial.finding(Draws, participant, action, wrong(REPEATED + which), cases[row].name)
        return
    if (anew := _called_alike(trial, participant, action, asked.rows, asked.log_probs)) is not None:
        yield trial.finding(Draws, participant, action, wrong(REPEATED_CALLS), cases[anew].name)
        return
    difference, branch, worst = _fit(trial, participant, asked)
    if difference.passed and (masked := _with_one_forbidden(trial, participant, action, asked.scores)) is not None:
        yield masked
        return
    begins = trial.bisect(participant, action, difference, asked.rows[worst], branch)
    yield trial.finding(Draws, participant, action, difference, cases[worst].name, bisection=begins)


def _questions(trial: Trial, participant: Participant) -> _Asked | None:
    """The inputs that classes are drawn for; None where the participant draws none, or no odds are known."""
    sampled = [s for s in trial.signature.outputs if s.role is Role.SAMPLED]
    scores = next((s.name for s in trial.signature.outputs if s.role is Role.LOG_PROBS), None)
    if not sampled or scores is None or sampled[0].name not in participant.outputs:
        return None
    action = sampled[0].name
    if action not in trial.reference.drawn or any(scores not in e for e in trial.expected):
        return None
    known = _without_open_choices(trial, scores, _known_odds(trial, scores))
    if not known:
        return None
    cases = [case for case, _, _ in known]
    rows = [{name: array[row : row + 1] for name, array in case.feeds.items()} for case, row, _ in known]
    log_probs = np.stack([odds for _, _, odds in known])
    return _Asked(action, scores, cases, rows, _seen_by(participant, log_probs, trial))


def _known_odds(trial: Trial, scores: str) -> list[tuple[Case, int, np.ndarray]]:
    """(case, row, log-probabilities) of the inputs at which these are numbers that every runtime has alike."""
    made = zip(trial.cases[: len(trial.cases) - len(trial.golden.cases)], trial.expected, strict=False)
    return [
        (case, row, expected[scores][row])
        for case, expected in made
        for row in range(2 if case.name == ONE_ALLOWED else 1)
        if case.name not in _LEFT_OUT and case.name != ONE_FORBIDDEN and not np.isnan(expected[scores][row]).any()
    ]


def _seen_by(participant: Participant, log_probs: np.ndarray, trial: Trial) -> np.ndarray:
    """The log-probabilities with which a runtime draws: of one whose uniform number may be 0, others."""
    if participant.runtime not in _ZEROS:
        return log_probs
    return with_zeros(log_probs, trial.signature.branches, _ZEROS[participant.runtime])


def _fit(trial: Trial, participant: Participant, asked: _Asked) -> tuple[Difference, int, int]:
    """(how the draws fit, the branch and the input that fit worst)."""
    branches = trial.signature.branches
    drawn = _draws_of_rows(trial, participant, asked.action, asked.rows)
    p_value, branch, worst = least_likely(drawn, asked.log_probs, branches)
    difference = likely(p_value)
    lattice = participant.runtime in _LATTICES
    if difference.passed and not lattice and (apart := repeats(drawn, asked.log_probs, branches)):
        difference = wrong(DEPENDENT.format(apart))
    return difference, branch, worst


def _without_open_choices(
    trial: Trial, scores: str, known: list[tuple[Case, int, np.ndarray]]
) -> list[tuple[Case, int, np.ndarray]]:
    """Those of the inputs at which no choice that the odds hang on is open: another is right there too."""
    if not known or not trial.choices.behind(scores):
        return known
    rows = [{n: a[row : row + 1] for n, a in case.feeds.items()} for case, row, _ in known]
    return [
        each
        for each, feeds in zip(known, rows, strict=True)
        if not trial.choices.tied_rows(scores, feeds, Tolerance(), 1)[0]
    ]


def _with_one_forbidden(trial: Trial, participant: Participant, action: str, scores: str) -> Finding | None:
    """What is wrong where one action is forbidden, or two; None where nothing is, or nothing can be.

    Each mask is drawn for a few times, all in one run: what is forbidden must never come up, whatever else is allowed.
    """
    found = [(c, e) for c, e in zip(trial.cases, trial.expected, strict=True) if c.name == ONE_FORBIDDEN]
    if not found:
        return None
    (case, expected) = found[0]
    single = _one_row_at_a_time(participant)
    cameras = any(s.role is Role.VISUAL for s in trial.signature.inputs)
    count = max(4, (FEW if single or cameras else FORBIDDEN) // case.batch)
    if np.isnan(expected[scores]).any() or not trial.allowance(participant, "draws").takes(
        count * case.batch, f"{count * case.batch} draws with one or two actions masked"
    ):
        return None
    batched = {s.name for s in trial.signature.inputs if s.batched}
    feeds = {n: np.repeat(a, count, axis=0) if n in batched else a for n, a in case.feeds.items()}
    if single:
        numbers = range(count * case.batch)
        inputs = [{n: a[i : i + 1] if n in batched else a for n, a in feeds.items()} for i in numbers]
    else:
        inputs = [feeds]
    drawn = np.concatenate([answer[action] for answer in participant.run(inputs, [action])])
    drawn = drawn.reshape(case.batch, count, -1)
    log_probs = np.asarray(expected[scores])
    decided = np.flatnonzero(~trial.choices.tied_rows(scores, case.feeds, Tolerance(), case.batch))
    if not decided.size:
        return None
    drawn, log_probs = drawn[decided], log_probs[decided]
    log_probs = _seen_by(participant, log_probs, trial)
    p_value, branch, worst = least_likely(drawn, log_probs, trial.signature.branches)
    difference = likely(p_value)
    if difference.passed:
        return None
    worst = int(decided[worst])
    row = {n: a[worst : worst + 1] if n in batched else a for n, a in case.feeds.items()}
    begins = trial.bisect(participant, action, difference, row, branch)
    return trial.finding(Draws, participant, action, difference, case.name, bisection=begins)


def _started_alike(
    trial: Trial, participant: Participant, action: str, rows: Sequence[Feeds], log_probs: np.ndarray
) -> dict[int, int]:
    """The branches that two starts draw alike → the row that shows it, whose draws can be told least."""
    single = _one_row_at_a_time(participant)
    count = STARTS if single or any(s.role is Role.VISUAL for s in trial.signature.inputs) else DRAWS
    shown: dict[int, int] = {}
    edges = np.cumsum(trial.signature.branches)[:-1]
    for branch, part in enumerate(np.split(np.exp(log_probs.astype(np.float64)), edges, axis=1)):
        same = np.square(part / part.sum(axis=1, keepdims=True)).sum(axis=1)
        if same.min() ** count < FALSE_ALARM:
            shown[branch] = int(same.argmin())
    if not shown or not trial.allowance(participant, "draws").takes(
        2 * count * len({*shown.values()}), "two starts' draws"
    ):
        return {}

    def ask(run: Run) -> dict[str, np.ndarray]:
        told = sorted({*shown.values()})
        drawn = dict(zip(told, _of_rows(run, action, [rows[row] for row in told], count, single=single), strict=True))
        return {str(branch): drawn[row][:, branch] for branch, row in shown.items()}

    alike = repeated_draws(trial, participant, ask)
    return {branch: row for branch, row in shown.items() if str(branch) in alike}


def _called_alike(
    trial: Trial, participant: Participant, action: str, rows: Sequence[Feeds], log_probs: np.ndarray
) -> int | None:
    """The row that two calls in a row draw alike, None where they do not: the row whose draws can be told least."""
    if participant.runtime == "numpy":  # its child draws from one seed
        return None
    parts = np.split(np.exp(log_probs.astype(np.float64)), np.cumsum(trial.signature.branches)[:-1], axis=1)
    same = np.prod([np.square(p / p.sum(axis=1, keepdims=True)).sum(axis=1) for p in parts], axis=0)
    row = int(same.argmin())
    if same[row] ** STARTS >= FALSE_ALARM or not trial.allowance(participant, "draws").takes(
        2 * STARTS, "two calls' draws"
    ):
        return None
    single = _one_row_at_a_time(participant)
    one, other = _of_rows(participant.run, action, [rows[row], rows[row]], STARTS, single=single)
    return row if np.array_equal(one, other) else None


def repeated_draws(trial: Trial, participant: Participant, ask: Callable[[Run], Arrays]) -> set[str]:
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
    one = _ask_again(participant, trial.pool, ask)
    if not apart:
        other = _ask_again(participant, trial.pool, ask)
    else:
        with RuntimePool() as second:
            other = _ask_again(participant, second, ask)
    return {name for name, drawn in one.items() if np.array_equal(drawn, other[name])}


def _ask_again(participant: Participant, pool: RuntimePool, ask: Callable[[Run], Arrays]) -> dict[str, np.ndarray]:
    assert participant.again is not None
    model, run = participant.again(pool, True)
    with model:
        return ask(run)


def _of_rows(run: Run, action: str, rows: Sequence[Feeds], count: int, *, single: bool) -> np.ndarray:
    """[inputs, draws, branches]: classes drawn for each of ``rows``."""
    if single:
        inputs = [row for row in rows for _ in range(count)]
    else:
        inputs = [{n: np.repeat(a, count, axis=0) for n, a in row.items()} for row in rows]
    drawn = [answer[action] for answer in run(inputs, [action])]
    return np.concatenate(drawn).reshape(len(rows), count, -1)


def _one_row_at_a_time(participant: Participant) -> bool:
    """In Node and in Chromium TensorFlow.js' cpu Multinomial restarts its generator for every row of a batch."""
    return participant.runtime.startswith("tfjs-cpu")


def _draws_of_rows(trial: Trial, participant: Participant, action: str, rows: Sequence[Feeds]) -> np.ndarray:
    single = _one_row_at_a_time(participant)
    cameras = any(s.role is Role.VISUAL for s in trial.signature.inputs)
    count = max(1, FEW // len(rows)) if single or cameras else DRAWS
    allowance = trial.allowance(participant, "draws")
    if not allowance.takes(count * len(rows), f"{count * len(rows)} draws for {len(rows)} inputs"):
        few = max(1, allowance.left // len(rows))
        allowance.left_out[-1] += f" but for {few * len(rows)}"
        count, allowance.left = few, 0
    return _of_rows(participant.run, action, rows, count, single=single)


def with_zeros(log_probs: np.ndarray, branches: Sequence[int], rate: float) -> np.ndarray:
    """Log-probabilities [inputs, ΣB] of a sampler whose uniform number is 0 at this rate."""
    probs = np.exp(log_probs.astype(np.float64)) * (1 - rate)
    for part in np.split(probs, np.cumsum(branches)[:-1], axis=1):  # views
        part[np.arange(len(part)), np.argmax(part > 0, axis=1)] += rate
    with np.errstate(divide="ignore"):
        return np.log(probs)


def least_likely(drawn: np.ndarray, log_probs: np.ndarray, branches: Sequence[int]) -> tuple[float, int, int]:
    """(the p-value, the branch and the input that it is of) of classes [inputs, draws, branches] that were drawn.

    Each input by itself, all of them together, every two branches at once; the smallest p counts as often as it was
    looked for. Together, a class that is rare everywhere is expected often enough, and a temperature shows; two
    branches that are drawn from one seed are right each, and not together.
    """
    parts = np.split(log_probs, np.cumsum(branches)[:-1], axis=1)
    found = [(fit(drawn[i, :, b], part[i]), b, i) for b, part in enumerate(parts) for i in range(len(drawn))]
    found += [(fit_all(drawn[:, :, b], part), b, 0) for b, part in enumerate(parts)]
    count = len(found) + len(parts) * (len(parts) - 1) // 2
    wrong_alone = [f for f in found if f[0] * count < FALSE_ALARM]
    for (a, first), (b, second) in combinations(enumerate(parts), 2):
        joint = drawn[:, :, a] * branches[b] + drawn[:, :, b]
        both = (first[:, :, None] + second[:, None, :]).reshape(len(first), -1)
        found.append((fit_all(joint, both), b, 0))
    p_value, branch, worst = min(found)
    if wrong_alone:  # what is wrong by itself is wrong beside another, too
        _, branch, worst = min(wrong_alone)
    return min(1.0, p_value * count), branch, worst


def repeats(drawn: np.ndarray, log_probs: np.ndarray, branches: Sequence[int]) -> int:
    """How many rows are between draws that tell something of each other; 0 where none do."""
    parts = np.split(log_probs, np.cumsum(branches)[:-1], axis=1)
    for branch, part in enumerate(parts):
        probs = np.exp(part.astype(np.float64))
        probs /= probs.sum(axis=1, keepdims=True)
        found = dependent([_deviations(d, p) for d, p in zip(drawn[:, :, branch].astype(int), probs, strict=True)])
        if found:
            return found
    return 0


def _deviations(drawn: np.ndarray, probs: np.ndarray) -> np.ndarray:
    """Classes [draws] less what is expected, [draws, components].

    There is a column for each class that was drawn, and one for all others, which differ from no draw to another. There
    may be many thousands of these.
    """
    classes = np.unique(drawn)
    rest = max(0.0, float(np.square(probs).sum() - np.square(probs[classes]).sum()))
    made = (drawn[:, None] == classes) - probs[classes]
    return np.column_stack([made, np.full(len(drawn), math.sqrt(rest))])


def likely(p_value: float) -> Difference:
    """What a test of draws says: as a difference, the p-value's complement."""
    if p_value >= FALSE_ALARM:
        return Difference(1 - p_value, 1 - p_value, True)
    reason = f"the draws do not have the distribution they should (p = {p_value:.1e})"
    return Difference(1 - p_value, 1 - p_value, False, reason)
