"""The generator: its algorithm's published values, its distribution, its edges."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from export_model.exporter.acting.generator import MAX_SEED, Generator, likeliest, philox
from export_model.exporter.verify.statistics import FALSE_ALARM, fit
from export_model.signatures.errors import UsageError


@pytest.mark.parametrize(
    ("counter", "key", "words"),
    [
        ((0, 0), 0, (0xFF1DAE59, 0x6CD10DF2)),
        ((0xFFFFFFFF, 0xFFFFFFFF), 0xFFFFFFFF, (0x2C3F628B, 0xAB4FD7AD)),
        ((0x243F6A88, 0x85A308D3), 0x13198A2E, (0xDD7CE038, 0xF62A4C12)),
    ],
)
def test_it_is_philox(counter: tuple[int, int], key: int, words: tuple[int, int]) -> None:
    """The known answers that Random123 publishes for philox2x32 with ten rounds."""
    first, second = (np.array([word], np.uint64) for word in counter)
    assert tuple(int(word[0]) for word in philox(first, second, key)) == words


def test_uniform_draws_are_uniform() -> None:
    draws = Generator(0).uniform((20_000,))
    assert draws.min() >= 0
    assert draws.max() < 1
    counts = (draws * 16).astype(int)
    assert fit(counts, np.log(np.full(16, 1 / 16, np.float32))) >= FALSE_ALARM


def test_normal_draws_are_normal() -> None:
    draws = Generator(1).normals((20_000,))
    assert draws.dtype == np.float32
    edges = [-math.inf, -1.5, -1, -0.5, 0, 0.5, 1, 1.5, math.inf]
    cdf = [0.5 * (1 + math.erf(e / math.sqrt(2))) for e in edges]
    counts = np.digitize(draws, edges[1:-1])
    assert fit(counts, np.log(np.diff(cdf)).astype(np.float32)) >= FALSE_ALARM


def test_choices_have_their_probabilities() -> None:
    """Two branches of one row each: both have their own distribution, and are drawn apart."""
    scores = np.log(np.array([0.5, 0.3, 0.2, 0.9, 0.1], np.float32))
    draws = Generator(2).choices(np.repeat(scores[None] + 7, 5_000, axis=0), [3, 2])
    assert draws.dtype == np.int64
    assert fit(draws[:, 0], scores[:3]) >= FALSE_ALARM
    assert fit(draws[:, 1], scores[3:]) >= FALSE_ALARM
    joint = np.log(np.outer(np.exp(scores[:3]), np.exp(scores[3:])).reshape(-1))
    assert fit(draws[:, 0] * 2 + draws[:, 1], joint.astype(np.float32)) >= FALSE_ALARM


@given(seed=st.integers(0, MAX_SEED), rows=st.integers(1, 5))
def test_many_at_once_are_those_one_by_one(seed: int, rows: int) -> None:
    """An agent's action does not depend on how many are asked together, only on the draws before it."""
    scores = np.random.default_rng(rows).normal(size=(rows, 5))
    one_by_one = Generator(seed)
    expected = [one_by_one.choices(row[None], [3, 2])[0] for row in scores]
    np.testing.assert_array_equal(Generator(seed).choices(scores, [3, 2]), expected)
    one_by_one = Generator(seed)
    normals = [one_by_one.normals((3,)) for _ in range(rows)]
    np.testing.assert_array_equal(Generator(seed).normals((rows, 3)), normals)


@given(seed=st.integers(0, MAX_SEED), allowed=st.integers(0, 3))
def test_what_has_no_probability_is_never_chosen(seed: int, allowed: int) -> None:
    scores = np.full((1, 4), -np.inf, np.float32)
    scores[0, allowed] = -80
    assert Generator(seed).choices(scores, [4]) == allowed
    assert likeliest(scores, [4]) == allowed


@pytest.mark.parametrize("scores", [[-np.inf, -np.inf], [np.nan, np.nan], [0.0, np.nan]])
def test_where_nothing_can_be_drawn_it_says_so(scores: list[float]) -> None:
    rows = np.array([[0.0, 0.0], scores], np.float32)
    for choose in (Generator(0).choices, likeliest):
        with pytest.raises(UsageError, match=r"nothing can be drawn.*agent 1"):
            choose(rows, [2])


@given(seed=st.integers(0, MAX_SEED))
def test_a_seed_says_all(seed: int) -> None:
    one, other = Generator(seed), Generator(seed)
    np.testing.assert_array_equal(one.uniform((5,)), other.uniform((5,)))


def test_near_seeds_are_far_apart() -> None:
    seeds = (*range(2000), *(2**32 * i for i in range(1, 2000)))
    first = np.array([Generator(seed).uniform((1,))[0] for seed in seeds])
    assert len(set(first)) == len(first)
    assert fit((first * 16).astype(int), np.log(np.full(16, 1 / 16, np.float32))) >= FALSE_ALARM


def test_a_seed_of_numpy_is_a_seed() -> None:
    seed: Any = np.int64(5)
    np.testing.assert_array_equal(Generator(seed).uniform((3,)), Generator(5).uniform((3,)))


@pytest.mark.parametrize("seed", [-1, MAX_SEED + 1, 1.5])
def test_other_seeds_are_refused(seed: float) -> None:
    with pytest.raises(UsageError, match="the seed "):
        Generator(seed)  # type: ignore[arg-type]
