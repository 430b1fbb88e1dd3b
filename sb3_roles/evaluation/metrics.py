"""The metrics of the paper's tables, as pure functions of recorded episodes.

Three that must never be confused: ``explo_paper`` counts newly seen cells,
obstacles included and start discs excluded, over the free cells, and can exceed 100 %;
``explo_true`` is the explored share of the free cells; ``cover`` the share of the targets that were
covered. The paper prints the first as exploration.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sb3_roles.common.thresholds import first_above
from sb3_roles.evaluation.intervals import LEVEL, Estimate, estimate_mean

if TYPE_CHECKING:
    from sb3_roles.evaluation.episodes import EpisodeRecords

NAMES = (
    "explo_paper",
    "explo_true",
    "cover",
    "cover_bound",
    "time_e_paper",
    "t90_true",
    "t90_paper",
    "path_length",
    "length",
)
"""All metrics, in the order of the reports; ``cover_bound`` only where the controller knows it."""


class Meaning(NamedTuple):
    """What readers are told of a metric.

    :param short: a word or two, for the head of a column
    :param label: what it is called, with its name and unit
    :param text: what it is, without a full stop
    """

    short: str
    label: str
    text: str


MEANINGS = {
    "explo_paper": Meaning(
        "Explored (paper)",
        "Explored, paper's count (explo_paper), %",
        "what the paper prints as exploration: cells newly seen from step 1 on, obstacles included "
        "and the view at the start excluded, over the free cells; it can exceed 100 %, and a "
        "printed 100 stands for 100 or more",
    ),
    "explo_true": Meaning(
        "Explored (true)",
        "Truly explored (explo_true), %",
        "the share of the free cells that was seen, the start included; never above 100 %",
    ),
    "cover": Meaning(
        "Covered",
        "Targets covered (cover), %",
        "the share of the targets that a robot stepped on from step 1 on",
    ),
    "time_e_paper": Meaning(
        "Time_E (paper)",
        "Time to 90 % (time_e_paper), steps",
        "the first step, counted from 0, at which the mean curve of explo_paper exceeds 90 %; a "
        "dash where it never does",
    ),
    "t90_true": Meaning(
        "t90 (true)",
        "Time to 90 % (t90_true), steps",
        "the first step, counted from 0, with explo_true of at least 90 %, mean over the episodes "
        "that get there, whose share stands beside it",
    ),
}
"""The metrics of tables and figures."""
_BLOCK = 4_000_000


def _resampled_times(curves: np.ndarray, n_resamples: int, seed: int) -> np.ndarray:
    """Time_E of resamples of the episodes; equal numbers and seeds draw the same episodes."""
    n = len(curves)
    rng = np.random.default_rng(seed)
    times = []
    block = max(1, min(n_resamples, _BLOCK // n))
    for low in range(0, n_resamples, block):
        size = min(block, n_resamples - low)
        # How often each episode is drawn: one product then gives all the mean curves.
        drawn = rng.integers(n, size=(size, n)) + n * np.arange(size)[:, None]
        counts = np.bincount(drawn.ravel(), minlength=size * n).reshape(size, n)
        times.append(first_above(counts.astype(np.float64) @ curves / n))
    return np.concatenate(times)


def _percentiles(times: np.ndarray) -> tuple[float, float]:
    # Whole steps, rounded outwards.
    tail = (1 - LEVEL) / 2
    low = np.quantile(times, tail, method="lower")
    return float(low), float(np.quantile(times, 1 - tail, method="higher"))


def time_e_paper(curves: np.ndarray, n_resamples: int = 1000, seed: int = 0) -> Estimate:
    """Time_E of the tables: first 0-based step at which the mean curve of explo_paper exceeds 0.9.

    It is no mean over episodes, so its standard error is the standard deviation over resamples of
    the episodes (bootstrap), and its interval their 2.5 and 97.5 % percentiles. A resample that
    never gets there counts as getting there at ``horizon``, the step after the last: such times
    are only known to be later, so the error is then a lower bound, and an interval that goes up to
    ``horizon`` has no known end.

    :param curves: explo_paper, fractions, (n_episodes, horizon)
    :param n_resamples: number of resamples
    :param seed: seed of the resampling
    :return: nothing if the mean never exceeds 0.9 (a dash in the tables); no error and interval for
        a single episode
    """
    n, horizon = curves.shape
    time = int(first_above(curves.mean(axis=0, keepdims=True))[0])
    if time == horizon:
        return Estimate(None, None, None, None)
    if n < 2:
        return Estimate(time, None, None, None)
    times = _resampled_times(curves, n_resamples, seed)
    return Estimate(time, float(np.std(times, ddof=1)), *_percentiles(times))


def t90(times: np.ndarray) -> tuple[float | None, float | None, float]:
    """Per-episode time to 90 %, over the episodes that get there.

    :param times: integer (n_episodes,), 0-based steps, -1 for never
    :return: mean and standard error over the episodes that get there, and their share in [0, 1]
    """
    estimate = estimate_mean(times[times >= 0])
    return estimate.mean, estimate.se, float(np.mean(times >= 0))


def _entry(estimate: Estimate, unit: str, **more: float) -> dict[str, Any]:
    mean, error, low, high = estimate
    interval = None if low is None else [low, high]
    return {"mean": mean, "se": error, "ci95": interval, "unit": unit, **more}


def _per_episode(records: EpisodeRecords) -> dict[str, tuple[np.ndarray, str]]:
    """Values that every episode has, and their units."""
    values = {name: (100.0 * curves[:, -1], "%") for name, curves in records.curves.items()}
    values["path_length"] = (records.path_length, "cells")
    values["length"] = (records.length, "steps")
    return values


def summarize(records: EpisodeRecords) -> dict[str, dict[str, Any]]:
    """All metrics at the end of the episodes; none depends on the time that anything took.

    Intervals are Student's t over the episodes, see ``intervals.estimate_mean``, but for
    ``time_e_paper``, whose is a bootstrap percentile interval.

    :param records: what :func:`~sb3_roles.evaluation.episodes.run_episodes` returned
    :return: name -> ``mean``, ``se`` (standard error), ``ci95`` (lower and upper end of the 95 %
        confidence interval) and ``unit``. ``explo_paper``, ``explo_true`` and ``cover`` are
        percentages, times and lengths joint steps, ``path_length`` the cells that a robot moved,
        mean over the team; ``t90_*``, over the episodes that get there, also have their ``share``
        in [0, 1]. What does not exist is None. ``cover_bound``, the cover that nobody can exceed,
        in percent and over the episodes of which it is known, is there only if there are any.
    """
    values = _per_episode(records)
    summary = {name: _entry(estimate_mean(each), unit) for name, (each, unit) in values.items()}
    time = time_e_paper(records.curves["explo_paper"])
    summary["time_e_paper"] = _entry(time, "steps")
    for name, times in (("t90_true", records.t90_true), ("t90_paper", records.t90_paper)):
        reached = times >= 0
        summary[name] = _entry(
            estimate_mean(times[reached]), "steps", share=float(np.mean(reached))
        )
    known = ~np.isnan(records.bounds)
    if known.any():
        share = 100.0 * records.bounds[known] / records.n_targets[known]
        summary["cover_bound"] = _entry(estimate_mean(share), "%")
    return {name: summary[name] for name in NAMES if name in summary}


def decision_time(records: EpisodeRecords) -> dict[str, Any]:
    """Time that the controller took to decide on a joint step, for one team.

    :param records: what :func:`~sb3_roles.evaluation.episodes.run_episodes` returned
    :return: ``median``, ``mean`` and ``p95`` over all steps of all episodes, and ``unit``; a step
        is an equal share of the decision for all teams of its batch, so the spread is that between
        batch steps
    """
    seconds = records.decision_seconds[~np.isnan(records.decision_seconds)].astype(np.float64)
    return {
        "median": float(np.median(seconds)),
        "mean": float(np.mean(seconds)),
        "p95": float(np.quantile(seconds, 0.95)),
        "unit": "s",
    }


def paired_differences(
    records: EpisodeRecords, reference: EpisodeRecords
) -> dict[str, dict[str, Any]]:
    """Differences of two controllers on the same episodes, ``records`` minus ``reference``.

    Episodes differ much more than controllers on one episode do, so these intervals are narrower
    than those of the two means. The difference of ``time_e_paper`` is that of the two mean curves'
    times, its interval from resamples of the episodes that are the same for both.

    :param records: of one controller
    :param reference: of the other
    :return: as :func:`summarize`, without ``t90_*``, which not every episode has, and
        ``cover_bound``, which is one of the episode. Percentages become percentage points
    :raises ValueError: if they are not of the same episodes
    """
    for what in ("scene", "seed"):
        if records.metadata[what] != reference.metadata[what]:
            raise ValueError(f"only the same episodes can be compared: the {what} is another one")
    if not np.array_equal(records.episode, reference.episode):
        raise ValueError("only the same episodes can be compared: their numbers are other ones")
    ours, theirs = _per_episode(records), _per_episode(reference)
    differences = {
        name: _entry(estimate_mean(values - theirs[name][0]), "pp" if unit == "%" else unit)
        for name, (values, unit) in ours.items()
    }
    differences["time_e_paper"] = _entry(
        _time_difference(records.curves["explo_paper"], reference.curves["explo_paper"]), "steps"
    )
    return {name: differences[name] for name in NAMES if name in differences}


def _time_difference(
    curves: np.ndarray, reference: np.ndarray, n_resamples: int = 1000, seed: int = 0
) -> Estimate:
    n, horizon = curves.shape
    times = [int(first_above(one.mean(axis=0, keepdims=True))[0]) for one in (curves, reference)]
    if horizon in times:
        return Estimate(None, None, None, None)
    time = times[0] - times[1]
    if n < 2:
        return Estimate(time, None, None, None)
    # The same seed: both are resampled alike.
    resampled = _resampled_times(curves, n_resamples, seed)
    resampled = resampled - _resampled_times(reference, n_resamples, seed)
    return Estimate(time, float(np.std(resampled, ddof=1)), *_percentiles(resampled))
