"""What a row scores in a cell of the tables, and over all scenes of a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_roles.evaluation.grid.entrants import Played, Results
from sb3_roles.evaluation.grid.plan import SCORES
from sb3_roles.evaluation.intervals import estimate_mean
from sb3_roles.evaluation.metrics import decision_time, summarize
from sb3_roles.evaluation.tables.aggregate import interval_over_runs, mean_of_tasks

CURVES = ("explo_paper", "explo_true", "cover")
"""Of ``SCORES``, those that every episode has: percentages."""


class Score(NamedTuple):
    """A number of a table; None: does not exist.

    :param mean: percent or steps
    :param low: lower end of the 95 % interval
    :param high: its upper end
    :param unit: ``"%"`` or ``"steps"``
    :param share: of the episodes that get there, in [0, 1], ``t90_true`` only
    :param n_episodes: of each entrant; the fewest, where they differ
    :param n_seeds: training runs, 0 for a scripted row
    """

    mean: float | None
    low: float | None
    high: float | None
    unit: str
    share: float | None
    n_episodes: int
    n_seeds: int


def check_results(results: Results) -> int | None:
    """Check that all rows of a column played the same episodes.

    :param results: what was played
    :return: seed of the stream of episodes; None without any
    :raises ValueError: naming the cell that holds episodes of another scene, team or stream, or
        does not begin at episode 0
    """
    seeds: dict[int, str] = {}
    for (row, column), played in results.items():
        for one in played:
            about, where = (
                one.records.metadata,
                f"{row} in {column.scene}, {column.n_agents} robots",
            )
            scene = about["scene"]
            if (scene["name"], scene["n_agents"]) != column:
                raise ValueError(
                    f"{where}: the records are of {scene['name']}, {scene['n_agents']} robots"
                )
            episodes = one.records.episode
            if not len(episodes) or not np.array_equal(episodes, np.arange(len(episodes))):
                raise ValueError(f"{where}: the episodes do not count up from 0")
            seeds.setdefault(about["seed"], where)
    if len(seeds) > 1:
        (one_seed, first), (other, second) = list(seeds.items())[:2]
        raise ValueError(
            f"only the same episodes can be compared: {first} played stream {one_seed}, "
            f"{second} stream {other}"
        )
    return next(iter(seeds), None)


def score_cell(played: Sequence[Played]) -> dict[str, Score]:
    """Score one row in one column, all of ``SCORES``.

    With a single entrant, what ``metrics.summarize`` says of its episodes. With several training
    runs, the interquartile mean of what it says of each, and ``aggregate.interval_over_runs``:
    ``time_e_paper`` is that of each run's own mean curve, and does not exist if a run never gets
    there; ``t90_true`` is over the runs in which some episode gets there, its share that of the
    episodes of all.

    :param played: what its entrants played, at least one
    """
    summaries = [summarize(one.records) for one in played]
    return {metric: _score([each[metric] for each in summaries], played) for metric in SCORES}


def _score(entries: Sequence[Mapping[str, Any]], played: Sequence[Played]) -> Score:
    share = None
    if "share" in entries[0]:
        share = float(np.mean([entry["share"] for entry in entries]))
    empty = Score(None, None, None, entries[0]["unit"], share, *_sizes(played))
    if len(entries) == 1:
        low, high = entries[0]["ci95"] or (None, None)
        return empty._replace(mean=entries[0]["mean"], low=low, high=high)
    known = [entry["mean"] for entry in entries if entry["mean"] is not None]
    # Without its share, a mean of some of the runs would pass for one of them all.
    if not known or (share is None and len(known) < len(entries)):
        return empty
    return _over_runs(np.array(known)[:, None], empty)


def _over_runs(scores: np.ndarray, empty: Score) -> Score:
    low, high = interval_over_runs(scores) if len(scores) > 1 else (None, None)
    return empty._replace(mean=float(mean_of_tasks(scores)), low=low, high=high)


def _sizes(played: Sequence[Played]) -> tuple[int, int]:
    n_episodes = min(len(one.records.episode) for one in played)
    return n_episodes, len(played) if played[0].entrant.learned else 0


def score_scenes(cells: Sequence[Sequence[Played]]) -> dict[str, Score]:
    """Score one row over all scenes of a table, the metrics in ``CURVES``.

    It is the mean over the scenes of the scores in each, on the episodes of the same number in all
    of them, up to the last that was played in all. With a single entrant, the interval is
    Student's t over those numbers. With several training runs, it is one over whole runs, for a
    policy that is good in one scene is good in the others.

    :param cells: what its entrants played, scene by scene
    :return: nothing if not the same entrants played all scenes
    """
    entrants = [[one.entrant for one in cell] for cell in cells]
    if not entrants or not entrants[0] or any(each != entrants[0] for each in entrants[1:]):
        return {}
    n_episodes = min(_sizes(cell)[0] for cell in cells)
    empty = Score(None, None, None, "%", None, n_episodes, _sizes(cells[0])[1])
    scores = {}
    for metric in CURVES:
        values = 100.0 * values_of(cells, metric)[..., 0]
        if len(values) > 1:
            scores[metric] = _over_runs(values.mean(axis=2), empty)
        else:
            mean, _, low, high = estimate_mean(values[0].mean(axis=0))
            scores[metric] = empty._replace(mean=mean, low=low, high=high)
    return scores


def values_of(cells: Sequence[Sequence[Played]], metric: str, whole: bool = False) -> np.ndarray:
    """Return what the episodes of one row have, for ``aggregate.Comparison``.

    :param cells: what its entrants played, scene by scene; the same entrants in all
    :param metric: of ``CURVES``
    :param whole: the curves, instead of what they end with
    :return: float64 (runs, tasks, episodes, horizon or 1), fractions; the episodes that all have
    """
    steps = slice(None) if whole else slice(-1, None)
    n_episodes = min(_sizes(cell)[0] for cell in cells)
    runs = zip(*cells, strict=True)
    return np.array(
        [[one.records.curves[metric][:n_episodes, steps] for one in run] for run in runs]
    )


def decision_of(played: Sequence[Played]) -> float:
    """Return the median time of a decision on a joint step of one team, in seconds.

    :param played: what the entrants of a row played; the median of theirs
    """
    return float(np.median([decision_time(one.records)["median"] for one in played]))
