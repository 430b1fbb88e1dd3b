"""Numba kernels for ``sub_goal="assigned"``: goals shared out among the robots of a team."""

from __future__ import annotations

import numpy as np
from numba import njit

from area_search.cells import FRONTIER, KNOWN_TARGET, N_ACTIONS
from area_search.paths import SCALE, encode, search

_NOBODY = -1


@njit(cache=True)
def _list_goals(
    cells: np.ndarray,
    bit: int,
    queue: np.ndarray,
    visited: int,
    distance: np.ndarray,
    out: np.ndarray,
) -> int:
    """Collect a robot's reachable goals by (distance, cell); return how many there are."""
    n = 0
    for k in range(visited):
        cell = queue[k]
        if not cells[cell] & bit:
            continue
        # The queue is ordered by distance already: sort by cell among equals.
        j = n
        while j > 0 and distance[out[j - 1]] == distance[cell] and out[j - 1] > cell:
            out[j] = out[j - 1]
            j -= 1
        out[j] = cell
        n += 1
    return n


@njit(cache=True)
def _assign(
    stride: int,
    spread: int,
    source: np.ndarray,
    distance: np.ndarray,
    lists: np.ndarray,
    counts: np.ndarray,
    cursor: np.ndarray,
    blocked: np.ndarray,
    chosen: np.ndarray,
) -> None:
    """Match robots and goals one to one, nearest pair first.

    Ties go to the robot with the lower index, then to the cell that comes first in the map.

    :param source: int64 (n_agents,), whose search and list of goals a robot shares
    :param spread: a chosen goal blocks the cells up to this far away (1: its 3 x 3 neighborhood)
    :param blocked: uint8 (n,), all 0 before and after
    :param chosen: int64 (n_agents,), overwritten with cells, or -1
    """
    n_agents = chosen.shape[0]
    chosen[:] = _NOBODY
    cursor[:] = 0
    while True:
        best, best_distance = _NOBODY, 0
        for i in range(n_agents):
            if chosen[i] != _NOBODY:
                continue
            s = source[i]
            # Robots in one cell share the cursor, too: what is blocked is so for all of them.
            while cursor[s] < counts[s] and blocked[lists[s, cursor[s]]]:
                cursor[s] += 1
            if cursor[s] < counts[s]:
                d = distance[s, lists[s, cursor[s]]]
                if best == _NOBODY or d < best_distance:
                    best, best_distance = i, d
        if best == _NOBODY:
            break
        goal = lists[source[best], cursor[source[best]]]
        chosen[best] = goal
        for dy in range(-spread, spread + 1):
            for dx in range(-spread, spread + 1):
                blocked[goal + dy * stride + dx] = 1
    for i in range(n_agents):
        if chosen[i] != _NOBODY:
            for dy in range(-spread, spread + 1):
                for dx in range(-spread, spread + 1):
                    blocked[chosen[i] + dy * stride + dx] = 0


@njit(cache=True)
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
    counts: np.ndarray,
    cursor: np.ndarray,
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
        for i in range(n_agents):
            # Robots in one cell share one search; teams start crowded.
            source[i] = i
            for j in range(i):
                if (
                    position[m, j, 0] == position[m, i, 0]
                    and position[m, j, 1] == position[m, i, 1]
                ):
                    source[i] = j
                    break
            if source[i] == i:
                start = (position[m, i, 0] + border) * stride + position[m, i, 1] + border
                counts[2, i] = search(
                    flat, stride, start, goals[m], True, distance[i], moves[i], queue[i], nearest
                )
        for goal_set in range(2):
            bit = FRONTIER if goal_set == 0 else KNOWN_TARGET
            for i in range(n_agents):
                if source[i] == i:
                    counts[goal_set, i] = _list_goals(
                        flat, bit, queue[i], counts[2, i], distance[i], lists[i]
                    )
            count = counts[goal_set]
            _assign(stride, 1 - goal_set, source, distance, lists, count, cursor, blocked, chosen)
            for i in range(n_agents):
                s = source[i]
                for k in range(count[s]):
                    cell = lists[s, k]
                    d = distance[s, cell]
                    if owner_distance[cell] < 0 or d < owner_distance[cell]:
                        owner_distance[cell] = d
                        owner[cell] = i
                    elif d == owner_distance[cell]:
                        owner[cell] = _NOBODY
            for i in range(n_agents):
                territory[:] = 0
                s = source[i]
                # A robot that shares its cell has nothing to itself.
                for k in range(count[s] if s == i else 0):
                    cell = lists[i, k]
                    if owner[cell] == i:
                        worth = table[min(distance[i, cell], last)]
                        for action in range(N_ACTIONS):
                            territory[action] += worth * ((moves[i, cell] >> action) & 1)
                features = out[m, i, goal_set]
                goal = chosen[i]
                if goal == _NOBODY:
                    encode(features[: N_ACTIONS + 1], -1, 0, table)
                else:
                    encode(features[: N_ACTIONS + 1], distance[s, goal], moves[s, goal], table)
                for action in range(N_ACTIONS):
                    features[N_ACTIONS + 1 + action] = territory[action] / SCALE
            for i in range(n_agents):
                if source[i] == i:
                    for k in range(count[i]):
                        owner_distance[lists[i, k]] = -1
        for i in range(n_agents):
            if source[i] == i:
                for k in range(counts[2, i]):
                    moves[i, queue[i, k]] = 0
