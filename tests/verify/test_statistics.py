"""The tests of draws by themselves: beside published tables, counts of every possible sample, and formulas by hand."""

from __future__ import annotations

import math
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from export_model.exporter.verify.statistics import (
    FALSE_ALARM,
    chi_square_survival,
    columns_related,
    dependent,
    fit,
    fit_all,
    normal_fit,
    ranks,
    same_distribution,
    spread_fit,
    uniform_fit,
)

Array = npt.NDArray[Any]
N = 5


def _ahead(one: Array, other: Array) -> int:
    """By how many the counts of two samples are apart, at worst."""
    return max(abs(int((one <= x).sum()) - int((other <= x).sum())) for x in (*one, *other))


def _share_ahead(ahead: int) -> float:
    """Of all orders of two samples, the share in which one is ahead by so many somewhere."""
    found = []
    for places in combinations(range(2 * N), N):
        walk = np.cumsum([1 if i in places else -1 for i in range(2 * N)])
        found.append(np.abs(walk).max() >= ahead)
    return float(np.mean(found))


SHARES = {ahead: _share_ahead(ahead) for ahead in range(1, N + 1)}


@pytest.mark.parametrize("shift", [-9.0, -2.2, -1.1, -0.4, 0.0, 0.3, 1.2, 2.3, 9.0])
def test_two_samples_are_as_likely_as_a_count_of_all_orders_says(shift: float) -> None:
    rng = np.random.default_rng(3)
    one = rng.standard_normal(N)
    other = rng.standard_normal(N) + shift
    assert same_distribution(one, other, 0, 0) == pytest.approx(SHARES[_ahead(one, other)], rel=1e-9)


@pytest.mark.parametrize(
    ("low", "high", "atol", "rtol", "right"),
    [
        (0.0, 0.25, 0.25, 0.0, True),
        (0.0, 0.26, 0.25, 0.0, False),
        (64.0, 80.0, 0.0, 0.25, True),
        (64.0, 80.5, 0.0, 0.25, False),
        (64.0, 80.5, 0.5, 0.25, True),
        (-64.0, -48.0, 0.0, 0.25, True),
        (-64.0, -42.0, 0.0, 0.25, False),
    ],
)
def test_draws_within_the_tolerance_are_equal(low: float, high: float, atol: float, rtol: float, right: bool) -> None:
    """The size of the smaller one is meant; both ways round."""
    one, other = np.full(N, low), np.full(N, high)
    for pair in ((one, other), (other, one)):
        assert same_distribution(*pair, atol, rtol) == pytest.approx(1.0 if right else SHARES[N])


def test_samples_of_other_sizes_or_without_numbers_are_no_match() -> None:
    one = np.arange(5.0)
    for other in (one[:4], np.where(one == 2, np.nan, one), np.where(one == 2, np.inf, one)):
        assert same_distribution(one, other, 0, 0) == 0.0
    assert same_distribution(one, one[::-1], 0, 0) == 1.0


# ------------------------------------------------------------------ one distribution


@pytest.mark.parametrize(
    ("size", "p_value"), [(0.5, 0.9639), (0.8276, 0.5), (1.2238, 0.1), (1.3581, 0.05), (1.6276, 0.01), (1.9495, 0.001)]
)
@pytest.mark.parametrize("turned", [False, True])
def test_uniform_numbers_are_as_likely_as_kolmogorovs_table_says(size: float, p_value: float, turned: bool) -> None:
    n = 100
    ahead = size / (math.sqrt(n) + 0.12 + 0.11 / math.sqrt(n))
    shares = np.maximum(0, np.arange(1, n + 1) / n - ahead)
    shares = np.random.default_rng(0).permutation(1 - shares if turned else shares)
    assert uniform_fit(shares) == pytest.approx(p_value, rel=2e-3)


def test_what_is_as_even_as_can_be_is_uniform() -> None:
    assert uniform_fit((np.arange(100) + 0.5) / 100) == 1.0
    assert uniform_fit(np.zeros(100)) < 1e-60


@pytest.mark.parametrize(("share", "off"), [(0.5, 1), (0.0, 2), (1.0, 2), (0.25, 0.25)])
def test_uniform_numbers_are_spread_as_such(share: float, off: float) -> None:
    """12·(u − ½)² is 1 on average, of variance 0.8, and at most 2 off that: Bernstein's bound."""
    wanted = 2 * math.exp(-((10 * off) ** 2) / (2 * (8 + 2 * 10 * off / 3)))
    assert spread_fit(np.full(10, share)) == pytest.approx(min(1, wanted))


