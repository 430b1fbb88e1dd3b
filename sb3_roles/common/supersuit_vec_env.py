"""Any PettingZoo environment through SuperSuit, with what SuperSuit breaks repaired."""

import copy
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import supersuit
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_roles.common.base_team_vec_env import TeamVecEnv
from sb3_roles.common.env_declarations import (
    check_homogeneous,
    check_picklable_arrays,
    declared,
    declared_names,
)
from sb3_roles.common.env_failures import (
    RESET_PARTS,
    STEP_PARTS,
    EnvironmentFailed,
    called,
    env_class,
    parts_problem,
)
from sb3_roles.common.names import one_line

Observations = dict[str, np.ndarray] | np.ndarray


class TeamRecorder(ParallelEnv):
    """
    Sits between SuperSuit and one copy of the environment and keeps what SuperSuit would lose.

    * Reward components and metrics are taken out of the infos into arrays when the step is made;
      SuperSuit's automatic reset comes after that and can not overwrite them.
    * Infos of a reset are kept aside: SuperSuit merges them over those of the terminal step.
    * Observations and infos of the terminal step are copied: an environment that reuses its arrays
      would overwrite them in that reset.
    * Agents that are done before the others give a clear error, and so does what the environment
      raises; its steps are counted from the reset.
    * SuperSuit copies by pickling. That fails for windows, files and locks, and silently takes
      numpy views apart from the arrays they show (refused). Where there is a function that makes
      the environment, a copy is made by calling it instead.

    :param env: a PettingZoo environment with homogeneous agents
    :param make: a function without arguments that makes another one
    """

    def __init__(self, env: ParallelEnv, make: Callable[[], ParallelEnv] | None = None):
        self.env = env
        self.make = make
        self.possible_agents = list(env.possible_agents)
        # The base class finds all agents alive, in this order, after every reset and step.
        self.agents = self.possible_agents
        # SuperSuit requires both, PettingZoo neither.
        self.metadata = declared(env, "metadata") or {}
        self.render_mode = declared(env, "render_mode")
        self.component_names = declared_names(env, "reward_component_names")
        self.metric_names = declared_names(env, "metric_names")
        self.reset_infos: list[dict[str, Any]] = [{} for _ in self.possible_agents]
        self.component_values = np.zeros(
            (len(self.possible_agents), len(self.component_names)), np.float32
        )
        self.metric_values = np.zeros(len(self.metric_names))
        self._n_steps = 0

    def __reduce_ex__(self, protocol: Any) -> Any:
        return (_record, (self.make,)) if self.make else super().__reduce_ex__(protocol)

    def observation_space(self, agent: str) -> spaces.Space:
        """Observation space of an agent."""
        return self.env.observation_space(agent)

    def action_space(self, agent: str) -> spaces.Space:
        """Action space of an agent."""
        return self.env.action_space(agent)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Reset the environment; its infos go to ``reset_infos``, the returned ones are empty."""
        self._n_steps = 0
        observations, infos = self._called(
            "reset", RESET_PARTS, self.env.reset, seed=seed, options=options
        )
        self._check_alive(observations)
        self.reset_infos = [copy.deepcopy(infos.get(agent, {})) for agent in self.possible_agents]
        return observations, {}

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[
        dict[str, Any],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Step the environment and record components and metrics (see the class)."""
        self._n_steps += 1
        observations, rewards, terminations, truncations, foreign = self._called(
            f"step {self._n_steps}", STEP_PARTS, self.env.step, actions
        )
        self._check_alive(observations)
        infos: dict[str, dict[str, Any]] = {}
        for row, agent in enumerate(self.possible_agents):
            info = dict(foreign.get(agent, {}))
            if self.component_names:
                self.component_values[row] = self._take(
                    info, agent, "reward_components", self.component_names
                )
            if self.metric_names:
                values = self._take(info, agent, "metrics", self.metric_names)
                if row == 0:
                    self.metric_values[:] = values
            infos[agent] = copy.deepcopy(info) if info else info
        over = [
            agent
            for agent in self.possible_agents
            if terminations.get(agent, False) or truncations.get(agent, False)
        ]
        if over:
            running = [agent for agent in self.possible_agents if agent not in over]
            if running:
                raise self._refused(
                    f"agents {over} are done while {running} are not: the agents of a team must "
                    "finish together. Keep them alive and idle to the end of the episode"
                )
            observations = copy.deepcopy(observations)
        return observations, rewards, terminations, truncations, infos

    def _called(
        self,
        where: str,
        names: tuple[str, ...],
        function: Callable[..., Any],
        *args: Any,
        **kw: Any,
    ) -> Any:
        result = called(self.env, where, function, *args, **kw)
        problem = parts_problem(result, names)
        if problem is not None:
            raise self._refused(problem)
        return result

    def _check_alive(self, observations: Mapping[str, object]) -> None:
        missing = [agent for agent in self.possible_agents if agent not in observations]
        if missing:
            raise self._refused(
                f"no observation for agents {missing}: all of {self.possible_agents} must "
                "be there from reset() to the end of the episode"
            )

    def _take(
        self, info: dict[str, Any], agent: str, key: str, names: tuple[str, ...]
    ) -> list[float]:
        """
        Take the declared values of one kind out of an agent's info.

        :param info: changed in place
        :param agent: name of the agent, for the error
        :param key: ``"reward_components"`` or ``"metrics"``
        :param names: names that the environment declares
        :raises EnvironmentFailed: if the key or one of the names is not there
        """
        values = info.pop(key, None)
        if values is None:
            raise self._refused(
                f"infos[{agent!r}] has no {key!r}, although the environment declares {names}: put "
                "a dict of floats there at every step, or do not declare them"
            )
        missing = [name for name in names if name not in values]
        if missing:
            raise self._refused(
                f"infos[{agent!r}][{key!r}] has {list(values)}, but not the declared {missing}"
            )
        return [values[name] for name in names]

    def _refused(self, text: str) -> EnvironmentFailed:
        where = f"step {self._n_steps}" if self._n_steps else "reset"
        return EnvironmentFailed(f"environment {env_class(self.env)}: {where}: {text}")

    def render(self) -> Any:
        """Render the environment."""
        return called(self.env, "render", self.env.render)

    def close(self) -> None:
        """Close the environment."""
        called(self.env, "close", self.env.close)


