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
SUB_GOALS = ("none", "nearest", "assigned", "routes", "role_routes")
ROUTE_SUB_GOALS = ("routes", "role_routes")
ROLE_ROUTES = ("explore", "cover")
SUB_GOAL_DISCOUNT = 0.9

# Discounted distances are summed as integers, so that a sum does not depend on its order.
_SCALE_BITS = 32
SCALE = float(1 << _SCALE_BITS)


def sub_goal_shape(sub_goal: str) -> tuple[int, int]:
    """Rows and columns of a robot's path features.

    A row per goal set, with "routes" one more for the robot's route, and with "role_routes" before
    all these one for its route in each role; in columns first moves and nearness, and unless it is
    "nearest" what there is to gain by first move.
    """
    rows = first_goal_row(sub_goal) + len(GOAL_SETS) + (sub_goal in ROUTE_SUB_GOALS)
    return rows, N_ACTIONS + 1 + (sub_goal != "nearest") * N_ACTIONS


def first_goal_row(sub_goal: str) -> int:
    """Row of a robot's path features with which those of the goal sets begin."""
    return len(ROLE_ROUTES) if sub_goal == "role_routes" else 0


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
    searches = 1 if sub_goal == "nearest" else n_agents
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
        np.zeros(n_agents, np.int64),  # visited
        np.zeros((n_agents, 4), np.int64),  # ends, see area_search.matching
        np.zeros(n_agents, np.int64),  # chosen
        np.zeros(area, np.uint8),  # blocked
        np.zeros(area, np.int32),  # owner
        np.full(area, -1, np.int32),  # owner_distance
        np.zeros(N_ACTIONS, np.int64),  # territory
        np.zeros(n_agents, np.int64),  # source
    )


@njit(cache=True, inline="always")
def start_at(start: int, distance: np.ndarray, moves: np.ndarray, queue: np.ndarray) -> int:
    """Begin a search at a robot's cell: visit it; return the number of visited cells."""
    moves[start] = 1
    distance[start] = 0
    queue[0] = start
    return 1


@njit(cache=True, inline="always")
def expand(
    cells: np.ndarray,
    stride: int,
    cell: int,
    distance: np.ndarray,
    moves: np.ndarray,
    queue: np.ndarray,
    tail: int,
) -> int:
    """Visit the known free neighbors of a cell; the arrays are those of :func:`search`.

    Once all cells of the queue before a cell are expanded, its first moves are complete.

    :param tail: number of visited cells
    :return: number of visited cells
    """
    d = distance[cell]
    mask = moves[cell]
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
def search(
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
    head, tail = 0, start_at(start, distance, moves, queue)
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
        tail = expand(cells, stride, cell, distance, moves, queue, tail)
    return tail


@njit(cache=True)
def encode(out: np.ndarray, distance: int, moves: int, table: np.ndarray) -> None:
    """Write first moves and nearness of one goal; a negative distance means that there is none."""
    out[:] = 0.0
    if distance >= 0:
        for action in range(N_ACTIONS):
            out[action] = (moves >> action) & 1
        out[N_ACTIONS] = table[min(distance, table.shape[0] - 1)] / SCALE


@njit(cache=True, nogil=True)
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
            visited = search(
                flat, stride, start, goals[m], False, distance[0], moves[0], queue[0], nearest
            )
            for k in range(visited):
                moves[0, queue[0, k]] = 0
            for goal_set in range(2):
                encode(out[m, i, goal_set], nearest[goal_set, 0], nearest[goal_set, 1], table)
