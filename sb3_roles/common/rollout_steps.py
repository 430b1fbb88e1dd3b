"""Rollouts step by step: played here, by the groups of teams of one environment."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv

from sb3_roles.common.env_state import take_rows
from sb3_roles.common.policies import Observation, Streams, TeamPolicy
from sb3_roles.common.rollouts import (
    Acted,
    TeamGroup,
    act,
    expected_values,
    join,
    truncation_values,
)
from sb3_roles.common.team_wrapper import find_team_env
from sb3_roles.common.threads import ThreadCrew

Observations = Mapping[str, np.ndarray]


class Step(NamedTuple):
    """One joint step of all teams: what SB3's callbacks see of it, and what the buffer keeps."""

    obs: Observation
    """before the step, as ``TeamPolicy.prepare`` returns it"""
    chosen: Streams
    actions: np.ndarray
    """int64 (n, S)"""
    new_obs: dict[str, np.ndarray]
    """after the step, of the environment"""
    rewards: np.ndarray
    """float32 (n,)"""
    dones: np.ndarray
    """bool (n,)"""
    infos: list[dict[str, Any]]
    stream_rewards: th.Tensor
    """float32 (n, S), with the value of the last observation where an episode was cut off"""


class Rollout(NamedTuple):
    """A rollout that is under way."""

    steps: Iterator[Step]
    last_values: Callable[[], th.Tensor]
    """after the last step, float32 (n, S): the values to bootstrap with"""


class Learner(Protocol):
    """What a rollout asks of an algorithm."""

    policy: TeamPolicy

    @property
    def device(self) -> th.device:
        """Where the policy is."""

    def discounts(self) -> th.Tensor:
        """Return the discount of each stream, float32 (S,)."""

    def to_env(self, actions: np.ndarray) -> np.ndarray:
        """Turn int64 (n, S) choices into the environment's actions."""

    def stream_rewards(self, env: VecEnv, rewards: np.ndarray) -> np.ndarray:
        """Return the rewards of each stream in the last step, float32 (n, S)."""


class RolloutPlayer(Protocol):
    """Plays rollouts, here or elsewhere."""

    def play(
        self, env: VecEnv, groups: list[TeamGroup], observations: Observations, n_steps: int
    ) -> AbstractContextManager[Rollout]:
        """Begin a rollout, within which torch has the threads that a rollout works with.

        After the last step the environment is where the rollout has ended; after each of them the
        records of the last step are readable: ``metrics`` and ``reward_components`` of the
        ``TeamVecEnv``, roles and ``stream_rewards`` of the ``RoleWrapper``.

        :param env: of all teams
        :param groups: of these teams, in order
        :param observations: what the teams see now
        :param n_steps: joint steps to play
        """


def inner_threads(groups: list[TeamGroup]) -> int | None:
    """Return the threads inside of operations: one for several groups, None for all of torch's.

    Rounding may depend on it, and several groups shall not depend on the number of threads.
    """
    return 1 if len(groups) > 1 else None


class LocalPlayer:
    """Plays all groups in one environment, side by side on threads.

    :param learner: the algorithm
    """

    def __init__(self, learner: Learner) -> None:
        self._learner = learner

    @contextmanager
    def play(
        self, env: VecEnv, groups: list[TeamGroup], observations: Observations, n_steps: int
    ) -> Iterator[Rollout]:
        """Begin a rollout, see :class:`RolloutPlayer`."""
        device = self._learner.device
        generators = [group.generator(device) for group in groups]
        with ThreadCrew(len(groups), device, inner_threads(groups)) as crew:
            table = _Table(env, crew, groups, generators)
            seen = [observations]

            def steps() -> Iterator[Step]:
                for _ in range(n_steps):
                    step = self.step(table, seen[0])
                    seen[0] = step.new_obs
                    yield step

            yield Rollout(steps(), lambda: self.last_values(table, seen[0]))

    def step(self, table: _Table, observations: Observations) -> Step:
        """Play one step of all teams."""
        obs, chosen = self.act(table, observations)
        actions = chosen.actions.cpu().numpy()
        new_obs, rewards, dones, infos = table.env.step(self._learner.to_env(actions))
        given = self._learner.stream_rewards(table.env, rewards)
        # A copy: the values at truncations are added to it.
        paid = th.tensor(given, device=self._learner.device)
        if dones.any():
            self.bootstrap(table, paid, dones, infos)
        return Step(obs, chosen, actions, new_obs, rewards, dones, infos, paid)  # type: ignore[arg-type]

    def act(self, table: _Table, observations: Observations) -> Acted:
        """Choose the actions of all teams."""

        def of_group(member: _Member) -> Acted:
            return act(self._learner.policy, table.view(observations, member), member.generator)

        return join(table.crew.map(of_group, table.members))

    def bootstrap(
        self, table: _Table, paid: th.Tensor, dones: np.ndarray, infos: list[dict[str, Any]]
    ) -> None:
        """Add the value of the last observation to the last reward of truncated episodes.

        :param paid: float (n, S), changed in place
        """

        def of_group(member: _Member) -> Any:
            return truncation_values(self._learner.policy, member.group.rows, dones, infos)

        for part in table.crew.map(of_group, table.members):
            if part is not None:
                rows = th.as_tensor(part.rows, device=paid.device)
                counts = th.as_tensor(part.truncated, device=paid.device).unsqueeze(1)
                paid[rows] += self._learner.discounts() * part.values * counts

    def last_values(self, table: _Table, observations: Observations) -> th.Tensor:
        """Return the values of all teams, float (n, S)."""

        def of_group(member: _Member) -> th.Tensor:
            return expected_values(self._learner.policy, table.view(observations, member))

        return th.cat(table.crew.map(of_group, table.members))


class _Member(NamedTuple):
    group: TeamGroup
    generator: th.Generator


class _Table:
    """Who plays in a rollout, and where."""

    def __init__(
        self,
        env: VecEnv,
        crew: ThreadCrew,
        groups: list[TeamGroup],
        generators: list[th.Generator],
    ) -> None:
        self.env, self.crew = env, crew
        self.members = [_Member(*pair) for pair in zip(groups, generators, strict=True)]
        self._n_teams = find_team_env(env).n_teams

    def view(self, observations: Observations, member: _Member) -> Observations:
        """Return what a group sees of the observations of all teams."""
        if len(self.members) == 1:
            return observations
        return take_rows(observations, member.group.teams, self._n_teams)
