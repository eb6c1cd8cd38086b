"""What a candidate's actions are of the reference's, where they differ: by the table of causes of an agent's log.

The candidate's answers to typical observations are taken for what an agent of the reference logged, and the other way
round; the cause that makes every step fit (exporter/logs/causes.py) says what differs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from msgspec.structs import replace

from export_model.exporter.logs.judging import LOG_TOLERANCE, targets_of
from export_model.exporter.logs.recording import NONE, Array, Recording
from export_model.exporter.logs.replay import Replay
from export_model.exporter.logs.search import Explanation, explain
from export_model.exporter.logs.trials import Trials
from export_model.exporter.verify.findings import Finding
from export_model.exporter.verify.participants import Feeds, Participant, Run
from export_model.exporter.verify.report import SideCause
from export_model.exporter.verify.trial import Trial
from export_model.exporter.verify.verification import CHECKS, Check
from export_model.exporter.verify.work import products
from export_model.signatures.roles import Role
from export_model.signatures.sampling import draw_rollout
from export_model.signatures.spec import PolicySignature

#: Products that a row may cost: thousands of causes are tried on dozens of rows.
_MOST_PRODUCTS = 3_000_000
#: Runs that a search may make, and rows of them all: it goes on from cause to cause where none is enough, and a policy
#: with a memory is run step by step. Of what is found, one cause of a memory takes most, 3,073 runs and 310,000 rows.
_MOST_RUNS, _MOST_ROWS = 4_000, 450_000
#: Episodes side by side, and steps of each.
_EPISODES, _STEPS = 16, 16


#: kind of a cause → what it does, after the tensor that it is done to.
CHANGES = {
    "memory": "used otherwise",
    "previous_action": "left out",
    "mask": "read otherwise",
    "image": "laid out otherwise",
    "normaliser": "normalised otherwise",
    "stated_scale": "scaled otherwise",
    "clip": "clipped",
    "squash": "squashed otherwise",
    "unit": "scaled",
    "scale": "scaled",
    "offset": "moved",
    "swap": "exchanged",
    "order": "in another order",
    "action_scale": "scaled",
    "action_offset": "moved",
    "lag": "a step apart",
}


#: Words of an agent's log → what they are where the side ``log`` is held against the ``other``.
_WORDS = (
    ("was given", "would be given"),
    ("× what was logged", "× what the {log} is"),
    ("than what was logged", "than the {log}'s"),
    ("what was logged", "the {log}'s action"),
    (" before it was logged", " by the {log}"),
    ("the log", "the {log}"),
    ("the policy", "the {other}"),
)


class _WorkDoneError(Exception):
    """A search has cost what it may."""


class Explaining:
    """Other checks, and where one of them fails, one cause that explains the difference: a sentence in ``notes``."""

    def __init__(self, checks: Sequence[Check] = CHECKS) -> None:
        self.notes: list[str] = []
        self.causes: list[SideCause] = []
        self._checks = checks

    def __call__(self, trial: Trial, participant: Participant) -> Iterator[Finding]:
        """Put a participant through the checks; explain what its actions are, if they are not the reference's."""
        findings = [finding for check in self._checks for finding in check(trial, participant)]
        yield from findings
        heads = _shared_actions(trial, participant)
        if heads and not all(f.passed for f in findings) and products(trial.tested.graph) <= _MOST_PRODUCTS:
            for side, other, explanation in _explanations(trial, participant, heads):
                if explanation is None:
                    cut = f"whether the {side} is the {other} with one change was not searched to the end"
                    self.notes.append(f"{participant.name}: {cut}")
                    continue
                phrases = ", ".join(_phrases(explanation, side, other))
                self.notes.append(f"{participant.name}: the {side} is the {other} with {phrases}")
                self.causes += [
                    SideCause(participant.name, side, c.kind, c.where, in_sides(c.says, side, other))
                    for c in explanation.causes
                ]


def _shared_actions(trial: Trial, participant: Participant) -> dict[str, str]:
    """Head → an output that has it without chance, where both sides have one: made for it, or its own without noise."""
    actions = {}
    for head in trial.signature.heads:
        outputs = (head.name,) if head.plain is None else (head.plain.name, head.name)
        able = [n for n in outputs if n in participant.outputs and not trial.is_drawn(n, participant)]
        if able and trial.signature.output(able[0]).role in (Role.CONTINUOUS, Role.DETERMINISTIC):
            actions[head.name] = able[0]
    return actions


