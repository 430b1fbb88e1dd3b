"""Scripted controllers, all with the ``predict()`` of a Stable-Baselines3 model."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from area_search.scenes import unknown

if TYPE_CHECKING:
    from sb3_roles.baselines.base import ScriptedController

# Names are cheap; the classes import numba, or more, and are loaded when they are asked for.
_HOME = {
    "random": "sb3_roles.baselines.random:RandomController",
    "greedy": "sb3_roles.baselines.greedy:GreedyController",
    "greedy_assigned": "sb3_roles.baselines.greedy:GreedyAssignedController",
    "look_ahead": "sb3_roles.baselines.look_ahead:LookAheadController",
    "vrpc": "sb3_roles.baselines.vrpc:VRPController",
    "planner": "sb3_roles.baselines.vrpc:RoutePlanner",
    "oracle": "sb3_roles.baselines.oracle:OracleController",
}
CONTROLLER_NAMES = tuple(_HOME)
CONTROLLERS: dict[str, type[ScriptedController]]


def controller_class(name: str) -> type[ScriptedController]:
    """Load the class of one controller.

    :param name: one of ``CONTROLLER_NAMES``
    :return: the class; it is made without arguments
    :raises ValueError: if there is none of that name
    """
    if name not in _HOME:
        raise ValueError(unknown("controller", name, CONTROLLER_NAMES))
    module, attribute = _HOME[name].split(":")
    found: type[ScriptedController] = getattr(import_module(module), attribute)
    return found


def __getattr__(name: str) -> Any:
    if name != "CONTROLLERS":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return {key: controller_class(key) for key in CONTROLLER_NAMES}
