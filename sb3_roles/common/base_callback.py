"""``TeamCallback``: what the callbacks of team training have in common."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_roles.common.role_wrapper import role_wrapper_of
from sb3_roles.common.team_wrapper import find_team_env

Evaluate = Callable[[BaseAlgorithm], Mapping[str, float]]


def role_options(env: VecEnv | None) -> dict[str, Any]:
    """Return how the roles of an environment are chosen, as arguments of ``RoleWrapper``.

    :param env: a vectorized environment, or None
    :return: ``roles``, ``role_every``, ``role_control``; empty without roles
    """
    wrapper = role_wrapper_of(env)
    if wrapper is None:
        return {}
    names = ("roles", "role_every", "role_control")
    return {name: getattr(wrapper, name) for name in names}


class TeamCallback(BaseCallback):
    """Knows the teams below the rows; the base of the callbacks here.

    :param verbose: see ``BaseCallback``
    """

    def __init__(self, verbose: int = 0) -> None:
        super().__init__(verbose)
        self._running: dict[str, np.ndarray] = {}
        """What is known of the episodes that have not ended, each (n_teams, ...)."""

    def _init_callback(self) -> None:
        self.team_env = find_team_env(self.training_env)
        self.n_teams, self.n_agents = self.team_env.n_teams, self.team_env.n_agents

    def _on_rollout_start(self) -> None:
        # Episodes may have begun since the last step: training that goes on after a reset.
        for array in self._running.values():
            array[self._begun()] = 0

    def _begun(self) -> np.ndarray:
        """Bool (n_teams,): which teams have not made a step in their episode yet."""
        starts = self.model._last_episode_starts
        return np.asarray(starts, np.bool_)[:: self.n_agents]

    def _ended(self) -> np.ndarray:
        """Indices of the teams whose episode has ended with this step."""
        return np.flatnonzero(np.asarray(self.locals["dones"])[:: self.n_agents])

    @property
    def joint_steps(self) -> int:
        """Steps of whole teams so far; SB3's ``num_timesteps`` counts those of robots."""
        return int(self.model.num_timesteps) // self.n_agents


def grown(array: np.ndarray, length: int) -> np.ndarray:
    """Return an array whose second axis is long enough, with zeros in what is new."""
    if length <= array.shape[1]:
        return array
    longer = np.zeros((array.shape[0], 2 * length, *array.shape[2:]), array.dtype)
    longer[:, : array.shape[1]] = array
    return longer


def stacked(arrays: list[np.ndarray], fill: float) -> np.ndarray:
    """Stack arrays of different lengths, the shorter ones filled up at their end."""
    if not arrays:
        return np.array([])
    longest = max(len(array) for array in arrays)
    rows = np.full((len(arrays), longest, *arrays[0].shape[1:]), fill, arrays[0].dtype)
    for row, array in zip(rows, arrays, strict=True):
        row[: len(array)] = array
    return rows
