"""Two arrays that should be the same: numbers, decisions, NaNs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from export_model.exporter.verify.excuses import BOTH_NAN, CHAOS, ROUNDING, Excuse, Forgiven
from export_model.exporter.verify.tolerances import Tolerance

#: Integer dtypes that TensorFlow.js has not: int32 in place of int64 there is listed, not a failure.
NARROWED = {("int64", "int32")}
#: What an output may be off of how far it varies.
SHARE = 1e-3
#: Rounding that explains so much of how far an output varies says nothing of an answer.
OPEN = 0.1
#: What a number may be off of its own size, however little its column varies: 64 units in the last place of float32
#: (measured on TensorFlow.js' wasm: 4e-6 of 1e4).
SIZE = 2.0**-17
#: Logarithm of the smallest float32 that has all its digits.
_UNDERFLOW = float(np.log(np.finfo(np.float32).tiny))
#: Of histograms: decades run from 10^FIRST to 10^LAST; the first takes what is smaller, the last what is larger.
FIRST, LAST = -12, 3
#: Why an answer differs that no number can say of.
ONE_SIDED = "NaN or infinity on one side only"
#: Entry 0 counts equal elements, entry 1 + i those of the decade from 10^(FIRST + i) on.
BINS = 1 + LAST - FIRST + 1


class Difference(Struct, frozen=True):
    """How far a candidate is from the reference; ``reason`` says what is wrong where it is not a number."""

    max_abs: float
    max_rel: float
    passed: bool
    reason: str = ""
    #: What rounding explains at the element that differs most, where that was asked for.
    rounding: float = 0.0
    #: Elements per decade of |a − b| (``BINS``); empty where there are no numbers to compare.
    histogram: tuple[int, ...] = ()
    #: The smallest t with |a − b| ≤ t + t·|b| everywhere; None where no number would do.
    smallest_tolerance: float | None = None
    #: Where the element is that needs it, in C order; None where there is none.
    worst: int | None = None
    #: The largest |a − b| as a share of what was allowed there, rounding included: it passes up to 1.
    share: float = 0.0
    #: How many elements there are, and which of them what rule forgave (exporter/verify/excuses.py).
    elements: int = 0
    forgiven: tuple[Forgiven, ...] = ()
    #: How many are beyond the tolerance, whether a rule forgives them or not.
    beyond: int = 0


def compare(
    reference: np.ndarray,
    candidate: np.ndarray,
    tolerance: Tolerance,
    *,
    free: Sequence[tuple[Excuse, np.ndarray]] = (),
    narrowed: bool = False,
    rounding: np.ndarray | None = None,
    most: np.ndarray | None = None,
    ceiling: np.ndarray | float = np.inf,
) -> Difference:
    """Compare by |a − b| ≤ atol + rtol·|b|, element by element.

    ``free`` marks elements where the answer is as right, by the rule that says so. ``narrowed`` allows int32 for int64.
    ``most`` are bounds per column that go before larger ones. ``rounding`` is an absolute difference per element that
    float32 itself explains; where it is larger than the tolerance it takes its place, up to ``ceiling``. A NaN or
    infinity must stand at the same place on both sides; a NaN beside a finite number is forgiven by no rule, and by one
    it is not proven wrong.
    """
    if (other := _other_kind(reference, candidate, narrowed=narrowed)) is not None:
        return other
    if not reference.size:
        return Difference(0.0, 0.0, True)
    a, b = candidate.astype(np.float64), reference.astype(np.float64)
    masks = [(e, mask if e.unproven else mask & ~(np.isnan(a) & np.isfinite(b))) for e, mask in free]
    freed = np.logical_or.reduce([mask for _, mask in masks]) if masks else np.zeros(a.shape, bool)
    odd, nan = ~np.isfinite(a) | ~np.isfinite(b), np.isnan(a) & np.isnan(b)
    one_sided = odd & ~(nan | (a == b))
    if (one_sided & ~freed).any():
        wrong_there = one_sided & ~freed
        return replace(wrong(ONE_SIDED), worst=int(wrong_there.argmax()), elements=a.size, beyond=int(one_sided.sum()))
    a, b = np.where(odd, 0.0, a), np.where(odd, 0.0, b)
    whole = np.abs(a - b)
    difference = np.where(freed, 0.0, whole)
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        # Beside a reference of nearly zero the tolerance is what a difference is relative to.
        relative = difference / np.maximum(np.abs(b), tolerance.atol)
    bound = tolerance.atol + tolerance.rtol * np.abs(b) if reference.dtype.kind == "f" else np.zeros_like(b)
    if most is not None:
        bound = np.minimum(bound, np.maximum(most, SIZE * np.abs(b)))
    beyond = (whole > bound) | one_sided
    if rounding is not None:
        rounding = np.minimum(rounding, ceiling)
        explained = beyond & ~freed & (difference <= rounding)
        reached = explained & (rounding >= OPEN * np.asarray(ceiling))
        masks = [*masks, (ROUNDING, explained & ~reached), (CHAOS, reached)]
        bound = np.maximum(bound, rounding)
    worst_relative = float(np.where(difference > 0, relative, 0.0).max())
    needed = difference / (1 + np.abs(b))
    if rounding is not None:
        needed = np.where(difference <= rounding, 0.0, needed)
    worst = int(needed.argmax())
    # A little more than the quotient: it was rounded, and a user who gives it must pass.
    smallest = float(needed.reshape(-1)[worst]) * (1 + 1e-12) if reference.dtype.kind == "f" else None
    whole = np.where(one_sided, np.inf, whole)
    return Difference(
        max_abs=float(difference.max()),
        max_rel=worst_relative,
        passed=bool((difference <= bound).all()),
        rounding=0.0 if rounding is None else float(rounding.reshape(-1)[int(difference.argmax())]),
        histogram=decades(difference),
        smallest_tolerance=smallest,
        worst=worst,
        share=float(shares(difference, bound).max()),
        elements=a.size,
        forgiven=_count_forgiven([*masks, (BOTH_NAN, nan)], beyond | nan, whole),
        beyond=int(beyond.sum()),
    )


def _other_kind(reference: np.ndarray, candidate: np.ndarray, *, narrowed: bool) -> Difference | None:
    if reference.shape != candidate.shape:
        return wrong(f"shape {list(candidate.shape)} instead of {list(reference.shape)}")
    names = (reference.dtype.name, candidate.dtype.name)
    if names[0] != names[1] and not (narrowed and names in NARROWED):
        return wrong(f"dtype {names[1]} instead of {names[0]}")
    return None


def _count_forgiven(
    masks: Sequence[tuple[Excuse, np.ndarray]], beyond: np.ndarray, whole: np.ndarray
) -> tuple[Forgiven, ...]:
    """What each rule forgave of what is ``beyond`` the tolerance: what one before it did is not counted again."""
    made, left = [], beyond
    for excuse, mask in masks:
        if (there := mask & left).any():
            made.append(Forgiven(excuse, int(there.sum()), float(whole[there].max())))
            left = left & ~there
    return tuple(made)


def shares(difference: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """Return each difference as a share of its bound: 0 where there is none, infinite where none is allowed."""
    found = np.zeros_like(difference)
    with np.errstate(divide="ignore", over="ignore"):
        np.divide(difference, bound, out=found, where=difference > 0)
    return found


def compare_all(
    references: Sequence[np.ndarray],
    candidates: Sequence[np.ndarray],
    tolerance: Tolerance,
    *,
    narrowed: bool = False,
    most: np.ndarray | None = None,
) -> list[Difference | None]:
    """``compare`` of pairs that differ in their rows only, in one go: to call numpy costs more than small arrays do.

    None for a pair that does not pass, or of which more has to be said: that is for ``compare``.
    """
    nothing: list[Difference | None] = [None] * len(references)
    kinds = {(r.dtype, c.dtype, r.shape[1:]) for r, c in zip(references, candidates, strict=True)}
    if len(kinds) != 1 or any(r.shape != c.shape or not r.size for r, c in zip(references, candidates, strict=True)):
        return nothing
    ((wanted, got, _),) = kinds
    if wanted != got and not (narrowed and (wanted.name, got.name) in NARROWED):
        return nothing
    a = np.concatenate(candidates, axis=None).astype(np.float64)
    b = np.concatenate(references, axis=None).astype(np.float64)
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return nothing
    size, difference = np.abs(b), np.abs(a - b)
    bound = tolerance.atol + tolerance.rtol * size if wanted.kind == "f" else np.zeros_like(b)
    if most is not None:
        narrow = np.concatenate([np.broadcast_to(most, r.shape) for r in references], axis=None)
        bound = np.minimum(bound, np.maximum(narrow, SIZE * size))
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        relative = np.where(difference > 0, difference / np.maximum(size, tolerance.atol), 0.0)
    sizes = [r.size for r in references]
    starts = np.concatenate(([0], np.cumsum(sizes[:-1]))).astype(int)
    passed = np.logical_and.reduceat(difference <= bound, starts)
    absolute, relative = np.maximum.reduceat(difference, starts), np.maximum.reduceat(relative, starts)
    share = np.maximum.reduceat(shares(difference, bound), starts)
    needed = np.maximum.reduceat(difference / (1 + size), starts) * (1 + 1e-12)
    counts = decades_by_group(difference, np.repeat(np.arange(len(sizes)), sizes), len(sizes)).tolist()
    return [
        Difference(
            float(absolute[i]),
            float(relative[i]),
            True,
            histogram=tuple(counts[i]),
            smallest_tolerance=float(needed[i]) if wanted.kind == "f" else None,
            share=float(share[i]),
            elements=sizes[i],
        )
        if passed[i]
        else None
        for i in range(len(sizes))
    ]


def wrong(reason: str) -> Difference:
    """One that no number tells, only ``reason``."""
    return Difference(float("inf"), float("inf"), False, reason, share=float("inf"))


def steps(exact: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """How far each value moved; 0 where that is not finite."""
    with np.errstate(invalid="ignore"):
        step = np.abs(moved.astype(np.float64) - exact)
    return np.where(np.isfinite(step), step, 0.0)


def spread(answers: Sequence[np.ndarray]) -> np.ndarray | None:
    """How far each column varies over float ``answers`` of one shape but for the rows: [1, ...].

    Infinite where it does not vary at all; None where nothing can be told.
    """
    if (
        not answers
        or answers[0].dtype.kind != "f"
        or any(a.ndim < 2 or a.shape[1:] != answers[0].shape[1:] for a in answers)
    ):
        return None
    rows = np.concatenate(answers).astype(np.float64)
    with np.errstate(invalid="ignore"):
        varies = rows.max(axis=0, keepdims=True) - rows.min(axis=0, keepdims=True)
    return np.where(np.isfinite(varies) & (varies > 0), varies, np.inf)


def floor_log_probs(log_probs: np.ndarray, branches: Sequence[int]) -> np.ndarray:
    """Log-probabilities with those that say "never" brought to one value: n·2⁻¹²⁶ of the likeliest of n classes.

    Below it a float32 probability is denormal or zero (the likeliest has 1/n or more): its logarithm has few digits
    left, is −∞ where it is flushed to zero, and is −10⁸ where a runtime takes log(softmax(x)) as one function
    (TensorFlow's grappler does).
    """
    sizes = branches if sum(branches) == log_probs.shape[-1] else (log_probs.shape[-1],)
    parts = []
    for part in np.split(log_probs, np.cumsum(sizes)[:-1], axis=-1):
        best = part.max(axis=-1, keepdims=True, initial=-np.inf)
        least = _UNDERFLOW + math.log(max(1, part.shape[-1]))
        parts.append(np.maximum(part, best + part.dtype.type(least)))
    return np.concatenate(parts, axis=-1)


def near_best(low: np.ndarray, high: np.ndarray, branches: Sequence[int]) -> np.ndarray:
    """[B, ΣB]: which classes may be the best of their branch, of scores between ``low`` and ``high``.

    Those that reach what the best of the others has at least. NaN decides nothing.
    """
    edges = np.cumsum(branches)[:-1]
    pairs = zip(*(np.split(a.astype(np.float64), edges, axis=1) for a in (low, high)), strict=True)
    with np.errstate(invalid="ignore"):
        return np.concatenate([~(up < np.fmax.reduce(down, axis=1, keepdims=True)) for down, up in pairs], axis=1)


def score_bounds(
    scores: np.ndarray, branches: Sequence[int], tolerance: Tolerance, rounding: np.ndarray | float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Between what each score may lie: off by the tolerance of the best of its branch, or what rounding explains."""
    whole = scores.astype(np.float64)
    sizes = np.asarray(branches)
    best = np.repeat(np.maximum.reduceat(whole, np.cumsum(sizes) - sizes, axis=1), sizes, axis=1)
    off = np.maximum(tolerance.atol + tolerance.rtol * np.abs(best), rounding)
    off = np.where(np.isfinite(off), off, 0.0)
    return whole - off, whole + off


def ties(
    scores: np.ndarray, branches: Sequence[int], tolerance: Tolerance, rounding: np.ndarray | float = 0.0
) -> np.ndarray:
    """[B, branches]: where several classes of a branch may be the best."""
    near = near_best(*score_bounds(scores, branches, tolerance, rounding), branches)
    return np.stack([part.sum(axis=1) > 1 for part in np.split(near, np.cumsum(branches)[:-1], axis=1)], axis=1)


def is_marked(marked: np.ndarray, classes: np.ndarray, branches: Sequence[int]) -> np.ndarray:
    """[B, branches]: whether the class of each branch is one of those ``marked`` [B, ΣB]; none outside of it is."""
    sizes = np.asarray(branches)
    inside = (classes >= 0) & (classes < sizes)
    places = np.cumsum(sizes) - sizes + np.where(inside, classes, 0)
    return np.asarray(inside & np.take_along_axis(marked, places.astype(np.int64), axis=1))


def decades(differences: np.ndarray) -> tuple[int, ...]:
    """How ``differences`` (any shape) are spread: counts of elements per decade of |a − b|."""
    flat = np.asarray(differences, np.float64).reshape(-1)
    return tuple(decades_by_group(flat, np.zeros(flat.size, int), 1)[0].tolist())


def decades_by_group(differences: np.ndarray, groups: np.ndarray, count: int) -> np.ndarray:
    """Counts of ``differences`` (finite, not negative, [n]) by group: [count, BINS]; ``groups`` says whose each is."""
    positive = differences > 0
    places = np.zeros(differences.shape, int)
    places[positive] = np.clip(np.floor(np.log10(differences[positive])).astype(int), FIRST, LAST) - FIRST + 1
    return np.bincount(groups * BINS + places, minlength=count * BINS).reshape(count, BINS)


def add_histograms(histograms: Iterable[tuple[int, ...]]) -> tuple[int, ...]:
    """The sum of histograms; empty ones count nothing."""
    return tuple(map(sum, zip(*filter(None, histograms), strict=True)))


def by_decade(counts: tuple[int, ...]) -> dict[str, int]:
    """For parity.json: the lower edge of each decade that has elements ("0" for equal ones) and their number."""
    names = ["0", *(f"1e{exponent}" for exponent in range(FIRST, LAST + 1))]
    return {name: n for name, n in zip(names, counts, strict=True) if n}
