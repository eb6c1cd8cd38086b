"""What ML-Agents' C# side reads of the actions: samples or log-probabilities of branches, and what a mask does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from export_model.converters.consumers.mlagents.input_mapping import supply_masks
from export_model.converters.consumers.mlagents.naming import Dressing, row
from export_model.converters.graph.types import FLOAT32, INT64
from export_model.converters.policy.action import action_meaning
from export_model.signatures.roles import ACTION_NAMES, Role
from export_model.signatures.spec import TensorSpec

_DISCRETE = (Role.SAMPLED, Role.LOG_PROBS, Role.PROBS, Role.DETERMINISTIC)


class Heads(Struct, frozen=True):
    """The actions of a policy: the specs of the continuous and of the discrete one."""

    continuous: TensorSpec | None
    discrete: TensorSpec | None


def heads(dressing: Dressing) -> Heads:
    """Which outputs are the actions."""
    signature = dressing.policy.signature
    own = [s for s in signature.outputs if s.name.rpartition("/")[2] in ACTION_NAMES]
    return Heads(
        next((s for s in own if s.is_continuous), None),
        next((s for s in own if s.role in _DISCRETE and not s.is_continuous), None),
    )


def continuous_rows(dressing: Dressing, spec: TensorSpec) -> tuple[str, str, int]:
    """(the continuous action, the one without chance, their width), as [B, A]."""
    width = 1
    for size in spec.shape[1:]:
        if size is None:
            dressing.refuse(
                f"its action has the shape {list(spec.shape)}",
                why="Unity wants to know how many continuous actions there are",
                fix="export the model again with the width of the action fixed",
            )
        width *= size or 1
    without = f"deterministic_{spec.name}"
    known = {s.name for s in dressing.policy.signature.outputs}
    drawn = row(dressing.builder, dressing.own(spec.name), width)
    return drawn, row(dressing.builder, dressing.own(without), width) if without in known else drawn, width


class Branches(Struct, frozen=True):
    """The scores of a discrete action: log-probabilities or logits [B, n] per branch, and its samples where it draws.

    ``samples`` and ``best`` are int64 [B, branches], None where they have to be made of the scores.
    """

    scores: tuple[str, ...]
    sizes: tuple[int, ...]
    samples: str | None
    best: str | None


def branches(dressing: Dressing, spec: TensorSpec, masks: str | None, *, masked: bool = True) -> Branches:
    """The branches of the discrete action ``spec``; masks are supplied and applied where ``masks`` is None.

    Not ``masked``: the consumer knows no masks, so none are supplied.
    """
    builder, signature = dressing.builder, dressing.policy.signature
    scores, sizes = _scores(dressing, spec)
    dressing.branches = sizes
    samples = best = None
    if masks is None and masked:
        masks = supply_masks(dressing, sum(sizes))
        own = zip(scores, _starts(sizes), sizes, strict=True)
        scores = tuple(_mask_scores(dressing, score, masks, at, size) for score, at, size in own)
    else:
        known = {s.name for s in signature.outputs}
        samples = dressing.own(spec.name) if spec.role in (Role.SAMPLED, Role.DETERMINISTIC) else None
        without = f"deterministic_{spec.name}"
        best = dressing.own(without) if without in known else samples
        samples = None if samples is None else _columns(dressing, samples, len(sizes))
        best = None if best is None else _columns(dressing, best, len(sizes))
    if spec.role is Role.DETERMINISTIC:
        if masked:
            dressing.notes.append("the policy does not draw: the action is the best one, with and without chance")
        samples = best = best or builder.concat([_best(dressing, s) for s in scores], 1)
    return Branches(scores, sizes, samples, best)


def samples(dressing: Dressing, found: Branches) -> tuple[str, str]:
    """(one draw per branch, the best of each branch), int64 [B, branches]."""
    builder = dressing.builder
    drawn, best = found.samples, found.best
    if drawn is None:
        one = builder.ints(1, "draws")
        parts = [
            _best(dressing, s)
            if size == 1
            else builder.add("Multinomial", [s, one], "drawn", T=None, output_dtype=INT64)
            for s, size in zip(found.scores, found.sizes, strict=True)
        ]
        drawn = builder.concat(parts, 1)
    return drawn, best or builder.concat([_best(dressing, s) for s in found.scores], 1)


def log_probabilities(dressing: Dressing, spec: TensorSpec, found: Branches) -> str:
    """What a consumer draws from, float32 [B, sum of branches]: log-probabilities per branch, one after the other.

    A policy that does not draw gets the best action of each branch far above all others.
    """
    builder = dressing.builder
    if spec.role is Role.DETERMINISTIC:
        return builder.concat([_scores_of_best(dressing, s) for s in found.scores], 1)
    if spec.role is Role.SAMPLED:
        return builder.concat([builder.add("LogSoftmax", [s], "log_probabilities") for s in found.scores], 1)
    return builder.concat(list(found.scores), 1)


def _scores_of_best(dressing: Dressing, score: str) -> str:
    """0 for the best, far below it for the others."""
    builder = dressing.builder
    best = builder.add("Equal", [score, builder.reduce("Max", score, [1], keep=True)], "is_best")
    other = builder.add("Sub", [builder.cast(best, FLOAT32), builder.floats(1.0, "one")])
    return builder.add("Mul", [other, builder.floats(dressing.forbidden)], "settled")


def _best(dressing: Dressing, score: str) -> str:
    builder = dressing.builder
    found = builder.add("ArgMax", [score, builder.ints(1, "axis")], "best", output_type=INT64)
    return builder.add("Reshape", [found, builder.ints([-1, 1], "column")], "best_column")


def _columns(dressing: Dressing, tensor: str, count: int) -> str:
    return dressing.builder.cast(row(dressing.builder, tensor, count), INT64)


def _starts(sizes: Sequence[int]) -> list[int]:
    return [sum(sizes[:i]) for i in range(len(sizes))]


def _mask_scores(dressing: Dressing, score: str, masks: str, at: int, size: int) -> str:
    """Scores of which those of forbidden actions are far below all others; nothing is changed where all are allowed."""
    builder = dressing.builder
    own = builder.slice(masks, 1, at, at + size)
    away = builder.add(
        "Mul", [builder.add("Sub", [own, builder.floats(1.0, "allowed")]), builder.floats(dressing.forbidden)]
    )
    return builder.add("Add", [score, away], "masked")


def _as_rows(dressing: Dressing, spec: TensorSpec, scores: str, width: int) -> str:
    """Scores [B, n]; those of a policy that was made for one agent may be [B, 1, n]."""
    builder = dressing.builder
    shape = builder.shape(scores)
    if len(shape) == 2:
        return scores
    if any(n != 1 for n in shape[1:-1]):
        dressing.refuse(
            f"the scores behind its discrete action {spec.name} have the shape {list(shape)}",
            why="a branch has one row of scores for each agent",
            fix="export the model with the logits or log-probabilities as its output: --output NAME=log_probs",
        )
    return builder.add("Reshape", [scores, builder.ints([-1, width], "rows")], "scores")


def _scores(dressing: Dressing, spec: TensorSpec) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """(scores per branch, sizes) of the discrete action, as they are in the policy."""
    builder, policy = dressing.builder, dressing.policy
    meaning = action_meaning(policy.graph, policy.fetches[spec.name], np.dtype(spec.dtype), has_masks=True)
    found = tuple(dressing.current_reference(b) for b in meaning.branches)
    widths = [builder.shape(b)[-1] for b in found]
    sizes = policy.signature.branches
    if not found or any(not isinstance(w, int) for w in widths):
        dressing.refuse(
            f"the scores behind its discrete action {spec.name} are not in the graph",
            why="action_masks have to be applied to the scores of each action, and an action drawn from them",
            fix="export the model with the logits or log-probabilities as its output: --output NAME=log_probs",
        )
    lengths = [w for w in widths if isinstance(w, int)]
    found = tuple(_as_rows(dressing, spec, b, n) for b, n in zip(found, lengths, strict=True))
    if len(found) == 1 and sizes and len(sizes) > 1 and sum(sizes) <= lengths[0]:
        found = tuple(builder.slice(found[0], 1, at, at + n) for at, n in zip(_starts(sizes), sizes, strict=True))
        lengths = list(sizes)
    if spec.role is Role.PROBS:
        found = tuple(builder.add("Log", [b], "log_probabilities") for b in found)
    return found, tuple(lengths)
