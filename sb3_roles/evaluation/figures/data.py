"""The numbers behind the figures of a plan: curves and bars with their intervals."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_roles.common.files import csv_bytes
from sb3_roles.evaluation.figures.role_curves import role_shares, role_switches
from sb3_roles.evaluation.figures.training_logs import (
    TrainingLog,
    TrainingLogError,
    read_training_log,
    smoothed,
)
from sb3_roles.evaluation.grid.entrants import Played, Results
from sb3_roles.evaluation.grid.plan import Column, Figure
from sb3_roles.evaluation.intervals import LEVEL, t_quantile
from sb3_roles.evaluation.records import EpisodeRecords
from sb3_roles.evaluation.tables.aggregate import interquartile_mean, resample_runs
from sb3_roles.evaluation.tables.scores import Score, score_cell

SMOOTHING = 5
"""Rollouts over which the curves of a training are averaged."""

Logs = Mapping[str, Sequence[Path]]
"""Name of a row -> folders of its training runs."""
Warn = Callable[[str], None]
"""Takes a line about what is left out of a figure."""


class Origin(NamedTuple):
    """Where numbers are from.

    :param seeds: training runs; 0 for a scripted controller
    :param episodes: of each entrant, the smallest number of them; None for a training
    :param env_steps: joint steps of the shortest training; None where none is known
    """

    seeds: int
    episodes: int | None
    env_steps: int | None


@dataclass(frozen=True, eq=False)
class Curve:
    """One line of a figure.

    :param row: name
    :param column: where it was played; None for a training
    :param metric: of the figure
    :param x: int64 (n,), steps of the episode from 1 on, or joint steps of the training
    :param mean: float64 (n,), percent, or rewards per episode and team
    :param low: lower end of the band, nan where there is none
    :param high: upper end
    :param origin: of the numbers
    """

    row: str
    column: Column | None
    metric: str
    x: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    origin: Origin


@dataclass(frozen=True)
class Bar:
    """One bar of a figure.

    :param row: name
    :param column: where it was played
    :param metric: of the figure
    :param score: as in the tables, in 0-based steps; no mean where 90 % is never reached
    :param horizon: steps of an episode
    :param origin: of the numbers
    """

    row: str
    column: Column
    metric: str
    score: Score
    horizon: int
    origin: Origin

    @property
    def open_ended(self) -> bool:
        """Whether the interval has no known upper end, see ``metrics.time_e_paper``."""
        return self.metric == "time_e_paper" and self.score.high == self.horizon


Drawn = Sequence[Curve] | Sequence[Bar]
"""What a figure shows, in the order of its rows."""


def collect(figure: Figure, results: Results, logs: Logs, warn: Warn) -> Drawn:
    """Compute what a figure shows.

    :param figure: of a plan
    :param results: what was played; cells may be missing
    :param logs: runs; rows may be missing
    :param warn: told of each row and run that is there and can not be drawn
    :return: empty if there is nothing to draw
    """
    if figure.kind == "training":
        return list(_training(figure, logs, warn))
    if figure.kind == "time_e":
        return list(_bars(figure, results))
    return list(_episodes(figure, results, warn))


def csv_of(drawn: Drawn) -> bytes:
    """Return the drawn numbers as a csv file, one line for each point or bar.

    :param drawn: of one figure, at least one thing
    """
    curves = [one for one in drawn if isinstance(one, Curve)]
    bars = [one for one in drawn if isinstance(one, Bar)]
    steps = "joint_step" if curves and curves[0].column is None else "step"
    points = [
        (
            curve.row,
            *(curve.column or ("", "")),
            curve.metric,
            int(x),
            *map(_number, values),
            *_source(curve),
        )
        for curve in curves
        for x, *values in zip(curve.x, curve.mean, curve.low, curve.high, strict=True)
    ]
    heights = [
        (
            bar.row,
            *bar.column,
            bar.metric,
            *map(_number, (bar.score.mean, bar.score.low, bar.score.high, bar.score.share)),
            *_source(bar),
        )
        for bar in bars
    ]
    middle = ("share",) if bars else (steps,)
    header = ["row", "scene", "n_agents", "metric", "mean", "low", "high", "seeds", "episodes"]
    place = 7 if bars else 4
    return csv_bytes([*header[:place], *middle, *header[place:]], points or heights)


def _number(value: float | None) -> str:
    return "" if value is None or np.isnan(value) else format(float(value), ".6g")


def _source(one: Curve | Bar) -> tuple[int | str, int | str]:
    episodes = one.origin.episodes
    return one.origin.seeds, "" if episodes is None else episodes


def mean_band(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pointwise means of curves and their 95 % t intervals, see ``estimate_mean``.

    :param values: (n, T), nan where a curve has no value
    :return: mean, and lower and upper end; float64 (T,), nan where there are too few values
    """
    known = ~np.isnan(values)
    n = known.sum(axis=0)
    some, several = np.maximum(n, 1), np.maximum(n - 1, 1)
    mean = np.where(n > 0, np.where(known, values, 0.0).sum(axis=0) / some, np.nan)
    deviations = np.where(known, values - mean, 0.0)
    error = np.sqrt((deviations**2).sum(axis=0) / several / some)
    bounds = {k: t_quantile(k - 1) if k > 1 else np.nan for k in set(n.tolist())}
    reach = np.array([bounds[k] for k in n.tolist()]) * error
    return mean, mean - reach, mean + reach


