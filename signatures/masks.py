"""Masks to try a policy on, [rows, actions]: 1 allows, 0 forbids; an action of every branch is always allowed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature

#: Rows that forbid one action, and two; as many at most, drawn from all there are.
MOST_FORBIDDEN = 64
_PAIRS, _PAIRS_OF_IMAGES = 16, 4


def all_allowed(rng: np.random.Generator, batch: int, branches: Sequence[int]) -> np.ndarray:
    """Return masks that forbid nothing."""
    return np.ones((batch, sum(branches)))


def one_allowed(rng: np.random.Generator, batch: int, branches: Sequence[int]) -> np.ndarray:
    """Of each branch another one in the next row."""
    parts = [np.eye(size)[(rng.integers(0, size) + np.arange(batch)) % size] for size in branches]
    return np.concatenate(parts, axis=1)


def forbidden(signature: PolicySignature, rng: np.random.Generator) -> np.ndarray:
    """Return what is forbidden, [rows, actions]: each action of a branch that has others, then two at once."""
    width = next(int(s.shape[-1] or 0) for s in signature.inputs if s.role is Role.MASKS)
    sizes = signature.branches if sum(signature.branches) == width else (width,)
    branch = np.repeat(np.arange(len(sizes)), sizes)
    single = np.flatnonzero(np.repeat(sizes, sizes) > 1)
    if len(single) > MOST_FORBIDDEN:
        ends = single[[0, -1]]
        single = np.sort(np.concatenate([ends, rng.choice(single[1:-1], MOST_FORBIDDEN - 2, replace=False)]))
    rows = [[int(i)] for i in single]
    cameras = any(s.role is Role.VISUAL for s in signature.inputs)
    pairs = min(_PAIRS_OF_IMAGES if cameras else _PAIRS, len(single))
    for number in range(pairs):
        one = int(single[number * len(single) // pairs] if number % 2 else rng.choice(single))
        others = single[(single != one) & ((branch[single] != branch[one]) | (np.asarray(sizes)[branch[one]] > 2))]
        if len(others):
            rows.append([one, int(rng.choice(others))])
    made = np.zeros((len(rows), width))
    for row, actions in zip(made, rows, strict=True):
        row[actions] = 1
    return made


def random_masks(rng: np.random.Generator, batch: int, branches: Sequence[int]) -> np.ndarray:
    """Return masks of which each number is drawn, beside one action of every branch that is allowed."""
    drawn = (rng.random((batch, sum(branches))) < 0.5).astype(float)
    return np.asarray(np.maximum(drawn, one_allowed(rng, batch, branches)))
