"""The fast lane: one environment object that steps all teams as arrays."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_roles.common.base_team_vec_env import TeamVecEnv
from sb3_roles.common.env_failures import called


class BatchedTeamEnv(Protocol):
    """
    The batched form of an environment, what its ``batched(n_teams)`` returns.

    Arrays may be overwritten in place by the next call; the caller copies. ``render_mode``,
    ``metadata``, ``goal_nearness`` and ``n_threads`` (threads that a step may use without changing
    its results; training sets it) are optional attributes.
    """

    n_teams: int
    n_agents: int
    possible_agents: list[str]
    observation_space: spaces.Dict
    """Of one robot, flat."""
    action_space: spaces.Space
    """Of one robot."""
    team_observation_keys: tuple[str, ...]
    reward_component_names: tuple[str, ...]
    metric_names: tuple[str, ...]

    @property
    def observations(self) -> dict[str, np.ndarray]:
        """Key -> ``(n_teams, n_agents, ...)``, or ``(n_teams, ...)`` for the team keys."""

    @property
    def rewards(self) -> np.ndarray:
        """Float32 ``(n_teams, n_agents)``."""

    @property
    def reward_components(self) -> np.ndarray:
        """Float32 ``(n_teams, n_agents, n_components)``."""

    @property
    def terminated(self) -> np.ndarray:
        """Bool ``(n_teams,)``."""

    @property
    def truncated(self) -> np.ndarray:
        """Bool ``(n_teams,)``."""

    @property
    def metrics(self) -> dict[str, np.ndarray]:
        """Name -> float64 ``(n_teams,)``."""

    def reset(self, seed: Sequence[int]) -> None:
        """Start the first episode of every team's stream, given one seed per team."""

    def reset_teams(self, done: np.ndarray) -> None:
        """
        Start the next episode of the own stream of each team that bool ``done (n_teams,)`` marks.

        Rewards, components, metrics and end flags of the last step stay as they are.
        """

    def step(self, actions: np.ndarray) -> None:
        """Step all teams with actions ``(n_teams, n_agents, ...)``; no automatic reset."""

    def episode_metrics(self, team: int) -> dict[str, float]:
        """Metrics of the episode that a team has just finished, before its reset."""

    def render(self, team: int, mode: str = "rgb_array") -> np.ndarray | None:
        """Render one team."""

    def close(self) -> None:
        """Release resources."""


