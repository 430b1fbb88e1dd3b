"""The environments of the command line: names, and ``module:factory`` for anybody's own."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import fields
from importlib import import_module
from types import ModuleType
from typing import Any

from area_search.scenes import SCENES, Scene, SceneError, get_scenes
from sb3_roles.common.names import closest, shown
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.stop_signals import SecondSignal

AREA_SEARCH = "area-search-v0"
ENVIRONMENTS: dict[str, str] = {AREA_SEARCH: "area_search:AreaSearchEnv"}
# area_search has both lists, behind numba, which takes a second to import.
SUB_GOALS = ("none", "nearest", "assigned", "routes", "role_routes")
GOAL_SETS = ("frontier", "target")
REWARD_COMPONENTS = ("explore", "cover")
# Observations that are there on demand; arguments that are true or false.
SHOWN = ("known_map", "time")
_FACTORY = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


def env_problems(env: str, env_kwargs: Mapping[str, Any]) -> list[str]:
    """Find all that is wrong with an environment and its arguments, without importing it.

    :param env: a name of :data:`ENVIRONMENTS`, or ``module:factory``
    :param env_kwargs: arguments of the environment
    :return: one line per problem
    """
    if env not in ENVIRONMENTS:
        if _FACTORY.fullmatch(env):
            wrong = [key for key in env_kwargs if not isinstance(key, str)]
            return [f"env_kwargs: {shown(key)} is no name of an argument" for key in wrong]
        return [closest("environment", env, ENVIRONMENTS) + ", or module:factory"]
    options = dict(env_kwargs)
    name, sub_goal = options.pop("scene", "hard"), options.pop("sub_goal", "none")
    found = []
    for key in SHOWN:
        if not isinstance(value := options.pop(key, False), bool):
            found.append(f"env_kwargs: {key} must be true or false, got {shown(value)}")
    if sub_goal not in SUB_GOALS:
        found.append(f"env_kwargs: {closest('sub_goal', sub_goal, SUB_GOALS)}")
    names_of_scenes = name if isinstance(name, list) else [name]
    for one in names_of_scenes:
        if not isinstance(one, str) or one not in SCENES:
            return [*found, f"env_kwargs: {closest('scene', one, SCENES)}"]
    known = [field.name for field in fields(Scene) if field.name != "name"]
    for key in options:
        if key not in known:
            names = ["scene", "sub_goal", *SHOWN, *known]
            found.append(closest("key in env_kwargs", key, names))
    single = []
    for key, value in options.items():
        if key in known:
            try:
                get_scenes(name, **{key: value})
            except SceneError as error:
                single.append(f"env_kwargs: {error}")
    try:
        # Together they may fit what none of them fits alone: more targets on a larger map.
        get_scenes(name, **{key: value for key, value in options.items() if key in known})
        single = []
    except SceneError as error:
        single = single or [f"env_kwargs: {error}"]
    # Each key on its own finds what is wrong with a mix.
    return found + list(dict.fromkeys(single))


def check_named(where: object, env: str, named: str | None) -> None:
    """Refuse the environment of a file that is code, unless the user names it as well.

    A run folder may come from anybody: what its configuration calls ``module:factory`` must not be
    imported because of that alone.

    :param where: the file or folder, for the message
    :param env: the environment that it asks for
    :param named: the environment that the user asks for; None if there is none
    :raises UsageError: if they differ, or ``env`` is code that nobody named
    """
    if named is not None and named != env:
        raise UsageError(f"{where}: its environment is {env}, not {named}")
    if named is None and env not in ENVIRONMENTS:
        raise UsageError(
            f"{where}: its environment is code, to be imported and called: add --env {env} if you "
            "trust it"
        )


def scenes_of_run(config: Mapping[str, Any]) -> tuple[Scene, ...]:
    """Return the scenes of a configuration for area search: one, or those of a mix.

    :param config: a checked configuration
    """
    options = dict(config["env_kwargs"])
    for key in ("sub_goal", *SHOWN):
        options.pop(key, None)
    return get_scenes(options.pop("scene", "hard"), **options)


def env_factory(env: str, env_kwargs: Mapping[str, Any]) -> Callable[[], Any]:
    """Return the function that makes one environment.

    :param env: a name of :data:`ENVIRONMENTS`, or ``module:factory``
    :param env_kwargs: arguments of the environment
    :return: a function without arguments, tried once; what that made is closed
    :raises UsageError: if it can not be imported, or does not make a PettingZoo ``ParallelEnv``
    """
    from pettingzoo import ParallelEnv

    path = ENVIRONMENTS.get(env, env)
    module, _, name = path.partition(":")
    if env not in ENVIRONMENTS and os.getcwd() not in sys.path:
        # As python -m does: the console script would not find a module of the current folder.
        sys.path.insert(0, os.getcwd())
    imported = None
    try:
        imported = import_module(module)
        factory = getattr(imported, name)
    except (Exception, SystemExit) as error:
        if isinstance(error, SecondSignal):
            raise
        said = f"{type(error).__name__}: {error}"
        if imported is not None and isinstance(error, AttributeError):
            said = closest(f"factory of {module}", name, _factories(imported))
        raise UsageError(f"--env {env}: {said}") from error

    def make() -> Any:
        return factory(**env_kwargs)

    try:
        made = make()
    except (Exception, SystemExit) as error:
        if isinstance(error, SecondSignal):
            raise
        given = ", ".join(f"{key}={value!r}" for key, value in env_kwargs.items())
        raise UsageError(f"--env {env}: {name}({given}) fails: {error}") from error
    if not isinstance(made, ParallelEnv):
        raise UsageError(
            f"--env {env}: {name} must make a pettingzoo.ParallelEnv, it makes "
            f"{type(made).__name__}"
        )
    # Not every environment can be closed before its first reset.
    with suppress(Exception):
        made.close()
    return make


def _factories(module: ModuleType) -> list[str]:
    """Name what a module says that it has to offer, or else what it defines itself."""
    return getattr(module, "__all__", None) or [
        name
        for name, value in vars(module).items()
        if callable(value)
        and not name.startswith("_")
        and getattr(value, "__module__", None) == module.__name__
    ]


def folder_name(env: str) -> str:
    """Return an environment's name as part of a folder's name."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", env)
