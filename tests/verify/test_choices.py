"""Choices among scores: where another one is as right."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from export_model.converters.policy.policy import Policy
from export_model.exporter.verify.checks.numbers import numbers
from export_model.exporter.verify.choices import Choices, broken_ties
from export_model.exporter.verify.tolerances import Tolerance
from tests.handmade import constant, node, placeholder
from tests.verify.judged import Feeds, compiled, judge, spoiling, wrong

Array = npt.NDArray[Any]
F: dict[str, Any] = {"T": np.float32}


def chosen(gap: float = 0.0, op: str = "ArgMax") -> Policy:
    """``action``: the best of four scores that are no output; the third is the second plus ``gap``."""
    matrix = np.random.default_rng(0).standard_normal((3, 4)).astype(np.float32)
    matrix[:, 2] = matrix[:, 1]
    return compiled(
        [
            placeholder("vector_observation"),
            constant("w", matrix),
            node("before", "MatMul", "vector_observation", "w", transpose_a=False, transpose_b=False, **F),
            constant("gap", np.array([0, 0, gap, 0], np.float32)),
            node("scores", "Add", "before", "gap", **F),
            constant("axis", 1, np.int32),
            node("action", op, "scores", "axis", T=np.float32, Tidx=np.int32, output_type=np.int64),
        ]
    )


def _exchanged(feeds: Feeds, choice: Array) -> Array:
    return np.where((choice == 1) | (choice == 2), 3 - choice, choice)


@pytest.mark.parametrize("op", ["ArgMax", "ArgMin"])
@pytest.mark.parametrize(("gap", "right"), [(0.0, True), (1e-6, True), (0.1, False)])
def test_a_tie_of_scores_that_are_no_output_may_go_either_way(gap: float, right: bool, op: str, tmp_path: Path) -> None:
    report = judge(chosen(gap, op), tmp_path, spoiling("action", _exchanged), checks=(numbers,))
    assert report.passed is right, [f.explanation() for f in report.failures]


@pytest.mark.parametrize("other", [0, 3])
def test_what_is_not_tied_stays_as_it_is(other: int, tmp_path: Path) -> None:
    """A class that is neither of the two that are as good."""
    lying = spoiling("action", lambda f, a: np.where(a == 1, other, a))
    assert wrong(judge(chosen(), tmp_path, lying, checks=(numbers,))) == {("numbers", "action")}


def test_ties_are_broken_as_an_answer_breaks_them() -> None:
    expected, other = np.array([[0], [1], [2]]), np.array([[5], [1], [7]])
    best = np.array([[0], [1], [2]])
    made = broken_ties(expected, [best, other], np.array([[5], [1], [2]]), Tolerance())
    assert made is not None and made.tolist() == [[5], [1], [2]]
    assert broken_ties(expected, [best, other], np.array([[9], [1], [2]]), Tolerance()) is None
    own = broken_ties(np.array([[5], [4], [2]]), [best, other], best, Tolerance())
    assert own is not None and own.tolist() == [[0], [4], [2]], "the best of the kernels, where the source's is as good"
    rows, others = np.array([[0.0, 1.0], [2.0, 3.0]]), np.array([[5.0, 6.0], [2.0, 3.0]])
    assert broken_ties(rows, [others], np.array([[5.0, 1.0], [2.0, 3.0]]), Tolerance()) is None, "a row as a whole"
    whole = broken_ties(rows, [others], np.array([[5.0, 6.0 + 1e-6], [2.0, 3.0]]), Tolerance())
    assert whole is not None and whole.tolist() == others.tolist()


def test_choices_stand_behind_what_hangs_on_them() -> None:
    graph = chosen().graph
    assert [n.op for n in Choices(graph).behind("action")] == ["ArgMax"]
    assert Choices(graph).behind("scores") == [] and Choices(graph).behind("nowhere") == []
    nothing = {"state": np.full((2, 3), np.nan, np.float32)}
    assert Choices(graph).has_only_nan_scores("action", nothing)
    assert not Choices(graph).has_only_nan_scores("action", {"state": np.ones((2, 3), np.float32)})


def test_a_choice_whose_rival_gives_the_same_numbers_is_no_tie(tmp_path: Path) -> None:
    """Both classes that are as good look up one number: an answer that is off in another way stays off."""
    matrix = np.random.default_rng(0).standard_normal((3, 4)).astype(np.float32)
    matrix[:, 2] = matrix[:, 1]
    policy = compiled(
        [
            placeholder("vector_observation"),
            constant("w", matrix),
            node("scores", "MatMul", "vector_observation", "w", transpose_a=False, transpose_b=False, **F),
            constant("axis", 1, np.int32),
            node("best", "ArgMax", "scores", "axis", T=np.float32, Tidx=np.int32, output_type=np.int64),
            constant("looks", np.array([[-1.0], [0.5], [0.5], [1]], np.float32)),
            constant("rows", 0, np.int32),
            node("action", "GatherV2", "looks", "best", "rows", Tparams=np.float32, Tindices=np.int64, Taxis=np.int32),
        ]
    )

    def lies(feeds: Feeds, a: Array) -> Array:
        return np.where(np.arange(len(a))[:, None] % 2, a * np.float32(1 + 2e-7), a + 0.1).astype(np.float32)

    lying = spoiling("action", lies)
    assert wrong(judge(policy, tmp_path, lying, checks=(numbers,))) == {("numbers", "action")}
