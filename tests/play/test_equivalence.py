"""The verdict on paired returns: right quantiles, right margins, and how often it is wrong, by simulation."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from export_model.exporter.play.episodes import Episodes
from export_model.exporter.play.equivalence import (
    Equivalence,
    Margin,
    equivalence,
    look_sizes,
    mean_interval,
    parse_margin,
    scale_of,
    share_error,
)
from export_model.exporter.play.match import decide
from export_model.exporter.play.options import PlayOptions
from export_model.exporter.play.student import t_quantile, upper_tail
from export_model.exporter.verify.plays import DIFFERENT, EQUIVALENT, NOT_DECIDED
from export_model.signatures.errors import UsageError

EPISODES = 200
#: From the tables of R 4 (qt), which are not ours: (upper tail, degrees of freedom, quantile).
TABLE = [
    (0.025, 1, 12.706204736),
    (0.025, 19, 2.093024054),
    (0.025, 199, 1.971956544),
    (0.05, 10, 1.812461123),
    (0.005, 5, 4.032142984),
    (0.0005, 30, 3.645958635),
]


@pytest.mark.parametrize(("tail", "freedom", "expected"), TABLE)
def test_quantiles_are_those_of_the_tables(tail: float, freedom: int, expected: float) -> None:
    assert t_quantile(tail, freedom) == pytest.approx(expected, rel=1e-9)


def test_far_tails_are_what_the_density_integrates_to() -> None:
    """One in a million, by Simpson's rule over the density from the quantile on."""
    import math

    freedom = 199
    t = t_quantile(5e-7, freedom)
    x = np.linspace(t, t + 60, 200_001)
    log_density = (
        math.lgamma((freedom + 1) / 2)
        - math.lgamma(freedom / 2)
        - 0.5 * math.log(freedom * math.pi)
        - (freedom + 1) / 2 * np.log1p(x * x / freedom)
    )
    y = np.exp(log_density)
    integral = (x[1] - x[0]) / 3 * (y[0] + y[-1] + 4 * y[1:-1:2].sum() + 2 * y[2:-1:2].sum())
    assert integral == pytest.approx(5e-7, rel=1e-6)
    assert upper_tail(t, freedom) == pytest.approx(5e-7, rel=1e-9)


# ------------------------------------------------------------------ margins


def test_a_share_is_of_the_mean_or_of_how_far_returns_usually_lie_apart() -> None:
    rng = np.random.default_rng(0)
    steady = rng.normal(100, 0.1, 1000)
    assert Margin(0.01).of(steady) == pytest.approx(1, rel=1e-2)
    around_zero = np.where(rng.random(1000) < 0.5, 1.0, -1.0)
    assert abs(around_zero.mean()) < 0.1
    assert scale_of(around_zero) == pytest.approx(2)
    # One episode that went wrong is no scale.
    accident = np.append(np.full(199, 100.0), -1e6)
    assert np.percentile(accident, 5) == 100
    assert Margin(0.5, is_share=False).of(accident) == 0.5
    assert scale_of(np.zeros(20)) == 0


@pytest.mark.parametrize(
    ("text", "expected"), [("1%", Margin(0.01)), (" .5 % ", Margin(0.005)), ("2", Margin(2, is_share=False))]
)
def test_margins_are_read(text: str, expected: Margin) -> None:
    assert parse_margin(text) == expected


@pytest.mark.parametrize("text", ["", "0", "0%", "-1%", "nan", "1e400", "1 percent", "1%%"])
def test_other_margins_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="margin"):
        parse_margin(text)


# ------------------------------------------------------------------ verdicts


def test_equal_episodes_are_equivalent_whatever_the_margin() -> None:
    found = equivalence(np.full(EPISODES, 3.0), np.full(EPISODES, 3.0), 0.0)
    assert (found.verdict, found.low, found.high, found.equal) == (EQUIVALENT, 0, 0, EPISODES)


