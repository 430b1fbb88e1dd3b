"""The Random row of the tables: every robot draws its action uniformly."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from area_search.cells import N_ACTIONS
from area_search.random_streams import draw, episode_key, mix, to_unit
from sb3_roles.baselines.base import ScriptedController

if TYPE_CHECKING:
    from area_search.batch import BatchedAreaSearch

# Separates these draws from those of the map, which have the same seed and episode.
_TAG = np.uint64(0x52414E444F4D2121)  # "RANDOM!!"


class RandomController(ScriptedController):
    """Uniform over the five actions.

    A draw is a function of (seed, episode, step, robot), so an episode is the same in any batch.
    """

    def act(self, batch: BatchedAreaSearch) -> np.ndarray:
        """Draw an action for every robot.

        :param batch: the teams
        :return: int64 (n_teams, n_agents)
        """
        actions = np.empty((batch.n_teams, batch.n_agents), np.int64)
        _draw_actions(batch.keys, batch.episodes, batch.steps, actions)
        return actions


@njit(cache=True)
def _draw_actions(
    keys: np.ndarray, episodes: np.ndarray, steps: np.ndarray, actions: np.ndarray
) -> None:
    n_agents = actions.shape[1]
    for m in range(actions.shape[0]):
        first = mix(keys[m, 0] ^ _TAG)
        second = mix(episode_key(keys[m], episodes[m]) ^ _TAG)
        for i in range(n_agents):
            counter = np.uint64(steps[m]) * np.uint64(n_agents) + np.uint64(i)
            actions[m, i] = int(to_unit(draw(first, second, counter)) * N_ACTIONS)
