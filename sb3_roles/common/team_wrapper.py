"""``TeamWrapper``: observations that tell a policy which rows are one team."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_roles.common.team_vec_env import TeamVecEnv

AGENT_KEY = "agent"


def find_team_env(env: VecEnv | None) -> TeamVecEnv:
    """Return the ``TeamVecEnv`` below any wrappers.

    :param env: a vectorized environment
    :raises ValueError: if there is none
    """
    layer: Any = env
    while not isinstance(layer, TeamVecEnv):
        if not isinstance(layer, VecEnvWrapper):
            raise ValueError(
                f"a team algorithm needs an environment of make_team_vec_env, got {env}: its rows "
                "must be robots, contiguous by team"
            )
        layer = layer.venv
    return layer


class TeamWrapper(VecEnvWrapper):
    """Adds the key ``agent`` to each row's observation: the robot's index, and the team's size.

    A policy needs it to put the rows of a team together, whatever its size, and to notice when a
    buffer has torn teams apart. An observation that is no Dict becomes its key ``observation``.

    :param venv: an environment of ``make_team_vec_env``, possibly wrapped
    :raises ValueError: if the rows are not those of a ``TeamVecEnv``
    """

    def __init__(self, venv: VecEnv) -> None:
        self.team_env = find_team_env(venv)
        self.n_agents, self.n_teams = self.team_env.n_agents, self.team_env.n_teams
        space = venv.observation_space
        self._is_dict = isinstance(space, spaces.Dict)
        boxes = dict(space.spaces) if isinstance(space, spaces.Dict) else {"observation": space}
        # Unbounded: a saved policy must serve teams of any size.
        taken = [key for key in (AGENT_KEY, *self._extra_spaces()) if key in boxes]
        if taken:
            raise ValueError(
                f"the environment's observation has a key {taken[0]!r}, which the wrapper adds: "
                "rename it"
            )
        boxes[AGENT_KEY] = spaces.Box(0.0, np.inf, (2,), np.float32)
        boxes.update(self._extra_spaces())
        super().__init__(venv, observation_space=spaces.Dict(boxes))
        index = np.arange(self.n_agents, dtype=np.float32)
        size = np.full_like(index, self.n_agents)
        self._members = np.tile(np.stack([index, size], axis=1), (self.n_teams, 1))

    def _extra_spaces(self) -> dict[str, spaces.Space]:
        """Spaces of the keys that a subclass adds."""
        return {}

    def _extra_observations(self) -> dict[str, np.ndarray]:
        """Rows of the keys that a subclass adds; new arrays at every call."""
        return {}

    def _extend(self, observations: Any) -> dict[str, np.ndarray]:
        rows = dict(observations) if self._is_dict else {"observation": observations}
        rows[AGENT_KEY] = self._members
        rows.update(self._extra_observations())
        return rows

    def _extend_terminal(self, infos: list[dict[str, Any]]) -> None:
        """Add the same keys to the last observations of finished episodes, in place."""
        done = [row for row, info in enumerate(infos) if "terminal_observation" in info]
        extra = self._extra_observations() if done else {}
        for row in done:
            last = infos[row]["terminal_observation"]
            last = last if self._is_dict else {"observation": last}
            last[AGENT_KEY] = self._members[row]
            last.update({key: value[row] for key, value in extra.items()})
            infos[row]["terminal_observation"] = last

    def reset(self) -> dict[str, np.ndarray]:
        """Start new episodes.

        :return: observations, rows (n_teams * n_agents, ...)
        """
        return self._extend(self.venv.reset())

    def step_wait(self) -> VecEnvStepReturn:
        """Finish the step; see ``TeamVecEnv``."""
        observations, rewards, dones, infos = self.venv.step_wait()
        self._extend_terminal(infos)
        return self._extend(observations), rewards, dones, infos
