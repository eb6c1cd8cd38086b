"""A log held against a policy: which steps fit, and what explains those that do not."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct

from export_model.exporter.logs.causes import Cause
from export_model.exporter.logs.judging import LOG_TOLERANCE, Target, targets_of
from export_model.exporter.logs.reading import log_error, read_recording
from export_model.exporter.logs.recording import Array, Recording
from export_model.exporter.logs.replay import Replay
from export_model.exporter.logs.search import LEAST, explain
from export_model.exporter.logs.trials import Trials, Verdict
from export_model.exporter.verify.tolerances import Tolerance
from export_model.signatures.fields import Record

if TYPE_CHECKING:
    from export_model.exporter.acting.policy import LoadedPolicy


class WorstStep(Record, frozen=True):
    """The element that is farthest from the answer: its step, name, and both numbers."""

    step: int
    column: str
    logged: float
    computed: float


class LogReport(Struct, frozen=True):
    """What came of it.

    - ``fits``: every step is what the policy answers; ``misfits``: bool [steps], which are not; ``first``, ``worst``.
    - ``drawn``: the action was judged as a draw, by its likelihood (``sigmas``: how far from what is expected).
    - ``causes``: what explains the misfits; ``others``: what explains them as well; ``explained``: steps that fit with
      the causes.
    - ``shares``: by output, float64 [steps], the largest |a − b| of the step as a share of what is allowed; with the
      causes in ``shares_explained``.
    """

    policy: str
    log: str
    runtime: str
    steps: int
    episodes: int
    fits: bool
    drawn: bool
    misfits: Array
    worst: WorstStep | None
    sigmas: Mapping[str, float]
    causes: tuple[Cause, ...]
    others: tuple[Cause, ...]
    explained: int
    shares: Mapping[str, Array]
    shares_explained: Mapping[str, Array]
    tolerance: Tolerance
    notes: tuple[str, ...] = ()

    @property
    def first(self) -> int | None:
        """The first step that does not fit."""
        return int(self.misfits.argmax()) if self.misfits.any() else None

    def to_dict(self) -> dict[str, Any]:
        """As in exporter/logs/log_report.schema.json."""
        return {
            "policy": self.policy,
            "log": self.log,
            "runtime": self.runtime,
            "steps": self.steps,
            "episodes": self.episodes,
            "fits": self.fits,
            "drawn": self.drawn,
            "misfits": int(self.misfits.sum()),
            "first": self.first,
            "worst": None if self.worst is None else self.worst.to_dict(),
            "sigmas": dict(self.sigmas),
            "causes": [c.to_dict() for c in self.causes],
            "others": [c.to_dict() for c in self.others],
            "explained": self.explained,
            "atol": self.tolerance.atol,
            "rtol": self.tolerance.rtol,
            "notes": list(self.notes),
        }


def check_log(policy: LoadedPolicy, path: Path, tolerance: Tolerance = LOG_TOLERANCE) -> LogReport:
    """Compute every step of a log again, and look for what explains the steps that do not fit.

    Raises UsageError, with the column's name, where the log cannot be read or does not fit the policy.
    """
    signature = policy.signature
    recording = read_recording(path, signature)
    targets = targets_of(signature, recording, draws_itself=policy.draws_itself)
    _check_drawable(path, policy, targets)
    pair = signature.recurrence
    wanted = [n for t in targets for n in t.output_names] + ([pair[1]] if pair else [])
    replay = Replay(policy.run, signature, tuple(dict.fromkeys(wanted)))
    plain = Trials(replay, recording, targets, tolerance, drawn=False)
    report = partial(_report, policy, path, recording, targets, tolerance)
    base = plain.verdict()
    if base.fits:
        return report(base, None, drawn=False)
    drawn = Trials(replay, recording, targets, tolerance, drawn=True)
    found = explain(plain, base)
    as_drawn = drawn.verdict()
    if (found is None or not found.whole) and drawn.drawn:
        by_chance = explain(drawn, as_drawn)
        if by_chance is None and as_drawn.fits:
            return report(as_drawn, None, drawn=True)
        if by_chance is not None and (by_chance.whole or found is None):
            return report(as_drawn, by_chance, drawn=True)
        found = found or explain(plain, base, LEAST)
    return report(base, found, drawn=False)


def _check_drawable(path: Path, policy: LoadedPolicy, targets: list[Target]) -> None:
    """Raise UsageError where an action is drawn inside the file, and neither its mean nor its odds are known."""
    for target in targets:
        head = next((h for h in policy.signature.heads if h.name == target.name), None)
        if head is not None and policy.draws_itself and head.is_continuous and head.plain is None:
            raise log_error(
                path,
                f"{target.name!r} cannot be computed again",
                why="it is drawn inside the file, which gives neither its mean nor its spread",
                fix="export the policy without --noise keep or --for",
            )


def _report(
    policy: LoadedPolicy,
    path: Path,
    recording: Recording,
    targets: list[Target],
    tolerance: Tolerance,
    base: Verdict,
    found: Any,
    *,
    drawn: bool,
) -> LogReport:
    after: Verdict | None = None if found is None else found.verdict
    notes = []
    if recording.ignored:
        notes.append(f"not compared: {', '.join(recording.ignored)}")
    if recording.chained:
        notes.append("the memory was not logged: it was fed back from step to step, zero when an episode begins")
    if drawn:
        notes.append("the action was drawn: its draws are judged by their likelihood, not one by one")
    return LogReport(
        policy=policy.name,
        log=path.name,
        runtime=policy.runtime,
        steps=recording.steps,
        episodes=recording.episodes,
        fits=base.fits and found is None,
        drawn=drawn,
        misfits=base.misfits,
        worst=_worst_step(recording, targets, base),
        sigmas={n: d.sigmas for n, d in base.draws.items()},
        causes=() if found is None else found.causes,
        others=() if found is None else found.others,
        explained=0 if after is None else int((~after.misfits).sum()),
        shares={n: s.max(axis=1, initial=0.0) for n, s in base.shares.items()},
        shares_explained={} if after is None else {n: s.max(axis=1, initial=0.0) for n, s in after.shares.items()},
        tolerance=tolerance,
        notes=tuple(notes),
    )


def _worst_step(recording: Recording, targets: list[Target], verdict: Verdict) -> WorstStep | None:
    """The element with the largest share; None where all fit."""
    if not verdict.misfits.any():
        return None
    target = max(targets, key=lambda t: float(verdict.shares[t.name].max(initial=0.0)))
    shares = verdict.shares[target.name]
    step, column = np.unravel_index(int(shares.argmax()), shares.shape)
    logged = recording.outputs[target.name].reshape(recording.steps, -1)
    if target.branches and target.scores is not None and target.answer not in verdict.answers:
        scores = verdict.answers[target.scores].reshape(recording.steps, -1)[step]
        edges = np.cumsum((0, *target.branches))
        computed = float(scores[edges[column] : edges[column + 1] if target.branches[0] else None].argmax())
    else:
        computed = float(verdict.answers[target.answer].reshape(recording.steps, -1)[step, column])
    return WorstStep(int(step), f"{target.name}[{column}]", float(logged[step, column]), computed)
