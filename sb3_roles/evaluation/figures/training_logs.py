"""Rewards over the training of a run, from what its folder says."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from area_search.scenes import Scene, SceneError, get_scene
from sb3_roles.common.names import one_line

_STEPS, _EXPLORED, _COVERED = "time/env_steps", "rollout/explo_paper", "rollout/cover"


class TrainingLogError(ValueError):
    """A run folder that does not tell how its rewards grew; one line."""


class TrainingLog(NamedTuple):
    """Rewards of a run after each of its rollouts that had finished an episode.

    :param steps: int64 (n,), joint steps so far, increasing
    :param rewards: ``explore_reward`` and ``cover_reward`` -> float64 (n,), the sum of R_e and of
        R_c over an episode and the team (Section IV), mean over the last episodes of the training
    """

    steps: np.ndarray
    rewards: Mapping[str, np.ndarray]


def read_training_log(folder: Path) -> TrainingLog:
    """Read the rewards of a training run for area search.

    R_e is the number of newly seen cells over B_e, R_c that of newly covered targets, whatever the
    weights with which the run was paid for them.

    :param folder: of the run, with ``progress.csv`` and ``config.yml``; a last line without its end
        is left out
    :raises TrainingLogError: naming the file, if one is missing or damaged, or the scene no scene
    """
    scene = _scene(folder / "config.yml")
    path = folder / "progress.csv"
    by_step: dict[int, tuple[float, float]] = {}
    try:
        content = path.read_bytes()
        # A training that goes on may have written a part of its last line.
        whole = content[: content.rfind(b"\n") + 1].decode()
        for row in csv.DictReader(io.StringIO(whole, newline=""), strict=True):
            # Before the first episode has ended there is nothing to tell; a row that was cut
            # short lacks its last entries, which DictReader gives as None.
            values = [row[_EXPLORED], row[_COVERED]]
            if None in row.values() or None in row:
                raise ValueError("a row has not as many entries as the first line")
            if all(values):
                by_step[int(row[_STEPS])] = (float(values[0]), float(values[1]))
    except OSError as error:
        raise TrainingLogError(f"{path}: {error.strerror}") from None
    except KeyError as error:
        raise TrainingLogError(f"{path}: it has no column {error}") from None
    except (ValueError, csv.Error) as error:
        raise TrainingLogError(f"{path}: damaged: {one_line(error)}") from None
    steps = np.array(sorted(by_step), np.int64)
    shares = np.array([by_step[int(step)] for step in steps], np.float64).reshape(-1, 2)
    if not len(steps) or not np.isfinite(shares).all():
        raise TrainingLogError(f"{path}: it has no rewards yet, or some that are no numbers")
    return TrainingLog(
        steps,
        {
            "explore_reward": shares[:, 0] * scene.n_free / scene.explore_normalizer,
            "cover_reward": shares[:, 1] * scene.n_targets,
        },
    )


def _scene(path: Path) -> Scene:
    from sb3_roles.common.yaml_text import load_yaml

    known = {field.name for field in fields(Scene)}
    try:
        config: Any = load_yaml(path.read_text(encoding="utf-8"))
        # The environment has other arguments, too; "scene" is the name.
        options = dict(config.get("env_kwargs") or {})
        name = options.get("scene", "hard")
        return get_scene(name, **{key: options[key] for key in options if key in known - {"name"}})
    except OSError as error:
        raise TrainingLogError(f"{path}: {error.strerror}") from None
    except (SceneError, AttributeError, TypeError, ValueError) as error:
        raise TrainingLogError(f"{path}: it names no scene: {one_line(error)}") from None


def smoothed(values: np.ndarray, window: int) -> np.ndarray:
    """Return the centered rolling mean, over fewer values near both ends.

    :param values: (n,)
    :param window: odd, values per mean
    :return: float64 (n,); entry i is the mean of those entries from i - window // 2 to
        i + window // 2 that exist
    """
    reach = window // 2
    sums = np.concatenate([[0.0], np.cumsum(values, dtype=np.float64)])
    index = np.arange(len(values))
    low, high = np.maximum(index - reach, 0), np.minimum(index + reach + 1, len(values))
    return (sums[high] - sums[low]) / (high - low)
