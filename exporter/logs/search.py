"""The search for what explains the steps that do not fit.

All causes of the table are tried on a few steps at once; the best are tried on all. Where none explains everything, the
one that explains most is kept and the search goes on from there: several columns may be in degrees. Last come scales
and offsets that no table has, fitted column by column.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from export_model.exporter.logs.causes import Cause, action_causes, drawn_action_causes, input_causes, lag_causes
from export_model.exporter.logs.fitting import fitted_causes, scanned_causes
from export_model.exporter.logs.judging import ties
from export_model.exporter.logs.recording import NONE, Array, Recording
from export_model.exporter.logs.replay import MemoryUse
from export_model.exporter.logs.trials import Chain, Trials, Verdict

#: Steps that all causes are tried on, and that the best are tried on.
FEW, MANY = 64, 5_000
#: How many of the best are tried on all steps, and how many causes one log may have.
BEST, MOST_CAUSES = 8, 8
#: A share of the steps that an explanation may leave: a log has a hiccup.
LEFT = 0.001
#: What a cause that explains only a part has to take off the cost of the few steps.
GAIN = 0.15
#: How much likelier a scanned figure has to make draws than a cause of the table to go before it.
SCANNED = 8.0
#: How much more likely draws have to be under a cause: a right policy reaches e^25 by chance in one of 7e10.
LIKELIER = 25.0
#: What a choice that comes to fit is worth, at least, as evidence for a cause: it is one of two by chance.
CHOICE = float(np.log(2))
#: Chains that are kept while several columns are searched for.
BEAMS = 6
#: The same where a log that was drawn is out of the question: one of a thousand causes would explain so much by chance.
LEAST = 12.0
#: Steps into an episode that are tried where the policy has a memory, and episodes.
DEEP, EPISODES = 24, 16


class Explanation(Struct, frozen=True):
    """An explanation of the steps that differ.

    ``causes`` stand in the order in which they are applied, ``verdict`` is that on all steps with them; ``others``
    explain as much. ``whole``: no step is left but for a hiccup.
    """

    causes: tuple[Cause, ...]
    verdict: Verdict
    others: tuple[Cause, ...] = ()
    whole: bool = True


def explain(trials: Trials, base: Verdict, least: float = LIKELIER) -> Explanation | None:
    """The causes that make the steps fit, by evidence of at least ``least``; None where none do."""
    many = trials.on(_first_rows(trials.recording, MANY))
    start = base if many.recording.steps == trials.recording.steps else many.verdict()
    few = trials.on(_sample(many.recording, start))
    table = input_causes(trials.replay.signature, trials.recording)
    if few.drawn:
        table += scanned_causes(trials.replay.signature, trials.recording)
    found = _one_by_one(few, many, table, start, least) or _several_columns(few, many, table, start, least)
    if found is None:
        return None
    chain, others = found
    whole = trials.verdict(chain)
    return Explanation(chain, whole, others, _explains(whole, base))


def _one_by_one(
    few: Trials, many: Trials, table: Sequence[Cause], start: Verdict, least: float
) -> tuple[tuple[Cause, ...], tuple[Cause, ...]] | None:
    """The best cause, then the best beside it, and so on: (the causes, others that explain as much)."""
    chain: tuple[Cause, ...] = ()
    current = start
    while len(chain) < MOST_CAUSES:
        ranked = _best_cause(few, many, table, chain, current)
        if not ranked:
            return None
        cause, current, others = ranked
        chain = (*chain, cause)
        if _explains(current, start) and _evidence(many, start, current) > least:
            chain = _drop_needless(many, chain, start)
            return chain, others if len(chain) == 1 else ()
    return None


def _several_columns(
    few: Trials, many: Trials, table: Sequence[Cause], start: Verdict, least: float
) -> tuple[tuple[Cause, ...], tuple[Cause, ...]] | None:
    """Units of several columns, none of which helps much alone: a beam search on the few steps."""
    units = [c for c in table if c.kind == "unit"]
    beams: list[tuple[Cause, ...]] = [()]
    best = float("inf")
    for _ in range(MOST_CAUSES):
        tried = [(*beam, c) for beam in beams for c in units if c.where not in {b.where for b in beam}]
        verdicts = list(few.verdicts(tried)) if tried else []
        costs = np.asarray([float(v.costs.mean()) for v in verdicts])
        if not len(costs) or costs.min() >= best:
            return None
        best = float(costs.min())
        order = np.argsort(costs, kind="stable")
        chain = tried[order[0]]
        if not verdicts[order[0]].misfits.any():
            verdict = many.verdict(chain)
            if _explains(verdict, start) and _evidence(many, start, verdict) > least:
                return _drop_needless(many, chain, start), ()
        distinct = {frozenset((c.where, c.says) for c in tried[i]): tried[i] for i in order[: 4 * BEAMS]}
        beams = list(distinct.values())[:BEAMS]
    return None


def _best_cause(
    few: Trials, many: Trials, table: Sequence[Cause], chain: Chain, current: Verdict
) -> tuple[Cause, Verdict, tuple[Cause, ...]] | None:
    """The next cause, what is found with it, and others that explain as much."""
    tried = [*_on_few(few, table, chain), *_on_answers(many, chain, current)]
    tried += [c for c in table if c.use is not MemoryUse.KEPT]
    if not few.drawn:
        tried += fitted_causes(few, chain)
    found = [(cause, many.verdict((*chain, cause))) for cause in dict.fromkeys(tried)]
    before = float(current.costs.mean())
    better = [(c, v) for c, v in found if _gain(v, current, before, drawn=few.drawn)]
    if not better:
        return None
    fitted = ("scale", "offset")
    order = {id(c): i for i, c in enumerate(table)}

    def rank(pair: tuple[Cause, Verdict]) -> tuple[float, float, int]:
        cause, verdict = pair
        cost = 0.0 if verdict.fits and not few.drawn else float(verdict.costs.sum())
        cost += SCANNED if few.drawn and cause.kind in fitted else 0.0
        return float(verdict.misfits.mean()), round(cost, 3), order.get(id(cause), len(order))

    better.sort(key=rank)
    (cause, verdict), *rest = better
    same = tuple(c for c, v in rest if not few.drawn and v.fits and verdict.fits and c.kind not in fitted)
    return cause, verdict, same


def _gain(verdict: Verdict, current: Verdict, before: float, *, drawn: bool) -> bool:
    if drawn:
        return _likelier(verdict, current) > LIKELIER and verdict.misfits.mean() <= current.misfits.mean()
    fewer = verdict.misfits.sum() <= 0.5 * current.misfits.sum()
    return bool(fewer or verdict.costs.mean() < (1 - GAIN) * before)


def _likelier(verdict: Verdict, current: Verdict) -> float:
    """The logarithm of how many times as likely the draws are as they were."""
    return sum(float((v.found - current.draws[n].found).sum()) for n, v in verdict.draws.items())


def _on_few(few: Trials, table: Sequence[Cause], chain: Chain) -> list[Cause]:
    """The causes that explain the few steps best; several where they explain as much."""
    kept = [c for c in table if c.use is MemoryUse.KEPT]
    costs = [float(v.costs.mean()) for v in few.verdicts([(*chain, c) for c in kept])]
    order = np.argsort(np.asarray(costs), kind="stable")
    return [kept[i] for i in order[:BEST]]


def _on_answers(many: Trials, chain: Chain, current: Verdict) -> list[Cause]:
    found: list[Cause] = []
    for target in many.targets:
        if not target.head or target.name in {c.output for c in chain}:
            continue
        found += lag_causes(target.name)
        if not target.branches:
            logged, computed = many.recording.outputs[target.name], current.answers[target.answer]
            made = drawn_action_causes if target.name in current.draws else action_causes
            found += made(target.name, logged.reshape(len(logged), -1), computed.reshape(len(logged), -1))
    return found


def _explains(verdict: Verdict, start: Verdict) -> bool:
    left = verdict.misfits.mean()
    return bool(left <= LEFT and left <= 0.5 * max(start.misfits.mean(), LEFT)) and all(
        d.fits for d in verdict.draws.values()
    )


def _evidence(many: Trials, start: Verdict, current: Verdict) -> float:
    """How much less likely the fit would be by chance, as a logarithm: an explanation of a few choices is none."""
    found = _likelier(current, start)
    for target in many.targets:
        if target.name in current.draws:
            continue
        before, after = start.shares[target.name], current.shares[target.name]
        mended = (before > 1) & (after <= 1)
        if target.branches and target.scores is not None:
            mended &= ~ties(target, current.answers[target.scores])
        found += CHOICE * mended.sum() if target.branches else float(np.log(before[mended]).sum())
    return float(found)


def _drop_needless(many: Trials, chain: tuple[Cause, ...], start: Verdict) -> tuple[Cause, ...]:
    """``chain`` without the causes that it does not take."""
    for cause in chain if len(chain) > 1 else ():
        rest = tuple(c for c in chain if c is not cause)
        if rest and _explains(many.verdict(rest), start):
            chain = rest
    return chain


def _first_rows(recording: Recording, count: int) -> Recording:
    return recording if recording.steps <= count else recording.rows(np.arange(count))


def _sample(recording: Recording, verdict: Verdict) -> Recording:
    """A few steps, most of them such as do not fit; of a policy with a memory, the beginnings of some episodes."""
    rng = np.random.default_rng(0)
    costs = verdict.costs
    depth = _depths(recording.before)
    misfits = verdict.misfits if verdict.misfits.any() else np.ones(recording.steps, bool)
    if not recording.chained:
        wrong, right = np.flatnonzero(misfits), np.flatnonzero(~misfits)
        wrong = wrong[np.argsort(-costs[wrong], kind="stable")] if len(wrong) > FEW else wrong
        worst = wrong[: FEW // 2]
        rest = rng.permutation(wrong[FEW // 2 :])[: FEW // 4]
        chosen = np.concatenate([worst, rest, rng.permutation(right)[: FEW // 4]])
        near = recording.before[chosen]  # an action may belong to the step before
        return recording.rows(np.unique(np.concatenate([chosen, near[near != NONE]])))
    deep = min(max(DEEP, int(depth[misfits].min()) + 8), 512)
    roots = np.flatnonzero(recording.before == NONE)
    starts = set(rng.permutation(roots)[: max(1, min(EPISODES, 2048 // deep))].tolist())
    root = _roots(recording.before)
    return recording.rows(np.flatnonzero(np.isin(root, list(starts)) & (depth < deep)))


def _depths(before: Array) -> Array:
    depth = np.zeros(len(before) + 1, np.int64)
    depth[NONE] = -1
    for row, source in enumerate(before.tolist()):
        depth[row] = depth[source] + 1
    return depth[:-1]


def _roots(before: Array) -> Array:
    root = np.arange(len(before) + 1)
    for row, source in enumerate(before.tolist()):
        root[row] = row if source == NONE else root[source]
    return root[:-1]