def test_the_same_difference_everywhere_is_different_beyond_the_margin_and_equivalent_within() -> None:
    returns = np.random.default_rng(0).normal(10, 5, EPISODES)
    assert equivalence(returns, returns - 0.2, 0.1).verdict == DIFFERENT
    assert equivalence(returns, returns - 0.05, 0.1).verdict == EQUIVALENT
    assert equivalence(returns, returns + 0.2, 0.1).verdict == DIFFERENT  # to earn more is another behaviour, too


@pytest.mark.parametrize(
    ("changed", "verdict"), [(0, EQUIVALENT), (10, NOT_DECIDED), (22, NOT_DECIDED), (40, DIFFERENT)]
)
def test_episodes_that_fail_are_counted(changed: int, verdict: str) -> None:
    """As in GridWorld: most pairs are equal, and some end in the pit."""
    reference = np.full(EPISODES, 1.0)
    candidate = reference.copy()
    candidate[:changed] = -1.0
    assert equivalence(reference, candidate, 0.01).verdict == verdict


def test_one_accident_among_equal_episodes_is_never_different() -> None:
    reference = np.full(EPISODES, 100.0)
    for size in (1e2, 1e4, 1e6):
        candidate = reference.copy()
        candidate[7] -= size
        assert equivalence(reference, candidate, 1.0).verdict != DIFFERENT


# ------------------------------------------------------------------ how often it is wrong


