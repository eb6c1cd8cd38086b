"""The generator that draws actions, the same in Python and in policy.mjs: one seed, the same actions everywhere.

Philox-2x32 with ten rounds (Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC11): draw
number i is a function of the seed and of i alone, so numpy makes the draws of a thousand agents at once, and JavaScript
makes the same ones by itself with products of 32 bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from export_model.signatures.errors import UsageError, whole

_MASK = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)
_MULTIPLIER = np.uint64(0xD256D193)
_WEYL = 0x9E3779B9
_ROUNDS = 10
#: The largest seed that a JavaScript number holds exactly.
MAX_SEED = 2**53 - 1


class Generator:
    """Uniform and normal draws, numbered from 0: the counter is a draw's number with the seed's upper half."""

    def __init__(self, seed: int) -> None:
        seed = whole("the seed", seed, 0, MAX_SEED)
        self._key, self._upper = seed & 0xFFFFFFFF, seed >> 32
        self._drawn = 0

    def uniform(self, shape: tuple[int, ...]) -> np.ndarray:
        """float64 draws in [0, 1) in C order, with all 53 bits."""
        count = math.prod(shape)
        number = np.arange(self._drawn, self._drawn + count, dtype=np.uint64)
        self._drawn += count
        high, low = philox(number & _MASK, (number >> _HALF << np.uint64(21)) | np.uint64(self._upper), self._key)
        bits = (high >> np.uint64(5)) * np.uint64(1 << 26) + (low >> np.uint64(6))
        return (bits.astype(np.float64) / float(1 << 53)).reshape(shape)

    def normals(self, shape: tuple[int, ...]) -> np.ndarray:
        """float32 draws of N(0, 1) in C order, by Box and Muller; two uniform draws for each."""
        first, second = np.ascontiguousarray(self.uniform((math.prod(shape), 2)).T)
        draws: np.ndarray = np.sqrt(-2 * np.log(1 - first)) * np.cos(2 * math.pi * second)
        return draws.astype(np.float32).reshape(shape)

    def choices(self, log_probs: np.ndarray, branches: Sequence[int]) -> np.ndarray:
        """int64 [rows, branches]: an index within each branch, by its probability; one uniform draw for each.

        ``log_probs`` are [rows, ΣB], a branch beside the other; unnormalised ones will do. Raises UsageError where a
        branch has nothing that could be drawn.
        """
        draws = self.uniform((len(log_probs), len(branches)))
        return _choose_by_weight(_columns(log_probs, branches), np.ascontiguousarray(draws.T)).T.astype(np.int64)


def likeliest(log_probs: np.ndarray, branches: Sequence[int]) -> np.ndarray:
    """int64 [rows, branches]: where each branch has its largest log-probability; UsageError where it has none."""
    scores = _columns(log_probs, branches)
    _largest(scores)
    best: np.ndarray = np.argmax(scores, axis=0)
    return best.T.astype(np.int64)


def _columns(log_probs: np.ndarray, branches: Sequence[int]) -> np.ndarray:
    """float64 [largest branch, branches, rows], shorter ones filled up with -inf: numpy works on all rows at once."""
    given = np.asarray(log_probs).T
    columns = np.full((max(branches), len(branches), given.shape[1]), -np.inf)
    start = 0
    for branch, size in enumerate(branches):
        columns[:size, branch] = given[start : start + size]
        start += size
    return columns


def _largest(scores: np.ndarray) -> np.ndarray:
    best: np.ndarray = np.max(scores, axis=0)
    bad = np.argwhere(~(best > -np.inf))
    if len(bad):
        branch, row = bad[0]
        raise UsageError(
            f"nothing can be drawn from the log-probabilities {scores[:, branch, row].tolist()} of agent {row}",
            fix="allow an action of every branch in masks, and give observations that are numbers",
        )
    return best


def _choose_by_weight(scores: np.ndarray, draws: np.ndarray) -> np.ndarray:
    """``accumulate`` adds one after the other, as policy.mjs does: a last bit may decide."""
    weights = np.exp(scores - _largest(scores))
    total = np.add.accumulate(weights)[-1]
    left = np.subtract.accumulate(np.concatenate([(draws * total)[None], weights]))[1:]
    chosen: np.ndarray = np.count_nonzero(left >= 0, axis=0)
    if (chosen == len(weights)).any():  # rounding left a rest: the last index that has a probability
        last = len(weights) - 1 - np.argmax(weights[::-1] > 0, axis=0)
        chosen = np.where(chosen == len(weights), last, chosen)
    return chosen


def philox(first: np.ndarray, second: np.ndarray, key: int) -> tuple[np.ndarray, np.ndarray]:
    """Two words for each counter of two words; all of them 32 bits in uint64 arrays."""
    for turn in range(_ROUNDS):
        word = np.uint64((key + turn * _WEYL) & 0xFFFFFFFF)
        product = first * _MULTIPLIER
        first, second = (product >> _HALF) ^ word ^ second, product & _MASK
    return first, second
