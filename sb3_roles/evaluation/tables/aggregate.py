"""Statistics over training runs, and of several rows on the same episodes; pure numpy.

Values of a row are arrays (runs, tasks, ...): a run is one training of the same configuration with
another seed, a task a scene. A scripted row has one run.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping

import numpy as np

from sb3_roles.common.thresholds import first_above
from sb3_roles.evaluation.intervals import LEVEL

N_RESAMPLES = 2000
MIN_EPISODES = 20
"""Shared episodes that a comparison needs: percentiles of a bootstrap are too narrow with few. In
simulations, one of two equal rows was found better in about 14 % of all cases with 6 episodes, in
7 % with 20 and in 6 % with 30; 5 % is meant."""
_TAIL = (1 - LEVEL) / 2


def interquartile_mean(scores: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Mean of the middle half, as rliable has it (Agarwal et al. 2021, ``trim_mean(x, 0.25)``).

    A quarter of the values, rounded down, is cut off at each end: nothing of three or fewer.

    :param scores: float (..., n, ...), n at least 1
    :param axis: of the n values; None for all values of the array together
    :return: without that axis
    """
    if axis is None:
        scores, axis = scores.ravel(), 0
    n = scores.shape[axis]
    cut = n // 4
    return np.sort(scores, axis=axis).take(range(cut, n - cut), axis=axis).mean(axis=axis)


def mean_of_tasks(scores: np.ndarray) -> np.ndarray:
    """Mean over the tasks of the interquartile means over the runs.

    The interquartile mean over all runs and tasks at once would drop whole tasks, the hardest and
    the easiest.

    :param scores: float (..., runs, tasks)
    :return: float (...)
    """
    return interquartile_mean(scores, axis=-2).mean(axis=-1)


def resample_runs(
    scores: np.ndarray,
    statistic: Callable[[np.ndarray], np.ndarray],
    whole: bool = False,
    n_resamples: int = N_RESAMPLES,
    seed: int = 0,
) -> np.ndarray:
    """Return a statistic of resamples of the runs, drawn with replacement (stratified bootstrap).

    :param scores: float (runs, tasks)
    :param statistic: (runs, tasks) -> a number, for a whole array (n_resamples, runs, tasks)
    :param whole: draw runs with all of their tasks, which is right where one policy plays all of
        them; otherwise runs are drawn for each task by itself, as rliable does, which is right
        where each task has its own trainings
    :param n_resamples: number of resamples
    :param seed: of the resampling
    :return: float (n_resamples,)
    """
    n_runs, n_tasks = scores.shape
    rng = np.random.default_rng(seed)
    drawn = rng.integers(n_runs, size=(n_resamples, n_runs, 1 if whole else n_tasks))
    return statistic(scores[drawn, np.arange(n_tasks)])


def interval_over_runs(scores: np.ndarray, seed: int = 0) -> tuple[float, float]:
    """95 % percentile interval of :func:`mean_of_tasks`, from resamples of whole runs.

    It covers how much trainings differ from each other, and nothing else: the episodes are the same
    ones for all runs, and are taken as they are. With two to four runs it goes from about the
    lowest to the highest one, which includes the true value in some ``1 - 2 ** (1 - runs)`` of all
    cases only.

    :param scores: float (runs, tasks), at least two runs; mean over the episodes of each
    :param seed: of the resampling
    :return: its ends
    """
    resampled = resample_runs(scores, mean_of_tasks, whole=True, seed=seed)
    low, high = np.quantile(resampled, [_TAIL, 1 - _TAIL])
    return float(low), float(high)


Reduce = Callable[[np.ndarray], np.ndarray]


def last_value(curves: np.ndarray) -> np.ndarray:
    """Return what a mean curve ends with: float (..., horizon) -> (...)."""
    return curves[..., -1]


def time_above(curves: np.ndarray) -> np.ndarray:
    """Time_E of mean curves, ``horizon`` where there is none: float (..., horizon) -> (...)."""
    return first_above(curves.reshape(-1, curves.shape[-1])).reshape(curves.shape[:-1])


class Comparison:
    """Which row is better than every other one, on the same episodes, by paired bootstrap.

    Episodes are drawn for all rows alike, and training runs for each row by itself, so that the
    difference of two rows has the noise of both. A row is better than another where the 95 %
    percentile interval of the difference of their :func:`mean_of_tasks` lies on one side of 0.
    Being better than *every* other one needs no correction for their number.

    Two rows are compared on the episodes that both played: the first ones of the stream.

    :param n_resamples: number of resamples
    :param seed: of the resampling
    """

    def __init__(self, n_resamples: int = N_RESAMPLES, seed: int = 0) -> None:
        self._n_resamples, self._seed = n_resamples, seed
        self._weights: dict[int, np.ndarray] = {}

    def best(
        self,
        rows: Mapping[str, np.ndarray],
        reduce: Reduce = last_value,
        larger_is_better: bool = True,
    ) -> str | None:
        """Name the row that is better than every other one.

        :param rows: name -> float (runs, tasks, episodes, steps), curves or, with one step, values;
            the number of runs and of episodes may differ between rows
        :param reduce: curves (..., steps) -> score (...), of a mean over episodes
        :param larger_is_better: the sign of a score
        :return: None if there is no such row: none is better than all others, it has no rival, or
            there are fewer than ``MIN_EPISODES`` in a comparison
        """
        sizes = {name: values.shape[2] for name, values in rows.items()}
        if len(rows) < 2 or min(sizes.values()) < MIN_EPISODES:
            return None
        sign = 1.0 if larger_is_better else -1.0
        scored: dict[tuple[str, int], np.ndarray] = {}

        def scores(name: str, size: int) -> np.ndarray:
            if (name, size) not in scored:
                values = rows[name][:, :, :size]
                scored[name, size] = sign * self._resampled(name, values, reduce)
            return scored[name, size]

        def beats(name: str, other: str) -> bool:
            size = min(sizes[name], sizes[other])
            difference = scores(name, size) - scores(other, size)
            return bool(np.quantile(difference, _TAIL, method="lower") > 0)

        for name in rows:
            if all(beats(name, other) for other in rows if other != name):
                return name
        return None

    def _resampled(self, name: str, values: np.ndarray, reduce: Reduce) -> np.ndarray:
        """Return the score of a row in every resample, (n_resamples,)."""
        n_runs, _, n_episodes, _ = values.shape
        # Resamples first: one product for all runs and tasks, as weights are read from memory.
        means = np.tensordot(self._weights_of(n_episodes), values, axes=(1, 2))
        scores = reduce(means)
        if n_runs > 1:
            # From its name, and not from its place: the order of the rows must not matter.
            rng = np.random.default_rng([self._seed, zlib.crc32(name.encode())])
            drawn = rng.integers(n_runs, size=(self._n_resamples, n_runs, 1))
            scores = np.take_along_axis(scores, drawn, axis=1)
        return mean_of_tasks(scores)

    def _weights_of(self, n_episodes: int) -> np.ndarray:
        # How often each episode is drawn, over their number: one product gives all the means.
        if n_episodes not in self._weights:
            rng = np.random.default_rng([self._seed, n_episodes])
            shares = np.full(n_episodes, 1 / n_episodes)
            counts = rng.multinomial(n_episodes, shares, size=self._n_resamples)
            self._weights[n_episodes] = counts / n_episodes
        return self._weights[n_episodes]
