"""Draws of numbers that are spread otherwise than the reference's, beside right ones that are rounded otherwise."""

from __future__ import annotations

import numpy as np
import pytest

from export_model.exporter.verify.statistics import FALSE_ALARM, same_distribution, same_spread

NEAR = 1e-3


def draws(seed: int, wide: float = 1.0) -> np.ndarray:
    return np.asarray(wide * np.random.default_rng(seed).standard_normal(4096))


@pytest.mark.parametrize("wide", [1.15, 1 / 1.15])
def test_a_spread_a_seventh_off_is_seen_where_the_distance_does_not_show_it(wide: float) -> None:
    assert same_spread(draws(0), draws(1, wide), NEAR) < FALSE_ALARM / 20
    assert same_distribution(draws(0), draws(1, wide), NEAR, 0.0) > FALSE_ALARM


@pytest.mark.parametrize("rounded", [1 - 1e-7, 1.0, 1 + 1e-7])
@pytest.mark.parametrize("wide", [0.5, 3.0, 30.0])
def test_right_draws_are_as_spread_where_they_saturate_too(wide: float, rounded: float) -> None:
    found = [
        same_spread(np.clip(draws(seed, wide), -1, 1), np.clip(draws(-seed % 997, wide), -1, 1) * rounded, NEAR)
        for seed in range(40)
    ]
    assert min(found) > 1e-3


def test_numbers_that_do_not_vary_are_as_spread() -> None:
    assert same_spread(np.zeros(64), np.zeros(64), NEAR) == same_spread(np.ones(64), np.full(64, 1.0001), NEAR) == 1
