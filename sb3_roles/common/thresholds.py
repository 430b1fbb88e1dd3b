"""When curves of a metric exceed a threshold."""

from __future__ import annotations

import numpy as np

THRESHOLD = 0.9
# Means are sums of rounded fractions: a mean of exactly 0.9 must not count as above it.
_ROUNDING = 1e-12


def first_above(curves: np.ndarray, threshold: float = THRESHOLD) -> np.ndarray:
    """First 0-based index at which each curve exceeds a threshold.

    :param curves: (n, horizon)
    :param threshold: exceeded means strictly above
    :return: int64 (n,); ``horizon`` where it never does
    """
    above = curves > threshold + _ROUNDING
    return np.where(above.any(axis=1), above.argmax(axis=1), curves.shape[1])
