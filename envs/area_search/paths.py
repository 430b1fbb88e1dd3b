"""Numba kernels for the goal-augmented observation: shortest paths over the known map.

The paper's GA-POMDP (Section IV) augments an observation with a sub-goal: an explorer heads for the
nearest frontier cell, a coverer for the nearest target. One breadth-first search per robot, over
known free cells, carries the set of first moves with which a shortest path can start.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from area_search.cells import (
    EXPLORED,
    FRONTIER,
    KNOWN_TARGET,
    MOVE_COLUMNS,
    MOVE_ROWS,
    N_ACTIONS,
    OBSTACLE,
)

GOAL_SETS = ("frontier", "target")
SUB_GOALS = ("none", "nearest", "assigned")
SUB_GOAL_DISCOUNT = 0.9

# Discounted distances are summed as integers, so that a sum does not depend on its order.
_SCALE_BITS = 32
SCALE = float(1 << _SCALE_BITS)
_NOBODY = -1


def sub_goal_width(sub_goal: str) -> int:
    """Features per goal set: first moves and nearness, and with "assigned" the territory."""
    return {"none": 0, "nearest": N_ACTIONS + 1, "assigned": 2 * N_ACTIONS + 1}[sub_goal]


def discount_table() -> np.ndarray:
    """``SUB_GOAL_DISCOUNT ** distance`` in fixed point, until it vanishes.

    :return: int64 array; its last entry is 0 and stands for all larger distances
    """
    length = int(np.ceil(_SCALE_BITS * np.log(2.0) / -np.log(SUB_GOAL_DISCOUNT))) + 2
    table = np.round(SUB_GOAL_DISCOUNT ** np.arange(length) * SCALE).astype(np.int64)
    table[-1] = 0
    return table


def search_scratch(sub_goal: str, n_agents: int, area: int) -> tuple[np.ndarray, ...]:
    """Allocate what the kernel of a ``sub_goal`` works on.

    :param area: cells of a padded map
    :return: the arguments from ``table`` up to ``out``
    """
    searches = n_agents if sub_goal == "assigned" else 1
    common = (
        discount_table(),
        np.zeros((searches, area), np.int32),  # distance
        np.zeros((searches, area), np.uint8),  # moves
        np.zeros((searches, area), np.int32),  # queue
        np.zeros((2, 2), np.int64),  # nearest
    )
    if sub_goal == "nearest":
        return common
    return (
        *common,
        np.zeros((n_agents, area), np.int32),  # lists
        np.zeros((3, n_agents), np.int64),  # counts
        np.zeros(n_agents, np.int64),  # cursor
        np.zeros(n_agents, np.int64),  # chosen
        np.zeros(area, np.uint8),  # blocked
        np.zeros(area, np.int32),  # owner
        np.full(area, -1, np.int32),  # owner_distance
        np.zeros(N_ACTIONS, np.int64),  # territory
    )


@njit(cache=True)
def _search(
    cells: np.ndarray,
    stride: int,
    start: int,
    n_goals: np.ndarray,
    everything: bool,
    distance: np.ndarray,
    moves: np.ndarray,
    queue: np.ndarray,
    nearest: np.ndarray,
) -> int:
    """Search from one cell over known free cells.

    :param cells: uint8 (n,), the padded map, flat
    :param stride: cells per padded row
    :param n_goals: int64 (2,), frontier cells and known targets there are; a set that is empty
        is not searched for
    :param everything: stop behind the last goal; else behind the nearest goal of each set
    :param distance: int32 (n,), written for visited cells
    :param moves: uint8 (n,), all 0 before; written for visited cells: bit ``a`` is set when a
        shortest path there can start with action ``a`` (bit 0: the robot is there)
    :param queue: int32 (n,), the visited cells by distance
    :param nearest: int64 (2, 2), per goal set the distance of the nearest goal (-1: none) and the
        first moves towards all goals at that distance
    :return: number of visited cells
    """
    nearest[:, 0] = -1
    nearest[:, 1] = 0
    moves[start] = 1
    distance[start] = 0
    queue[0] = start
    head, tail = 0, 1
    wanted = (n_goals[0] > 0) + (n_goals[1] > 0)
    left = n_goals[0] + n_goals[1]
    last = -1
    while head < tail and left > 0:
        cell = queue[head]
        d = distance[cell]
        if not everything and wanted == 0 and d > last:
            break
        head += 1
        bits = cells[cell]
        mask = moves[cell]
        left -= ((bits & FRONTIER) > 0) + ((bits & KNOWN_TARGET) > 0)
        if bits & FRONTIER and (nearest[0, 0] < 0 or nearest[0, 0] == d):
            wanted -= nearest[0, 0] < 0
            nearest[0, 0] = d
            nearest[0, 1] |= mask
            last = d
        if bits & KNOWN_TARGET and (nearest[1, 0] < 0 or nearest[1, 0] == d):
            wanted -= nearest[1, 0] < 0
            nearest[1, 0] = d
            nearest[1, 1] |= mask
            last = d
        for action in range(1, N_ACTIONS):
            neighbor = cell + MOVE_ROWS[action] * stride + MOVE_COLUMNS[action]
            if cells[neighbor] & (EXPLORED | OBSTACLE) != EXPLORED:
                continue
            first = np.uint8(1 << action) if d == 0 else mask
            if moves[neighbor] == 0:
                moves[neighbor] = first
                distance[neighbor] = d + 1
                queue[tail] = neighbor
                tail += 1
            elif distance[neighbor] == d + 1:
                moves[neighbor] |= first
    return tail


@njit(cache=True)
def _encode(out: np.ndarray, distance: int, moves: int, table: np.ndarray) -> None:
    """Write first moves and nearness of one goal; a negative distance means that there is none."""
    out[:] = 0.0
    if distance >= 0:
        for action in range(N_ACTIONS):
            out[action] = (moves >> action) & 1
        out[N_ACTIONS] = table[min(distance, table.shape[0] - 1)] / SCALE


@njit(cache=True)
def nearest_sub_goals(
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
    out: np.ndarray,
) -> None:
    """Per robot and goal set: first moves towards the nearest goals, and their nearness.

    :param which: bool (n_teams,), the teams to write
    :param cells: uint8 (n_teams, height + 2 border, width + 2 border)
    :param position: int32 (n_teams, n_agents, 2)
    :param goals: int64 (n_teams, 2), cells in each goal set
    :param table: int64, see :func:`discount_table`
    :param out: float32 (n_teams, n_agents, 2, 6), overwritten: five first-move flags (stop, up,
        right, down, left) and ``0.9 ** distance``; all 0 when no goal can be reached
    """
    stride = cells.shape[2]
    for m in range(position.shape[0]):
        if not which[m]:
            continue
        flat = cells[m].reshape(-1)
        for i in range(position.shape[1]):
            start = (position[m, i, 0] + border) * stride + position[m, i, 1] + border
            visited = _search(
                flat, stride, start, goals[m], False, distance[0], moves[0], queue[0], nearest
            )
            for k in range(visited):
                moves[0, queue[0, k]] = 0
            for goal_set in range(2):
                _encode(out[m, i, goal_set], nearest[goal_set, 0], nearest[goal_set, 1], table)


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
    distance: np.ndarray,
    lists: np.ndarray,
    counts: np.ndarray,
    cursor: np.ndarray,
    blocked: np.ndarray,
    chosen: np.ndarray,
) -> None:
    """Match robots and goals one to one, nearest pair first.

    Ties go to the robot with the lower index, then to the cell that comes first in the map.

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
            while cursor[i] < counts[i] and blocked[lists[i, cursor[i]]]:
                cursor[i] += 1
            if cursor[i] < counts[i]:
                d = distance[i, lists[i, cursor[i]]]
                if best == _NOBODY or d < best_distance:
                    best, best_distance = i, d
        if best == _NOBODY:
            break
        goal = lists[best, cursor[best]]
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
            start = (position[m, i, 0] + border) * stride + position[m, i, 1] + border
            counts[2, i] = _search(
                flat, stride, start, goals[m], True, distance[i], moves[i], queue[i], nearest
            )
        for goal_set in range(2):
            bit = FRONTIER if goal_set == 0 else KNOWN_TARGET
            for i in range(n_agents):
                counts[goal_set, i] = _list_goals(
                    flat, bit, queue[i], counts[2, i], distance[i], lists[i]
                )
            count = counts[goal_set]
            _assign(stride, 1 - goal_set, distance, lists, count, cursor, blocked, chosen)
            for i in range(n_agents):
                for k in range(count[i]):
                    cell = lists[i, k]
                    d = distance[i, cell]
                    if owner_distance[cell] < 0 or d < owner_distance[cell]:
                        owner_distance[cell] = d
                        owner[cell] = i
                    elif d == owner_distance[cell]:
                        owner[cell] = _NOBODY
            for i in range(n_agents):
                territory[:] = 0
                for k in range(count[i]):
                    cell = lists[i, k]
                    if owner[cell] == i:
                        worth = table[min(distance[i, cell], last)]
                        for action in range(N_ACTIONS):
                            territory[action] += worth * ((moves[i, cell] >> action) & 1)
                features = out[m, i, goal_set]
                goal = chosen[i]
                if goal == _NOBODY:
                    _encode(features[: N_ACTIONS + 1], -1, 0, table)
                else:
                    _encode(features[: N_ACTIONS + 1], distance[i, goal], moves[i, goal], table)
                for action in range(N_ACTIONS):
                    features[N_ACTIONS + 1 + action] = territory[action] / SCALE
            for i in range(n_agents):
                for k in range(count[i]):
                    owner_distance[lists[i, k]] = -1
        for i in range(n_agents):
            for k in range(counts[2, i]):
                moves[i, queue[i, k]] = 0
