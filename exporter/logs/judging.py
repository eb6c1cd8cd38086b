"""Which steps of a recording fit what the policy answers: numbers, choices, and draws by their likelihood."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from msgspec import Struct

from export_model.exporter.logs.recording import Array, Arrays, Recording
from export_model.exporter.verify.tolerances import Tolerance
from export_model.signatures.roles import Role
from export_model.signatures.spec import ActionHead, PolicySignature, TensorSpec

#: What a log and the policy may differ by: one is of another machine, often of a GPU, and passed through text.
LOG_TOLERANCE = Tolerance(1e-4, 1e-4, "a log is of another machine")
#: A share of what is allowed that stands for "beyond all": a choice without scores, a NaN.
BEYOND = 1e12
#: Of draws: how many standard deviations their log-likelihood may be from what is expected (two-sided p = 6e-7).
SIGMAS = 5.0
#: As near the mean as one draw of a hundred is, in standard deviations: more of them were not drawn, or only some.
NEAR, NEAR_ODDS = 0.0125, 0.00997
#: A class that the policy gives less than this log-probability is never drawn.
NEVER = -18.4
#: A Gaussian whose mean is so many deviations within the bounds is as good as never clipped (1e-4).
CLIP_SIGMAS = 3.7
#: Noise that is fed to measure the spread of an action that the graph draws.
NOISE_STEP = 0.25


class Target(Struct, frozen=True):
    """A logged output and what it is held against.

    ``answer`` is the policy's output; ``scores`` what a choice is the largest of (None: choices have to be equal);
    ``branches`` are those of a choice, empty for numbers. ``head``: it is an action, which may have been drawn.
    """

    name: str
    answer: str
    branches: tuple[int, ...] = ()
    scores: str | None = None
    head: bool = False
    #: output that has the spread of a drawn action, and whether as its logarithm
    spread: tuple[str, bool] | None = None
    #: the graph takes the noise that the action is drawn with
    noisy: bool = False

    @property
    def drawable(self) -> bool:
        """Whether the odds of a draw are known."""
        return self.head and (self.scores is not None if self.branches else self.noisy or self.spread is not None)

    @property
    def output_names(self) -> tuple[str, ...]:
        """The policy's outputs that it takes to judge it."""
        parts = [self.scores if self.branches and self.scores else self.answer, self.spread and self.spread[0]]
        return tuple(p for p in parts if p)


def targets_of(signature: PolicySignature, recording: Recording, *, draws_itself: bool) -> list[Target]:
    """What of ``recording`` can be held against the policy."""
    heads = {h.name: h for h in signature.heads}
    deviation = next((s for s in signature.outputs if s.role in (Role.STD, Role.LOG_STD)), None)
    found = []
    for spec in signature.outputs:
        logged = recording.outputs.get(spec.name)
        if logged is None:
            continue
        head = heads.get(spec.name)
        if head is not None and logged.dtype.kind == "i":
            found.append(_choice(signature, head))
        elif logged.dtype.kind == "i":
            found.append(Target(spec.name, spec.name, tuple(signature.branches) or (0,), _scores(signature)))
        elif head is None or not head.is_continuous:
            found.append(Target(spec.name, spec.name))
        else:
            answer = head.plain.name if draws_itself and head.plain is not None else head.name
            spread = None if deviation is None else (deviation.name, deviation.role is Role.LOG_STD)
            noisy = bool(signature.noise) and not any(s.name in recording.logged for s in signature.noise)
            found.append(Target(spec.name, answer, head=True, spread=None if noisy else spread, noisy=noisy))
    return found


def _choice(signature: PolicySignature, head: ActionHead) -> Target:
    answer = head.name if head.spec.role is Role.DETERMINISTIC or head.plain is None else head.plain.name
    scores = head.name if head.spec.role in (Role.PROBS, Role.LOG_PROBS) else _scores(signature)
    return Target(head.name, answer, head.branches or (0,), scores, head=head.spec.role is not Role.DETERMINISTIC)


def _scores(signature: PolicySignature) -> str | None:
    wanted = (Role.LOG_PROBS, Role.Q_VALUES, Role.PROBS)
    found: list[TensorSpec] = [s for role in wanted for s in signature.outputs if s.role is role]
    return found[0].name if found else None


def shares(
    target: Target, logged: Array, answers: Arrays, tolerance: Tolerance, explained: Mapping[str, Array]
) -> Array:
    """How far each element of ``logged`` is from the answer, as a share of what is allowed there: [steps, columns].

    ``explained``: by output, [steps], what rounding of the inputs makes.
    """
    if target.branches:
        return _choice_shares(target, logged, answers, tolerance, explained)
    wanted = flat_rows(answers[target.answer]).astype(np.float64)
    given = flat_rows(logged).astype(np.float64)
    allowed = tolerance.atol + tolerance.rtol * np.abs(wanted) + explained.get(target.answer, np.zeros(1))[:, None]
    with np.errstate(invalid="ignore"):
        found = np.abs(given - wanted) / allowed
    return np.minimum(np.where(np.isnan(found), BEYOND, found), BEYOND)