class NativeTeamVecEnv(TeamVecEnv):
    """
    A :class:`TeamVecEnv` over the batched form of an environment.

    Observations are copied into two sets of buffers in turn: what ``reset()`` or ``step()``
    returned stays unchanged during one further step (SB3 stores the last observation after it has
    the next one) and is overwritten by the second. Buffers keep the memory layout of the source
    within a row, so a channels-last map is still channels-last in torch.

    :param batched: the environment; not used by anyone else from here on
    :param expand_team_observations: see :class:`TeamVecEnv`
    :param env: the environment that declares ``render_mode``, ``metadata`` and ``goal_nearness``,
        by default the batched form itself
    :raises ValueError: if its observation space is not a flat Dict, or a team key is not in it
    """

    observation_space: spaces.Dict

    def __init__(
        self,
        batched: BatchedTeamEnv,
        *,
        expand_team_observations: bool = True,
        env: object | None = None,
    ):
        if not isinstance(batched.observation_space, spaces.Dict):
            raise ValueError(
                "the native backend needs a Dict observation space, not "
                f"{batched.observation_space}: give its one array a key"
            )
        self.batched = batched
        self._slots: list[dict[str, np.ndarray]] = []
        super().__init__(
            batched if env is None else env,
            batched.n_teams,
            batched.possible_agents,
            batched.observation_space,
            batched.action_space,
            team_keys=tuple(batched.team_observation_keys),
            component_names=tuple(batched.reward_component_names),
            metric_names=tuple(batched.metric_names),
            expand_team_observations=expand_team_observations,
        )

    def _reset_all(
        self, seeds: list[int] | None, options: list[dict[str, Any]]
    ) -> dict[str, np.ndarray]:
        if any(options):
            raise ValueError(
                f"the native backend takes no reset options, got {options}: set them in the "
                "environment's constructor or use backend='supersuit'"
            )
        if seeds is None:
            self._called("reset_teams", np.ones(self.n_teams, bool))
        else:
            self._called("reset", seed=seeds)
        if not self._slots:
            self._check_observations()
            self._slots = [self._allocate() for _ in range(2)]
        return self._copy_observations()

    def _called(self, method: str, *args: Any, **kwargs: Any) -> None:
        called(self.batched, f"{method}()", getattr(self.batched, method), *args, **kwargs)

    def _lead(self, key: str) -> tuple[int, ...]:
        """Leading dimensions of a key's array in the batched environment."""
        return (self.n_teams,) if key in self.team_keys else (self.n_teams, self.n_agents)

    def _check_observations(self) -> None:
        arrays = {k: (v.shape, v.dtype) for k, v in self.batched.observations.items()}
        wanted = {
            key: ((*self._lead(key), *(space.shape or ())), space.dtype)
            for key, space in self.observation_space.spaces.items()
        }
        wrong = [key for key in {**wanted, **arrays} if arrays.get(key) != wanted.get(key)]
        if wrong:
            raise ValueError(
                "observations of the batched environment do not match its observation_space: "
                + "; ".join(f"{k!r} is {arrays.get(k)}, expected {wanted.get(k)}" for k in wrong)
            )

    def _allocate(self) -> dict[str, np.ndarray]:
        """One set of output arrays, by key: teams (and robots) first, as ``_copy_observations``."""
        slot = {}
        for key, source in self.batched.observations.items():
            once = key in self.team_keys and not self.expand_team_observations
            lead = (self.n_teams,) if once else (self.n_teams, self.n_agents)
            slot[key] = empty_rows(lead, source[(0,) * len(self._lead(key))])
        return slot

    def _copy_observations(self) -> dict[str, np.ndarray]:
        # The slot returned last time goes to the end of the queue: it is still in use.
        slot = self._slots.pop(0)
        self._slots.append(slot)
        observations = {}
        for key, source in self.batched.observations.items():
            target = slot[key]
            if key not in self.team_keys:
                np.copyto(target, source)
            elif self.expand_team_observations:
                np.copyto(target, source[:, None])
            else:
                np.copyto(target, source)
                observations[key] = target
                continue
            # A view, see empty_rows.
            observations[key] = target.reshape(self.num_envs, *target.shape[2:])
        return observations

    def step_wait(self) -> VecEnvStepReturn:
        """
        Step all teams; those that finish start their next episode.

        :return: observations, rewards float32 ``(num_envs,)``, dones bool ``(num_envs,)``, infos
        :raises NotFiniteError: if a reward or an observation is not finite
        :raises EnvironmentFailed: if the environment raises
        """
        batched = self.batched
        moves = self._actions.reshape(self.n_teams, self.n_agents, *self._actions.shape[1:])
        self._called("step", moves)
        # Copies, here and below: SB3 adds the value at the horizon to the rewards in place.
        rewards = np.array(batched.rewards, np.float32).reshape(self.num_envs)
        self.reward_components = np.array(batched.reward_components, np.float32).reshape(
            self.num_envs, len(self.component_names)
        )
        self._check_rewards(rewards)
        self.metrics = {
            name: np.array(batched.metrics[name], np.float64) for name in self.metric_names
        }
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        done = batched.terminated | batched.truncated
        if done.any():
            self._check_last(batched.observations)
            self._add_terminal_infos(infos, done)
            self._called("reset_teams", done)
        observations = self._copy_observations()
        self._check_seen(observations)
        return observations, rewards, np.repeat(done, self.n_agents), infos

    def _check_last(self, observations: dict[str, np.ndarray]) -> None:
        """Check them before the reset; values of the last ones are bootstrapped with."""
        by_row = {
            key: observations[key].reshape(-1, *observations[key].shape[len(self._lead(key)) :])
            for key in self._float_keys
        }
        self._check_seen(by_row, " at the end of an episode")

    def _add_terminal_infos(self, infos: list[dict[str, Any]], done: np.ndarray) -> None:
        """
        Fill the infos of the rows of finished teams, before these are reset.

        :param infos: one dict per row, changed in place
        :param done: bool ``(n_teams,)``
        """
        observations = self.batched.observations
        for team in np.flatnonzero(done).tolist():
            truncated = bool(self.batched.truncated[team] and not self.batched.terminated[team])
            metrics = self.batched.episode_metrics(team)
            for agent in range(self.n_agents):
                info = infos[team * self.n_agents + agent]
                info["terminal_observation"] = {
                    key: value[team if key in self.team_keys else (team, agent)].copy(order="K")
                    for key, value in observations.items()
                }
                info["TimeLimit.truncated"] = truncated
                if metrics:
                    info["episode_metrics"] = dict(metrics)

    def _team_env(self, team: int) -> object:
        return self.batched

    def _render_team(self, team: int, mode: str) -> np.ndarray | None:
        if mode == "rgb_array":  # The default; many batched forms know no other.
            return self.batched.render(team)
        return self.batched.render(team, mode=mode)

    def _close(self) -> None:
        self.batched.close()


def empty_rows(lead: tuple[int, ...], sample: np.ndarray) -> np.ndarray:
    """
    An uninitialized array of rows that are laid out in memory like a sample row.

    The leading axes are outermost and dense, so that merging them by ``reshape`` is a view, which
    ``np.empty_like(order="K")`` does not promise.

    :param lead: leading dimensions
    :param sample: one row, for example a ``(C, H, W)`` view of channels-last memory
    :return: shape ``(*lead, *sample.shape)``, dtype of the sample
    """
    # Axes of length 1 have arbitrary strides; a stable sort leaves them in place.
    order = sorted(range(sample.ndim), key=lambda axis: -abs(sample.strides[axis]))
    memory = np.empty((*lead, *(sample.shape[axis] for axis in order)), sample.dtype)
    back = [len(lead) + order.index(axis) for axis in range(sample.ndim)]
    return memory.transpose(*range(len(lead)), *back)
