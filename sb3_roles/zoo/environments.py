"""The environments of the command line: names, and ``module:factory`` for anybody's own."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import fields
from importlib import import_module
from typing import TYPE_CHECKING, Any

from area_search.scenes import SCENES, SceneError, get_scene
from sb3_roles.common.names import closest
from sb3_roles.zoo.options import UsageError

if TYPE_CHECKING:
    from area_search.scenes import Scene

AREA_SEARCH = "area-search-v0"
ENVIRONMENTS: dict[str, str] = {AREA_SEARCH: "area_search:AreaSearchEnv"}
# area_search has both lists, behind numba, which takes a second to import.
SUB_GOALS = ("none", "nearest", "assigned")
REWARD_COMPONENTS = ("explore", "cover")
_FACTORY = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


def env_problems(env: str, env_kwargs: Mapping[str, Any]) -> list[str]:
    """Find all that is wrong with an environment and its arguments, without importing it.

    :param env: a name of :data:`ENVIRONMENTS`, or ``module:factory``
    :param env_kwargs: arguments of the environment
    :return: one line per problem
    """
    if env not in ENVIRONMENTS:
        if _FACTORY.fullmatch(env):
            return []
        return [closest("environment", env, ENVIRONMENTS) + ", or module:factory"]
    options = dict(env_kwargs)
    name, sub_goal = options.pop("scene", "hard"), options.pop("sub_goal", "none")
    found = []
    if sub_goal not in SUB_GOALS:
        found.append(f"env_kwargs: {closest('sub_goal', sub_goal, SUB_GOALS)}")
    if not isinstance(name, str) or name not in SCENES:
        return [*found, f"env_kwargs: {closest('scene', name, SCENES)}"]
    known = [field.name for field in fields(SCENES[name]) if field.name != "name"]
    for key in options:
        if key not in known:
            names = ["scene", "sub_goal", *known]
            found.append(closest("key in env_kwargs", key, names))
    single = []
    for key, value in options.items():
        if key in known:
            try:
                get_scene(name, **{key: value})
            except SceneError as error:
                single.append(f"env_kwargs: {error}")
    if not found and not single:
        return []
    try:
        # Together they may fit what none of them fits alone: more targets on a larger map.
        get_scene(name, **{key: value for key, value in options.items() if key in known})
        single = []
    except SceneError as error:
        single = single or [f"env_kwargs: {error}"]
    return found + single


def scene_of_run(config: Mapping[str, Any]) -> Scene:
    """Return the scene of a configuration for area search.

    :param config: a checked configuration
    """
    options = dict(config["env_kwargs"])
    options.pop("sub_goal", None)
    return get_scene(options.pop("scene", "hard"), **options)


def env_factory(env: str, env_kwargs: Mapping[str, Any]) -> Callable[[], Any]:
    """Return the function that makes one environment.

    :param env: a name of :data:`ENVIRONMENTS`, or ``module:factory``
    :param env_kwargs: arguments of the environment
    :return: a function without arguments, tried once
    :raises UsageError: if it can not be imported, or does not make a PettingZoo ``ParallelEnv``
    """
    from pettingzoo import ParallelEnv

    path = ENVIRONMENTS.get(env, env)
    module, _, name = path.partition(":")
    if env not in ENVIRONMENTS and os.getcwd() not in sys.path:
        # As python -m does: the console script would not find a module of the current folder.
        sys.path.insert(0, os.getcwd())
    try:
        factory = getattr(import_module(module), name)
    except Exception as error:
        raise UsageError(f"--env {env}: {type(error).__name__}: {error}") from error

    def make() -> Any:
        return factory(**env_kwargs)

    try:
        made = make()
    except Exception as error:
        given = ", ".join(f"{key}={value!r}" for key, value in env_kwargs.items())
        raise UsageError(f"--env {env}: {name}({given}) fails: {error}") from error
    if not isinstance(made, ParallelEnv):
        raise UsageError(
            f"--env {env}: {name} must make a pettingzoo.ParallelEnv, it makes "
            f"{type(made).__name__}"
        )
    return make


def folder_name(env: str) -> str:
    """Return an environment's name as part of a folder's name."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", env)
