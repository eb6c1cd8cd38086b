"""Student's t distribution, without scipy: how many standard errors an interval reaches to either side."""

from __future__ import annotations

import functools
import math


@functools.cache
def t_quantile(tail: float, freedom: int) -> float:
    """Return the t that a variable of Student's distribution exceeds with the probability ``tail`` (below 0.5)."""
    low, high = 0.0, 1.0
    while upper_tail(high, freedom) > tail:
        high *= 2
    while high - low > 1e-12 * high:
        middle = (low + high) / 2
        if upper_tail(middle, freedom) > tail:
            low = middle
        else:
            high = middle
    return high


def upper_tail(t: float, freedom: int) -> float:
    """Return P(T > t) for t >= 0: half the regularised incomplete beta function at ν / (ν + t²)."""
    return 0.5 * _incomplete_beta(freedom / 2, 0.5, freedom / (freedom + t * t))


def _incomplete_beta(a: float, b: float, x: float) -> float:
    """Return I_x(a, b), by the continued fraction (Abramowitz and Stegun 26.5.8) with Lentz's method."""
    if x <= 0 or x >= 1:
        return 0.0 if x <= 0 else 1.0
    log_front = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x)
    if x > (a + 1) / (a + b + 2):  # converges faster from the other side
        return 1 - math.exp(log_front) * _fraction(b, a, 1 - x) / b
    return math.exp(log_front) * _fraction(a, b, x) / a


def _fraction(a: float, b: float, x: float) -> float:
    c, d = 1.0, 1 / (1 - (a + b) * x / (a + 1))
    value = d
    for m in range(1, 10_000):
        even = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        step = 1.0
        for term in (even, odd):
            d, c = 1 / (1 + term * d), 1 + term / c
            step = c * d
            value *= step
        if abs(step - 1) < 1e-15:
            break
    return value
