"""MAPPO and its policy."""

from sb3_roles.mappo.mappo import MAPPO
from sb3_roles.mappo.policies import TeamActorCriticPolicy

__all__ = ["MAPPO", "TeamActorCriticPolicy"]
