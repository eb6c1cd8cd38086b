"""How differences are spread: counts of elements per decade of |a − b|."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

#: Decades run from 10^FIRST to 10^LAST; the first takes what is smaller, the last what is larger.
FIRST, LAST = -12, 3
#: Entry 0 counts equal elements, entry 1 + i those of the decade from 10^(FIRST + i) on.
BINS = 1 + LAST - FIRST + 1


def decades(differences: np.ndarray) -> tuple[int, ...]:
    """Counts of ``differences`` (finite, not negative, any shape) in ``BINS`` bins."""
    flat = np.asarray(differences, np.float64).reshape(-1)
    positive = flat[flat > 0]
    places = np.clip(np.floor(np.log10(positive)).astype(int), FIRST, LAST) - FIRST + 1
    counts = np.bincount(places, minlength=BINS)
    counts[0] = flat.size - positive.size
    return tuple(counts.tolist())


def decades_by_group(differences: np.ndarray, groups: np.ndarray, count: int) -> np.ndarray:
    """As ``decades``, of ``count`` groups at once: [count, BINS]; ``groups`` says whose each difference is."""
    positive = differences > 0
    places = np.zeros(differences.shape, int)
    places[positive] = np.clip(np.floor(np.log10(differences[positive])).astype(int), FIRST, LAST) - FIRST + 1
    return np.bincount(groups * BINS + places, minlength=count * BINS).reshape(count, BINS)


def added(histograms: Iterable[tuple[int, ...]]) -> tuple[int, ...]:
    """The sum of histograms; empty ones count nothing."""
    return tuple(map(sum, zip(*filter(None, histograms), strict=True)))


def to_dict(counts: tuple[int, ...]) -> dict[str, int]:
    """For parity.json: the lower edge of each decade that has elements ("0" for equal ones) and their number."""
    names = ["0", *(f"1e{exponent}" for exponent in range(FIRST, LAST + 1))]
    return {name: n for name, n in zip(names, counts, strict=True) if n}