@pytest.mark.parametrize("times", [1.15, 1 / 1.15])
def test_noise_that_is_a_seventh_too_wide_is_seen(times: float) -> None:
    def below(values: Array) -> Array:
        return np.array([math.erfc(-x / math.sqrt(2)) / 2 for x in values])

    drawn = np.random.default_rng(0).standard_normal(4096)
    assert spread_fit(below(drawn * times)) < FALSE_ALARM < 1e-3 < spread_fit(below(drawn))


def _quantiles(n: int) -> Array:
    """N(0, 1) as evenly as can be, by bisection."""
    low, high = np.full(n, -9.0), np.full(n, 9.0)
    for _ in range(60):
        middle = (low + high) / 2
        below = np.array([math.erfc(-x / math.sqrt(2)) / 2 for x in middle]) < (np.arange(n) + 0.5) / n
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return low


def test_the_worst_of_three_tests_says_whether_numbers_are_normal() -> None:
    even = _quantiles(400)
    assert normal_fit(even.reshape(20, 20)) == 1.0
    mean = normal_fit(even + 0.3)
    assert mean == pytest.approx(3 * math.erfc(0.3 * math.sqrt(200)), rel=1e-6)
    assert normal_fit(even - 0.3) == pytest.approx(mean, rel=1e-6)
    wide = even * 1.2
    two_sided = 2 * chi_square_survival(float(np.square(wide).sum()), 400)
    assert normal_fit(wide) == pytest.approx(3 * two_sided, rel=0.05)
    assert normal_fit(even * 0.8) < 1e-5 < normal_fit(even * 0.9)
    coin = np.tile([-1.0, 1.0], 50)
    apart = math.erf(1 / math.sqrt(2)) / 2
    assert normal_fit(coin) == pytest.approx(3 * 2 * math.exp(-200 * apart**2), rel=1e-6)


@pytest.mark.parametrize("sign", [1, -1])
def test_the_larger_of_two_gaps_counts(sign: int) -> None:
    """Of two numbers, one of which is more often: mean 0, variance 1."""
    low, high = -math.sqrt(2 / 3), math.sqrt(3 / 2)
    apart = 0.6 - math.erfc(-low / math.sqrt(2)) / 2
    drawn = sign * np.array([low] * 60 + [high] * 40)
    assert normal_fit(drawn) == pytest.approx(3 * 2 * math.exp(-200 * apart**2), rel=1e-6)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_gap_on_either_side_is_as_far(sign: int) -> None:
    """All numbers of one half are brought to its edge: their mean and spread are then put right."""
    even = _quantiles(400)
    made = np.where(even > 0, 0.0, even)
    made = sign * (made - made.mean()) / np.sqrt(np.mean((made - made.mean()) ** 2))
    edge = abs(float(np.sort(sign * made)[-1]))
    apart = max(0.5 - (1 - math.erfc(-edge / math.sqrt(2)) / 2), math.erfc(-edge / math.sqrt(2)) / 2 - 0.5)
    assert normal_fit(made) == pytest.approx(3 * 2 * math.exp(-2 * 400 * apart**2), rel=0.05)


# ------------------------------------------------------------------ classes


def _pearson(counts: Array, expected: Array) -> float:
    return chi_square_survival(float(((counts - expected) ** 2 / expected).sum()), len(counts) - 1)


@pytest.mark.parametrize(
    ("counts", "probs", "pooled_counts", "pooled_expected"),
    [
        ([60, 30, 10], [0.5, 0.3, 0.2], [60, 30, 10], [50, 30, 20]),
        ([60, 35, 5], [0.5, 0.45, 0.05], [60, 35, 5], [50, 45, 5]),  # five is enough
        ([50, 44, 6], [0.5, 0.46, 0.04], [50, 50], [50, 50]),  # four joins the rarest
        ([50, 40, 4, 6], [0.5, 0.42, 0.04, 0.04], [50, 40, 10], [50, 42, 8]),  # two of four stand together
        ([45, 40, 9, 6], [0.5, 0.45, 0.025, 0.025], [45, 40, 15], [50, 45, 5]),
        ([6, 44, 50], [0.04, 0.46, 0.5], [50, 50], [50, 50]),
    ],
)
def test_classes_are_counted_beside_what_is_expected(
    counts: list[int], probs: list[float], pooled_counts: list[int], pooled_expected: list[float]
) -> None:
    draws = np.repeat(np.arange(len(counts)), counts)
    wanted = _pearson(np.array(pooled_counts), np.array(pooled_expected, float))
    assert fit(draws, np.log(probs)) == pytest.approx(wanted, rel=1e-6)
    assert fit(draws.reshape(2, -1), np.log(probs) + 7) == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize(("probability", "possible"), [(2e-9, True), (0.5e-9, False)])
