"""Goodness of fit of draws, categorical ones and numbers, without scipy."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

#: How often a right sampler is called wrong, per test.
FALSE_ALARM = 1e-6
#: Classes expected less often than this are pooled: the chi-square approximation needs it.
_MIN_EXPECTED = 5.0
#: Groups of classes by how likely they are.
_GROUPS = 8
#: Draws of which fewer than this share repeat another are as good as independent.
_SHARE = 0.1


def chi_square_survival(statistic: float, freedom: int) -> float:
    """P(X ≥ statistic) for a chi-square variable: the regularised upper incomplete gamma function Q(k/2, x/2)."""
    a, x = freedom / 2, statistic / 2
    if freedom < 1 or x <= 0:
        return 1.0
    scale = math.exp(a * math.log(x) - x - math.lgamma(a))
    if x < a + 1:
        term = total = 1 / a
        n = a
        while term > total * 1e-15:
            n += 1
            term *= x / n
            total += term
        return max(0.0, 1 - scale * total)
    b = x + 1 - a
    c, d = 1e300, 1 / b
    h = d
    for i in range(1, 500):
        an = -i * (i - a)
        b += 2
        d = 1 / (an * d + b)
        c = b + an / c
        h *= d * c
        if abs(d * c - 1) < 1e-15:
            break
    return scale * h


def odds_of(scores: np.ndarray) -> np.ndarray:
    """The probabilities, float64, that log-probabilities or any scores [..., classes] stand for."""
    wide = scores.astype(np.float64)
    with np.errstate(invalid="ignore"):  # of all that are -infinity the odds are NaN
        odds = np.exp(wide - wide.max(axis=-1, keepdims=True))
    return np.asarray(odds / odds.sum(axis=-1, keepdims=True))


def fit(draws: np.ndarray, log_probs: np.ndarray) -> float:
    """The p-value of ``draws`` (class numbers) under ``log_probs`` (one row); 0 for an impossible class.

    A class is impossible below 1e-9: ML-Agents leaves masked actions about 1e-10.
    """
    probabilities = odds_of(log_probs)
    if draws.size == 0 or draws.min() < 0 or draws.max() >= probabilities.size:
        return 0.0
    counts = np.bincount(draws.reshape(-1).astype(int), minlength=probabilities.size)
    if (counts[probabilities < 1e-9] > 0).any():
        return 0.0
    expected = probabilities * draws.size
    order = np.argsort(-expected)
    expected, counts = expected[order], counts[order]
    large = expected >= _MIN_EXPECTED
    if not large.all():
        rest = slice(int(large.sum()), None)
        pooled_expected, pooled_counts = expected[rest].sum(), counts[rest].sum()
        expected, counts = expected[large], counts[large]
        if pooled_expected >= _MIN_EXPECTED or not expected.size:
            expected, counts = np.append(expected, pooled_expected), np.append(counts, pooled_counts)
        else:  # the rest is too rare to stand alone: it joins the rarest class
            expected[-1] += pooled_expected
            counts[-1] += pooled_counts
    if expected.size < 2:
        return 1.0
    return chi_square_survival(float(((counts - expected) ** 2 / expected).sum()), expected.size - 1)


def fit_all(draws: np.ndarray, log_probs: np.ndarray) -> float:
    """The p-value of ``draws`` [inputs, draws] under ``log_probs`` [inputs, classes], of all inputs together.

    Twice: by class, and by how likely the class was at its input, in groups of about the same expectation. (The counts
    of several inputs vary less than those of one whose probabilities are the mean: p is never too small.)
    """
    if draws.size == 0 or draws.min() < 0 or draws.max() >= log_probs.shape[1]:
        return 0.0
    probabilities = odds_of(log_probs) / len(log_probs)
    indices = draws.astype(int)
    flat = probabilities.reshape(-1)
    order = np.argsort(flat, kind="stable")
    group = np.empty(flat.size, int)
    group[order] = np.minimum(np.cumsum(flat[order]) * _GROUPS, _GROUPS - 1).astype(int)
    seen = np.take_along_axis(group.reshape(probabilities.shape), indices, axis=1)
    with np.errstate(divide="ignore"):
        groups, classes = np.log(np.bincount(group, flat, _GROUPS)), np.log(probabilities.sum(axis=0))
    return min(fit(indices.reshape(-1), classes), fit(seen.reshape(-1), groups))


def same_distribution(reference: np.ndarray, draws: np.ndarray, atol: float, rtol: float) -> float:
    """The p-value of two samples of one size, float [n] each, from one distribution; 0 for a NaN.

    Kolmogorov-Smirnov's, by Gnedenko's exact formula. Numbers within ``atol + rtol·|a|`` count as equal: where an
    action saturates, many draws are one number, and runtimes round it differently. p becomes larger, never smaller.
    """
    n = reference.size
    a, b = np.sort(reference.astype(np.float64)), np.sort(draws.astype(np.float64))
    if a.size != b.size or not np.isfinite(b).all():
        return 0.0
    ahead = max(_ahead(a, b, atol, rtol), _ahead(b, a, atol, rtol))
    if ahead <= 0:
        return 1.0
    total, k = 0.0, 1
    while k * ahead <= n:
        log_ratio = 2 * math.lgamma(n + 1) - math.lgamma(n - k * ahead + 1) - math.lgamma(n + k * ahead + 1)
        total += math.exp(log_ratio) if k % 2 else -math.exp(log_ratio)
        k += 1
    return min(1.0, max(0.0, 2 * total))


def normal_fit(values: np.ndarray) -> float:
    """The p-value of independent draws of N(0, 1): their mean, their variance, and Kolmogorov-Smirnov's distance.

    The distance by the inequality of Dvoretzky, Kiefer and Wolfowitz, the variance by Wilson and Hilferty's cube root.
    """
    x = np.sort(values.reshape(-1).astype(np.float64))
    n = x.size
    below = np.array([math.erfc(-each / math.sqrt(2)) / 2 for each in x.tolist()])
    places = np.arange(n)
    distance = max(float(((places + 1) / n - below).max()), float((below - places / n).max()))
    middle, width = 1 - 2 / (9 * n), math.sqrt(2 / (9 * n))
    cube = (math.cbrt(float(np.square(x).mean())) - middle) / width
    p_values = (
        2 * math.exp(-2 * n * distance**2),
        math.erfc(abs(cube) / math.sqrt(2)),
        math.erfc(abs(float(x.mean())) * math.sqrt(n / 2)),
    )
    return min(1.0, len(p_values) * min(p_values))


def uniform_fit(shares: np.ndarray) -> float:
    """The p-value of ``shares`` [n] being uniform from 0 to 1: Kolmogorov's, as Stephens brings it to finite n."""
    n, found = shares.size, np.sort(shares)
    ahead = max(float((np.arange(1, n + 1) / n - found).max()), float((found - np.arange(n) / n).max()))
    size = (math.sqrt(n) + 0.12 + 0.11 / math.sqrt(n)) * ahead
    if size < 0.3:  # p is 1 to five digits, and the series slow
        return 1.0
    terms = (math.exp(-2 * (k * size) ** 2) * (-1) ** (k - 1) for k in range(1, 100))
    return min(1.0, max(0.0, 2 * math.fsum(terms)))