def _choice_shares(
    target: Target, logged: Array, answers: Arrays, tolerance: Tolerance, explained: Mapping[str, Array]
) -> Array:
    given = flat_rows(logged)
    if target.scores is None:
        wanted = flat_rows(answers[target.answer])
        return np.where(given == wanted, 0.0, BEYOND)
    scores = flat_rows(answers[target.scores]).astype(np.float64)
    more = explained.get(target.scores, np.zeros(1))
    columns = []
    for part, chosen in _by_branch(target, scores, given):
        best = part.max(axis=1)
        gap = best - np.take_along_axis(part, chosen[:, None], axis=1)[:, 0]
        allowed = 2 * (tolerance.atol + tolerance.rtol * np.abs(best) + more)
        columns.append(np.where(np.isfinite(gap), np.minimum(gap / allowed, BEYOND), BEYOND))
    return np.stack(columns, axis=1)


def ties(target: Target, scores: Array) -> Array:
    """Bool [steps, branches]: the two best scores are so close that every choice between them fits."""
    found = []
    flat = flat_rows(scores).astype(np.float64)
    for part, _ in _by_branch(target, flat, np.zeros((len(flat), len(target.branches)), np.int64)):
        top = np.sort(part, axis=1)[:, -2:]
        found.append(top[:, -1] - top[:, 0] < 1e-3 * np.maximum(1.0, np.abs(top[:, -1])))
    return np.stack(found, axis=1)


def _by_branch(target: Target, scores: Array, choices: Array) -> list[tuple[Array, Array]]:
    """(its scores, what was chosen) per branch; a choice beyond the branch takes the last."""
    sizes = target.branches if sum(target.branches) == scores.shape[1] else (scores.shape[1],)
    edges = np.cumsum((0, *sizes))
    return [(scores[:, a:b], np.clip(choices[:, i], 0, b - a - 1)) for i, (a, b) in enumerate(pairwise(edges.tolist()))]


class Clip(Struct, frozen=True):
    """How a graph clips the action that it draws.

    ``bounds``, [2, columns], are infinite where it does not; ``usual`` is the standard deviation for each column.
    """

    bounds: Array
    usual: Array


class Likelihood(Struct, frozen=True):
    """The log-likelihood of what was drawn in each step, what is expected of it, and its variance: float64 [steps].

    Of choices also whether the likeliest was taken, less its odds, and the variance of that; of numbers how many of
    those that were ``counted`` lie ``near`` the mean.
    """

    found: Array
    expected: Array
    variance: Array
    likeliest: Array
    likeliest_variance: Array
    near: Array
    counted: Array

    @property
    def sigmas(self) -> float:
        """How many standard deviations the sum is from what is expected of it."""
        both = (
            _sigmas(float((self.found - self.expected).sum()), float(self.variance.sum())),
            _sigmas(float(self.likeliest.sum()), float(self.likeliest_variance.sum())),
            _too_many(float(self.near.sum()), float(self.counted.sum()), NEAR_ODDS),
        )
        return max(both, key=abs)

    @property
    def fits(self) -> bool:
        """Whether it can have been drawn so."""
        return abs(self.sigmas) <= SIGMAS and bool((self.found > 2 * NEVER).all())

    def without(self, rows: Array) -> Likelihood:
        """The same, with nothing said of the steps ``rows``, bool [steps]."""
        return Likelihood(*(np.where(rows, 0.0, getattr(self, part)) for part in self.__struct_fields__))


def _sigmas(apart: float, variance: float) -> float:
    if not math.isfinite(apart):
        return -BEYOND
    if variance < 1e-9:
        return 0.0 if abs(apart) < 1e-3 else math.copysign(BEYOND, apart)
    return apart / math.sqrt(variance)


def _too_many(found: float, count: float, odds: float) -> float:
    """How improbable so many of ``count`` are (Chernoff's bound), as standard deviations of a Gaussian."""
    share = found / max(count, 1.0)
    if share <= odds:
        return 0.0
    rest = (1 - share) * math.log((1 - share) / (1 - odds)) if share < 1 else 0.0
    return math.sqrt(2 * count * (share * math.log(share / odds) + rest))


def likelihood(
    target: Target, logged: Array, answers: Arrays, moved: Sequence[Arrays], clip: Clip | None
) -> Likelihood:
    """The likelihood of logged draws.

    ``moved``: the answers with the noise at ±``NOISE_STEP``, for an action that the graph draws; ``clip``: how the
    graph clips it.
    """
    if target.branches:
        assert target.scores is not None
        return _of_classes(target, flat_rows(logged), flat_rows(answers[target.scores]).astype(np.float64))
    mean = flat_rows(answers[target.answer]).astype(np.float64)
    if target.spread is not None:
        spread = flat_rows(answers[target.spread[0]]).astype(np.float64)
        std = np.broadcast_to(np.exp(spread) if target.spread[1] else spread, mean.shape)
    else:
        steps = [np.abs(flat_rows(m[target.answer]) - mean) for m in moved]
        std = np.max(steps, axis=0) / NOISE_STEP
    return _of_numbers(flat_rows(logged).astype(np.float64), mean, std, clip)