def band_of_row(values: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean curve of a row and its 95 % band, at each step as the tables have it.

    :param values: (E, T) of each of its entrants, at least one
    :return: mean, and lower and upper end; float64 (T,). Of a single entrant, see
        :func:`mean_band`; of several training runs, the interquartile mean of their mean curves,
        and the percentiles of resamples of the runs, see ``aggregate.interval_over_runs``
    """
    bands = [mean_band(each) for each in values]
    if len(bands) == 1:
        return bands[0]
    means = np.stack([mean for mean, _, _ in bands])

    def over_runs(runs: np.ndarray) -> np.ndarray:
        return interquartile_mean(runs, axis=-2)

    tail = (1 - LEVEL) / 2
    low, high = np.quantile(resample_runs(means, over_runs, whole=True), [tail, 1 - tail], axis=0)
    return over_runs(means), low, high


def _values(figure: Figure, records: EpisodeRecords, metric: str) -> np.ndarray | None:
    """Return fractions for each episode and step of ``_steps``."""
    if figure.kind == "switching":
        return role_switches(records)
    return role_shares(records, metric) if figure.kind == "roles" else records.curves[metric]


def _steps(figure: Figure, n_values: int) -> np.ndarray:
    """Return the steps that values belong to: a change of roles needs a step before."""
    return np.arange(n_values) + (2 if figure.kind == "switching" else 1)


def _episodes(figure: Figure, results: Results, warn: Warn) -> Iterator[Curve]:
    told = set()
    for row in figure.rows:
        for column in figure.columns:
            played = results.get((row, column), ())
            for metric in figure.metrics if played else ():
                found = [_values(figure, records, metric) for _, records in played]
                known = [100.0 * values for values in found if values is not None]
                if len(known) < len(found):
                    if (row, metric) not in told:
                        lacks = "roles" if figure.kind == "switching" else f"role {metric}"
                        warn(f"figure {figure.name}: {row} has no {lacks}, it is left out")
                        told.add((row, metric))
                    continue
                mean, low, high = band_of_row(known)
                x = _steps(figure, len(mean))
                yield Curve(row, column, metric, x, mean, low, high, origin_of(played))


def origin_of(played: Sequence[Played]) -> Origin:
    """Return who played, and how much.

    :param played: of a cell, at least one entrant
    """
    trained = [who for who, _ in played if who.learned]
    steps = [who.env_steps for who in trained if who.env_steps is not None]
    return Origin(
        len(trained), min(len(records.episode) for _, records in played), min(steps, default=None)
    )


def _bars(figure: Figure, results: Results) -> Iterator[Bar]:
    for row in figure.rows:
        for column in figure.columns:
            played = results.get((row, column), ())
            if played:
                scores, origin = score_cell(played), origin_of(played)
                horizon = played[0].records.roles.shape[1]
                for metric in figure.metrics:
                    yield Bar(row, column, metric, scores[metric], horizon, origin)


def _training(figure: Figure, logs: Logs, warn: Warn) -> Iterator[Curve]:
    for row in figure.rows:
        read = []
        for folder in logs.get(row, ()):
            try:
                read.append(read_training_log(folder))
            except TrainingLogError as error:
                warn(f"figure {figure.name}: {row}: a run is left out: {error}")
        for metric in figure.metrics if read else ():
            x, values = common_curves(read, metric)
            if not len(x):
                warn(f"figure {figure.name}: {row} is left out: its runs share no joint steps")
                break
            low, high = values.min(axis=0), values.max(axis=0)
            if len(read) == 1:
                low = high = np.full(len(x), np.nan)
            origin = Origin(len(read), None, int(x[-1]))
            yield Curve(row, None, metric, x, values.mean(axis=0), low, high, origin)


def common_curves(runs: Sequence[TrainingLog], metric: str) -> tuple[np.ndarray, np.ndarray]:
    """Return smoothed rewards of runs while all of them were trained.

    :param runs: at least one
    :param metric: of ``TrainingLog.rewards``
    :return: joint steps, int64 (T,), all at which one of the runs has a value, none if one ended
        before another began; and float64
        (n_runs, T), between two values of a run on a straight line
    """
    steps = np.unique(np.concatenate([run.steps for run in runs]))
    first, last = max(run.steps[0] for run in runs), min(run.steps[-1] for run in runs)
    steps = steps[(steps >= first) & (steps <= last)]
    values = [np.interp(steps, run.steps, smoothed(run.rewards[metric], SMOOTHING)) for run in runs]
    return steps, np.stack(values)
