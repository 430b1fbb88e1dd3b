"""HMAPPO and its policy."""

from sb3_roles.hmappo.hmappo import HMAPPO
from sb3_roles.hmappo.policies import RoleActorCriticPolicy

__all__ = ["HMAPPO", "RoleActorCriticPolicy"]
