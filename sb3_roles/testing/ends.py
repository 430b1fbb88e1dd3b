"""Checks of how episodes end, and of who owns the arrays that an environment returns."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from sb3_roles.common.checks import check_positive
from sb3_roles.testing.episodes import (
    ConformanceError,
    MakeEnv,
    Moment,
    check_given,
    compare,
    difference,
    frozen,
    play,
)

_KEPT = 4


def check_episode_ends(
    make_env: MakeEnv,
    max_episode_steps: int = 1000,
    horizon: int | None = None,
    n_episodes: int = 2,
    seed: int = 0,
) -> None:
    """Check that episodes end, and that a known horizon truncates them and does not terminate.

    Before the horizon an episode may terminate, but not be truncated.

    A horizon that is reported as a termination teaches a critic that nothing would have followed.

    Example: ``check_episode_ends(MyEnv, horizon=50)``

    :param make_env: makes a new environment
    :param max_episode_steps: steps within which each episode must have ended
    :param horizon: steps after which all agents that still live are truncated, if there is one
    :param n_episodes: episodes to play
    :param seed: of play
    :raises ConformanceError: naming agent and step
    :raises TypeError: if ``make_env`` can not be called
    :raises ValueError: if another argument is not allowed
    """
    check_given(make_env, seed, max_episode_steps=max_episode_steps, n_episodes=n_episodes)
    if horizon is not None:
        check_positive(horizon=horizon)
    limit = horizon or max_episode_steps
    env, ended = make_env(), 0
    for moment in play(env, n_episodes * limit, seed):
        if not moment.after:
            ended += 1
            if ended == n_episodes:
                return
        if horizon is not None:
            _check_horizon(moment, horizon)
        if moment.step >= limit and moment.after:
            raise ConformanceError(
                f"agent {moment.after[0]!r}, {moment.where}: expected the episode to have ended "
                f"within {limit} steps"
            )


def _check_horizon(moment: Moment, horizon: int) -> None:
    for agent, truncated in moment.truncation.items():
        if truncated and moment.step < horizon:
            raise ConformanceError(
                f"agent {agent!r}, {moment.where}: truncated before the horizon, expected after "
                f"{horizon} steps only: is horizon={horizon} that of the environment?"
            )
    for agent in moment.before if moment.step == horizon else ():
        if moment.truncation.get(agent):
            continue
        if moment.termination.get(agent):
            text = "the horizon is reported as a termination, expected a truncation"
        else:
            text = "expected a truncation at the horizon"
        raise ConformanceError(f"agent {agent!r}, {moment.where}: {text}")


def check_agents_live_together(make_env: MakeEnv, n_steps: int = 200, seed: int = 0) -> None:
    """Check what teams need: all possible agents start together and end in the same step.

    Example: ``check_agents_live_together(MyEnv)``

    :param make_env: makes a new environment
    :param n_steps: steps to play
    :param seed: of play
    :raises ConformanceError: naming agent and step
    :raises TypeError: if ``make_env`` can not be called
    :raises ValueError: if another argument is not allowed
    """
    check_given(make_env, seed, n_steps=n_steps)
    env = make_env()
    possible = list(env.possible_agents)
    for moment in play(env, n_steps, seed):
        for agent in possible:
            lives = agent in moment.after
            if lives != bool(moment.after) or agent not in moment.before:
                raise ConformanceError(
                    f"agent {agent!r}, {moment.where}: agents of a team start and end together, "
                    f"but env.agents is {list(moment.after)}"
                )
        if moment.step:
            done = {
                agent: bool(moment.termination.get(agent) or moment.truncation.get(agent))
                for agent in possible
            }
            if len(set(done.values())) > 1:
                odd = next(agent for agent in possible if done[agent])
                raise ConformanceError(
                    f"agent {odd!r}, {moment.where}: it has ended while others have not"
                )


def check_no_aliasing(make_env: MakeEnv, n_steps: int = 200, seed: int = 0) -> None:
    """Check that what was returned never changes, and that writing into it reaches nothing.

    Example: ``check_no_aliasing(MyEnv)``

    :param make_env: makes a new environment
    :param n_steps: steps to play
    :param seed: of play
    :raises ConformanceError: naming agent and step of the value that changed
    :raises TypeError: if ``make_env`` can not be called
    :raises ValueError: if another argument is not allowed
    """
    check_given(make_env, seed, n_steps=n_steps)
    kept: deque[tuple[Moment, Moment]] = deque(maxlen=_KEPT)
    for moment in play(make_env(), n_steps, seed):
        for given, copied in kept:
            for name, part in copied.parts().items():
                for agent, value in part.items():
                    now = given.parts()[name].get(agent)
                    text = difference(value, now, name)
                    if text:
                        raise ConformanceError(
                            f"agent {agent!r}, {copied.where}: what was returned has changed by "
                            f"the {moment.where} (before and now: {text}); return a copy"
                        )
        kept.append((moment, frozen(moment)))
    plays = zip(play(make_env(), n_steps, seed), play(make_env(), n_steps, seed), strict=True)
    for spoiled, other in plays:
        compare(spoiled, other, "writing into what was returned before reached the environment")
        for part in spoiled.parts().values():
            for value in part.values():
                _spoil(value)


def _spoil(value: Any) -> None:
    """Overwrite all arrays of a value but masks, by which the next actions are drawn."""
    if isinstance(value, np.ndarray) and value.flags.writeable:
        value[...] = 1 if value.dtype.kind in "iufb" else value
    elif isinstance(value, dict):
        for key, part in value.items():
            if key != "action_mask":
                _spoil(part)
    elif isinstance(value, (list, tuple)):
        for part in value:
            _spoil(part)
