"""Confidence intervals of means: Student's t, without a statistics library."""

from __future__ import annotations

import math
from functools import cache
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

LEVEL = 0.95
# Up to here the distribution is summed exactly; beyond, four terms of an expansion are exact to 8
# digits.
_EXACT = 100


class Estimate(NamedTuple):
    """A mean with its standard error and a 95 % confidence interval; None: does not exist."""

    mean: float | None
    se: float | None
    low: float | None
    high: float | None


def t_within(t: float, df: int) -> float:
    """Probability that Student's t is between ``-t`` and ``t`` (Abramowitz and Stegun 26.7.3, 4).

    :param t: at least 0
    :param df: degrees of freedom, at least 1
    """
    angle = math.atan(t / math.sqrt(df))
    cosine, sine = math.cos(angle), math.sin(angle)
    odd = df % 2
    # Terms cos, cos^3, ... for odd degrees of freedom, 1, cos^2, ... for even ones.
    term, total = (cosine, 0.0) if odd else (1.0, 0.0)
    for k in range(2 + odd, df + 1, 2):
        total += term
        term *= cosine**2 * (k - 1) / k
    if odd:
        return 2 / math.pi * (angle + sine * total)
    return sine * total


@cache
def t_quantile(df: int, level: float = LEVEL) -> float:
    """Bound within which Student's t is with some probability, on both sides of 0.

    :param df: degrees of freedom, at least 1
    :param level: the probability, in (0, 1)
    :return: t with P(-t < T < t) = level; 1.96 for many degrees of freedom and 95 %
    """
    if df > _EXACT:
        # Abramowitz and Stegun 26.7.5
        x = NormalDist().inv_cdf(0.5 + level / 2)
        terms = (
            (x**3 + x) / 4,
            (5 * x**5 + 16 * x**3 + 3 * x) / 96,
            (3 * x**7 + 19 * x**5 + 17 * x**3 - 15 * x) / 384,
        )
        return x + sum(term / df ** (k + 1) for k, term in enumerate(terms))
    low, high = 0.0, 1.0
    while t_within(high, df) < level:
        high *= 2
    for _ in range(60):
        middle = (low + high) / 2
        if t_within(middle, df) < level:
            low = middle
        else:
            high = middle
    return (low + high) / 2


def estimate_mean(values: np.ndarray) -> Estimate:
    """Mean, its standard error, and the t interval that covers the true mean in 95 % of samples.

    The error is s / sqrt(n) with the unbiased sample deviation s, the interval the mean plus and
    minus ``t_quantile(n - 1)`` times the error. It is exact for normal values, and good for the
    means of some dozen independent episodes or more.

    :param values: (n,), independent of each other
    :return: without a mean for n = 0, without error and interval for n = 1
    """
    n = len(values)
    if n == 0:
        return Estimate(None, None, None, None)
    mean = float(np.mean(values))
    if n == 1:
        return Estimate(mean, None, None, None)
    error = float(np.std(values, ddof=1) / np.sqrt(n))
    reach = t_quantile(n - 1) * error
    return Estimate(mean, error, mean - reach, mean + reach)
