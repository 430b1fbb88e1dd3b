"""The roles that a robot can act in, and what each of them is paid for (Section V-A, V-B)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING

from sb3_roles.common.names import closest

# The command line checks names of roles before anything heavy is imported.
if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True)
class Role:
    """One entry of the role action space.

    :param name: how configurations, logs and frames call it
    :param reward_component: the reward component that its primitive policy is paid by default
    :param goal_set: the sub-goals it heads for, a name of the environment; for rules and pictures
    """

    name: str
    reward_component: str
    goal_set: str = ""


ROLES: dict[str, Role] = {}

LEARNED, RANDOM, NEAREST = "learned", "random", "nearest"


def role_controls(role_names: Sequence[str]) -> tuple[str, ...]:
    """Return what ``role_control`` may be: who chooses the roles, or the only role there is.

    :param role_names: of the roles in use
    """
    return (LEARNED, RANDOM, NEAREST, *role_names)


def register_role(role: Role) -> Role:
    """Add a role to the registry.

    :param role: the role; its name must be free, or taken by an equal role
    :return: the role
    :raises ValueError: if another role has this name
    """
    if ROLES.setdefault(role.name, role) != role:
        raise ValueError(f"role {role.name!r} is registered already: {ROLES[role.name]}")
    return role


register_role(Role("explore", reward_component="explore", goal_set="frontier"))
register_role(Role("cover", reward_component="cover", goal_set="target"))


def get_roles(roles: Sequence[str | Role]) -> tuple[Role, ...]:
    """Look roles up.

    :param roles: names of the registry, or roles
    :return: the roles, in order
    :raises ValueError: if a name is unknown, or none or one twice is given
    """
    found = []
    for role in roles:
        if isinstance(role, str):
            if role not in ROLES:
                raise ValueError(closest("role", role, list(ROLES)))
            role = ROLES[role]
        found.append(role)
    names = [role.name for role in found]
    if not names or len(set(names)) < len(names):
        raise ValueError(f"roles must be at least one, each once, got {names}")
    return tuple(found)


def weight_vector(what: str, weights: Mapping[str, float], components: Sequence[str]) -> np.ndarray:
    """Turn weights by component name into a vector.

    :param what: for the error message
    :param weights: component name -> weight; a component that is left out weighs 0
    :param components: names of the environment's reward components
    :return: float32 (n_components,)
    :raises ValueError: if a component is unknown or a weight is not a finite number
    """
    import numpy as np

    vector = np.zeros(len(components), np.float32)
    for name, weight in weights.items():
        if name not in components:
            raise ValueError(closest(f"reward component in {what}", name, components))
        if isinstance(weight, bool) or not isinstance(weight, (int, float)):
            raise ValueError(f"{what}: the weight of {name!r} must be a number, got {weight!r}")
        if not isfinite(weight):
            raise ValueError(f"{what}: the weight of {name!r} must be finite, got {weight!r}")
        vector[list(components).index(name)] = weight
    return vector


def primitive_weights(
    weights: str | Mapping[str, Mapping[str, float]],
    roles: Sequence[Role],
    components: Sequence[str],
    role_weights: np.ndarray,
) -> np.ndarray:
    """Role x component weights of the primitive reward (Eq. 6 and its variants).

    :param weights: ``"identity"``: each role is paid its own component (the paper);
        ``"role_reward"``: all roles are paid the role reward (the released code); or for each
        role's name the weights by component
    :param roles: the roles, in order
    :param components: names of the environment's reward components
    :param role_weights: float32 (n_components,), the weights of the role reward
    :return: float32 (n_roles, n_components)
    :raises ValueError: if a name is unknown, or a role is missing
    """
    import numpy as np

    if weights == "role_reward":
        return np.tile(role_weights, (len(roles), 1))
    if weights == "identity":
        weights = {role.name: {role.reward_component: 1.0} for role in roles}
    elif not isinstance(weights, Mapping):
        known = ["identity", "role_reward"]
        raise ValueError(closest("primitive_weights", weights, known) + ", or a weight matrix")
    names = [role.name for role in roles]
    for name in weights:
        if name not in names:
            raise ValueError(closest("role in primitive_weights", name, names))
    missing = [name for name in names if name not in weights]
    if missing:
        raise ValueError(f"primitive_weights must have a row for each role: {missing[0]!r} is none")
    return np.stack(
        [weight_vector("primitive_weights", weights[name], components) for name in names]
    )
