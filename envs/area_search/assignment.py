"""Numba kernel for ``sub_goal="assigned"``: goals shared out among the robots of a team."""

from __future__ import annotations

import numpy as np
from numba import njit

from area_search.cells import FRONTIER, KNOWN_TARGET, N_ACTIONS
from area_search.matching import (
    CURSOR,
    HEAD,
    LISTED,
    NOBODY,
    TAIL,
    assign,
    list_goals,
    share_searches,
)
from area_search.paths import SCALE, encode, search


@njit(cache=True, nogil=True)
def assigned_sub_goals(
    which: np.ndarray,
    cells: np.ndarray,
    border: int,
    position: np.ndarray,
    goals: np.ndarray,
    table: np.ndarray,
    distance: np.ndarray,
    moves: np.ndarray,
    queue: np.ndarray,
    nearest: np.ndarray,
    lists: np.ndarray,
    visited: np.ndarray,
    ends: np.ndarray,
    chosen: np.ndarray,
    blocked: np.ndarray,
    owner: np.ndarray,
    owner_distance: np.ndarray,
    territory: np.ndarray,
    source: np.ndarray,
    out: np.ndarray,
) -> None:
    """Per robot and goal set: the goal assigned to it, and the goals that are its own to reach.

    :param out: float32 (n_teams, n_agents, 2, 11), overwritten. The first six are those of
        :func:`nearest_sub_goals` for the one goal that the matching gave to the robot; a frontier
        goal blocks its 3 x 3 neighborhood for team mates; all 0 for a robot without a goal. The
        last five: per first move, the sum of ``0.9 ** distance`` over the goals that are strictly
        nearer to this robot than to any team mate and that a shortest path reaches by that move
    """
    stride = cells.shape[2]
    n_agents = position.shape[1]
    last = table.shape[0] - 1
    for m in range(position.shape[0]):
        if not which[m]:
            continue
        flat = cells[m].reshape(-1)
        share_searches(position[m], source)
        for i in range(n_agents):
            if source[i] == i:
                start = (position[m, i, 0] + border) * stride + position[m, i, 1] + border
                visited[i] = search(
                    flat, stride, start, goals[m], True, distance[i], moves[i], queue[i], nearest
                )
                # Nothing is left to search.
                ends[i, HEAD] = ends[i, TAIL]
        for goal_set in range(2):
            bit = FRONTIER if goal_set == 0 else KNOWN_TARGET
            for i in range(n_agents):
                if source[i] == i:
                    ends[i, LISTED] = list_goals(
                        flat, bit, queue[i], visited[i], distance[i], lists[i]
                    )
                    ends[i, CURSOR] = 0
            assign(
                flat,
                stride,
                bit,
                goals[m, goal_set],
                bit & KNOWN_TARGET,
                0,
                0,
                source,
                distance,
                moves,
                queue,
                ends,
                lists,
                blocked,
                chosen,
            )
            for i in range(n_agents):
                s = source[i]
                for k in range(ends[s, LISTED]):
                    cell = lists[s, k]
                    d = distance[s, cell]
                    if owner_distance[cell] < 0 or d < owner_distance[cell]:
                        owner_distance[cell] = d
                        owner[cell] = i
                    elif d == owner_distance[cell]:
                        owner[cell] = NOBODY
            for i in range(n_agents):
                territory[:] = 0
                s = source[i]
                # A robot that shares its cell has nothing to itself.
                for k in range(ends[s, LISTED] if s == i else 0):
                    cell = lists[i, k]
                    if owner[cell] == i:
                        worth = table[min(distance[i, cell], last)]
                        for action in range(N_ACTIONS):
                            territory[action] += worth * ((moves[i, cell] >> action) & 1)
                features = out[m, i, goal_set]
                goal = chosen[i]
                if goal == NOBODY:
                    encode(features[: N_ACTIONS + 1], -1, 0, table)
                else:
                    encode(features[: N_ACTIONS + 1], distance[s, goal], moves[s, goal], table)
                for action in range(N_ACTIONS):
                    features[N_ACTIONS + 1 + action] = territory[action] / SCALE
            for i in range(n_agents):
                if source[i] == i:
                    for k in range(ends[i, LISTED]):
                        owner_distance[lists[i, k]] = -1
        for i in range(n_agents):
            if source[i] == i:
                for k in range(visited[i]):
                    moves[i, queue[i, k]] = 0
