"""Area search: a team of robots explores an unknown map and covers the targets on it."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from area_search.batch import BatchedAreaSearch
    from area_search.parallel_env import AreaSearchEnv
    from area_search.scenes import SCENES, Scene, SceneError, get_scene

__all__ = [
    "SCENES",
    "AreaSearchEnv",
    "BatchedAreaSearch",
    "Scene",
    "SceneError",
    "get_scene",
]

_HOME = {
    "AreaSearchEnv": "parallel_env",
    "BatchedAreaSearch": "batch",
    "SCENES": "scenes",
    "Scene": "scenes",
    "SceneError": "scenes",
    "get_scene": "scenes",
}


def __getattr__(name: str) -> Any:
    # Numba and PettingZoo take most of a second to import: only when something needs them.
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
