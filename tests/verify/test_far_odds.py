"""Classes drawn from scores that are no log-probabilities: of any size, or no numbers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from export_model.exporter.verify.checks.generators import wrong_classes

NUMPY: Any = SimpleNamespace(runtime="numpy")


def drawn(scores: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(1).gumbel(size=scores.shape)
    return np.asarray((scores + noise).argmax(axis=1)[:, None])


@pytest.mark.parametrize("far", [0.0, 2e3, -2e3])
def test_scores_far_from_zero_are_odds_like_any(far: float) -> None:
    scores = far + np.random.default_rng(0).standard_normal((2048, 4))
    right, _ = wrong_classes(drawn(scores), scores, [4], NUMPY)
    assert right.passed, right.reason
    wrong, _ = wrong_classes(drawn(scores[::-1]), scores, [4], NUMPY)
    assert not wrong.passed


@pytest.mark.parametrize("lie", [np.nan, -np.inf])
def test_scores_that_are_no_numbers_are_a_fault(lie: float) -> None:
    scores = np.zeros((64, 4))
    scores[3] = lie
    found, _ = wrong_classes(drawn(np.zeros((64, 4))), scores, [4], NUMPY)
    assert not found.passed and "NaN" in found.reason
