"""Rollouts of single groups, as functions of plain data, and how they become one rollout again.

What a group does in a rollout is a function of the policy's weights, the state of its teams and of
their wrappers, what they see, and the seed of its generator. Whoever computes it, and however often
it is tried, gets the same.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv

from sb3_roles.common.env_state import (
    EnvState,
    env_state,
    join_rows,
    join_states,
    laid_out_like,
    parts_gap,
    set_env_state,
    set_wrapper_states,
    take_rows,
    take_state,
    wrapper_states,
)
from sb3_roles.common.policies import Streams
from sb3_roles.common.role_wrapper import role_wrapper_of
from sb3_roles.common.rollout_steps import (
    Learner,
    LocalPlayer,
    Observations,
    Rollout,
    Step,
    inner_threads,
)
from sb3_roles.common.rollouts import TeamGroup
from sb3_roles.common.team_wrapper import find_team_env
from sb3_roles.common.threads import ThreadCrew

Frame = dict[str, dict[str, np.ndarray]]
"""What one step leaves, by kind and name; all arrays have rows in the order of the teams."""
_WRAPPER = "wrapper_"


class GroupTask(NamedTuple):
    """A rollout of one group, to be played."""

    n_teams: int
    n_agents: int
    seed: int
    state: EnvState
    observations: dict[str, np.ndarray]
    n_steps: int


class GroupRecord(NamedTuple):
    """A rollout of one group, as it was played."""

    film: Frame
    """with the steps as the first dimension, float, int, uint8 and bool (n_steps, rows, ...)"""
    infos: list[dict[int, dict[str, Any]]]
    """of each step, those that are not empty, by row of the group"""
    last_values: np.ndarray
    """float32 (n, S)"""
    state: EnvState
    """after the last step"""


def divide(
    env: VecEnv,
    state: EnvState,
    groups: Sequence[TeamGroup],
    observations: Observations,
    n_steps: int,
) -> list[GroupTask]:
    """Make the tasks of a rollout.

    :param env: of all teams
    :param state: its state, which can be divided
    :param groups: in order
    :param observations: what the teams see
    :param n_steps: joint steps
    """
    team_env = find_team_env(env)
    return [
        GroupTask(
            group.teams.stop - group.teams.start,
            team_env.n_agents,
            group.seed,
            take_state(env, state, group.teams),
            take_rows(observations, group.teams, team_env.n_teams),
            n_steps,
        )
        for group in groups
    ]


class GroupStage:
    """Plays tasks of groups of one size, one after the other.

    :param learner: whose policy acts; its weights are replaced
    :param env: of as many teams as a group has; it is reset
    """

    def __init__(self, learner: Learner, env: VecEnv) -> None:
        self._learner, self._env = learner, env
        self._templates: Any = env.reset()

    def play(self, task: GroupTask, weights: Mapping[str, th.Tensor]) -> GroupRecord:
        """Play one task; nothing that was played before has an influence.

        :param task: of a group of this size
        :param weights: of the policy
        """
        policy = self._learner.policy
        policy.load_state_dict(weights)
        policy.set_training_mode(False)
        set_env_state(self._env, task.state)
        seen = {
            key: laid_out_like(self._templates[key], value)
            for key, value in task.observations.items()
        }
        group = TeamGroup(slice(0, task.n_teams), slice(0, task.n_teams * task.n_agents), task.seed)
        film: Frame = {}
        infos: list[dict[int, dict[str, Any]]] = []
        player = LocalPlayer(self._learner)
        with player.play(self._env, [group], seen, task.n_steps) as rollout:
            for t, step in enumerate(rollout.steps):
                for kind, arrays in _frame(step, self._env).items():
                    kept = film.setdefault(kind, {})
                    for name, array in arrays.items():
                        if t == 0:
                            kept[name] = np.empty((task.n_steps, *array.shape), array.dtype)
                        kept[name][t] = array
                infos.append({row: info for row, info in enumerate(step.infos) if info})
            last_values = rollout.last_values().numpy()
        return GroupRecord(film, infos, last_values, env_state(self._env))


def _frame(step: Step, env: VecEnv) -> Frame:
    """Return what a step leaves, as views."""
    team_env, roles = find_team_env(env), role_wrapper_of(env)
    chosen = step.chosen
    frame = {
        "obs": {key: value.numpy() for key, value in step.obs.items()},
        "chosen": {
            "actions": chosen.actions.numpy(),
            "values": chosen.values.numpy(),
            "expected_values": chosen.expected_values.numpy(),
            "active": chosen.active.numpy(),
        },
        "log_probs": {str(s): one.numpy() for s, one in enumerate(chosen.log_probs)},
        "new_obs": dict(step.new_obs),
        "step": {
            "rewards": step.rewards,
            "dones": step.dones,
            "paid": step.stream_rewards.numpy(),
        },
        "metrics": dict(team_env.metrics),
        "components": {"": team_env.reward_components},
        "roles": {} if roles is None else {"": roles.stream_rewards},
    }
    for k, state in enumerate(wrapper_states(env)):
        frame[f"{_WRAPPER}{k}"] = dict(state)
    return frame


def replay(
    env: VecEnv, groups: Sequence[TeamGroup], records: Sequence[GroupRecord]
) -> Iterator[Step]:
    """Go through a rollout that was played elsewhere.

    With each step the environment gets the records of that step, with the last one the state, too.

    :param env: of all teams
    :param groups: in order
    :param records: of these groups
    """
    n_steps = len(records[0].infos)
    for t in range(n_steps):
        frame = {
            kind: join_rows(
                [{name: array[t] for name, array in one.film[kind].items()} for one in records]
            )
            for kind in records[0].film
        }
        infos: list[dict[str, Any]] = [{} for _ in range(env.num_envs)]
        for group, record in zip(groups, records, strict=True):
            for row, info in record.infos[t].items():
                infos[group.rows.start + row] = info
        if t == n_steps - 1:
            set_env_state(env, join_states(env, [record.state for record in records]))
        _show(frame, env)
        yield _step(frame, infos)


class RolloutsLost(RuntimeError):
    """Whoever played the tasks is gone, and will not come back; one line."""


class TaskPlayer(ABC):
    """Plays every group of a rollout as a task of its own; the steps are replayed afterwards.

    :param learner: the algorithm, on the CPU
    """

    def __init__(self, learner: Learner) -> None:
        self._learner = learner

    @abstractmethod
    def run(
        self, tasks: Sequence[GroupTask], weights: Mapping[str, th.Tensor]
    ) -> list[GroupRecord]:
        """Play some tasks, anywhere.

        :param tasks: of the groups
        :param weights: of the policy
        :return: in the order of the tasks
        """

    @contextmanager
    def play(
        self, env: VecEnv, groups: list[TeamGroup], observations: Observations, n_steps: int
    ) -> Iterator[Rollout]:
        """Play a rollout, and begin to replay it; see ``RolloutPlayer``.

        :raises ValueError: if the state of the environment can not be divided by teams
        """
        state = env_state(env)
        gap = parts_gap(env, state)
        if gap is not None:
            raise ValueError(gap)
        tasks = divide(env, state, groups, observations, n_steps)
        records = self.run(tasks, self._learner.policy.state_dict())
        last_values = np.concatenate([record.last_values for record in records])
        # Callbacks compute, too: on as many threads as where the rollout is played here.
        with ThreadCrew(1, self._learner.device, inner_threads(groups)):
            yield Rollout(replay(env, groups, records), lambda: th.from_numpy(last_values))


def _show(frame: Frame, env: VecEnv) -> None:
    """Let an environment say what it would after the step."""
    team_env, roles = find_team_env(env), role_wrapper_of(env)
    team_env.metrics = frame["metrics"]
    team_env.reward_components = frame["components"][""]
    if roles is not None:
        roles.stream_rewards = frame["roles"][""]
    n_wrappers = sum(kind.startswith(_WRAPPER) for kind in frame)
    set_wrapper_states(env, [frame[f"{_WRAPPER}{k}"] for k in range(n_wrappers)])


def _step(frame: Frame, infos: list[dict[str, Any]]) -> Step:
    chosen = {name: th.from_numpy(array) for name, array in frame["chosen"].items()}
    log_probs = frame["log_probs"]
    streams = Streams(
        chosen["actions"],
        tuple(th.from_numpy(log_probs[str(s)]) for s in range(len(log_probs))),
        chosen["values"],
        chosen["expected_values"],
        chosen["active"],
    )
    return Step(
        {key: th.from_numpy(array) for key, array in frame["obs"].items()},
        streams,
        frame["chosen"]["actions"],
        frame["new_obs"],
        frame["step"]["rewards"],
        frame["step"]["dones"],
        infos,
        th.from_numpy(frame["step"]["paid"]),
    )