def spread_fit(shares: np.ndarray) -> float:
    """The p-value of ``shares`` [n] being as spread as uniform ones, by Bernstein's inequality.

    Kolmogorov's test is nearly blind in the tails: of 4,096 draws it saw no noise that was a seventh too wide.
    """
    off = abs(float((12 * np.square(shares - 0.5) - 1).sum()))  # terms of variance 0.8, at most 2
    return min(1.0, 2 * math.exp(-(off**2) / (2 * (0.8 * shares.size + 2 * off / 3))))


def same_spread(reference: np.ndarray, draws: np.ndarray, near: float) -> float:
    """The p-value of two samples of one size, float [n] each, being as spread, by their ranks among all of both.

    Were they alike, either of a pair could be the other's: Hoeffding's inequality for sums of such signs. A draw that
    is ``near`` one of the reference counts as that: where an action saturates, runtimes round it differently.
    """
    known = np.sort(reference)
    above = np.searchsorted(known, draws).clip(1, known.size - 1)
    nearest = np.where(draws - known[above - 1] < known[above] - draws, known[above - 1], known[above])
    draws = np.where(np.abs(nearest - draws) <= near, nearest, draws)
    (shares,) = ranks(np.concatenate([reference, draws])[:, None]).T
    one, other = np.split(np.square(shares), 2)
    size = float(np.square(other - one).sum())
    return min(1.0, 2 * math.exp(-(float((other - one).sum()) ** 2) / (2 * size))) if size else 1.0


