"""Random play that notes everything an environment returns, and compares it value by value."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_roles.common.checks import check_positive, check_whole
from sb3_roles.common.env_failures import RESET_PARTS, STEP_PARTS, parts_problem, place_of
from sb3_roles.common.names import one_line

MakeEnv = Callable[[], Any]
"""Makes a new environment at each call: the environment's class, for example."""


class ConformanceError(AssertionError):
    """Something does not do what it should; the message, one line, says where and what."""


def check_given(make_env: Any, seed: int, **counts: int) -> None:
    """Refuse wrong arguments of a check, which would look like faults of the environment.

    :param make_env: makes a new environment
    :param seed: of play
    :param counts: name -> number, at least 1
    :raises TypeError: if ``make_env`` can not be called
    :raises ValueError: naming the first wrong number
    """
    if not callable(make_env):
        name = type(make_env).__name__
        raise TypeError(
            "make_env must be a class or function that makes a new environment at each call, got "
            f"an instance of {name}"
            + (f": give {name}, or lambda: {name}(...)" if hasattr(make_env, "reset") else "")
        )
    check_whole(0, seed=seed)
    check_positive(**counts)


class Moment(NamedTuple):
    """What a reset or a step returned, dicts by agent."""

    episode: int
    step: int
    """Steps since the reset; 0 is the reset itself, which has no rewards and flags."""
    before: tuple[Any, ...]
    """Agents that were to act; at a reset, those that are."""
    after: tuple[Any, ...]
    observation: dict[Any, Any]
    reward: dict[Any, Any]
    termination: dict[Any, Any]
    truncation: dict[Any, Any]
    info: dict[Any, Any]

    @property
    def where(self) -> str:
        """Name the moment for a message."""
        what = f"step {self.step}" if self.step else "reset"
        return f"{what} of episode {self.episode}"

    def parts(self) -> dict[str, dict[Any, Any]]:
        """Return the dicts by name; of a reset only those that it returns."""
        names = STEP_PARTS if self.step else RESET_PARTS
        return {name: getattr(self, name) for name in names}


class Actions:
    """Random actions from the agents' spaces, the same for the same seed on any instance.

    A mask under the key ``action_mask`` of an agent's observation or info is kept to.

    :param seed: of the choices
    """

    def __init__(self, seed: int) -> None:
        self._seed = int(seed)
        self._spaces: dict[Any, spaces.Space] = {}

    def draw(self, env: Any, last: Moment) -> dict[Any, Any]:
        """Choose for each agent that lives.

        :param env: to act in
        :param last: what it returned last
        """
        return {agent: self._space(env, agent).sample(_mask(last, agent)) for agent in env.agents}

    def _space(self, env: Any, agent: Any) -> spaces.Space:
        if agent not in self._spaces:
            # A copy: seeding it leaves the environment's own space alone.
            space = copy.deepcopy(env.action_space(agent))
            space.seed(self._seed * 1000 + len(self._spaces))
            self._spaces[agent] = space
        return self._spaces[agent]


def _mask(last: Moment, agent: Any) -> Any:
    for part in (last.observation.get(agent), last.info.get(agent)):
        if isinstance(part, dict) and "action_mask" in part:
            return part["action_mask"]
    return None


def reset(env: Any, episode: int = 0, seed: int | None = None) -> Moment:
    """Start an episode.

    :param env: a parallel environment
    :param episode: its number, for messages
    :param seed: of the reset, if any
    :raises ConformanceError: if it fails, or returns something else than two dicts
    """
    where = f"reset of episode {episode}"
    options = {} if seed is None else {"seed": int(seed)}
    result = _dicts(where, guard(where, env.reset, **options), RESET_PARTS)
    agents = tuple(env.agents)
    return Moment(episode, 0, agents, agents, result[0], {}, {}, {}, result[1])


def step(env: Any, last: Moment, actions: dict[Any, Any]) -> Moment:
    """Make one step.

    :param env: a parallel environment
    :param last: what it returned last
    :param actions: by agent
    :raises ConformanceError: if it fails, or returns something else than five dicts
    """
    before, number = tuple(env.agents), last.step + 1
    where = f"step {number} of episode {last.episode}"
    result = _dicts(where, guard(where, env.step, actions), STEP_PARTS)
    return Moment(last.episode, number, before, tuple(env.agents), *result)


