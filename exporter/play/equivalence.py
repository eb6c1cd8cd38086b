"""Whether one player earns as much as another: two one-sided tests on the mean of paired differences.

The unit is the episode. Episode i of the candidate and episode i of the reference begin alike and draw alike, so what
is looked at is the difference of their returns, one number for each pair: agents that share a world share its episode
and are no further evidence. Student's interval of the mean difference has to lie within ±margin:

- EQUIVALENT: all of the 95 % interval does (both one-sided tests reject at 2.5 %).
- DIFFERENT: all of the interval in which a right player would be with all but one in a million lies outside.
- NOT DECIDED: neither, and how many episodes would decide is said.

Where the first episodes do not decide, twice as many others join them, and again: a look at all of them after each.
The 5 % in which an interval misses are shared among the looks, half of it for the first and an equal part for each of
the others, so that a player at the margin passes one in forty times on either side however often is looked (the union
bound), and all the intervals hold together at 95 %.

A right player that is called DIFFERENT stops a release, so that takes far more evidence than 95 %; most pairs are equal
to the last bit, and the few that are not are far from normal. k equal differences among many episodes are √k standard
errors, so that no fewer than 23 of 200 episodes make a player DIFFERENT, and a rare accident alone does not.

A share as a margin is of how large returns are: of |mean|, or of the distance from their 5th to their 95th percentile
where that is larger, both of the reference. A mean near 0 says nothing of a scale, nor does one episode that went
wrong; where every return is 0 the margin is 0, and any difference is larger.
"""

from __future__ import annotations

import math
import re
from statistics import NormalDist

import numpy as np
from msgspec import Struct

from export_model.exporter.play.student import t_quantile
from export_model.exporter.verify.plays import CONFIDENCE, DIFFERENT, EQUIVALENT, NOT_DECIDED, Interval
from export_model.exporter.verify.statistics import FALSE_ALARM
from export_model.signatures.errors import UsageError

#: Of returns, those that tell how far they usually lie apart.
PERCENTILES = (5, 95)
#: Fewer say nothing: twenty equal differences are as rare as FALSE_ALARM where either sign is as likely.
LEAST_EPISODES = 20
MOST_EPISODES = 1_000_000
#: Of the error, what the first look takes, where there are others.
FIRST_SHARE = 0.5
#: No others are played where so many times as many as may be would be needed.
HOPELESS = 4
#: How surely a player that is right would be found EQUIVALENT with as many episodes as are proposed.
POWER = 0.95


class Margin(Struct, frozen=True):
    """How far mean returns may be apart: a number, or a share of how large the reference's returns are."""

    value: float
    is_share: bool = True

    def of(self, returns: np.ndarray) -> float:
        """Return the margin in the unit of ``returns``, those of the reference."""
        return self.value * scale_of(returns) if self.is_share else self.value


def parse_margin(text: str) -> Margin:
    """Return the margin of ``1%`` (a share) or ``0.5`` (in the unit of returns). Raises UsageError."""
    found = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(%?)\s*", text)
    value = float(found[1]) if found else 0.0
    if found is None or not 0 < value < math.inf:
        raise UsageError(
            f"--margin {text}: must be a share such as 1%, or a positive number in the unit of returns",
            fix="give for example --margin 1%",
        )
    return Margin(value / 100, True) if found[2] else Margin(value, False)


def scale_of(returns: np.ndarray) -> float:
    """Return how large returns are: |mean|, or how far they usually lie apart where that is more."""
    low, high = np.percentile(returns, PERCENTILES)
    return float(max(abs(returns.mean()), high - low))


class Equivalence(Struct, frozen=True):
    """What pairs of episodes tell: the mean difference of returns, its interval, the verdict."""

    verdict: str
    #: candidate less reference
    difference: float
    low: float
    high: float
    margin: float
    #: standard deviation of the differences
    deviation: float
    episodes: int
    #: episodes whose returns are equal
    equal: int
    #: how many episodes would decide, where these did not; None where none would
    needed: int | None = None


def look_sizes(first: int, most: int) -> list[int]:
    """Return how many episodes join at each look: the first, then twice as many each time, at most ``most`` others."""
    sizes = [first]
    while sum(sizes[1:]) + 2 * sizes[-1] <= most:
        sizes.append(2 * sizes[-1])
    return sizes


def share_error(looks: int) -> list[float]:
    """Return the tail of the interval at each look: their sum is that of CONFIDENCE."""
    whole = (1 - CONFIDENCE) / 2
    if looks == 1:
        return [whole]
    return [whole * FIRST_SHARE, *[whole * (1 - FIRST_SHARE) / (looks - 1)] * (looks - 1)]


def is_out_of_reach(compared: Equivalence, episodes: int, tail: float) -> bool:
    """Whether even a player without any difference would need more than HOPELESS times as many episodes.

    The difference that was seen says nothing here: of a right player it lies near the margin by chance.
    """
    errors = NormalDist().inv_cdf(1 - tail) + NormalDist().inv_cdf(1 - (1 - POWER) / 2)
    return compared.deviation * errors > compared.margin * math.sqrt(HOPELESS * episodes)


def equivalence(
    reference: np.ndarray, candidate: np.ndarray, margin: float, tail: float = (1 - CONFIDENCE) / 2
) -> Equivalence:
    """Return the verdict on paired returns, float64 [episodes] each; the interval misses by ``tail`` on either side."""
    differences = candidate - reference
    count = len(differences)
    mean = float(differences.mean())
    deviation = float(differences.std(ddof=1))
    error = deviation / math.sqrt(count)
    near = t_quantile(tail, count - 1) * error
    far = t_quantile(FALSE_ALARM / 2, count - 1) * error
    needed = None
    if abs(mean) + near <= margin:
        verdict = EQUIVALENT
    elif abs(mean) - far > margin:
        verdict = DIFFERENT
    else:
        verdict, needed = NOT_DECIDED, _episodes_needed(mean, deviation, margin, near, tail)
    equal = int((differences == 0).sum())
    return Equivalence(
        verdict=verdict,
        difference=mean,
        low=mean - near,
        high=mean + near,
        margin=margin,
        deviation=deviation,
        episodes=count,
        equal=equal,
        needed=needed,
    )


def mean_interval(values: np.ndarray) -> Interval:
    """Return the mean of ``values``, float64 [episodes], with Student's interval."""
    mean, count = float(values.mean()), len(values)
    error = float(values.std(ddof=1)) / math.sqrt(count)
    near = t_quantile((1 - CONFIDENCE) / 2, count - 1) * error
    return Interval(mean, mean - near, mean + near)


def _episodes_needed(mean: float, deviation: float, margin: float, near: float, tail: float) -> int | None:
    """Return the number of episodes that would decide: of a right player where the interval holds 0, else of this."""
    inside, outside, power = (NormalDist().inv_cdf(1 - beyond) for beyond in (tail, FALSE_ALARM / 2, 1 - POWER))
    if abs(mean) <= near:  # a difference of 0 is as likely as any: its |mean| stays within the power's two-sided bound
        distance, errors = margin, inside + NormalDist().inv_cdf(1 - (1 - POWER) / 2)
    elif abs(mean) < margin:
        distance, errors = margin - abs(mean), inside + power
    else:
        distance, errors = abs(mean) - margin, outside + power
    if distance <= 0 or deviation * errors > distance * math.sqrt(MOST_EPISODES):
        return None
    return math.ceil((deviation * errors / distance) ** 2)
