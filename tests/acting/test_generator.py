"""The generator: its distribution, its edges, and the very same draws in Node."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from exporter.acting.generator import MAX_SEED, Generator
from exporter.verify.statistics import FALSE_ALARM, fit
from signatures.errors import UsageError


def test_uniform_draws_are_uniform() -> None:
    generator = Generator(0)
    draws = np.array([generator.uniform() for _ in range(20_000)])
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
    scores = np.log(np.array([0.5, 0.3, 0.2], np.float32)) + 7
    generator = Generator(2)
    draws = np.array([generator.choice(scores) for _ in range(5_000)])
    assert fit(draws, scores - 7) >= FALSE_ALARM


@given(seed=st.integers(0, MAX_SEED), allowed=st.integers(0, 3))
def test_what_has_no_probability_is_never_chosen(seed: int, allowed: int) -> None:
    scores = np.full(4, -np.inf, np.float32)
    scores[allowed] = -80
    assert Generator(seed).choice(scores) == allowed


@pytest.mark.parametrize("scores", [[-np.inf, -np.inf], [np.nan, np.nan]])
def test_where_nothing_can_be_drawn_it_says_so(scores: list[float]) -> None:
    with pytest.raises(UsageError, match="nothing can be drawn"):
        Generator(0).choice(np.array(scores, np.float32))


@given(seed=st.integers(0, MAX_SEED))
def test_a_seed_says_all(seed: int) -> None:
    one, other = Generator(seed), Generator(seed)
    assert [one.uniform() for _ in range(5)] == [other.uniform() for _ in range(5)]


def test_near_seeds_are_far_apart() -> None:
    first = [Generator(seed).uniform() for seed in (*range(2000), *(2**32 * i for i in range(1, 2000)))]
    assert len(set(first)) == len(first)
    assert fit((np.array(first) * 16).astype(int), np.log(np.full(16, 1 / 16, np.float32))) >= FALSE_ALARM


@pytest.mark.parametrize("seed", [-1, MAX_SEED + 1, 1.5])
def test_other_seeds_are_refused(seed: float) -> None:
    with pytest.raises(UsageError, match="the seed is"):
        Generator(seed)  # type: ignore[arg-type]
