"""Which inputs are tried: faults that a few of them alone show."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from export_model.exporter.verify.checks.numbers import numbers
from export_model.signatures.sampling import HUGE_BATCH, draw_cases
from tests.handmade import constant, continuous_policy, dense, node, placeholder
from tests.verify.judged import Feeds, compiled, judge, spoiling, wrong

Array = npt.NDArray[Any]
F: dict[str, Any] = {"T": np.float32}


def eye(side: int) -> list[Any]:
    """A picture, of which the mean is seen, beside four numbers."""
    return [
        placeholder("visual_observation_0", (None, side, side, 3)),
        placeholder("vector_observation", (None, 4)),
        constant("axes", [1, 2]),
        node("mean", "Mean", "visual_observation_0", "axes", T=np.float32, Tidx=np.int32, keep_dims=False),
        *dense("left", "mean", 3, 2),
        *dense("right", "vector_observation", 4, 2),
        node("action", "Add", "left", "right", **F),
    ]


def masked() -> list[Any]:
    return [
        placeholder("vector_observation", (None, 4)),
        placeholder("action_masks", (None, 3)),
        *dense("logits", "vector_observation", 4, 3),
        node("soft", "Softmax", "logits", **F),
        node("left", "Mul", "soft", "action_masks", **F),
        constant("little", 1e-7),
        node("kept", "Add", "left", "little", **F),
        node("action", "Log", "kept", **F),
    ]


VECTORS: dict[str, Callable[[Array], Array]] = {
    **{f"number {i} above 50, alone": lambda v, i=i: (v[:, i] > 50) & ((np.abs(v) < 5).sum(1) == 3) for i in range(4)},  # type: ignore[misc]
    "opposite extremes": lambda v: (v[:, 0] > 4.5) & (v[:, 3] < -4.5) & (np.abs(v) < 9).all(1),
}


@pytest.mark.parametrize("region", VECTORS)
@pytest.mark.parametrize("side", [20, 120])
def test_numbers_beside_a_camera_are_far_too(side: int, region: str) -> None:
    (name,) = (s.name for s in compiled(eye(side)).signature.observations if len(s.shape) == 2)
    cases = draw_cases(compiled(eye(side)).signature)
    assert any(VECTORS[region](case.feeds[name]).any() for case in cases)


def test_masks_come_with_far_observations(tmp_path: Path) -> None:
    def far(feeds: Feeds, values: Array) -> Array:
        rows = (np.abs(feeds["state"]).max(1) > 40) & (feeds["action_masks"] == 0).any(1)
        return values + rows[:, None].astype(np.float32)

    policy = compiled(masked())
    assert judge(policy, tmp_path).passed is True
    assert wrong(judge(policy, tmp_path, spoiling("action", far), checks=(numbers,))) == {("numbers", "action")}


@pytest.mark.parametrize("batch", [1, 2, 3, 4, 5, 7, 10, 12, 16, 32, 48, 64, 521, HUGE_BATCH])
def test_each_batch_is_tried(batch: int, tmp_path: Path) -> None:
    def rolled(feeds: Feeds, values: Array) -> Array:
        return np.roll(values, 1, axis=0) + np.float32(len(values) == 1) if len(values) == batch else values

    report = judge(compiled(continuous_policy()), tmp_path, spoiling("action", rolled), checks=(numbers,))
    assert wrong(report) == {("numbers", "action")}


def test_the_largest_batch_is_for_one_runtime_of_a_format(tmp_path: Path) -> None:
    batches: list[list[int]] = []

    def watch(feeds: Feeds, values: Array) -> Array:
        batches[-1].append(len(values))
        return values

    for count in (1, 2):
        batches.append([])
        judge(compiled(continuous_policy()), tmp_path, spoiling("action", watch), checks=(numbers,) * count)
    assert [b.count(HUGE_BATCH) for b in batches] == [1, 2], "the same runtime, asked twice"
