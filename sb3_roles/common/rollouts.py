"""Groups of teams, for each of which the policy acts on its own during a rollout.

What a group's policy says is a function of the weights, what the group observes, and its generator:
rounding in matrix products depends on how many rows there are, so every evaluation is one of a
whole group, whoever does it, and whatever other groups there are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.utils import obs_as_tensor

from sb3_roles.common.policies import Observation, Streams, TeamPolicy


class TeamGroup(NamedTuple):
    """Consecutive teams, and what they draw with in one rollout."""

    teams: slice
    rows: slice
    seed: int

    def generator(self, device: th.device) -> th.Generator:
        """Return a fresh generator, the same at every call."""
        return th.Generator(device).manual_seed(self.seed)


class Acted(NamedTuple):
    """What some teams saw, prepared for the buffer, and what the policy said of it."""

    observations: Observation
    chosen: Streams


def split_teams(n_teams: int, n_groups: int) -> list[slice]:
    """Divide teams into groups of nearly equal size, the larger ones first.

    :param n_teams: number of teams
    :param n_groups: number of groups
    :raises ValueError: if there are more groups than teams
    """
    if n_groups > n_teams:
        raise ValueError(
            f"rollout_groups must be from 1 to the number of teams, {n_teams}, got {n_groups}"
        )
    parts = np.array_split(np.arange(n_teams), n_groups)
    return [slice(int(part[0]), int(part[-1]) + 1) for part in parts]


def make_groups(n_teams: int, n_agents: int, n_groups: int) -> list[TeamGroup]:
    """Divide the teams of a rollout that begins, and seed the groups.

    The seeds are drawn from torch's own generator, which checkpoints keep.

    :param n_teams: number of teams
    :param n_agents: robots in each
    :param n_groups: number of groups
    :raises ValueError: see :func:`split_teams`
    """
    drawn = int(th.randint(2**62, ()))
    words = np.random.SeedSequence(drawn).generate_state(n_groups, np.uint64)
    return [
        TeamGroup(teams, slice(teams.start * n_agents, teams.stop * n_agents), int(word >> 1))
        for teams, word in zip(split_teams(n_teams, n_groups), words.tolist(), strict=True)
    ]


def act(
    policy: TeamPolicy, observations: Mapping[str, np.ndarray], generator: th.Generator
) -> Acted:
    """Choose the actions of one group.

    :param policy: in evaluation mode
    :param observations: of the group
    :param generator: of the group
    """
    with th.inference_mode():
        tensors: Any = obs_as_tensor(dict(observations), policy.device)
        prepared = policy.prepare(tensors)
        return Acted(prepared, policy.streams(prepared, generator=generator))


def expected_values(policy: TeamPolicy, observations: Mapping[str, np.ndarray]) -> th.Tensor:
    """Return the values of one group to bootstrap with, float32 (n, S); draws nothing.

    :param policy: in evaluation mode
    :param observations: of whole teams of the group
    """
    with th.inference_mode():
        tensors: Any = obs_as_tensor(dict(observations), policy.device)
        return policy.streams(tensors, deterministic=True).expected_values


class Truncations(NamedTuple):
    """Values at the end of the episodes that were cut off; k rows of teams that finished."""

    rows: np.ndarray
    """int64 (k,), of all teams"""
    truncated: np.ndarray
    """bool (k,)"""
    values: th.Tensor
    """float32 (k, S)"""


def truncation_values(
    policy: TeamPolicy, rows: slice, dones: np.ndarray, infos: Sequence[Mapping[str, Any]]
) -> Truncations | None:
    """Evaluate the last observations of the teams of a group that have finished.

    :param policy: in evaluation mode
    :param rows: of the group
    :param dones: bool (n,), of all teams
    :param infos: of all teams
    :return: None if no episode was cut off
    """
    # Whole teams, which end together, even if only some of their robots were truncated.
    done = np.flatnonzero(dones[rows]) + rows.start
    truncated = np.array([bool(infos[row].get("TimeLimit.truncated")) for row in done], np.bool_)
    if not truncated.any():
        return None
    last = [infos[row]["terminal_observation"] for row in done]
    stacked = {key: np.stack([one[key] for one in last]) for key in last[0]}
    return Truncations(done, truncated, expected_values(policy, stacked))


def join(parts: Sequence[Acted]) -> Acted:
    """Put the groups of a step together.

    :param parts: in the order of the groups
    """
    if len(parts) == 1:
        return parts[0]
    seen, said = zip(*parts, strict=True)
    return Acted(
        {key: th.cat([one[key] for one in seen]) for key in seen[0]},
        Streams(
            th.cat([one.actions for one in said]),
            tuple(th.cat(logs) for logs in zip(*(one.log_probs for one in said), strict=True)),
            th.cat([one.values for one in said]),
            th.cat([one.expected_values for one in said]),
            th.cat([one.active for one in said]),
        ),
    )
