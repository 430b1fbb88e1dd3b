"""Checks of each single value that an environment returns: spaces, types, numbers, infos."""

from __future__ import annotations

from collections.abc import Iterator
from numbers import Real
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_roles.testing.episodes import ConformanceError, MakeEnv, Moment, check_given, play

_N_STEPS = 200


def _leaves(
    space: spaces.Space, value: Any, path: str, where: str
) -> Iterator[tuple[spaces.Space, Any, str]]:
    """Yield the simple spaces of a space with the values that should be in them."""
    if isinstance(space, spaces.Dict):
        if not isinstance(value, dict) or value.keys() != space.spaces.keys():
            got = list(value) if isinstance(value, dict) else type(value).__name__
            raise ConformanceError(
                f"{where}: {path} must be a dict with the keys {list(space.spaces)}, got {got}"
            )
        for key, part in space.spaces.items():
            yield from _leaves(part, value[key], f"{path}[{key!r}]", where)
    elif isinstance(space, spaces.Tuple):
        if not isinstance(value, tuple) or len(value) != len(space.spaces):
            raise ConformanceError(
                f"{where}: {path} must be a tuple of {len(space.spaces)}, got {value!r:.60}"
            )
        for i, part in enumerate(space.spaces):
            yield from _leaves(part, value[i], f"{path}[{i}]", where)
    else:
        yield space, value, path


def _observations(
    make_env: MakeEnv, n_steps: int, seed: int
) -> Iterator[tuple[str, spaces.Space, Any, str]]:
    """Play, and yield agent and moment, simple space, value and path of each observation."""
    env = make_env()
    for moment in play(env, n_steps, seed):
        for agent, observation in moment.observation.items():
            where = f"agent {agent!r}, {moment.where}"
            space = env.observation_space(agent)
            for part, value, path in _leaves(space, observation, "observation", where):
                yield where, part, value, path


def check_dtypes_and_shapes(make_env: MakeEnv, n_steps: int = _N_STEPS, seed: int = 0) -> None:
    """Check that observations have the keys, dtypes and shapes that their spaces declare.

    Example: ``check_dtypes_and_shapes(MyEnv)``

    :param make_env: makes a new environment
    :param n_steps: steps to play
    :param seed: of play
    :raises ConformanceError: naming agent, step, and what was expected
    :raises TypeError: if ``make_env`` can not be called
    :raises ValueError: if another argument is not allowed
    """
    check_given(make_env, seed, n_steps=n_steps)
    for where, space, value, path in _observations(make_env, n_steps, seed):
        if isinstance(space, spaces.Discrete):
            whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
            if not whole and not (np.ndim(value) == 0 and np.asarray(value).dtype.kind in "iu"):
                raise ConformanceError(
                    f"{where}: {path} must be a whole number, got {type(value).__name__}"
                )
        elif space.shape is not None and space.dtype is not None:
            want = f"an array, {space.dtype} of shape {space.shape}"
            if not isinstance(value, np.ndarray):
                raise ConformanceError(
                    f"{where}: {path} must be {want}, got {type(value).__name__}"
                )
            if value.dtype != space.dtype or value.shape != space.shape:
                raise ConformanceError(
                    f"{where}: {path} must be {want}, got {value.dtype} of shape {value.shape}"
                )


def check_finite(make_env: MakeEnv, n_steps: int = _N_STEPS, seed: int = 0) -> None:
    """Check that no observation is NaN or infinite, and every reward is a finite number.

    Example: ``check_finite(MyEnv, n_steps=1000)``

    :param make_env: makes a new environment
    :param n_steps: steps to play
    :param seed: of play
    :raises ConformanceError: naming agent, step and value
    :raises TypeError: if ``make_env`` can not be called
    :raises ValueError: if another argument is not allowed
    """
    check_given(make_env, seed, n_steps=n_steps)
    env = make_env()
    for moment in play(env, n_steps, seed):
        for agent, observation in moment.observation.items():
            where = f"agent {agent!r}, {moment.where}"
            space = env.observation_space(agent)
            for _, value, path in _leaves(space, observation, "observation", where):
                array = np.asarray(value)
                if array.dtype.kind == "f" and not np.isfinite(array).all():
                    index = np.argwhere(~np.isfinite(array))[0].tolist()
                    bad = array[tuple(index)]
                    raise ConformanceError(f"{where}: {path}{index} is {bad}, not a finite number")
        for agent, reward in moment.reward.items():
            where = f"agent {agent!r}, {moment.where}"
            if not isinstance(reward, Real) or isinstance(reward, (bool, np.bool_)):
                raise ConformanceError(
                    f"{where}: the reward must be a number, got {type(reward).__name__} "
                    f"{reward!r:.60}"
                )
            if not np.isfinite(float(reward)):
                raise ConformanceError(f"{where}: the reward is {reward}, not a finite number")


