"""The difference of two rows on the same episodes, with the noise of episodes and of trainings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sb3_roles.evaluation.intervals import t_quantile

BETTER, WORSE, ALIKE = "better", "worse", "not told apart"


class Difference(NamedTuple):
    """How much more a row has than another one; None: does not exist.

    :param mean: in the unit of the values
    :param low: lower end of the 95 % interval
    :param high: its upper end
    :param over_seeds: whether the interval says how much trainings differ; otherwise it is over
        episodes only, and speaks for these trained policies
    """

    mean: float
    low: float | None
    high: float | None
    over_seeds: bool

    @property
    def verdict(self) -> str:
        """``BETTER`` or ``WORSE`` where the interval is on one side of 0, else ``ALIKE``."""
        if self.low is None or self.high is None or self.low <= 0 <= self.high:
            return ALIKE
        return BETTER if self.low > 0 else WORSE


def difference(values: np.ndarray, reference: np.ndarray, same_runs: bool = False) -> Difference:
    """Return the difference of two means over trainings and episodes, and its 95 % t interval.

    Episodes are the same for all runs, and are paired. Trainings are independent of each other,
    whatever their seeds, and are compared as two samples of one variance, but where the same runs
    play for both rows: then they are paired as well. The squared standard error is the sum of two:

    * over episodes, the variance of the differences of the means over runs, by their number;
    * over trainings, the pooled variance of the runs' means times (1 / runs + 1 / runs of the
      reference), or for the same runs the variance of their differences by their number.

    The degrees of freedom are Welch and Satterthwaite's. The noise that an episode has for one run
    alone is part of both, so that the interval is rather too wide than too narrow.

    :param values: float (runs, episodes)
    :param reference: float (runs of the reference, episodes)
    :param same_runs: run k of both is the same training
    :return: without an interval for a single episode; ``over_seeds`` is False if there are too few
        runs to tell how much trainings differ
    :raises ValueError: if they are not of as many episodes
    """
    n_runs, n_episodes = values.shape
    if reference.shape[1] != n_episodes or (same_runs and len(reference) != n_runs):
        raise ValueError(f"no pairs: {values.shape} and {reference.shape} runs and episodes")
    per_episode = values.mean(axis=0) - reference.mean(axis=0)
    mean = float(per_episode.mean())
    ours, theirs = values.mean(axis=1), reference.mean(axis=1)
    over_runs = _paired(ours - theirs) if same_runs else _pooled(ours, theirs)
    over_episodes = _paired(per_episode)
    if over_episodes is None:
        return Difference(mean, None, None, False)
    parts = [over_episodes] if over_runs is None else [over_episodes, over_runs]
    total, reach = sum(variance for variance, _ in parts), 0.0
    if total > 0:
        within = sum(variance**2 / df for variance, df in parts)
        reach = t_quantile(max(1, int(total**2 / within))) * float(np.sqrt(total))
    return Difference(mean, mean - reach, mean + reach, over_runs is not None)


_Part = tuple[float, int]
"""The square of a standard error, and its degrees of freedom."""


def _paired(differences: np.ndarray) -> _Part | None:
    n = len(differences)
    return (float(np.var(differences, ddof=1)) / n, n - 1) if n > 1 else None


def _pooled(ours: np.ndarray, theirs: np.ndarray) -> _Part | None:
    df = len(ours) + len(theirs) - 2
    if df < 1:
        return None
    squares = sum(float(np.sum((part - part.mean()) ** 2)) for part in (ours, theirs))
    return squares / df * (1 / len(ours) + 1 / len(theirs)), df