def test_a_class_of_less_than_one_in_a_billion_never_comes_up(probability: float, possible: bool) -> None:
    draws = np.array([1] + [0] * 99)
    assert (fit(draws, np.log([1 - probability, probability])) > 0) is possible


def _rows(probs: Array, count: int) -> Array:
    """[inputs, draws] of classes, as evenly as can be."""
    return np.stack([np.repeat(np.arange(len(p)), np.rint(p * count).astype(int)) for p in probs])


ODDS = np.array([[0.4, 0.3, 0.2, 0.1], [0.1, 0.2, 0.3, 0.4], [0.3, 0.1, 0.4, 0.2]])


def test_classes_of_several_inputs_fit_their_own_odds() -> None:
    even = _rows(ODDS, 200)
    assert fit_all(even, np.log(ODDS)) > 0.99
    assert fit_all(even, np.log(ODDS) + np.array([[5.0], [-3.0], [0.0]])) > 0.99, "each row adds up to one"
    turned = np.roll(ODDS, 1, axis=0)
    assert fit_all(even, np.log(turned)) < FALSE_ALARM, "the counts of all are the same"
    for outside in (-1, 4):
        wrong = even.copy()
        wrong[0, 0] = outside
        assert fit_all(wrong, np.log(ODDS)) == 0.0
    assert fit_all(even[:, :0], np.log(ODDS)) == 0.0


def test_a_class_that_is_as_likely_is_another_class() -> None:
    """Classes 0 and 1 exchange at each input where both are as likely: groups by odds are as they should be."""
    odds = np.array([[0.25, 0.25, 0.5], [0.25, 0.25, 0.5]])
    made = _rows(odds, 200)
    made[made == 0] = 1
    assert fit_all(made, np.log(odds)) < FALSE_ALARM
    few = _rows(odds, 200)
    few[0, :12] = 1
    counts = np.array([88, 112, 200])
    assert fit_all(few, np.log(odds)) == pytest.approx(_pearson(counts, np.array([100.0, 100, 200])), rel=1e-6)


def test_the_likely_classes_are_drawn_as_often_as_they_should() -> None:
    """The classes come up as often: one input takes from its likely one what another gives back."""
    odds = np.tile([[0.9, 0.1], [0.1, 0.9]], (4, 1))
    even = _rows(odds, 100)
    assert fit_all(even, np.log(odds)) > 0.99
    made = even.copy()
    made[::2, :5], made[1::2, -5:] = 1, 0
    counts, expected = np.array([120, *[85] * 6, 170]), np.array([80.0, *[90] * 6, 180])  # eight groups by likelihood
    assert fit_all(made, np.log(odds)) == pytest.approx(_pearson(counts, expected), rel=1e-6)
    assert fit_all(made, np.log(odds)) < 1e-2 < fit(made.reshape(-1), np.log([0.5, 0.5]))


# ------------------------------------------------------------------ what tells of another


def _signs(count: int, agreeing: int, seed: int = 0) -> Array:
    """±1, of which so many are like the one before."""
    turns = np.array([1] * agreeing + [-1] * (count - 1 - agreeing))
    return np.cumprod([1, *np.random.default_rng(seed).permutation(turns)]).astype(float)[:, None]