def _ahead(a: np.ndarray, b: np.ndarray, atol: float, rtol: float) -> int:
    """How many more of sorted ``a`` than of sorted ``b`` are at most x, at worst, b's being given the tolerance."""
    below = np.searchsorted(b, a + atol + rtol * np.abs(a), side="right")
    return int((np.arange(1, a.size + 1) - below).max(initial=0))


def dependent(deviations: Sequence[np.ndarray], largest: float = 3.0) -> int:
    """How many draws apart two are that tell something of each other, 0 where all are independent.

    ``deviations``, of each input [draws, components], are what was drawn less what is expected. The products of two at
    a distance are uncorrelated and at most ``largest``, so Bernstein's inequality says how far their sum may be from 0.
    """
    count = len(deviations[0])
    together, squares = np.zeros(count), 0.0
    for each in deviations:
        spectrum = np.abs(np.fft.rfft(each, 2 * count, axis=0)) ** 2
        together += np.fft.irfft(spectrum.sum(axis=1), 2 * count)[:count]
        squares += float(np.square(each.T @ each).sum()) / count**2
    variance, sums = np.arange(count, 0, -1) * squares, np.abs(together)
    with np.errstate(divide="ignore", invalid="ignore"):
        exponents = np.where(sums > 0, sums**2 / (2 * (variance + sums * largest / 3)), 0.0)
    wrong = (exponents > math.log(2 * count / FALSE_ALARM)) & (sums > _SHARE * together[0])
    return int(np.flatnonzero(wrong[1:])[0]) + 1 if wrong[1:].any() else 0


def columns_related(reference: np.ndarray, draws: np.ndarray) -> bool:
    """Whether the columns of two samples' ranks [n, columns] hang together otherwise than by chance."""
    count = len(draws)
    one, other = (r.T @ r for r in (reference, draws))
    off = np.abs(one - other)
    np.fill_diagonal(off, 0)  # what a column does alone is another test's
    # a product of two ranks is at most 3, its square 1.8 on average
    exponents = off**2 / (2 * (2 * 1.8 * count + 2 * off))
    return bool((exponents > math.log(off.size / FALSE_ALARM)).any())


def ranks(values: np.ndarray) -> np.ndarray:
    """The place of each value in its column [n, columns], centred, of variance 1 (0 where all are equal).

    None is further than √3, as without ties: where an action saturates, the few that do not would outweigh all.
    """
    made = np.empty(values.shape)
    for column, each in enumerate(values.T):
        _, place, counts = np.unique(each, return_inverse=True, return_counts=True)
        middle = np.cumsum(counts) - counts / 2
        made[:, column] = middle[place.reshape(-1)]
    made -= made.mean(axis=0)
    spread = made.std(axis=0)
    made = np.divide(made, spread, out=np.zeros_like(made), where=spread > 0).clip(-math.sqrt(3), math.sqrt(3))
    return np.asarray(made - made.mean(axis=0))
