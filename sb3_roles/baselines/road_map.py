"""Numba kernels between a team's map and a routing problem: distances, nodes and first steps."""

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
    TARGET,
)
from area_search.paths import expand, start_at
from sb3_roles.baselines.routing import FAR


@njit(cache=True)
def flood(
    cells: np.ndarray,
    stride: int,
    start: int,
    distance: np.ndarray,
    moves: np.ndarray,
    queue: np.ndarray,
) -> int:
    """Path lengths from one cell to all cells that known free cells join to it.

    :param cells: uint8 (n,), the padded map, flat
    :param distance: int32 (n,), overwritten; ``FAR`` where no path leads
    :param moves: uint8 (n,), scratch, all 0 before and after
    :param queue: int32 (n,), overwritten with the visited cells by distance
    :return: number of visited cells
    """
    distance[:] = FAR
    head, visited = 0, start_at(start, distance, moves, queue)
    while head < visited:
        visited = expand(cells, stride, queue[head], distance, moves, queue, visited)
        head += 1
    for k in range(visited):
        moves[queue[k]] = 0
    return visited


@njit(cache=True)
def path_lengths(
    cells: np.ndarray, stride: int, starts: np.ndarray, nodes: np.ndarray
) -> np.ndarray:
    """Exact path lengths over known free cells.

    :param cells: uint8 (n,), the padded map, flat
    :param starts: int64 (a,), flat cells
    :param nodes: int64 (b,), flat cells
    :return: int64 (a, b), ``FAR`` where no path leads
    """
    n = cells.shape[0]
    distance, moves = np.empty(n, np.int32), np.zeros(n, np.uint8)
    queue = np.empty(n, np.int32)
    lengths = np.empty((starts.shape[0], nodes.shape[0]), np.int64)
    for i in range(starts.shape[0]):
        flood(cells, stride, starts[i], distance, moves, queue)
        for k in range(nodes.shape[0]):
            lengths[i, k] = distance[nodes[k]]
    return lengths


@njit(cache=True)
def new_views(
    cells: np.ndarray, stride: int, disc: np.ndarray, candidates: np.ndarray, least: int
) -> tuple[np.ndarray, np.ndarray]:
    """Few cells from which all is seen that can be seen from many: greedy maximum coverage.

    :param cells: uint8 (n,), the padded map, flat
    :param disc: int64 (k, 2), offsets of the sensed cells
    :param candidates: int64 (c,), flat cells
    :param least: unexplored cells that a view must add to be worth a node
    :return: int64 flat cells, the one with most unexplored cells in view first (of equal ones the
        first candidate), and int64 how many unexplored cells each adds to those before it
    """
    claimed = np.zeros(cells.shape[0], np.bool_)
    gains = np.full(candidates.shape[0], disc.shape[0], np.int64)
    chosen = np.empty(candidates.shape[0], np.int64)
    added = np.empty(candidates.shape[0], np.int64)
    n = 0
    while n < candidates.shape[0]:
        best, best_gain = -1, max(least, 1) - 1
        for c in range(candidates.shape[0]):
            # Gains only shrink, so an old one that is no better needs no new count.
            if gains[c] <= best_gain:
                continue
            gain = 0
            for k in range(disc.shape[0]):
                cell = candidates[c] + disc[k, 0] * stride + disc[k, 1]
                gain += not (cells[cell] & EXPLORED or claimed[cell])
            gains[c] = gain
            if gain > best_gain:
                best, best_gain = c, gain
        if best < 0:
            break
        chosen[n], added[n] = candidates[best], best_gain
        n += 1
        for k in range(disc.shape[0]):
            claimed[candidates[best] + disc[k, 0] * stride + disc[k, 1]] = True
    return chosen[:n], added[:n]


@njit(cache=True)
def nearest_nodes(first: np.ndarray, budget: int, per_robot: int) -> np.ndarray:
    """Which nodes to keep: those among the nearest ``per_robot`` of some robot, within the budget.

    :param first: int64 (R, n), distance from each robot to each node
    :return: bool (n,)
    """
    keep = np.zeros(first.shape[1], np.bool_)
    for robot in range(first.shape[0]):
        # A stable sort, so that ties go to the node that comes first.
        order = np.argsort(first[robot], kind="mergesort")
        for k in range(min(per_robot, order.shape[0])):
            keep[order[k]] |= first[robot, order[k]] <= budget
    return keep


@njit(cache=True)
def first_moves(
    cells: np.ndarray,
    stride: int,
    starts: np.ndarray,
    goals: np.ndarray,
    actions: np.ndarray,
) -> None:
    """First action of each robot on a shortest path to its goal.

    Among shortest paths it takes one over the most known targets, then frontier cells, then the
    action with the lowest number.

    :param cells: uint8 (n,), the padded map, flat
    :param starts: int64 (R,), flat cells of the robots
    :param goals: int64 (R,), flat cells, -1 to stay
    :param actions: int64 (R,), overwritten
    """
    n = cells.shape[0]
    distance, moves = np.empty(n, np.int32), np.zeros(n, np.uint8)
    queue, worth = np.empty(n, np.int32), np.empty(n, np.int64)
    for robot in range(starts.shape[0]):
        actions[robot] = 0
        if goals[robot] < 0 or goals[robot] == starts[robot]:
            continue
        visited = flood(cells, stride, goals[robot], distance, moves, queue)
        steps = distance[starts[robot]]
        for k in range(visited):
            cell = queue[k]
            if distance[cell] > steps:
                break
            most = -1
            for action in range(1, N_ACTIONS):
                neighbor = cell + MOVE_ROWS[action] * stride + MOVE_COLUMNS[action]
                if distance[neighbor] == distance[cell] - 1 and worth[neighbor] > most:
                    most = worth[neighbor]
                    if cell == starts[robot]:
                        actions[robot] = action
            bits = cells[cell]
            here = (bits & KNOWN_TARGET > 0) * n + (bits & FRONTIER > 0)
            worth[cell] = max(most, 0) + here


@njit(cache=True)
def reveal(cells: np.ndarray, out: np.ndarray) -> None:
    """Copy a map as it would be if all of it were known; for the Oracle only.

    :param cells: uint8 (n,), the padded map, flat
    :param out: uint8 (n,), overwritten: explored everywhere, every open target known, no frontier
    """
    for k in range(cells.shape[0]):
        cell = (cells[k] | EXPLORED) & ~FRONTIER
        out[k] = cell | KNOWN_TARGET if cell & TARGET else cell
