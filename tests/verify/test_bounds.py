"""Bounds and excuses of exporter/verify by themselves: the numbers that they are, at their edges."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from export_model.converters.files.children.process import RunFailedError
from export_model.exporter.verify import rounding
from export_model.exporter.verify.checks.decisions import LIMITS, compare_decisions, decisions
from export_model.exporter.verify.difference import compare, compare_all, floor_log_probs, spread, ties
from export_model.exporter.verify.participants import policy_under_test
from export_model.exporter.verify.session import Session
from export_model.exporter.verify.statistics import chi_square_survival, dependent, fit, fit_all, same_distribution
from export_model.exporter.verify.tolerances import Tolerance
from export_model.exporter.verify.work import WorkAllowance, products
from export_model.signatures.sampling import Case
from tests.handmade import continuous_policy
from tests.verify.judged import KNOWN, Pool, compiled

Array = npt.NDArray[Any]
F32 = np.float32


def one(*values: float) -> Array:
    return np.array([values], F32)


# ------------------------------------------------------------------ two arrays


@pytest.mark.parametrize(
    ("reference", "candidate", "right"),
    [
        (one(1, np.nan), one(1, np.nan), True),
        (one(1, np.nan), one(2, np.nan), False),  # a NaN that both have excuses no other element
        (one(1, np.nan), one(np.nan, np.nan), False),
        (one(1, 1), one(1, np.nan), False),
        (one(1, np.inf), one(1, np.inf), True),
        (one(1, np.inf), one(1, -np.inf), False),
        (one(1, np.inf), one(1, 1), False),
        (one(0, 100), one(1e-5, 100), True),
        (one(0, 100), one(1.1e-5, 100), False),
        (one(0, 100), one(0, 100.00099), True),
        (one(0, 100), one(0, 100.0012), False),
        (one(0, -100), one(0, -100.0012), False),
    ],
)
def test_elements_are_compared_one_by_one(reference: Array, candidate: Array, right: bool) -> None:
    found = compare(reference, candidate, Tolerance())
    assert found.passed is right
    assert found.share <= 1 if right else found.share > 1
    (at_once,) = compare_all([reference], [candidate], Tolerance())
    assert at_once is None or right
    assert (
        compare_all([reference, one(1, 2)], [candidate, one(1, 2)], Tolerance())[1] is None
        or np.isfinite([*reference, *candidate]).all()
    )


def test_integers_are_equal_or_not() -> None:
    assert compare(np.array([[2]]), np.array([[2]]), Tolerance(9.0, 9.0)).passed
    assert not compare(np.array([[2]]), np.array([[3]]), Tolerance(9.0, 9.0)).passed
    assert compare_all([np.array([[2]])] * 2, [np.array([[2]]), np.array([[3]])], Tolerance(9.0, 9.0))[1] is None


def test_int32_is_listed_where_the_format_lacks_int64() -> None:
    wide, narrow = np.array([[2]]), np.array([[2]], np.int32)
    assert compare(wide, narrow, Tolerance(), narrowed=True).passed
    assert not compare(wide, narrow, Tolerance()).passed
    assert not compare(wide, np.array([[2]], np.int16), Tolerance(), narrowed=True).passed
    assert compare_all([wide], [narrow], Tolerance()) == [None]
    assert compare_all([wide], [narrow], Tolerance(), narrowed=True)[0] is not None


def test_what_rounding_explains_is_its_own_elements() -> None:
    reference, bound = one(0, 0), np.array([[1.0, 0.0]])
    assert compare(reference, one(1, 0), Tolerance(), rounding=bound).passed
    assert not compare(reference, one(1.1, 0), Tolerance(), rounding=bound).passed
    assert not compare(reference, one(0, 1), Tolerance(), rounding=bound).passed
    assert compare(reference, one(0.5, 0), Tolerance(), rounding=bound).rounding == 1.0


def test_what_hardly_varies_is_held_to_less_but_not_to_less_than_its_digits() -> None:
    most = np.array([[1e-7, np.inf]])
    assert not compare(one(0, 0), one(9e-7, 0), Tolerance(), most=most).passed
    assert compare(one(0, 0), one(0, 9e-6), Tolerance(), most=most).passed
    assert compare(one(1, 0), one(1 + 2**-18, 0), Tolerance(), most=most).passed
    assert not compare(one(1, 0), one(1 + 2**-16.9, 0), Tolerance(1e-4, 1e-4), most=most).passed
    assert compare_all([one(0, 0)], [one(9e-7, 0)], Tolerance(), most=most) == [None]
    assert compare_all([one(0, 0)], [one(0, 9e-6)], Tolerance(), most=most) != [None]


def test_the_smallest_tolerance_is_that_of_the_worst_element() -> None:
    found = compare(one(0, 3, 1), one(0.1, 3.8, 1), Tolerance())
    assert (found.worst, found.max_abs) == (1, pytest.approx(0.8))
    assert found.smallest_tolerance == pytest.approx(0.2)
    assert found.max_rel == pytest.approx(0.1 / 1e-5)
    passing = compare(one(0, 3), one(1e-6, 3), Tolerance())
    (same,) = compare_all([one(0, 3)], [one(1e-6, 3)], Tolerance())
    assert same is not None
    assert (same.max_abs, same.max_rel, same.share) == (passing.max_abs, passing.max_rel, passing.share)
    assert (same.histogram, same.smallest_tolerance) == (passing.histogram, passing.smallest_tolerance)


def test_a_column_varies_by_its_own() -> None:
    made = spread([one(0, 5), one(2, 5)])
    assert made is not None
    assert made[0, 0] == pytest.approx(2) and np.isinf(made[0, 1])
    assert spread([]) is None and spread([np.array([[1]])]) is None and spread([one(1), one(1, 2)]) is None


def test_log_probabilities_that_say_never_are_alike_in_each_branch() -> None:
    floored = floor_log_probs(one(0, -1e8, -50, -200), [2, 2])
    assert floored.tolist() == [[0, pytest.approx(-87, abs=1), -50, pytest.approx(-137, abs=1)]]
    assert floor_log_probs(one(0, -1e8, -50, -200), [3])[0, 3] == pytest.approx(-86.5, abs=1)


def test_a_tie_is_one_of_its_branch_and_row() -> None:
    scores = np.array([[1, 1, 5, 0], [1, 2, 3, 3], [1, 2, 0, 9]], F32)
    assert ties(scores, (2, 2), Tolerance()).tolist() == [[True, False], [False, True], [False, False]]
    assert ties(one(1, 1 + 3e-5, 7), (2, 1), Tolerance()).tolist() == [[True, False]]
    assert ties(one(1, 1 + 6e-5), (2,), Tolerance()).tolist() == [[False]]
    assert ties(one(1, 2, 5, 5.5), (2, 2), Tolerance(), np.array([[0, 1.1, 0, 0.2]])).tolist() == [[True, False]]
    assert ties(one(np.nan, np.nan), (2,), Tolerance()).tolist() == [[True]]


# ------------------------------------------------------------------ what rounding explains


class Jittered:
    """A model that each run of Monte Carlo arithmetic moves by what was asked for."""

    def __init__(self, moved: float, later: float = 0.0) -> None:
        self.moved, self.later, self.runs = moved, later, 0

    def run_all(self, inputs: Any, fetch: Any, requests: Any) -> list[dict[str, Array]]:
        self.runs = len(requests)
        return [{"y": one(0, 0)}, *({"y": one(self.moved if i < 6 else self.later, 0)} for i in range(len(inputs) - 1))]


@pytest.mark.parametrize(("sure", "bound", "runs"), [(False, 4.0, 7), (True, 8.0, 25)])
def test_rounding_explains_four_times_the_largest_movement(sure: bool, bound: float, runs: int) -> None:
    model, case = Jittered(1.0, 2.0), Case("typical", {}, 1)
    explained = rounding.Rounding(0, ["y"], dict).outputs(model, case, "onnxruntime", sure=sure)  # type: ignore[arg-type]
    assert explained["y"].tolist() == [[bound, 0.0]] and model.runs == runs


def test_where_the_model_does_not_run_nothing_is_explained() -> None:
    class Dead(Jittered):
        def run_all(self, inputs: Any, fetch: Any, requests: Any) -> list[dict[str, Array]]:
            raise RunFailedError("numpy ended")

    known = rounding.Rounding(0, ["y"], dict)
    assert known.outputs(Dead(1.0), Case("typical", {}, 1), "numpy", sure=False) == {}  # type: ignore[arg-type]


# ------------------------------------------------------------------ rounded weights


@pytest.mark.parametrize(("storage", "share"), [("int8", 0.05), ("float16", 0.01)])
def test_rounded_weights_may_move_so_much(storage: str, share: float) -> None:
    assert LIMITS[storage] == share  # type: ignore[index]


def test_decisions_that_are_other_ones_are_counted() -> None:
    was = np.arange(200).reshape(100, 2)
    made = was.copy()
    made[:3, 0] += 1
    assert compare_decisions(was, made)[0] == 3 / 200
    wide = np.array([[0.0, 5.0], [2.0, 5.0]])
    assert compare_decisions(wide, wide + np.array([0.1, 0.0]))[0] == pytest.approx(0.1)
    assert compare_decisions(wide, wide + np.array([0.0, 0.005]))[0] == pytest.approx(
        1.0
    )  # a still number, by its size
    assert compare_decisions(wide, np.where(wide == 0, np.nan, wide))[0] == np.inf
    assert compare_decisions(wide, wide[:1])[0] == np.inf


@pytest.mark.parametrize(("factor", "right"), [(1.0, True), (1.03, True), (1.2, False)])
def test_a_policy_with_other_weights_decides_otherwise(factor: float, right: bool, tmp_path: Path) -> None:
    policy, scaled = compiled(continuous_policy()), continuous_policy()
    kernel = next(n for n in scaled if n.name == "mu/kernel").attr["value"].tensor
    kernel.tensor_content = (np.frombuffer(kernel.tensor_content, F32) * F32(factor)).tobytes()
    whole, small = (
        policy_under_test(p, {}, tmp_path / name, sizes={}) for p, name in ((policy, "a"), (compiled(scaled), "b"))
    )
    session = Session(("numpy",), KNOWN, Pool())  # type: ignore[arg-type]
    (found,) = decisions(whole, small, "int8", session)
    assert found.passed is right, found


# ------------------------------------------------------------------ draws


@pytest.mark.parametrize(("statistic", "freedom"), [(3.84146, 1), (18.307, 10), (124.342, 100)])
def test_a_twentieth_is_beyond_the_table(statistic: float, freedom: int) -> None:
    assert chi_square_survival(statistic, freedom) == pytest.approx(0.05, rel=1e-3)
    assert chi_square_survival(0.0, freedom) == 1.0 and chi_square_survival(9.0, 0) == 1.0


def test_draws_fit_their_odds_or_not() -> None:
    draws, odds = np.repeat([0, 1, 2], [500, 300, 200]), np.log([0.5, 0.3, 0.2])
    assert fit(draws, odds) == pytest.approx(1.0)
    assert fit(np.repeat([0, 1, 2], [400, 400, 200]), odds) < 1e-6
    assert fit(np.repeat([0, 1, 2], [480, 310, 210]), odds) == pytest.approx(0.435, abs=0.01)
    for impossible in ([3], [-1], []):
        assert fit(np.array(impossible, int), odds) == 0.0
    with np.errstate(divide="ignore"):
        assert fit(np.array([2]), np.log([0.5, 0.5, 0.0])) == 0.0
    rows = np.stack([draws, draws])
    assert fit_all(rows, np.stack([odds, odds])) > 0.9
    assert fit_all(rows, np.stack([odds, odds[::-1]])) < 1e-6


def test_two_samples_are_of_one_distribution_or_not() -> None:
    rng = np.random.default_rng(0)
    one_, other = rng.standard_normal((2, 1000))
    assert same_distribution(one_, other, 0, 0) > 1e-3
    assert same_distribution(one_, other * 1.5, 0, 0) < 1e-6
    assert same_distribution(one_, other + 0.3, 0, 0) < 1e-6
    assert same_distribution(one_, np.where(other > 3, np.nan, other) * np.nan, 0, 0) == 0.0
    assert same_distribution(np.ones(9), np.ones(9) + 1e-6, 1e-5, 0) == 1.0
    assert same_distribution(np.ones(99), np.ones(99) + 1e-4, 1e-5, 0) < 1e-6


def test_draws_that_repeat_are_dependent() -> None:
    rng = np.random.default_rng(0)
    drawn = rng.standard_normal((512, 2)).clip(-2, 2)
    assert dependent([drawn], 8.0) == 0
    assert dependent([np.repeat(drawn[::2], 2, axis=0)], 8.0) == 1
    assert dependent([np.resize(drawn[:256], drawn.shape)], 8.0) == 256


# ------------------------------------------------------------------ how much there is time for


def test_a_slow_runtime_gets_as_many_rows_as_it_has_time_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("export_model.exporter.verify.work._SPEEDS", {"slow": 100.0})
    left = WorkAllowance(cost=10, runtime="slow")
    assert left.left == 200 and left.takes(150, "a") and not left.takes(51, "b") and left.takes(50, "c")
    assert left.note("it") == "it is slow (1e-05 million products for a row); left out there: b"
    assert WorkAllowance(10, "slow").note("it") is None
    assert products(compiled(continuous_policy()).graph) >= 6
