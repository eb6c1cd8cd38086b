"""Two arrays that should be the same: when they are, and what is said when they are not."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from msgspec.structs import replace

from export_model.exporter.verify.difference import (
    compare,
    compare_all,
    floor_log_probs,
    is_marked,
    near_best,
    score_bounds,
    steps,
    ties,
)
from export_model.exporter.verify.excuses import (
    BOTH_NAN,
    CHAOS,
    EXCUSES,
    NAN_FROM_ZERO,
    ROUNDING,
    TIE,
    Excuse,
    Forgiven,
)
from export_model.exporter.verify.statistics import FALSE_ALARM, chi_square_survival, fit
from export_model.exporter.verify.tolerances import ATOL, RTOL, Tolerance, tolerance_for
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature, TensorSpec

PLAIN = Tolerance()


def floats(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


# ------------------------------------------------------------------ numbers


@pytest.mark.parametrize("reference", [0.0, 1.0, -1000.0])
def test_the_bound_is_absolute_plus_relative(reference: float) -> None:
    bound = ATOL + RTOL * abs(reference)
    near = compare(np.array([reference]), np.array([reference + 0.99 * bound]), PLAIN)
    far = compare(np.array([reference]), np.array([reference + 1.01 * bound]), PLAIN)
    assert (near.passed, far.passed) == (True, False)
    assert far.max_abs == pytest.approx(1.01 * bound)
    assert far.reason == ""


def test_beside_nothing_a_difference_is_relative_to_the_tolerance() -> None:
    assert compare(floats(0.0), floats(2e-5), PLAIN).max_rel == pytest.approx(2)
    assert compare(floats(4.0), floats(5.0), PLAIN).max_rel == pytest.approx(0.25)


def test_the_relative_part_is_of_the_reference() -> None:
    assert compare(floats(1000.0), floats(1000.005), PLAIN).passed
    assert not compare(np.array([0.0]), np.array([0.005]), PLAIN).passed
    assert compare(np.array([1e9]), np.array([0.0]), PLAIN).max_rel == 1.0


def test_the_worst_element_counts() -> None:
    difference = compare(floats(1, 2, 3), floats(1, 2.5, 3), PLAIN)
    assert (difference.max_abs, difference.max_rel, difference.passed) == (0.5, 0.25, False)


@given(
    st.lists(st.integers(0, 3), min_size=1, max_size=4),
    st.sampled_from([("float32", "float32"), ("int64", "int32"), ("float32", "float64")]),
    st.sampled_from([0.0, 1e-6, 1e-3]),
    st.booleans(),
    st.integers(0, 99),
)
@settings(max_examples=150, deadline=None)
def test_what_is_compared_at_once_is_what_each_comparison_says(
    rows: list[int], dtypes: tuple[str, str], off: float, odd: bool, seed: int
) -> None:
    random = np.random.default_rng(seed)
    wanted = [(3 * random.standard_normal((n, 2))).astype(dtypes[0]) for n in rows]
    got = [(w + off * random.standard_normal(w.shape) * random.integers(0, 2)).astype(dtypes[1]) for w in wanted]
    if odd and dtypes[0] == "float32" and wanted[0].size:
        wanted[0][0, 0] = np.nan
    most = np.array([[np.inf, 1e-4]])
    together = compare_all(wanted, got, PLAIN, narrowed=True, most=most)
    each = [compare(w, g, PLAIN, narrowed=True, most=most) for w, g in zip(wanted, got, strict=True)]
    assert all(t == (replace(e, worst=None) if e.passed else None) for t, e in zip(together, each, strict=True) if t)
    plain = dtypes[1] != "float64" and all(rows) and not np.isnan(wanted[0]).any()
    assert [t is not None for t in together] == [plain and e.passed for e in each]


def test_nothing_is_equal_to_nothing() -> None:
    assert compare(np.zeros((0, 3)), np.zeros((0, 3)), PLAIN).passed


@given(arrays.arrays(np.float32, arrays.array_shapes(max_dims=3, max_side=4)))
@settings(max_examples=50, deadline=None)
def test_anything_is_equal_to_itself(values: np.ndarray) -> None:
    difference = compare(values, values.copy(), Tolerance(0, 0))
    assert (difference.passed, difference.max_abs, difference.max_rel) == (True, 0, 0)


@pytest.mark.parametrize("odd", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_stands_on_both_sides_or_it_is_a_fault(odd: float) -> None:
    assert compare(floats(1, odd), floats(1, odd), PLAIN).passed
    for a, b in ((floats(1, odd), floats(1, 2)), (floats(1, 2), floats(1, odd)), (floats(odd), floats(5e37))):
        difference = compare(a, b, Tolerance(1e30, 1e30))
        assert (difference.passed, difference.reason) == (False, "NaN or infinity on one side only")
        assert difference.max_abs == math.inf
    assert not compare(floats(math.inf), floats(-math.inf), PLAIN).passed
    assert not compare(floats(math.inf), floats(math.nan), PLAIN).passed


def test_what_is_not_finite_does_not_hide_the_rest() -> None:
    assert not compare(floats(math.nan, 1), floats(math.nan, 2), PLAIN).passed


def test_another_shape_is_a_fault() -> None:
    difference = compare(np.zeros((2, 3)), np.zeros((3, 2)), PLAIN)
    assert (difference.passed, difference.reason) == (False, "shape [3, 2] instead of [2, 3]")
    assert not compare(np.zeros(()), np.zeros((1,)), PLAIN).passed


def test_another_dtype_is_a_fault_and_narrow_integers_where_they_are_not_allowed() -> None:
    wide, narrow = np.array([1], np.int64), np.array([1], np.int32)
    assert compare(wide, narrow, PLAIN).reason == "dtype int32 instead of int64"
    assert compare(wide, narrow, PLAIN, narrowed=True).passed
    assert not compare(narrow, wide, PLAIN, narrowed=True).passed
    assert not compare(np.array([1.0]), floats(1), PLAIN, narrowed=True).passed


def test_integers_are_equal_or_not() -> None:
    a, b = np.array([[1000, 2000]]), np.array([[1000, 2001]])
    assert compare(a, a, Tolerance(5, 5)).passed
    assert not compare(a, b, Tolerance(5, 5)).passed
    forgiven = compare(a, b, PLAIN, free=[(TIE, np.array([[False, True]]))])
    assert forgiven.passed and [(f.excuse, f.elements) for f in forgiven.forgiven] == [(TIE, 1)]
    assert not compare(a, b, PLAIN, free=[(TIE, np.array([[True, False]]))]).passed


def test_a_choice_is_free_where_rounding_may_turn_it() -> None:
    scores = floats(1.0, 1.001)[None]
    assert ties(scores, (2,), PLAIN).tolist() == [[False]]
    assert near_best(*score_bounds(scores, (2,), PLAIN, 6e-4), (2,)).tolist() == [[True, True]]
    assert near_best(*score_bounds(scores, (2,), PLAIN, 4e-4), (2,)).tolist() == [[False, True]]


def test_what_rounding_makes_of_one_score_frees_no_other() -> None:
    """As of a masked class, whose score of -1e8 rounding moves by 24."""
    scores, moved = floats(1.0, 0.0, -1e8)[None], np.array([[0, 0, 94.0]])
    assert near_best(*score_bounds(scores, (3,), PLAIN, moved), (3,)).tolist() == [[True, False, False]]


def test_a_choice_is_one_of_those_that_are_as_good() -> None:
    marked = np.array([[True, False, True, True, False]])
    for first, second, right in (
        (0, 0, [True, True]),
        (1, 1, [False, False]),
        (2, 2, [True, False]),
        (-1, 9, [False, False]),
    ):
        assert is_marked(marked, np.array([[first, second]]), (3, 2)).tolist() == [right]


@pytest.mark.parametrize("excuse", EXCUSES, ids=lambda e: e.title)
def test_no_rule_forgives_a_nan_beside_a_number(excuse: Excuse) -> None:
    """One alone explains it: what it explains is not verified (tests/faults/test_undetermined.py)."""
    free = [(excuse, np.array([True, True]))]
    found = compare(floats(1, 2), floats(1, np.nan), PLAIN, free=free, rounding=np.full(2, 1e9))
    assert found.passed == excuse.unproven == (excuse is NAN_FROM_ZERO)


def test_rounding_forgives_no_more_than_its_ceiling() -> None:
    a, bounds = floats(0, 0), np.array([5.0, 5.0])
    assert compare(a, floats(0, 4), PLAIN, rounding=bounds).passed
    assert not compare(a, floats(0, 4), PLAIN, rounding=bounds, ceiling=3.0).passed
    found = compare(a, floats(0, 2), PLAIN, rounding=bounds, ceiling=3.0)
    assert found.passed and found.forgiven == (Forgiven(CHAOS, 1, 2.0),)
    assert compare(a, floats(0, 2), PLAIN, rounding=bounds).forgiven == (Forgiven(ROUNDING, 1, 2.0),)


def test_a_nan_on_both_sides_is_said() -> None:
    found = compare(floats(1, np.nan, np.inf), floats(1, np.nan, np.inf), PLAIN)
    assert found.passed and [(f.excuse, f.elements) for f in found.forgiven] == [(BOTH_NAN, 1)]


def test_rounding_takes_the_place_of_a_smaller_tolerance() -> None:
    a, b = floats(1, 1), floats(1, 1.5)
    assert not compare(a, b, PLAIN, rounding=np.array([0.6, 0.4])).passed
    explained = compare(a, b, PLAIN, rounding=np.array([0.0, 0.6]))
    assert (explained.passed, explained.rounding) == (True, 0.6)
    assert compare(a, floats(1, 1 + 5e-6), PLAIN, rounding=np.zeros(2)).passed


# ------------------------------------------------------------------ ties


def test_scores_that_are_too_close_are_a_tie() -> None:
    scores = np.array([[0.0, 1.0, -1.0, -1.0], [0.0, 1e-6, 5.0, 1.0], [2.0, 2.0, 0.0, 1e-3]])
    assert ties(scores, (2, 2), PLAIN).tolist() == [[False, True], [True, False], [True, False]]


def test_a_branch_of_one_has_no_tie() -> None:
    assert ties(np.zeros((2, 3)), (1, 2), PLAIN).tolist() == [[False, True], [False, True]]


def test_scores_that_are_not_finite_decide_nothing() -> None:
    scores = np.array([[math.nan, 1.0], [math.inf, math.inf], [-math.inf, 0.0]])
    assert ties(scores, (2,), PLAIN).tolist() == [[True], [True], [False]]


def test_rounding_moves_each_element_by_itself() -> None:
    exact, moved = floats(1, -1e8, -np.inf)[None], floats(1.5, -1e8 + 24, -87)[None]
    assert steps(exact, moved).tolist() == [[0.5, 24, 0]]


# ------------------------------------------------------------------ logarithms of next to nothing


def test_log_probabilities_that_say_never_are_all_the_same() -> None:
    """2^-126 of the likeliest class of the branch, for each class: what float32 has with all digits is more."""
    scores = np.array([[0.0, -1e8, -5.0, -5.0 - 88], [-3.0, -np.inf, -5.0, -80.0]], np.float32)
    never = math.log(2) * -126 + math.log(2)
    expected = np.array([[0, never, -5, -5 + never], [-3, -3 + never, -5, -80]], np.float32)
    np.testing.assert_allclose(floor_log_probs(scores, (2, 2)), expected, rtol=1e-6, strict=True)


def test_log_probabilities_that_do_not_fit_the_branches_are_one_branch() -> None:
    scores = np.array([[0.0, -200.0, -1.0]], np.float32)
    assert floor_log_probs(scores, (2, 2))[0, 1] == pytest.approx(-126 * math.log(2) + math.log(3))
    assert floor_log_probs(np.zeros((0, 3), np.float32), (3,)).shape == (0, 3)


def test_what_is_not_a_number_stays_so() -> None:
    result = floor_log_probs(np.array([[math.nan, 0.0], [-math.inf, -math.inf]], np.float32), (2,))
    assert np.isnan(result[0]).any()
    assert (result[1] == -math.inf).all()


# ------------------------------------------------------------------ tolerances


def signature(algorithm: str | None) -> PolicySignature:
    spec = TensorSpec("action", Role.CONTINUOUS, "float32", (None, 2))
    return PolicySignature(
        inputs=(spec,), outputs=(spec,), family="own model", action_space="continuous", algorithm=algorithm
    )


def test_only_sac_has_a_wider_tolerance_and_says_why() -> None:
    assert tolerance_for(signature("PPO"), "action_probs", PLAIN) is PLAIN
    assert tolerance_for(signature("SAC"), "action", PLAIN) is PLAIN
    wider = tolerance_for(signature("SAC"), "action_probs", PLAIN)
    assert (wider.atol, wider.rtol) == (5e-3, 5e-3)
    assert "cancels" in wider.reason


def test_a_tolerance_that_is_wider_still_is_kept() -> None:
    own = Tolerance(0.1, 0.1)
    assert tolerance_for(signature("SAC"), "action_probs", own) is own


# ------------------------------------------------------------------ goodness of fit


@pytest.mark.parametrize(
    ("statistic", "freedom", "expected"),
    [
        # published critical values of the chi-square distribution
        (3.841458820694124, 1, 0.05),
        (6.634896601021213, 1, 0.01),
        (10.827566170662733, 1, 0.001),
        (5.991464547107979, 2, 0.05),
        (9.210340371976182, 2, 0.01),
        (11.070497693516351, 5, 0.05),
        (15.08627246938899, 5, 0.01),
        (18.307038053275146, 10, 0.05),
        (31.410432844230918, 20, 0.05),
        (124.34211340400407, 100, 0.05),
        (0.6931471805599453 * 2, 2, 0.5),
    ],
)
def test_the_tail_of_chi_square_is_that_of_the_tables(statistic: float, freedom: int, expected: float) -> None:
    assert chi_square_survival(statistic, freedom) == pytest.approx(expected, rel=1e-9)


@given(st.floats(0.001, 700))
@settings(deadline=None)
def test_the_tail_has_a_closed_form_for_one_and_two_degrees_of_freedom(x: float) -> None:
    assert chi_square_survival(x, 2) == pytest.approx(math.exp(-x / 2), rel=1e-9, abs=1e-300)
    assert chi_square_survival(x, 1) == pytest.approx(math.erfc(math.sqrt(x / 2)), rel=1e-9, abs=1e-300)


@given(st.floats(0, 500), st.integers(1, 200))
@settings(deadline=None)
def test_the_tail_is_a_probability_that_falls_and_grows_with_freedom(x: float, freedom: int) -> None:
    p = chi_square_survival(x, freedom)
    assert 0 <= p <= 1
    assert chi_square_survival(x + 1, freedom) <= p + 1e-12
    assert chi_square_survival(x, freedom + 1) >= p - 1e-12


def test_no_difference_or_no_freedom_is_no_doubt() -> None:
    assert chi_square_survival(0.0, 3) == chi_square_survival(-1.0, 3) == chi_square_survival(5.0, 0) == 1.0


def test_extreme_statistics_have_no_doubt_left() -> None:
    assert 0 <= chi_square_survival(1e6, 3) < 1e-300


LOG = np.log(np.array([0.5, 0.3, 0.2]))


def test_draws_from_the_distribution_fit_it() -> None:
    rng = np.random.default_rng(7)
    values = [fit(rng.choice(3, 512, p=np.exp(LOG)), LOG) for _ in range(200)]
    assert min(values) > FALSE_ALARM
    assert 0.3 < float(np.mean(values)) < 0.7  # p-values are uniform


def test_draws_from_another_distribution_do_not() -> None:
    rng = np.random.default_rng(7)
    assert fit(rng.choice(3, 512, p=[0.3, 0.5, 0.2]), LOG) < FALSE_ALARM
    assert fit(np.zeros(512, int), LOG) < FALSE_ALARM


def test_the_scores_need_not_be_normalised() -> None:
    draws = np.random.default_rng(7).choice(3, 512, p=np.exp(LOG))
    assert fit(draws, LOG + 0.25) == pytest.approx(fit(draws, LOG))


def test_the_order_of_the_classes_does_not_matter() -> None:
    draws = np.random.default_rng(7).choice(3, 512, p=np.exp(LOG))
    assert fit(2 - draws, LOG[::-1]) == pytest.approx(fit(draws, LOG))


@pytest.mark.parametrize("draws", [[], [-1, 0], [0, 3]])
def test_no_draws_or_impossible_ones_do_not_fit(draws: list[int]) -> None:
    assert fit(np.array(draws, int), LOG) == 0.0


def test_a_masked_class_may_never_be_drawn() -> None:
    masked = np.log(np.array([1.0, 1e-10]))
    assert fit(np.zeros(512, int), masked) == 1.0
    assert fit(np.array([0] * 511 + [1]), masked) == 0.0


def test_rare_classes_are_counted_together() -> None:
    """Forty classes that are expected once each are one class of forty, or join the rarest that is large."""
    rng = np.random.default_rng(7)
    probabilities = np.array([0.9, *[0.1 / 40] * 40])
    assert fit(rng.choice(41, 400, p=probabilities), np.log(probabilities)) > 1e-3
    assert fit(np.where(rng.random(400) < 0.5, 0, rng.integers(1, 41, 400)), np.log(probabilities)) < FALSE_ALARM
    few = np.array([0.6, 0.395, 0.005])
    assert fit(rng.choice(3, 400, p=few), np.log(few)) > 1e-3
    assert fit(rng.choice(3, 400, p=[0.3, 0.2, 0.5]), np.log(few)) < FALSE_ALARM


def test_too_few_draws_to_tell_are_no_fault() -> None:
    assert fit(np.array([0, 1]), LOG) == 1.0
