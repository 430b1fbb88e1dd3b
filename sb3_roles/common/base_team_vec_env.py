"""The abstract vectorized environment of robot teams, and how its teams are seeded."""

import warnings
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvObs

from sb3_roles.common.env_declarations import (
    check_observation_space,
    declared,
    declared_goals,
    env_layers,
)
from sb3_roles.common.not_finite import NotFiniteError


def team_seeds(seed: int | None, n: int) -> list[int]:
    """
    One independent seed per team.

    The children of a ``SeedSequence`` are prefix-stable: team ``i`` gets the same seed whatever
    ``n`` is, and no seed ``s`` shares a stream with ``s + 1`` (SB3's ``seed + i`` shares all but
    one).

    :param seed: the seed of the whole set, or ``None`` for fresh entropy
    :param n: number of teams
    :return: ``n`` integers in ``[0, 2**32)``, which old-style environments take too
    """
    children = np.random.SeedSequence(seed).spawn(n)
    return [int(child.generate_state(1)[0]) for child in children]


class TeamVecEnv(VecEnv):
    """
    A vectorized environment whose rows are robots, contiguous by team.

    Row ``team * n_agents + agent`` is robot ``agent`` of team ``team``. The robots of a team finish
    their episodes together. Stable-Baselines3 sees ``n_teams * n_agents`` independent rows; what
    is there for multi-agent algorithms comes on top:

    * ``reward_components``: float32 ``(num_envs, n_components)``, of the last step;
    * ``metrics``: name -> float64 ``(n_teams,)``, of the last step; for a team whose episode has
      just ended these are the final values, not those after the reset;
    * ``team_keys``: keys of a Dict observation that are the same for all robots of a team;
    * ``goal_nearness``: where robots observe how near their goals are, see ``declared_goals``.

    The first two are zero after ``reset()``, and fresh arrays at every step.

    The info of a row that is not done holds what the environment put there, and nothing else. That
    of a finished row also holds ``"terminal_observation"`` (the row's own, a copy),
    ``"TimeLimit.truncated"`` (truncated and not terminated) and, where the environment has it,
    ``"episode_metrics"``.

    :param env: the environment that declares ``metadata``, ``render_mode`` and ``goal_nearness``,
        all optional
    :param n_teams: number of teams
    :param agents: names of the robots of a team, in row order
    :param observation_space: of one robot: a flat Dict, or a simple space
    :param action_space: of one robot
    :param team_keys: observation keys that are shared by a team
    :param component_names: names of the reward components, the columns of ``reward_components``
    :param metric_names: names of the team metrics, the keys of ``metrics``
    :param expand_team_observations: ``True`` (the SB3 interface) repeats the value of a team key
        for each robot, so that all arrays have ``num_envs`` rows; ``False`` returns it once per
        team, with leading dimension ``n_teams``. ``observation_space`` is per robot in both cases.
    :raises ValueError: if SB3 can not take the observation space, or a key that is declared is not
        in it
    """

    def __init__(
        self,
        env: object,
        n_teams: int,
        agents: Sequence[str],
        observation_space: spaces.Space,
        action_space: spaces.Space,
        *,
        team_keys: tuple[str, ...] = (),
        component_names: tuple[str, ...] = (),
        metric_names: tuple[str, ...] = (),
        expand_team_observations: bool = True,
    ):
        check_observation_space(observation_space, team_keys)
        self.n_teams = n_teams
        self.n_agents = len(agents)
        self.agents = list(agents)
        self.team_keys = team_keys
        self.component_names = component_names
        self.metric_names = metric_names
        self.goal_nearness = declared_goals(env, observation_space, team_keys)
        self.expand_team_observations = expand_team_observations
        # SB3 asks for it through get_attr in its constructor; PettingZoo does not require it.
        self._declared_render_mode = declared(env, "render_mode")
        self._started = False
        self._closed = False
        super().__init__(n_teams * self.n_agents, observation_space, action_space)
        self.metadata = {**self.metadata, **(declared(env, "metadata") or {})}
        self._float_keys = _float_keys(observation_space)
        self._clear_records()

    def _clear_records(self) -> None:
        self.reward_components = np.zeros((self.num_envs, len(self.component_names)), np.float32)
        self.metrics = {name: np.zeros(self.n_teams) for name in self.metric_names}

    @abstractmethod
    def _reset_all(
        self, seeds: list[int] | None, options: list[dict[str, Any]]
    ) -> dict[str, np.ndarray] | np.ndarray:
        """
        Start a new episode in every team.

        :param seeds: one per team, or ``None`` to go on with each team's own stream
        :param options: reset options, one dict per team, empty where there are none
        :return: observations of all rows
        """

    @abstractmethod
    def _team_env(self, team: int) -> object:
        """
        The object that answers ``get_attr``, ``set_attr`` and ``env_method`` for a team.

        :param team: index of the team
        """

    @abstractmethod
    def _render_team(self, team: int, mode: str) -> np.ndarray | None:
        """
        Render one team.

        :param team: index of the team
        :param mode: the environment's render mode
        """

    @abstractmethod
    def _close(self) -> None:
        """Release the environments; called once."""

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """
        Set the seeds to be used at the next ``reset()``, see :func:`team_seeds`.

        :param seed: the seed of the whole set, ``None`` for fresh entropy
        :return: the team's seed for each row
        """
        per_team = team_seeds(seed, self.n_teams)
        self._seeds = [value for value in per_team for _ in range(self.n_agents)]
        return self._seeds

    def reset(self) -> VecEnvObs:
        """
        Start a new episode in every team.

        The seeds of the last ``seed()`` are used once. Without any, the first reset takes fresh
        entropy, because copies of one environment would otherwise share a stream; later ones go on
        with the streams.

        :return: observations, one row per robot
        """
        seeds: list[int] | None
        seeds = [value for value in self._seeds[:: self.n_agents] if value is not None]
        if len(seeds) < self.n_teams:
            seeds = None if self._started else team_seeds(None, self.n_teams)
        options = self._options[:: self.n_agents]
        self._clear_records()
        observations = self._reset_all(seeds, options)
        self._check_seen(observations, " after reset()")
        self._reset_seeds()
        self._reset_options()
        self._started = True
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """
        Take the actions of the step that ``step_wait()`` computes.

        :param actions: ``(num_envs, *action_space.shape)``
        :raises ValueError: if the shape is another one
        :raises RuntimeError: if the environment was never reset
        """
        if not self._started:
            raise RuntimeError(
                "step() before the first reset(): call reset() to start the episodes"
            )
        actions = np.asarray(actions)
        expected = (self.num_envs, *(self.action_space.shape or ()))
        if actions.shape != expected:
            raise ValueError(
                f"actions have shape {actions.shape}, expected {expected}: one row for each of "
                f"{self.n_teams} teams x {self.n_agents} agents, contiguous by team"
            )
        self._actions = actions

    def _check_rewards(self, rewards: np.ndarray) -> None:
        """
        Refuse rewards, or components of them, that would poison the returns.

        :param rewards: float32, ``num_envs`` elements in row order; ``reward_components`` are set
        :raises NotFiniteError: naming team and agent, if one is NaN or infinite
        """
        self._check_finite("reward", rewards.ravel(), "correct the environment's reward function")
        if self.component_names:
            advice = f"correct one of the components {', '.join(self.component_names)}"
            self._check_finite("reward component", self.reward_components, advice)

    def _check_seen(self, observations: VecEnvObs, when: str = "") -> None:
        """
        Refuse observations that would poison the networks; integers are always finite.

        :param observations: of all rows, or of all teams for keys that are given once per team
        :param when: added to the message
        :raises NotFiniteError: naming key, team and agent, if a number is NaN or infinite
        """
        for key in self._float_keys:
            values: Any = observations[key] if isinstance(observations, dict) else observations
            what = f"observation {key!r}{when}" if key else f"observation{when}"
            self._check_finite(what, values, "correct what the environment observes")

    def _check_finite(self, what: str, values: np.ndarray, advice: str) -> None:
        finite = np.isfinite(values)
        if finite.all():
            return
        rows = finite.reshape(len(values), -1)
        row = int(np.flatnonzero(~rows.all(axis=1))[0])
        value = values.reshape(len(values), -1)[row][~rows[row]][0]
        if len(values) == self.num_envs:
            team, agent = divmod(row, self.n_agents)
            of = f"team {team}, agent {self.agents[agent]!r} (row {row})"
        else:
            of = f"team {row}"
        raise NotFiniteError(
            what.split()[0],
            f"{what} {value} of {of} is not finite in {values.dtype}: {advice}",
            {what.split()[0]: values},
        )

    def _teams_of(self, indices: VecEnvIndices) -> list[int]:
        # range()[row] counts negative rows from the end and refuses those out of range.
        return [range(self.num_envs)[row] // self.n_agents for row in self._get_indices(indices)]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        An attribute of the environment of each row's team.

        On the native backend all teams are one batched environment: the value is the same for each.

        :param attr_name: attribute name
        :param indices: rows, all by default
        :return: one value per row
        :raises AttributeError: if the environment does not have it
        """
        values = []
        for team in self._teams_of(indices):
            env = self._team_env(team)
            if attr_name == "render_mode" and not hasattr(env, attr_name):
                values.append(self._declared_render_mode)
            else:
                values.append(getattr(env, attr_name))
        return values

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        Set an attribute in the environments of the rows' teams (for all teams on the native one).

        It is set on the outermost layer that has it, or on the innermost if none has: set on a
        wrapper, it would hide the attribute and change nothing.

        :param attr_name: attribute name
        :param value: the new value
        :param indices: rows, all by default
        """
        for team in dict.fromkeys(self._teams_of(indices)):
            layers = env_layers(self._team_env(team))
            owners = [x for x in layers if attr_name in vars(x) or hasattr(type(x), attr_name)]
            setattr((owners or layers[-1:])[0], attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """
        Call a method of the environments of the rows' teams.

        It is called once per environment, not once per row: once per team, or a single time on the
        native backend.

        :param method_name: method name
        :param method_args: positional arguments
        :param indices: rows, all by default
        :param method_kwargs: keyword arguments
        :return: for each row what its team's environment returned
        :raises AttributeError: if the environment does not have the method
        """
        envs = [self._team_env(team) for team in self._teams_of(indices)]
        results = {
            key: getattr(env, method_name)(*method_args, **method_kwargs)
            for key, env in {id(env): env for env in envs}.items()
        }
        return [results[id(env)] for env in envs]

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None
    ) -> list[bool]:
        """
        Whether the environment of each row's team is wrapped.

        :param wrapper_class: a wrapper class, of gymnasium or PettingZoo
        :param indices: rows, all by default
        """
        return [
            any(isinstance(layer, wrapper_class) for layer in env_layers(self._team_env(team)))
            for team in self._teams_of(indices)
        ]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """One RGB image per team (not per row), ``None`` without ``render_mode="rgb_array"``."""
        if self.render_mode != "rgb_array":
            warnings.warn(
                f"no images: render_mode is {self.render_mode!r}, not 'rgb_array'", stacklevel=2
            )
            return [None] * self.n_teams
        return [self._render_team(team, "rgb_array") for team in range(self.n_teams)]

    def render(self, mode: str | None = None) -> np.ndarray | None:
        """
        Render all teams; their images are tiled to one for ``"rgb_array"``.

        :param mode: ``None``, or the ``render_mode`` of the environment; ``"human"`` also shows the
            images of ``"rgb_array"``
        """
        if self.render_mode in (None, "rgb_array") or mode not in (None, self.render_mode):
            return super().render(mode)
        # SB3 would call env.render() for each row.
        for team in range(self.n_teams):
            self._render_team(team, str(self.render_mode))
        return None

    def close(self) -> None:
        """Release the environments; does nothing when called again."""
        if not self._closed:
            self._closed = True
            self._close()


def _float_keys(space: spaces.Space) -> tuple[str, ...]:
    """Keys of an observation that may be NaN; ``""`` for an observation without keys."""
    parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
    return tuple(
        key
        for key, part in parts.items()
        if part.dtype is not None and np.issubdtype(part.dtype, np.floating)
    )
