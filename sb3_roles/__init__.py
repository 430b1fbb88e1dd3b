"""Multi-agent, role-hierarchical PPO for Stable-Baselines3."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sb3_roles._version import __version__

if TYPE_CHECKING:
    from sb3_roles.common.role_wrapper import RoleWrapper
    from sb3_roles.common.roles import ROLES, Role, register_role
    from sb3_roles.common.team_vec_env import make_team_vec_env
    from sb3_roles.common.team_wrapper import TeamWrapper
    from sb3_roles.hmappo import HMAPPO
    from sb3_roles.mappo import MAPPO

__all__ = [
    "HMAPPO",
    "MAPPO",
    "ROLES",
    "Role",
    "RoleWrapper",
    "TeamWrapper",
    "__version__",
    "make_team_vec_env",
    "register_role",
]

_HOME = {
    "HMAPPO": "hmappo",
    "MAPPO": "mappo",
    "ROLES": "common.roles",
    "Role": "common.roles",
    "RoleWrapper": "common.role_wrapper",
    "TeamWrapper": "common.team_wrapper",
    "make_team_vec_env": "common.team_vec_env",
    "register_role": "common.roles",
}


def __getattr__(name: str) -> Any:
    # Torch takes seconds to import: the command line checks its arguments without it.
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
