"""Checks of what an episode depends on: its seed and the actions, and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib import import_module
from typing import Any

from sb3_roles.common.checks import check_whole
from sb3_roles.common.plain_tree import encode_tree
from sb3_roles.testing.episodes import (
    Actions,
    ConformanceError,
    MakeEnv,
    check_given,
    compare,
    difference,
    frozen,
    go_on,
    guard,
    play,
    reset,
    step,
)
from sb3_roles.testing.notes import digests, noted, noted_play

_N_STEPS = 200
_ALONE = "; do instances share state, in the class or the module?"


def check_determinism(make_env: MakeEnv, n_steps: int = _N_STEPS, seed: int = 0) -> None:
    """Check that two instances with one seed and the same actions return the same, at every step.

    Resets without a seed belong to it: they go on with the stream of the first one. Two instances
    play side by side, and one before them to its end: what instances share shows only there.

    Example: ``check_determinism(MyEnv, n_steps=1000)``

    :param make_env: makes a new environment
    :param n_steps: steps to play
    :param seed: of play
    :raises ConformanceError: naming agent, step, and the first value that differs
    :raises TypeError: if ``make_env`` can not be called
    :raises ValueError: if another argument is not allowed
    """
    check_given(make_env, seed, n_steps=n_steps)
    earlier = noted_play(make_env, n_steps, seed)
    first, second = (play(make_env(), n_steps, seed) for _ in range(2))
    with_same = f"with seed {seed} and the same actions"
    for before, one, other in zip(earlier, first, second, strict=True):
        compare(one, other, f"two instances {with_same}")
        compare(before, noted(one), f"an instance and a later one {with_same}{_ALONE}")


def check_reset_forgets(make_env: MakeEnv, n_steps: int = _N_STEPS, seed: int = 0) -> None:
    """Check that a reset with a seed plays as a new environment does, whatever was played before.

    Tried after a few steps and after a whole play of another seed.

    Example: ``check_reset_forgets(MyEnv)``

    :param make_env: makes a new environment
    :param n_steps: steps to play
    :param seed: of play
    :raises ConformanceError: naming agent, step, and the first value that differs
    :raises TypeError: if ``make_env`` can not be called
    :raises ValueError: if another argument is not allowed
    """
    check_given(make_env, seed, n_steps=n_steps)
    alone = noted_play(make_env, n_steps, seed)
    later = f"a new environment with seed {seed}, and later a reset of another one with it{_ALONE}"
    used = make_env()
    for earlier in (3, n_steps):
        for _ in play(used, earlier, seed + 1):
            pass
        why = f"a reset with seed {seed} after other play, and a new environment"
        again, fresh = play(used, n_steps, seed), play(make_env(), n_steps, seed)
        for before, one, other in zip(alone, again, fresh, strict=True):
            compare(one, other, why)
            compare(before, noted(one), later)


def check_seed_matters(
    make_env: MakeEnv, n_steps: int = _N_STEPS, seed: int = 0, n_seeds: int = 8
) -> None:
    """Check that some of several seeds give different play with the same actions.

    Not for environments without chance.

    Example: ``check_seed_matters(MyEnv)``

    :param make_env: makes a new environment
    :param n_steps: steps to play
    :param seed: of the actions, and the first of the seeds
    :param n_seeds: seeds to try
    :raises ConformanceError: if all play the same
    :raises TypeError: if ``make_env`` can not be called
    :raises ValueError: if another argument is not allowed
    """
    check_given(make_env, seed, n_steps=n_steps)
    check_whole(2, n_seeds=n_seeds)
    expected = digests(make_env, n_steps, seed, seed)
    for other in range(seed + 1, seed + n_seeds):
        if digests(make_env, n_steps, other, seed) != expected:
            return
    raise ConformanceError(
        f"reset to step {n_steps}, all agents: seeds {seed} to {seed + n_seeds - 1} give the same "
        "play, expected different ones: does reset() pass its seed on?"
    )


def check_actions_matter(
    make_env: MakeEnv, n_steps: int = _N_STEPS, seed: int = 0, n_tries: int = 4
) -> None:
    """Check that the actions of each agent change something that is observed or rewarded.

    Example: ``check_actions_matter(MyEnv)``

    :param make_env: makes a new environment
    :param n_steps: steps to play in each try
    :param seed: of play
    :param n_tries: other choices of actions to try for each agent
    :raises ConformanceError: naming the agent whose actions change nothing
    :raises TypeError: if ``make_env`` can not be called
    :raises ValueError: if another argument is not allowed
    """
    check_given(make_env, seed, n_steps=n_steps, n_tries=n_tries)
    env = make_env()
    for agent in env.possible_agents:
        tries = range(seed + 1, seed + 1 + n_tries)
        if not any(_changes(make_env, agent, n_steps, seed, other) for other in tries):
            raise ConformanceError(
                f"agent {agent!r}, steps 1 to {n_steps}: other actions of it change no "
                "observation, reward or flag of anyone, expected some effect"
            )


def _changes(make_env: MakeEnv, agent: Any, n_steps: int, seed: int, other: int) -> bool:
    """Whether other actions of one agent change what follows, all else equal."""
    first, second = make_env(), make_env()
    usual, odd = Actions(seed), Actions(other)
    one, two = reset(first, seed=seed), reset(second, seed=seed)
    for _ in range(n_steps):
        if agent not in first.agents or agent not in second.agents:
            return False
        actions = usual.draw(first, one)
        changed = {**actions, agent: odd.draw(second, two)[agent]}
        one, two = frozen(step(first, one, actions)), step(second, two, changed)
        if any(difference(part, two.parts()[name]) for name, part in one.parts().items()):
            return True
    return False


def check_state_round_trip(make_env: MakeEnv, n_steps: int = _N_STEPS, seed: int = 0) -> None:
    """Check ``get_state`` and ``set_state``: another instance continues where the first one was.

    Tried right after a reset, within an episode, and where ends of episodes follow. The state must
    be a copy, of what a checkpoint can store.

    Example: ``check_state_round_trip(MyEnv)``

    :param make_env: makes a new environment
    :param n_steps: steps to play, before and after
    :param seed: of play
    :raises ConformanceError: naming agent, step, and the first value that differs
    :raises TypeError: if ``make_env`` can not be called
    :raises ValueError: if another argument is not allowed
    """
    from sb3_roles.common.env_declarations import declared

    check_given(make_env, seed, n_steps=n_steps)
    _check_state_methods(make_env())
    for cut in (0, n_steps // 7 + 1, n_steps):
        env, other = make_env(), make_env()
        *_, last = play(env, cut, seed)
        after = f"after the {last.where}"
        state = guard(f"get_state {after}", declared(env, "get_state"))
        try:
            encode_tree(state, {})
        except ValueError as error:
            raise ConformanceError(
                f"get_state {after}: expected what can be stored, that is numbers, texts, None, "
                f"arrays of numbers, and lists and dicts of them with texts as keys, but {error}"
            ) from error
        copied = frozen(state)
        reset(other, seed=seed + 1)
        guard(f"set_state {after}", declared(other, "set_state"), frozen(copied))
        if list(other.agents) != list(env.agents):
            raise ConformanceError(
                f"{last.where}: set_state must restore env.agents, {list(env.agents)}, "
                f"got {list(other.agents)}"
            )
        why = f"play on, and from a state that was taken after the {last.where}"
        plays = [go_on(one, Actions(seed + 2), n_steps, last) for one in (env, other)]
        for one, two in zip(*plays, strict=True):
            compare(one, two, why)
        text = difference(copied, state, "state")
        if text:
            raise ConformanceError(
                f"{last.where}: get_state must return a copy, but play has changed it: {text}"
            )


def state_methods(env: Any) -> list[str]:
    """Return which of ``get_state`` and ``set_state`` an environment offers.

    :param env: any environment
    """
    from sb3_roles.common.env_declarations import declared

    return [name for name in ("get_state", "set_state") if callable(declared(env, name))]


def _check_state_methods(env: Any) -> None:
    offered, name = state_methods(env), type(env).__name__
    if not offered:
        raise ValueError(
            f"make_env must make an environment with get_state and set_state, {name} has neither"
        )
    if len(offered) == 1:
        raise ConformanceError(
            f"before any step: {name} has {offered[0]} alone, expected get_state and set_state, "
            "or neither: states are taken to be put back"
        )


def check_fresh_process(make_env: MakeEnv | str, n_steps: int = _N_STEPS, seed: int = 0) -> None:
    """Check that a new Python process, with another hash seed, plays the same.

    What depends on the order of a set, on ``hash()`` of a text or on an address shows here only.

    Example: ``check_fresh_process("my_package.envs:MyEnv")``

    :param make_env: ``"module:name"``, or a function or class that a new process can import
    :param n_steps: steps to play
    :param seed: of play
    :raises ConformanceError: naming the first step that differs
    :raises TypeError: if ``make_env`` can not be called
    :raises ValueError: if it can not be imported, or not elsewhere, as a lambda, or a
        number is not allowed
    """
    made = _named(make_env) if isinstance(make_env, str) else make_env
    check_given(made, seed, n_steps=n_steps)
    if not isinstance(make_env, str):
        module, name = make_env.__module__, getattr(make_env, "__qualname__", "<>")
        if "<" in name or module == "__main__":
            raise ValueError(
                f"a new process can not import {make_env!r}: give a function or class of a module"
            )
        make_env = f"{module}:{name}"
    here = digests(made, n_steps, seed, seed)
    code = "import sys; from sb3_roles.testing import seeds; seeds.print_notes(*sys.argv[1:])"
    other_hashes = "1" if os.environ.get("PYTHONHASHSEED") == "2" else "2"
    result = subprocess.run(
        [sys.executable, "-c", code, make_env, str(n_steps), str(seed)],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path),
            "PYTHONHASHSEED": other_hashes,
        },
        capture_output=True,
        text=True,
        check=False,
    )
    if result.returncode:
        said = (result.stderr.strip() or "no message").splitlines()[-1]
        raise ConformanceError(f"play of {make_env} in a new process failed: {said}")
    there = [line.split()[-1] for line in result.stdout.splitlines() if line.startswith("moment ")]
    moments = play(made(), n_steps, seed)
    for moment, one, other in zip(moments, here, there, strict=True):
        if one != other:
            raise ConformanceError(
                f"{moment.where}, all agents: a new process with the same seed {seed} and actions "
                "returns something else, expected the same; does it depend on hash(), or on the "
                "order of a set?"
            )


def _named(spec: str) -> MakeEnv:
    module, _, name = spec.partition(":")
    if not module or not name:
        raise ValueError(
            "make_env must be a class or function, or its name as module:name, for example "
            f"my_package.envs:MyEnv, got {spec!r}"
        )
    try:
        value: Any = import_module(module)
        for part in name.split("."):
            value = getattr(value, part)
    except Exception as error:
        raise ValueError(
            f"make_env {spec!r} can not be imported: {type(error).__name__}: {error}"
        ) from error
    return value


def print_notes(make_env: str, n_steps: str, seed: str) -> None:
    """Print a digest of each moment of a play, as the new process of a check does.

    :param make_env: ``module:name``
    :param n_steps: steps to play
    :param seed: of play
    """
    for note in digests(_named(make_env), int(n_steps), int(seed), int(seed)):
        print("moment", note)