def pairs(rng: np.random.Generator, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns of two players that are equally good, as environments make them."""
    if kind == "chaotic":  # the episodes part after some steps: pairs tell little of each other (Crawler2D)
        base = rng.normal(38, 0.2, EPISODES)
        return base + rng.normal(0, 0.15, EPISODES), base + rng.normal(0, 0.15, EPISODES)
    if kind == "falls":  # and one in two hundred falls, in either player
        one, other = rng.normal(36.7, 0.25, (2, EPISODES))
        for each in (one, other):
            each[rng.random(EPISODES) < 1 / 200] -= rng.uniform(5, 15)
        return one, other
    if kind == "ties":  # a decision in a thousand is decided by the last digit
        one = np.where(rng.random(EPISODES) < 0.03, -1.0, 0.93)
        other = one.copy()
        flipped = rng.random(EPISODES) < 1e-3
        other[flipped] = np.where(rng.random(int(flipped.sum())) < 0.03, -1.0, 0.93)
        return one, other
    assert kind == "unpaired"  # nothing but noise
    one, other = rng.normal(0, 1, (2, EPISODES))
    return one, other


@pytest.mark.parametrize("kind", ["chaotic", "falls", "ties", "unpaired"])
def test_players_that_are_equally_good_are_never_different(kind: str) -> None:
    rng = np.random.default_rng(1)
    counts: Counter[str] = Counter()
    for _ in range(2000):
        reference, candidate = pairs(rng, kind)
        counts[equivalence(reference, candidate, Margin(0.01).of(reference)).verdict] += 1
    assert counts[DIFFERENT] == 0
    if kind in ("chaotic", "ties"):
        assert counts[NOT_DECIDED] <= 0.05 * 2000
    if kind == "unpaired":  # a margin of a hundredth of the spread is not decided by 200 episodes
        assert counts[NOT_DECIDED] >= 0.95 * 2000


def test_a_player_at_the_margin_is_seldom_equivalent() -> None:
    """Two one-sided tests at 2.5 %: of players that are worse by the margin, one in forty passes."""
    rng = np.random.default_rng(2)
    passed = 0
    for _ in range(4000):
        reference, noise = rng.normal(10, 1, EPISODES), rng.normal(0, 0.2, EPISODES)
        passed += equivalence(reference, reference - 0.1 + noise, 0.1).verdict == EQUIVALENT
    # 4000 of 1/40 are 100 with a deviation of 10.
    assert 60 <= passed <= 140


def decided(rng: np.random.Generator, difference: float, most: int, deviation: float = 1.0) -> Equivalence:
    """The verdict of ``play`` on a player that differs so much, of returns that are noise; the margin is 0.2."""

    def play(more: int, mean: float) -> Episodes:
        count = more or EPISODES
        returns = rng.normal(mean, deviation, count)
        return Episodes(returns, np.ones(count, np.int64), np.ones(count, bool))

    nothing = Episodes(np.zeros(EPISODES), np.ones(EPISODES, np.int64), np.ones(EPISODES, bool))

    def reference(more: int) -> Episodes:
        return nothing if not more else Episodes(np.zeros(more), np.ones(more, np.int64), np.ones(more, bool))

    options = PlayOptions(EPISODES, most=most, margin="0.2")
    return decide(reference, lambda more: play(more, difference), options, 0.2)[1]


def test_looking_often_lets_no_more_than_one_in_forty_at_the_margin_pass() -> None:
    """The looks share the error: 1/40 of 1,000 is 25, with a deviation of 5."""
    rng = np.random.default_rng(4)
    found = [decided(rng, -0.2, 12_800) for _ in range(1000)]
    assert sum(f.verdict == EQUIVALENT for f in found) <= 25 + 3 * 5
    assert not any(f.verdict == DIFFERENT for f in found)
    assert max(f.episodes for f in found) == EPISODES + 12_400


def test_players_that_are_equally_good_are_decided_in_the_end() -> None:
    """Noise that 200 episodes do not decide: five times the margin, as in Tennis."""
    rng = np.random.default_rng(5)
    found = [decided(rng, 0.0, 12_800, deviation=2.2) for _ in range(300)]
    assert all(f.verdict == EQUIVALENT for f in found)
    assert sum(f.episodes > EPISODES for f in found) > 200
    assert np.mean([f.episodes for f in found]) < 3000


def test_one_look_has_all_of_the_error_and_others_share_it() -> None:
    assert look_sizes(200, 12_800) == [200, 400, 800, 1600, 3200, 6400]
    assert look_sizes(200, 399) == [200] and look_sizes(20, 0) == [20]
    for looks in range(1, 9):
        assert sum(share_error(looks)) == pytest.approx(0.025)
    assert share_error(1) == [pytest.approx(0.025)]


def test_what_no_number_of_episodes_in_reach_decides_is_not_played() -> None:
    found = decided(np.random.default_rng(6), 0.0, 12_800, deviation=15.0)
    assert found.verdict == NOT_DECIDED and found.episodes == EPISODES
    assert found.needed is not None and found.needed > 4 * 12_600


def test_as_many_episodes_as_are_proposed_decide() -> None:
    rng = np.random.default_rng(3)
    needed = []
    for _ in range(200):
        reference, candidate = rng.normal(0, 1, (2, EPISODES))
        found = equivalence(reference, candidate, 0.2)
        assert found.verdict != DIFFERENT
        if found.needed is not None:
            needed.append(found.needed)
    count = int(np.median(needed))
    assert EPISODES < count < 20 * EPISODES
    verdicts = Counter(equivalence(*rng.normal(0, 1, (2, count)), 0.2).verdict for _ in range(500))
    assert verdicts[EQUIVALENT] >= 0.9 * 500


def test_no_number_of_episodes_decides_where_there_is_no_margin() -> None:
    reference = np.zeros(EPISODES)
    candidate = reference.copy()
    candidate[0] = 1.0
    found = equivalence(reference, candidate, Margin(0.01).of(reference))
    assert (found.verdict, found.margin, found.needed) == (NOT_DECIDED, 0, None)


def test_the_interval_of_a_mean() -> None:
    """By hand: the mean of 1 to 4 is 2.5, its error 0.6455, Student's quantile for 3 degrees of freedom 3.1824."""
    assert mean_interval(np.array([1.0, 2.0, 3.0, 4.0])).words == "2.5 (0.4457 to 4.554)"
