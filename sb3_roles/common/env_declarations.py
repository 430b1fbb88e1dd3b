"""What an environment declares about itself, its layers, and whether it can serve a team."""

import io
from collections.abc import Mapping
from typing import Any

import cloudpickle
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_roles.common.env_failures import called

GoalNearness = Mapping[str, tuple[str, tuple[int, ...]]]
"""Goal set -> observation key, and index in a robot's array of that key."""


def declared(env: object, name: str, default: Any = None) -> Any:
    """
    An optional attribute of an environment, looked up on it and then on ``env.unwrapped``.

    :param env: any environment
    :param name: attribute name
    :param default: what to return when neither has it
    """
    value = getattr(env, name, None)
    return getattr(getattr(env, "unwrapped", env), name, default) if value is None else value


def declared_names(env: object, name: str) -> tuple[str, ...]:
    """
    An optional tuple of names that an environment declares, ``()`` when it does not.

    :param env: any environment
    :param name: attribute name, for example ``"metric_names"``
    :raises ValueError: if the attribute is a string, which would be read letter by letter
    """
    names = declared(env, name, ())
    if isinstance(names, str):
        raise ValueError(f"{name} must be a tuple of strings, not {names!r}: write ({names!r},)")
    return tuple(names)


def declared_goals(
    env: object, space: spaces.Space, team_keys: tuple[str, ...] = ()
) -> GoalNearness:
    """
    Where robots observe how near their goals are: the attribute ``goal_nearness``, ``{}`` without.

    It names, for each goal set (``Role.goal_set``), one entry of the observation that is the larger
    the nearer the nearest goal of the set is, and least when none is known. Of equally near goals
    those of the set that is named first take precedence.

    :param env: any environment
    :param space: observation space of one robot
    :param team_keys: keys that are shared by a team
    :raises ValueError: if an entry is not in the observation of a robot
    """
    goals: GoalNearness = declared(env, "goal_nearness", {})
    parts = space.spaces if isinstance(space, spaces.Dict) else {}
    for name, (key, index) in goals.items():
        shape = (parts[key].shape or ()) if key in parts and key not in team_keys else None
        inside = shape is not None and len(index) == len(shape)
        if not inside or any(not 0 <= i < n for i, n in zip(index, shape or (), strict=True)):
            raise ValueError(
                f"goal_nearness says that {name!r} is at {index} of the observation {key!r}, which "
                f"no robot's observation has: {space}"
            )
    return goals


def env_layers(env: object) -> list[object]:
    """
    An environment and what it wraps, outermost first.

    :param env: any environment; a wrapper is one with an instance attribute ``env``
    """
    layers = [env]
    while (inner := getattr(layers[-1], "__dict__", {}).get("env")) is not None:
        layers.append(inner)
    return layers


def check_observation_space(space: spaces.Space, team_keys: tuple[str, ...]) -> None:
    """
    Refuse observation spaces that Stable-Baselines3 would refuse later, and unknown team keys.

    :param space: observation space of one robot
    :param team_keys: keys that the environment declares as shared by a team
    :raises ValueError: saying what does not fit
    """
    parts = space.spaces if isinstance(space, spaces.Dict) else {}
    nested = [key for key, part in parts.items() if isinstance(part, (spaces.Dict, spaces.Tuple))]
    if isinstance(space, spaces.Tuple) or nested:
        raise ValueError(
            "Stable-Baselines3 takes simple spaces and a flat Dict of them as observations, not "
            f"{space}: flatten {nested or 'the Tuple'} into keys of one Dict"
        )
    for key, part in (parts or {"": space}).items():
        problem = _problem_of(part)
        if problem is not None:
            name = f"observation {key!r}" if key else "the observation"
            raise ValueError(f"{name} is {part}, but policies read {problem}")
    unknown = [key for key in team_keys if key not in parts]
    if unknown:
        raise ValueError(
            f"team_observation_keys {unknown} are not keys of the observation space, which has "
            f"{list(parts) or 'none: it is not a Dict'}"
        )


def _problem_of(space: spaces.Space) -> str | None:
    """What policies could read instead of a space that Stable-Baselines3 makes no vector of."""
    if isinstance(space, spaces.MultiDiscrete) and space.nvec.ndim != 1:
        return "MultiDiscrete of one dimension: flatten nvec"
    if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)) and np.any(space.start):
        return f"choices that are counted from 0: subtract start={space.start}"
    readable = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
    if not isinstance(space, readable):
        return "Box, Discrete, MultiDiscrete and MultiBinary: encode it as one of them"
    return None


def check_homogeneous(env: ParallelEnv) -> None:
    """
    Refuse environments whose agents differ.

    :param env: a PettingZoo environment
    :raises ValueError: naming the agents and their spaces, or what a space could not be had for
    """
    agents = list(env.possible_agents)
    if not agents:
        raise ValueError(f"{env} has no possible_agents: a team needs at least one")
    for kind in ("observation_space", "action_space"):
        by_agent = {agent: called(env, kind, getattr(env, kind), agent) for agent in agents}
        odd = [agent for agent in agents if by_agent[agent] != by_agent[agents[0]]]
        if odd:
            raise ValueError(
                f"the agents of a team must be homogeneous, but the {kind} of {agents[0]!r} is "
                f"{by_agent[agents[0]]} and that of {odd} is {[by_agent[agent] for agent in odd]}. "
                "Pad the spaces, for example with SuperSuit's pad_observations_v0 and "
                "pad_action_space_v0"
            )


class _ArrayFinder(cloudpickle.Pickler):
    """Notes the arrays that it pickles."""

    def __init__(self) -> None:
        super().__init__(io.BytesIO())
        self.arrays: list[np.ndarray] = []

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, np.ndarray):
            self.arrays.append(obj)
        return super().reducer_override(obj)


def check_picklable_arrays(env: ParallelEnv) -> None:
    """
    Refuse an environment whose pickled copies would fail, or silently show stale arrays.

    Pickling turns each numpy array into one of its own: what was a view of another array does not
    follow it any more.

    :param env: the environment to copy
    :raises ValueError: if arrays of it share memory, or it can not be pickled
    """
    finder = _ArrayFinder()
    remedy = "Give a function that makes the environment (its class, for example), not an instance"
    try:
        finder.dump(env)
    except Exception as error:
        raise ValueError(
            f"SuperSuit copies {env} by cloudpickle, which fails: {error}. {remedy}"
        ) from error
    seen: dict[int, np.ndarray] = {}
    for array in finder.arrays:
        owner = array
        while isinstance(owner.base, np.ndarray):
            owner = owner.base
        other = seen.setdefault(id(owner), array)
        if other is not array and owner.flags.writeable and np.may_share_memory(other, array):
            raise ValueError(
                f"{env} holds arrays that are views of one another (shapes {other.shape} and "
                f"{array.shape}); in the copies that SuperSuit pickles they would come apart. "
                f"{remedy}"
            )