def _record(make: Callable[[], ParallelEnv]) -> TeamRecorder:
    return TeamRecorder(make(), make)


class SuperSuitTeamVecEnv(TeamVecEnv):
    """
    A :class:`TeamVecEnv` over copies of a PettingZoo ``ParallelEnv``, made by SuperSuit.

    Optional attributes of the environment: ``team_observation_keys``, ``goal_nearness``,
    ``reward_component_names``, ``metric_names``. With the last two, ``infos[agent]`` of every step
    holds ``"reward_components"`` and ``"metrics"`` (the same for all agents), each a dict
    name -> float.

    All copies run in this process: SuperSuit's workers are slower for cheap environments, share
    seeds, and hang the interpreter at exit.

    :param env: the environment; it is copied ``n_teams`` times and not used itself
    :param n_teams: number of teams
    :param make: a function without arguments that makes such an environment. Without it copies are
        made by pickling, which not every environment survives
    :param expand_team_observations: see :class:`TeamVecEnv`
    :raises ValueError: if the agents differ in their spaces, SB3 can not take the observation
        space, a team key is not in it, or the environment can not be copied
    """

    def __init__(
        self,
        env: ParallelEnv,
        n_teams: int,
        *,
        make: Callable[[], ParallelEnv] | None = None,
        expand_team_observations: bool = True,
    ):
        check_homogeneous(env)
        if make is None:
            check_picklable_arrays(env)
        recorder = TeamRecorder(env, make)
        vec_env = supersuit.pettingzoo_env_to_vec_env_v1(recorder)
        # The class of SuperSuit for SB3 has already merged termination with truncation.
        self._vec = supersuit.concat_vec_envs_v1(
            vec_env, n_teams, num_cpus=0, base_class="gymnasium"
        )
        self._recorders: list[TeamRecorder] = [copied.par_env for copied in self._vec.vec_envs]
        if len({id(recorder.env) for recorder in self._recorders}) < n_teams:
            raise ValueError(
                f"{make} returns the same environment at every call: make a new one in it"
            )
        super().__init__(
            env,
            n_teams,
            recorder.possible_agents,
            vec_env.observation_space,
            vec_env.action_space,
            team_keys=declared_names(env, "team_observation_keys"),
            component_names=recorder.component_names,
            metric_names=recorder.metric_names,
            expand_team_observations=expand_team_observations,
        )

    def _reset_all(self, seeds: list[int] | None, options: list[dict[str, Any]]) -> Observations:
        # One by one: SuperSuit's own reset would seed copy i with seed + i.
        with self._telling():
            parts = [
                copied.reset(seed=seeds and seeds[team], options=options[team] or None)
                for team, copied in enumerate(self._vec.vec_envs)
            ]
            observations = self._vec.concat_obs([part[0] for part in parts])
        self.reset_infos = [info for recorder in self._recorders for info in recorder.reset_infos]
        self._check_team_keys(observations)
        return self._collapse(observations)

    @contextmanager
    def _telling(self) -> Iterator[None]:
        """Tell what SuperSuit fails on, such as an observation of another shape."""
        try:
            yield
        except EnvironmentFailed:
            raise
        except (TypeError, LookupError, AttributeError, ValueError) as error:
            raise EnvironmentFailed(
                f"environment {env_class(self._recorders[0].env)}: what it returned can not be put "
                f"together: {type(error).__name__}: {one_line(error)}"
            ) from error

    def _check_team_keys(self, observations: Observations) -> None:
        """Refuse a wrong declaration; at resets only, because it reads every map."""
        for key in self.team_keys:
            rows = np.asarray(observations[key])
            teams = rows.reshape(self.n_teams, self.n_agents, *rows.shape[1:])
            differs = (teams != teams[:, :1]).reshape(self.n_teams, self.n_agents, -1).any(axis=2)
            if differs.any():
                team, agent = np.argwhere(differs)[0]
                raise ValueError(
                    f"observation {key!r} is declared in team_observation_keys, but in team {team} "
                    f"{self.agents[agent]!r} sees another one than {self.agents[0]!r}"
                )

    def _collapse(self, observations: Observations) -> Observations:
        """Team keys once per team, if so configured."""
        if self.expand_team_observations or not isinstance(observations, dict):
            return observations
        first = {key: observations[key][:: self.n_agents].copy() for key in self.team_keys}
        return {**observations, **first}

    def step_wait(self) -> VecEnvStepReturn:
        """
        Step all teams; those that finish start their next episode.

        :return: observations, rewards float32 ``(num_envs,)``, dones bool ``(num_envs,)``, infos
        :raises NotFiniteError: if a reward or an observation is not finite
        :raises EnvironmentFailed: if the environment raises or returns something else than dicts,
            agents do not finish together, or a declared reward component or metric is missing
        """
        with self._telling():
            observations, rewards, terminated, truncated, infos = self._vec.step(self._actions)
        if self.component_names:
            self.reward_components = np.concatenate([r.component_values for r in self._recorders])
        self._check_rewards(rewards)
        self._check_seen(observations)
        if self.metric_names:
            values = np.stack([recorder.metric_values for recorder in self._recorders], axis=1)
            self.metrics = dict(zip(self.metric_names, values, strict=True))
        dones = (terminated | truncated).astype(bool)
        if dones.any():
            self._check_last(infos)
        for row in np.flatnonzero(dones).tolist():
            infos[row]["TimeLimit.truncated"] = bool(truncated[row] and not terminated[row])
            team, agent = divmod(row, self.n_agents)
            self.reset_infos[row] = self._recorders[team].reset_infos[agent]
        return self._collapse(observations), rewards, dones, infos

    def _check_last(self, infos: list[dict[str, Any]]) -> None:
        """Check the last observations of finished episodes, which are bootstrapped with."""
        for row, info in enumerate(infos):
            last = info.get("terminal_observation")
            if last is None:
                continue
            for key in self._float_keys:
                part = last[key] if key else last
                if not np.isfinite(part).all():
                    every = np.zeros((self.num_envs, *np.shape(part)), np.float32)
                    every[row] = part
                    self._check_seen({key: every} if key else every, " at the end of an episode")

    def _team_env(self, team: int) -> object:
        return self._recorders[team].env

    def _render_team(self, team: int, mode: str) -> np.ndarray | None:
        return self._recorders[team].render()

    def _close(self) -> None:
        errors = []
        for recorder in self._recorders:
            try:
                recorder.close()
            except EnvironmentFailed as error:
                errors.append(error)
        if errors:
            raise errors[0]
