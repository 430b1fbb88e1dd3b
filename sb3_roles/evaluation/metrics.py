"""The metrics of the paper's tables, as pure functions of recorded episodes.

Three that must never be confused: ``explo_paper`` counts newly seen cells,
obstacles included and start discs excluded, over the free cells, and can exceed 100 %;
``explo_true`` is the explored share of the free cells; ``cover`` the share of the targets that were
covered. The paper prints the first as exploration.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from sb3_roles.evaluation.episodes import EpisodeRecords

THRESHOLD = 0.9
# Means are sums of rounded fractions: a mean of exactly 0.9 must not count as above it.
_ROUNDING = 1e-12
_BLOCK = 4_000_000


def mean_and_error(values: np.ndarray) -> tuple[float | None, float | None]:
    """Mean and its standard error, s / sqrt(n) with the unbiased sample deviation s.

    :param values: (n,)
    :return: mean and standard error; None where n is too small (below 1 and 2)
    """
    n = len(values)
    if n == 0:
        return None, None
    error = float(np.std(values, ddof=1) / np.sqrt(n)) if n > 1 else None
    return float(np.mean(values)), error


def first_above(curves: np.ndarray, threshold: float = THRESHOLD) -> np.ndarray:
    """First 0-based index at which each curve exceeds a threshold.

    :param curves: (n, horizon)
    :param threshold: exceeded means strictly above
    :return: int64 (n,); ``horizon`` where it never does
    """
    above = curves > threshold + _ROUNDING
    return np.where(above.any(axis=1), above.argmax(axis=1), curves.shape[1])


def time_e_paper(
    curves: np.ndarray, n_resamples: int = 1000, seed: int = 0
) -> tuple[int | None, float | None]:
    """Time_E of the tables: first 0-based step at which the mean curve of explo_paper exceeds 0.9.

    Its standard error is the standard deviation over resamples of the episodes (bootstrap).
    A resample that never gets there counts as getting there at ``horizon``, the step after the
    last: such times are only known to be later, so the error is then a lower bound.

    :param curves: explo_paper, fractions, (n_episodes, horizon)
    :param n_resamples: number of resamples
    :param seed: seed of the resampling
    :return: the step and its standard error; both None if the mean never exceeds 0.9 (a dash in
        the tables), no error for a single episode
    """
    n, horizon = curves.shape
    time = int(first_above(curves.mean(axis=0, keepdims=True))[0])
    if time == horizon:
        return None, None
    if n < 2:
        return time, None
    rng = np.random.default_rng(seed)
    times = []
    block = max(1, min(n_resamples, _BLOCK // n))
    for low in range(0, n_resamples, block):
        size = min(block, n_resamples - low)
        # How often each episode is drawn: one product then gives all the mean curves.
        drawn = rng.integers(n, size=(size, n)) + n * np.arange(size)[:, None]
        counts = np.bincount(drawn.ravel(), minlength=size * n).reshape(size, n)
        times.append(first_above(counts.astype(np.float64) @ curves / n))
    return time, float(np.std(np.concatenate(times), ddof=1))


def t90(times: np.ndarray) -> tuple[float | None, float | None, float]:
    """Per-episode time to 90 %, over the episodes that get there.

    :param times: integer (n_episodes,), 0-based steps, -1 for never
    :return: mean and standard error over the episodes that get there, and their share in [0, 1]
    """
    reached = times[times >= 0]
    return *mean_and_error(reached), len(reached) / len(times)


def summarize(records: EpisodeRecords) -> dict[str, dict[str, Any]]:
    """All metrics at the end of the episodes.

    :param records: what :func:`~sb3_roles.evaluation.episodes.run_episodes` returned
    :return: name -> ``mean``, ``se`` (standard error) and ``unit``. ``explo_paper``, ``explo_true``
        and ``cover`` are percentages, times and lengths joint steps; ``t90_*`` also have ``share``
        in [0, 1], the episodes that get there. What does not exist is None.
    """
    summary: dict[str, dict[str, Any]] = {}
    for name, curves in records.curves.items():
        mean, error = mean_and_error(100.0 * curves[:, -1])
        summary[name] = {"mean": mean, "se": error, "unit": "%"}
    time, error = time_e_paper(records.curves["explo_paper"])
    summary["time_e_paper"] = {"mean": time, "se": error, "unit": "steps"}
    for name, times in (("t90_true", records.t90_true), ("t90_paper", records.t90_paper)):
        mean, error, share = t90(times)
        summary[name] = {"mean": mean, "se": error, "unit": "steps", "share": share}
    mean, error = mean_and_error(records.length)
    summary["length"] = {"mean": mean, "se": error, "unit": "steps"}
    return summary