def go_on(env: Any, actions: Actions, n_steps: int, last: Moment) -> Iterator[Moment]:
    """Play on, with a reset without a seed after each end.

    :param env: a parallel environment
    :param actions: what to do
    :param n_steps: steps to make, resets not counted
    :param last: what the environment returned last
    """
    for _ in range(n_steps):
        if not env.agents:
            last = reset(env, last.episode + 1)
            yield last
            if not env.agents:
                raise ConformanceError(f"{last.where}: env.agents is empty, nobody can act")
        last = step(env, last, actions.draw(env, last))
        yield last


def play(env: Any, n_steps: int, seed: int, action_seed: int | None = None) -> Iterator[Moment]:
    """Reset with a seed and play at random, with a reset without a seed after each end.

    :param env: a parallel environment
    :param n_steps: steps to make, resets not counted
    :param seed: of the first reset
    :param action_seed: of the actions; by default that of the reset
    """
    first = reset(env, seed=seed)
    yield first
    yield from go_on(env, Actions(seed if action_seed is None else action_seed), n_steps, first)


def guard(where: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Call a function of an environment; an error of it becomes a line that says where.

    :param where: what is being done
    :param function: to call, with the arguments that follow
    :raises ConformanceError: if it raises
    """
    try:
        return function(*args, **kwargs)
    except Exception as error:
        said = f"{one_line(error)}{place_of(error)}"
        raise ConformanceError(f"{where}: it raised {type(error).__name__}: {said}") from error


def _dicts(where: str, result: Any, names: tuple[str, ...]) -> list[dict[Any, Any]]:
    problem = parts_problem(result, names)
    if problem is not None:
        raise ConformanceError(f"{where}: {problem}")
    return list(result)


def difference(first: Any, second: Any, path: str = "") -> str | None:
    """Say where two values differ: in type, shape or any bit of a number; None if nowhere.

    :param first: nested dicts, sequences, arrays and plain values
    :param second: to compare with
    :param path: of the values, for the message
    """
    label = path or "the value"
    if isinstance(first, np.ndarray) or isinstance(second, np.ndarray):
        a, b = np.asarray(first), np.asarray(second)
        if a.dtype != b.dtype or a.shape != b.shape:
            return f"{label} is {a.dtype} {a.shape} and {b.dtype} {b.shape}"
        unequal = a != b
        if a.dtype.kind in "fc":
            unequal &= ~(np.isnan(a) & np.isnan(b))
        if not np.any(unequal):
            return None
        index = tuple(int(i) for i in np.argwhere(unequal)[0])
        return f"{label}{list(index) if index else ''} is {a[index]} and {b[index]}"
    if isinstance(first, dict) and isinstance(second, dict):
        if first.keys() != second.keys():
            return f"{label} has the keys {list(first)} and {list(second)}"
        pairs: Any = ((f"{path}[{key!r}]", first[key], second[key]) for key in first)
    elif isinstance(first, (list, tuple)) and isinstance(second, (list, tuple)):
        if len(first) != len(second):
            return f"{label} has {len(first)} and {len(second)} entries"
        pairs = ((f"{path}[{i}]", a, b) for i, (a, b) in enumerate(zip(first, second, strict=True)))
    else:
        both_nan = first != first and second != second
        return None if both_nan or first == second else f"{label} is {first!r} and {second!r}"
    return next((text for p, a, b in pairs if (text := difference(a, b, p))), None)


def compare(first: Moment, second: Moment, why: str) -> None:
    """Refuse two moments that should be the same.

    :param first: of one play
    :param second: of the other
    :param why: what the plays have in common, for the message
    :raises ConformanceError: saying agent, step and value
    """
    for name, part in first.parts().items():
        other = second.parts().get(name, {})
        for agent in (*part, *(agent for agent in other if agent not in part)):
            if (agent in part) != (agent in other):
                raise ConformanceError(
                    f"agent {agent!r}, {first.where}: only one of two plays has its {name}, "
                    f"expected both or neither: {why}"
                )
            text = difference(part[agent], other[agent], name)
            if text:
                raise ConformanceError(
                    f"agent {agent!r}, {first.where}: {text}, expected to be equal: {why}"
                )
    if first.after != second.after:
        raise ConformanceError(
            f"{first.where}: env.agents is {list(first.after)} and {list(second.after)}, expected "
            f"to be equal: {why}"
        )


def frozen(moment: Moment) -> Moment:
    """Copy a moment, so that it lasts whatever the environment does.

    :param moment: to copy
    """
    return copy.deepcopy(moment)