def _explanations(
    trial: Trial, participant: Participant, heads: Mapping[str, str]
) -> Iterator[tuple[str, str, Explanation | None]]:
    """Yield (the side that is the other with something, the other, with what), once at most.

    None stands for a search that was not ended.
    """
    signature = trial.signature
    pair = signature.recurrence
    if pair is not None and pair[1] not in participant.outputs:
        return
    steps = draw_rollout(signature, seed=trial.options.seed, steps=_STEPS, batch=_EPISODES)
    for feeds in steps:  # without chance
        feeds.update({s.name: np.zeros_like(feeds[s.name]) for s in signature.noise})
    fetch = [*heads.values(), *(pair[1:] if pair else ())]
    runs: dict[str, Run] = {"candidate": participant.run, "reference": trial.reference.run}
    logs = {
        side: _recording(signature, steps, _play(signature, steps, run, fetch), heads) for side, run in runs.items()
    }
    ours, theirs = (logs[side].outputs for side in ("reference", "candidate"))
    if any(ours[head].shape != theirs[head].shape for head in heads):
        return  # other actions: no cause makes them these
    for side, other in (("candidate", "reference"), ("reference", "candidate")):
        answered = [s.name for s in signature.outputs] if other == "reference" else participant.outputs
        try:
            found = _explain(signature, _bound_trials(runs[other]), answered, logs[side], heads)
        except _WorkDoneError:
            yield side, other, None
            continue
        if found is not None and found.whole:
            yield side, other, found
            return


def _bound_trials(run: Run) -> Run:
    """A run that raises _WorkDoneError after ``_MOST_RUNS`` or ``_MOST_ROWS``."""
    runs, rows = 0, 0

    def run_counted(inputs: Sequence[Feeds], fetch: Sequence[str]) -> list[dict[str, np.ndarray]]:
        nonlocal runs, rows
        runs += 1
        rows += sum(max((len(array) for array in feeds.values() if array.ndim), default=1) for feeds in inputs)
        if runs > _MOST_RUNS or rows > _MOST_ROWS:
            raise _WorkDoneError
        return run(inputs, fetch)

    return run_counted


def _phrases(found: Explanation, side: str, other: str) -> Iterator[str]:
    for cause in found.causes:
        others = [c.where for c in found.others if c.kind == cause.kind][:2]
        also = f", or {', '.join(others)}" if others else ""
        yield f"{cause.where} {CHANGES[cause.kind]} ({in_sides(cause.says, side, other)}{also})"


def in_sides(sentence: str, log: str, other: str) -> str:
    """Return what a cause says of an agent's log and its policy as said of two sides."""
    for word, of_side in _WORDS:
        sentence = sentence.replace(word, of_side.format(log=log, other=other))
    return sentence


def _play(
    signature: PolicySignature, steps: Sequence[Feeds], run: Run, fetch: Sequence[str]
) -> list[Mapping[str, Array]]:
    """The answers to each step, the memory fed back."""
    answers: list[Mapping[str, Array]] = []
    for feeds in steps:
        carried = signature.fed_back(answers[-1]) if answers else {}
        answers.append(run([{**feeds, **carried}], fetch)[0])
    return answers


def _recording(
    signature: PolicySignature, steps: Sequence[Feeds], answers: Sequence[Mapping[str, Array]], heads: Mapping[str, str]
) -> Recording:
    """The steps as an agent's log has them: those of one episode in a row."""
    memories = {signature.recurrence[0]} if signature.recurrence else set[str]()  # one not given back is fed as any
    batched = [s.name for s in signature.inputs if s.batched and s.name not in memories]
    inputs: dict[str, Array] = {n: np.concatenate([feeds[n] for feeds in steps]) for n in batched}
    inputs |= {s.name: steps[0][s.name] for s in signature.inputs if not s.batched}
    outputs = {}
    for head, name in heads.items():
        values = np.concatenate([answer[name] for answer in answers])
        outputs[head] = values.reshape(len(values), -1) if values.dtype.kind in "iu" else values.astype(np.float64)
    rows = len(steps) * _EPISODES
    before = np.maximum(np.arange(rows) - _EPISODES, NONE)
    return Recording(
        inputs=inputs,
        outputs=outputs,
        before=before,
        last=before,
        episodes=_EPISODES,
        logged=frozenset(inputs),
        chained=bool(memories),
        episode=np.zeros(rows, np.int64),
        agent=np.tile(np.arange(_EPISODES), len(steps)),
    )


def _explain(
    signature: PolicySignature, run: Run, answered: Sequence[str], recording: Recording, heads: Mapping[str, str]
) -> Explanation | None:
    """What makes the steps those of the policy that ``run`` runs; None where they are, or nothing does.

    ``answered`` are the outputs that it can be asked for; ``heads``: head → the output that was recorded of it.
    """
    targets = targets_of(signature, recording, draws_itself=False)
    targets = [t if t.branches else replace(t, answer=heads.get(t.name, t.answer)) for t in targets]
    pair = signature.recurrence
    names = dict.fromkeys([*(n for t in targets for n in t.output_names), *(pair[1:] if pair else ())])
    if not set(names) <= set(answered):
        return None
    replay = Replay(lambda feeds, fetch: run([feeds], fetch)[0], signature, tuple(names))
    trials = Trials(replay, recording, targets, LOG_TOLERANCE, drawn=False)
    base = trials.verdict()
    return None if base.fits else explain(trials, base)