def check_spaces(make_env: MakeEnv, n_steps: int = _N_STEPS, seed: int = 0) -> None:
    """Check that every observation lies in its space, and that the spaces stay what they are.

    A space must be the same object at each call, so that seeding it lasts.

    Example: ``check_spaces(MyEnv)``

    :param make_env: makes a new environment
    :param n_steps: steps to play
    :param seed: of play
    :raises ConformanceError: naming agent, step, and the value that is out of bounds
    :raises TypeError: if ``make_env`` can not be called
    :raises ValueError: if another argument is not allowed
    """
    check_given(make_env, seed, n_steps=n_steps)
    env = make_env()
    for agent in getattr(env, "possible_agents", ()):
        for name in ("observation_space", "action_space"):
            space = getattr(env, name)
            if space(agent) is not space(agent):
                raise ConformanceError(
                    f"agent {agent!r}, before any step: {name} must return the same object at "
                    "each call, so that seeding it lasts, but made a new one"
                )
    for where, space, value, path in _observations(make_env, n_steps, seed):
        if space.contains(value):
            continue
        if isinstance(space, spaces.Box) and np.shape(value) == space.shape:
            array = np.asarray(value)
            outside = ~((array >= space.low) & (array <= space.high))
            if outside.any():
                index = tuple(np.argwhere(outside)[0].tolist())
                raise ConformanceError(
                    f"{where}: {path}{list(index)} is {array[index]}, expected from "
                    f"{space.low[index]} to {space.high[index]}"
                )
        raise ConformanceError(f"{where}: {path} is not in {space}: {value!r:.80}")


def check_infos(make_env: MakeEnv, n_steps: int = _N_STEPS, seed: int = 0) -> None:
    """Check that each agent gets an info of its own, with everything that is declared.

    An environment that declares ``reward_component_names`` or ``metric_names`` must give them after
    each step, under ``reward_components`` and ``metrics``, as finite numbers.

    Example: ``check_infos(MyEnv)``

    :param make_env: makes a new environment
    :param n_steps: steps to play
    :param seed: of play
    :raises ConformanceError: naming agent, step, and what is missing or shared
    :raises TypeError: if ``make_env`` can not be called
    :raises ValueError: if another argument is not allowed
    """
    from sb3_roles.common.env_declarations import declared_names

    check_given(make_env, seed, n_steps=n_steps)
    env = make_env()
    declared = {
        "reward_components": declared_names(env, "reward_component_names"),
        "metrics": declared_names(env, "metric_names"),
    }
    for moment in play(env, n_steps, seed):
        owners: dict[int, Any] = {}
        for agent in moment.before:
            where = f"agent {agent!r}, {moment.where}"
            info = moment.info.get(agent)
            if not isinstance(info, dict):
                got = "none" if agent not in moment.info else type(info).__name__
                raise ConformanceError(f"{where}: expected an info dict, got {got}")
            other = owners.setdefault(id(info), agent)
            if other != agent:
                raise ConformanceError(
                    f"{where}: its info is the same object as that of {other!r}, expected its own"
                )
            if moment.step:
                for key, names in declared.items():
                    _check_declared(where, info, key, names)


def _check_declared(where: str, info: dict[Any, Any], key: str, names: tuple[str, ...]) -> None:
    if not names:
        return
    values = info.get(key)
    if not isinstance(values, dict) or set(values) != set(names):
        got = list(values) if isinstance(values, dict) else values
        raise ConformanceError(
            f"{where}: info[{key!r}] must have what is declared, {list(names)}, got {got!r:.80}"
        )
    for name, value in values.items():
        if not np.isfinite(value):
            raise ConformanceError(f"{where}: info[{key!r}][{name!r}] is {value}, not finite")


def check_agents(make_env: MakeEnv, n_steps: int = _N_STEPS, seed: int = 0) -> None:
    """Check who gets what: each agent that acts gets all five parts, and lives until it ends.

    Flags must be bool; ``env.agents`` must hold exactly those that have not ended.

    Example: ``check_agents(MyEnv)``

    :param make_env: makes a new environment
    :param n_steps: steps to play
    :param seed: of play
    :raises ConformanceError: naming agent and step
    :raises TypeError: if ``make_env`` can not be called
    :raises ValueError: if another argument is not allowed
    """
    check_given(make_env, seed, n_steps=n_steps)
    env = make_env()
    possible = list(getattr(env, "possible_agents", ()))
    if not possible:
        raise ConformanceError("before any step: possible_agents must name the agents, it is empty")
    ended: set[Any] = set()
    for moment in play(env, n_steps, seed):
        ended = ended if moment.step else set()
        _check_who(moment, possible)
        for name in ("termination", "truncation") if moment.step else ():
            for agent, flag in getattr(moment, name).items():
                if not isinstance(flag, (bool, np.bool_)):
                    raise ConformanceError(
                        f"agent {agent!r}, {moment.where}: the {name} must be a bool, "
                        f"got {type(flag).__name__} {flag!r:.40}"
                    )
                if flag:
                    ended.add(agent)
        for agent in moment.after:
            if agent in ended:
                raise ConformanceError(
                    f"agent {agent!r}, {moment.where}: it has ended, but is in env.agents"
                )
        gone = [agent for agent in moment.before if agent not in (*moment.after, *ended)]
        if gone:
            raise ConformanceError(
                f"agent {gone[0]!r}, {moment.where}: it has left env.agents without an end"
            )


def _check_who(moment: Moment, possible: list[Any]) -> None:
    for agent in (*moment.before, *moment.after):
        if agent not in possible:
            raise ConformanceError(
                f"agent {agent!r}, {moment.where}: it is in env.agents, not in possible_agents"
            )
    for name, part in moment.parts().items():
        for agent in moment.before:
            if agent not in part:
                raise ConformanceError(f"agent {agent!r}, {moment.where}: it got no {name}")
