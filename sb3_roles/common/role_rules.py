"""Roles by a rule instead of a policy: the controls that show what learning them is worth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sb3_roles.common.env_declarations import GoalNearness
from sb3_roles.common.names import closest
from sb3_roles.common.roles import Role


class NearestRole:
    """The role whose goal is nearest: for area search, cover when a known target is nearer.

    What is compared is what the robot observes. In area search with ``sub_goal="nearest"`` that is
    the nearest goal of each kind; with all other kinds of sub-goals it is the goal of each kind
    that was assigned to this robot, however near others are, and a kind of which it was assigned
    none has nearness 0.

    Of equally near goals, the one whose goal set the environment names first is taken; so it is
    when no goal is known.

    :param roles: the roles, in order, each with a goal set of its own
    :param goal_nearness: what the environment declares, see ``env_declarations.declared_goals``
    :raises ValueError: if the environment does not declare the goal set of a role, or two roles
        have the same
    """

    def __init__(self, roles: Sequence[Role], goal_nearness: GoalNearness) -> None:
        if not goal_nearness:
            raise ValueError(
                "role_control='nearest' needs an environment that declares goal_nearness, which "
                "this one does not (area search does with any sub_goal but 'none')"
            )
        of_goal_set: dict[str, int] = {}
        for index, role in enumerate(roles):
            if role.goal_set not in goal_nearness:
                known = closest("goal set", role.goal_set, goal_nearness)
                raise ValueError(f"role_control='nearest': role {role.name!r} has an {known}")
            first = of_goal_set.setdefault(role.goal_set, index)
            if first != index:
                raise ValueError(
                    f"role_control='nearest' needs a goal set for each role, but "
                    f"{roles[first].name!r} and {role.name!r} both head for {role.goal_set!r}"
                )
        chosen = [name for name in goal_nearness if name in of_goal_set]
        self._roles = np.array([of_goal_set[name] for name in chosen], np.int64)
        # With an index of all rows in front.
        self._places: list[tuple[str, Any]] = [
            (goal_nearness[name][0], (slice(None), *goal_nearness[name][1])) for name in chosen
        ]
        self.keys = tuple(dict.fromkeys(key for key, _ in self._places))
        """Observation keys that are read."""

    def __call__(self, observations: Mapping[str, np.ndarray]) -> np.ndarray:
        """Choose a role for each row.

        :param observations: key -> (rows, ...)
        :return: int64 (rows,)
        """
        nearness = [observations[key][index] for key, index in self._places]
        # argmax takes the first of equals.
        return self._roles[np.stack(nearness, axis=1).argmax(axis=1)]
