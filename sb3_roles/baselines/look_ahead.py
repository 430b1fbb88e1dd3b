"""The row ``look_ahead``: whole teams that plan a few steps ahead, in microseconds.

Ours. It is the fast relative of ``planner``: routes over the known map, worth what they cover and
see and less as that comes later, planned by one robot after the other over what the others leave.
Targets are worth 1, unseen cells the number of targets to be expected on them. Where ``planner``
orders distant goals into long routes and searches that for milliseconds, this looks some steps
ahead along all ways at once, see :mod:`area_search.look_ahead`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from area_search.look_ahead import plan_routes
from area_search.look_ahead_data import (
    Labels,
    Marks,
    Plans,
    Timetable,
    make_labels,
    make_marks,
    make_plans,
    make_timetable,
)
from area_search.look_ahead_search import forget
from sb3_roles.baselines.greedy import Walker, first_move, random_bits


class LookAheadController(Walker):
    """Every robot takes the first step of its route; all routes are planned anew at each step.

    Among the moves with which a route can begin it takes one that goes straight on, else any. A
    robot that can reach nothing worth a step stays.
    """

    def _allocate(self, n_teams: int, n: int, area: int) -> tuple[Any, ...]:
        assert self.batch is not None
        return (
            make_timetable(self.batch.scene, self.batch.cells.shape[2]),
            make_marks(area),
            make_labels(area),
            make_plans(n, area),
            np.zeros((n_teams, n), np.int64),  # heading
        )

    def _walk(self, *arguments: Any) -> None:
        _walk_routes(*arguments)


@njit(cache=True)
def _walk_routes(
    keys: np.ndarray,
    episodes: np.ndarray,
    steps: np.ndarray,
    cells: np.ndarray,
    border: int,
    position: np.ndarray,
    timetable: Timetable,
    marks: Marks,
    labels: Labels,
    plans: Plans,
    heading: np.ndarray,
    actions: np.ndarray,
) -> None:
    """Choose the actions of :class:`LookAheadController`.

    :param heading: int64 (n_teams, n_agents), the last actions
    """
    n_agents, routes = position.shape[1], plans.best
    for m in range(position.shape[0]):
        plan_routes(cells[m], border, position[m], steps[m], timetable, marks, labels, plans)
        forget(marks)
        for i in range(n_agents):
            action = 0
            if routes.lengths[i] > 0:
                bits = random_bits(keys[m], episodes[m], steps[m] * n_agents + i)
                action = first_move(routes.first[i], heading[m, i], bits)
            heading[m, i] = actions[m, i] = action