def test_draws_are_dependent_beyond_bernsteins_bound() -> None:
    """The products of neighbours add up to ``total``, of variance 1 each: the largest product decides."""
    count, agreeing = 512, 380
    drawn = _signs(count, agreeing)
    total, needed = 2 * agreeing - (count - 1), math.log(2 * count / FALSE_ALARM)
    edge = 3 * (total**2 / (2 * needed) - (count - 1)) / total
    assert edge > 1
    assert dependent([drawn], 0.999 * edge) == 1 and dependent([drawn], 1.001 * edge) == 0
    assert dependent([-drawn], 0.999 * edge) == 1
    # as much of each of two inputs, or of two numbers that tell nothing of each other
    both = 3 * ((2 * total) ** 2 / (2 * needed) - 2 * (count - 1)) / (2 * total)
    assert dependent([drawn, drawn], 0.999 * both) == 1 and dependent([drawn, drawn], 1.001 * both) == 0
    apart = np.concatenate([drawn, drawn[::-1] * np.resize([1.0, 1, -1, -1], (count, 1))], axis=1)
    assert dependent([apart], 1.0) in (1, 2)
    assert dependent([_signs(count, 255)], 1.0) == 0


def test_two_numbers_that_are_one_vary_as_one() -> None:
    """Their products are the same: twice the sum, and twice the spread of it."""
    count, agreeing = 512, 380
    drawn = _signs(count, agreeing)
    total, needed = 2 * (2 * agreeing - (count - 1)), math.log(2 * count / FALSE_ALARM)
    edge = 3 * (total**2 / (2 * needed) - 4 * (count - 1)) / total
    twice = np.repeat(drawn, 2, axis=1)
    assert dependent([twice], 0.999 * edge) == 1 and dependent([twice], 1.001 * edge) == 0


def test_a_tenth_of_all_is_too_little_to_say_so() -> None:
    count = 8192
    for agreeing, apart in ((4504, 0), (4506, 1)):  # 817 and 821 of 8,192 more are alike than not
        assert dependent([_signs(count, agreeing)], 1.0) == apart


@pytest.mark.parametrize("distance", [5, 60, 200])
def test_the_distance_is_said(distance: int) -> None:
    rng = np.random.default_rng(1)
    drawn = rng.choice([-1.0, 1.0], (512, 1))
    for i in range(distance, 512):
        drawn[i] = drawn[i - distance] * (1 if rng.random() < 0.9 else -1)
    assert dependent([drawn], 1.0) == distance


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("columns", [2, 3])
def test_columns_are_related_beyond_their_bound(columns: int, sign: int) -> None:
    count, pairs = 512, math.log(columns**2 / FALSE_ALARM)
    even = np.resize([1.0, -1.0], count)
    other = np.resize([1.0, 1, -1, -1], count)
    third = np.resize([1.0, 1, 1, 1, -1, -1, -1, -1], count)
    reference = np.stack([even, other, third][:columns], axis=1)
    edge = 2 * pairs + math.sqrt((2 * pairs) ** 2 + 7.2 * count * pairs)  # off² = 2·pairs·(3.6·count + 2·off)
    assert not columns_related(reference, reference) and not columns_related(reference, 9 * reference)
    for total in (2 * math.floor(edge / 2), 2 * math.floor(edge / 2) + 2):
        drawn = reference.copy()
        unlike = np.flatnonzero(even * other < 0)[: total // 2]
        drawn[unlike, 1] = even[unlike]
        drawn[:, 1] *= sign
        assert columns_related(reference * [1, sign, 1][:columns], drawn) is (total > edge)
        assert columns_related(drawn, reference * [1, sign, 1][:columns]) is (total > edge)
        assert not columns_related(drawn, drawn)


def test_places_in_a_column_are_centred_and_of_variance_one() -> None:
    values = np.array([[3.0, 7, 1], [1.0, 7, 1], [2.0, 7, 1], [4.0, 7, 5]])
    made = ranks(values)
    np.testing.assert_allclose(made[:, 0], np.array([0.5, -1.5, -0.5, 1.5]) / math.sqrt(1.25))
    assert not made[:, 1].any()
    root = math.sqrt(3)
    np.testing.assert_allclose(made[:, 2], np.array([-1, -1, -1, 3]) / root)  # √3 at most, and 3/√3 is
    rare = ranks(np.array([[0.0]] * 99 + [[1.0]]))
    assert rare.max() == pytest.approx(root - (root - math.sqrt(99)) / 100)
    assert abs(rare.mean()) < 1e-12
    tied = ranks(np.array([[1.0], [2], [2], [3]]))[:, 0]
    np.testing.assert_allclose(tied, np.array([-1.5, 0, 0, 1.5]) / math.sqrt(1.125))
