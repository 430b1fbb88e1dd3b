"""The check of a batched form against the environment that it stands for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_roles.testing.episodes import (
    Actions,
    ConformanceError,
    MakeEnv,
    Moment,
    check_given,
    difference,
    guard,
    reset,
    step,
)


def check_batched_equals_single(
    make_env: MakeEnv, n_steps: int = 100, seed: int = 0, n_teams: int = 3
) -> None:
    """Check that ``env.batched(n_teams)`` plays, team by team, what single environments play.

    Compared are observations, rewards, flags, and the declared reward components and metrics, at
    every step and over the ends of episodes.

    Example: ``check_batched_equals_single(MyEnv)``

    :param make_env: makes a new environment, one with ``batched``
    :param n_steps: steps to play
    :param seed: of the first team; each team has a seed of its own
    :param n_teams: teams in the batch
    :raises ConformanceError: naming team, agent, step, and the first value that differs
    :raises TypeError: if ``make_env`` can not be called
    :raises ValueError: if another argument is not allowed
    """
    check_given(make_env, seed, n_steps=n_steps, n_teams=n_teams)
    singles = [make_env() for _ in range(n_teams)]
    if not callable(getattr(singles[0], "batched", None)):
        raise ValueError(
            "make_env must make an environment with batched(n_teams), which "
            f"{type(singles[0]).__name__} has not"
        )
    batch = singles[0].batched(n_teams)
    seeds = [seed + m for m in range(n_teams)]
    guard("reset of the batch", batch.reset, seeds)
    last = [reset(env, seed=one) for env, one in zip(singles, seeds, strict=True)]
    actions = [Actions(one) for one in seeds]
    for m, moment in enumerate(last):
        _compare_observations(batch, m, moment)
    for _ in range(n_steps):
        chosen = [a.draw(*env) for a, *env in zip(actions, singles, last, strict=True)]
        moves = np.array([[one[agent] for agent in one] for one in chosen])
        guard(f"step {last[0].step + 1} of the batch", batch.step, moves)
        last = [step(*both) for both in zip(singles, last, chosen, strict=True)]
        for m, moment in enumerate(last):
            _compare_observations(batch, m, moment)
            _compare_outcome(batch, m, moment)
        ended = np.array([not moment.after for moment in last])
        if ended.any():
            guard("reset_teams of the batch", batch.reset_teams, ended)
            for m in np.flatnonzero(ended).tolist():
                last[m] = reset(singles[m], last[m].episode + 1)
                _compare_observations(batch, m, last[m])


def _differ(m: int, agent: Any, moment: Moment, text: str) -> ConformanceError:
    return ConformanceError(
        f"team {m}, agent {agent!r}, {moment.where}: of the single environment and the batched "
        f"form, {text}, expected to be equal"
    )


def _compare_observations(batch: Any, m: int, moment: Moment) -> None:
    shared = tuple(getattr(batch, "team_observation_keys", ()))
    for i, agent in enumerate(moment.before):
        observation = moment.observation[agent]
        if not isinstance(batch.observations, Mapping):
            pairs = {"observation": (observation, batch.observations[m, i])}
        else:
            pairs = {
                f"observation[{key!r}]": (
                    observation.get(key),
                    array[m] if key in shared else array[m, i],
                )
                for key, array in batch.observations.items()
            }
        for name, (single, of_batch) in pairs.items():
            text = difference(single, of_batch, name)
            if text:
                raise _differ(m, agent, moment, text)


def _compare_outcome(batch: Any, m: int, moment: Moment) -> None:
    components = tuple(getattr(batch, "reward_component_names", ()))
    metrics = tuple(getattr(batch, "metric_names", ()))
    for i, agent in enumerate(moment.before):
        info = moment.info[agent]
        pairs = {
            "reward": (moment.reward[agent], batch.rewards[m, i]),
            "termination": (moment.termination[agent], batch.terminated[m]),
            "truncation": (moment.truncation[agent], batch.truncated[m]),
        }
        for k, name in enumerate(components):
            pairs[f"reward component {name!r}"] = (
                info["reward_components"][name],
                batch.reward_components[m, i, k],
            )
        for name in metrics:
            pairs[f"metric {name!r}"] = info["metrics"][name], batch.metrics[name][m]
        for name, (single, of_batch) in pairs.items():
            if float(single) != float(of_batch):
                raise _differ(m, agent, moment, f"{name} is {single} and {of_batch}")
        if "episode_metrics" in info and not moment.after:
            text = difference(
                info["episode_metrics"], dict(batch.episode_metrics(m)), "episode_metrics"
            )
            if text:
                raise _differ(m, agent, moment, text)