def _of_classes(target: Target, choices: Array, scores: Array) -> Likelihood:
    found, expected, variance, likeliest, spread, none = (np.zeros(len(scores)) for _ in range(6))
    for part, chosen in _by_branch(target, scores, choices):
        shifted = part - part.max(axis=1, keepdims=True)
        logs = np.maximum(shifted - np.log(np.exp(shifted).sum(axis=1, keepdims=True)), 4 * NEVER)
        odds = np.exp(logs)
        mean = (odds * logs).sum(axis=1)
        found += np.take_along_axis(logs, chosen[:, None], axis=1)[:, 0]
        expected += mean
        variance += (odds * logs**2).sum(axis=1) - mean**2
        most = odds.max(axis=1)
        likeliest += (odds.argmax(axis=1) == chosen) - most
        spread += most * (1 - most)
    return Likelihood(found, expected, np.maximum(variance, 0.0), likeliest, spread, near=none, counted=none)


def measured_spread(target: Target, answers: Arrays, moved: Sequence[Arrays], bounds: Array) -> Array:
    """The usual standard deviation of each column: the median over the steps at which the mean is not clipped, or 0."""
    mean = flat_rows(answers[target.answer]).astype(np.float64)
    std = np.max([np.abs(flat_rows(m[target.answer]) - mean) for m in moved], axis=0) / NOISE_STEP
    known = (std > 1e-9) & (mean > bounds[0] + 1e-6) & (mean < bounds[1] - 1e-6)
    return np.asarray([float(np.median(s[k])) if k.any() else 0.0 for s, k in zip(std.T, known.T, strict=True)])


def _of_numbers(drawn: Array, mean: Array, std: Array, clip: Clip | None) -> Likelihood:
    """Of Gaussians; what lies on a bound was clipped, and counts with the odds of lying beyond it.

    Where the mean itself is clipped its spread cannot be measured: it takes what is usual, and the bound as its mean.
    A column that is always clipped says nothing.
    """
    columns = mean.shape[1]
    low, high = (np.full(columns, -np.inf), np.full(columns, np.inf)) if clip is None else clip.bounds
    known = (std > 1e-9) & (mean > low + 1e-6) & (mean < high - 1e-6)
    if clip is None:
        free = known
    else:
        std = np.where(known, std, clip.usual)
        free = np.broadcast_to(clip.usual > 1e-9, mean.shape)
    std = np.where(free, std, 1.0)
    clipped = (drawn <= low + 1e-6) | (drawn >= high - 1e-6)
    z = (drawn - mean) / std
    density = -0.5 * z**2 - np.log(std) - 0.5 * math.log(2 * math.pi)
    beyond = np.where(drawn <= low + 1e-6, _log_tail((mean - low) / std), _log_tail((high - mean) / std))
    found = np.where(free, np.where(clipped, beyond, density), 0.0)
    # Where clipping is likely, the test leaves an element out whether it was clipped or not; weighing causes does not.
    counted = known & free & ((high - mean) / std > CLIP_SIGMAS) & ((mean - low) / std > CLIP_SIGMAS)
    expected = np.where(counted, -np.log(std) - 0.5 * math.log(2 * math.pi) - 0.5, found)
    none, size = np.zeros(len(mean)), counted.sum(axis=1).astype(np.float64)
    near = (counted & (np.abs(z) < NEAR)).sum(axis=1).astype(np.float64)
    return Likelihood(found.sum(axis=1), expected.sum(axis=1), 0.5 * size, none, none, near=near, counted=size)


def _log_tail(x: Array) -> Array:
    """Log P(N > x), to three digits."""
    with np.errstate(over="ignore"):
        near = np.log(np.maximum(0.5 * _erfc(np.minimum(x, 5.0) / math.sqrt(2)), 1e-300))
        far = -0.5 * x**2 - np.log(np.maximum(x, 1.0)) - 0.5 * math.log(2 * math.pi)
    found: Array = np.where(x > 5.0, far, near)
    return found


def _erfc(x: Array) -> Array:
    """The complementary error function: Abramowitz and Stegun 7.1.26, 1.5e-7."""
    t = 1 / (1 + 0.3275911 * np.abs(x))
    series = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))))
    value = series * np.exp(-(x**2))
    found: Array = np.where(x < 0, 2 - value, value)
    return found


def flat_rows(array: Array) -> Array:
    """An array as rows of numbers."""
    return array.reshape(len(array), -1)
