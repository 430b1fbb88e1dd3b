"""Numba kernels that plan routes: greedy insertion, then ruin and recreate.

Ruin and recreate is that of Schrimpf et al. (2000) with the string removals and blinks of
Christiaens and Vanden Berghe (2020), under simulated annealing. The number of rounds is fixed and
the random numbers are hashes of a counter, so that a plan is a function of the task alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from area_search.random_streams import draw, to_unit

_TAG = np.uint64(0x564550435F504C41)
_NONE = -1
_HUGE = 1 << 60
_BLINK = 0.01  # chance to overlook a place
_LONGEST_STRING = 10
_MOST_STRINGS = 3
_HOT, _COLD = 0.5, 0.5  # temperatures: the first in mean prizes, the last in units of cost


class Task(NamedTuple):
    """A routing problem, see :class:`~sb3_roles.baselines.routing.RoutingProblem`."""

    first: np.ndarray
    between: np.ndarray
    prize: np.ndarray
    lateness: np.ndarray
    budget: int
    length_weight: int


class Plan(NamedTuple):
    """Routes under construction.

    ``routes`` int64 (R, n) holds the nodes of each route, ``counts`` int64 (R,) how many, and
    ``lengths`` int64 (R,) how long it is; ``open_nodes`` bool (n,): no route visits the node.
    """

    routes: np.ndarray
    counts: np.ndarray
    lengths: np.ndarray
    open_nodes: np.ndarray


@njit(cache=True)
def _unit(counter: np.ndarray) -> float:
    """Next random number in [0, 1); ``counter`` uint64 (1,) is advanced."""
    counter[0] += np.uint64(1)
    return to_unit(draw(_TAG, _TAG, counter[0]))


@njit(cache=True)
def _best_place(
    node: int, task: Task, plan: Plan, blink: float, counter: np.ndarray
) -> tuple[int, int, int, int]:
    """Cheapest feasible place of a node: cost, robot (-1: none), index in its route, extra length.

    :param blink: chance to overlook a place
    """
    first, between, lateness = task.first, task.between, task.lateness
    routes, counts, lengths = plan.routes, plan.counts, plan.lengths
    best, best_robot, best_place, best_extra = _HUGE, _NONE, 0, 0
    for robot in range(counts.shape[0]):
        reach = first[robot, node]
        if reach > task.budget:
            continue
        count, room = counts[robot], task.budget - lengths[robot]
        arrival = 0
        # What one step more costs the nodes from a place on.
        waiting = 0
        for k in range(count):
            waiting += lateness[routes[robot, k]]
        for place in range(count + 1):
            into = reach if place == 0 else between[routes[robot, place - 1], node]
            extra, old, following = into, 0, 0
            if place < count:
                following = routes[robot, place]
                if place == 0:
                    old = first[robot, following]
                else:
                    old = between[routes[robot, place - 1], following]
                extra += between[node, following] - old
            if extra <= room:
                cost = task.length_weight * extra + extra * waiting
                cost += lateness[node] * (arrival + into)
                if cost < best and (blink == 0.0 or _unit(counter) >= blink):
                    best, best_robot, best_place, best_extra = cost, robot, place, extra
            if place < count:
                arrival += old
                waiting -= lateness[following]
    return best, best_robot, best_place, best_extra


@njit(cache=True)
def _insert(node: int, robot: int, place: int, extra: int, plan: Plan) -> None:
    routes, counts = plan.routes, plan.counts
    for k in range(counts[robot], place, -1):
        routes[robot, k] = routes[robot, k - 1]
    routes[robot, place] = node
    counts[robot] += 1
    plan.lengths[robot] += extra
    plan.open_nodes[node] = False


@njit(cache=True)
def _measure(task: Task, plan: Plan) -> int:
    """Cost of a plan; rewrites ``lengths`` and ``open_nodes``."""
    routes, open_nodes = plan.routes, plan.open_nodes
    open_nodes[:] = True
    total = 0
    for robot in range(plan.counts.shape[0]):
        length = 0
        for k in range(plan.counts[robot]):
            node = routes[robot, k]
            if k == 0:
                length += task.first[robot, node]
            else:
                length += task.between[routes[robot, k - 1], node]
            total += task.lateness[node] * length
            open_nodes[node] = False
        plan.lengths[robot] = length
        total += task.length_weight * length
    for node in range(open_nodes.shape[0]):
        if open_nodes[node]:
            total += task.prize[node]
    return total


@njit(cache=True)
def _copy(source: Plan, out: Plan) -> None:
    out.counts[:] = source.counts
    out.lengths[:] = source.lengths
    out.open_nodes[:] = source.open_nodes
    for robot in range(source.counts.shape[0]):
        for k in range(source.counts[robot]):
            out.routes[robot, k] = source.routes[robot, k]


@njit(cache=True)
def _greedy(task: Task, plan: Plan, counter: np.ndarray) -> None:
    """Insert the node with the best ratio of gain to extra length, until nothing gains."""
    while True:
        chosen, at_robot, at_place, added = _NONE, _NONE, 0, 0
        best_ratio = 0.0
        for node in range(task.prize.shape[0]):
            if not plan.open_nodes[node]:
                continue
            cost, robot, place, extra = _best_place(node, task, plan, 0.0, counter)
            if robot != _NONE and cost < task.prize[node]:
                # What lies on the way costs nothing: half a step keeps the ratio finite.
                ratio = (task.prize[node] - cost) / (extra + 0.5)
                if ratio > best_ratio:
                    best_ratio = ratio
                    chosen, at_robot, at_place, added = node, robot, place, extra
        if chosen == _NONE:
            return
        _insert(chosen, at_robot, at_place, added, plan)


@njit(cache=True)
def _ruin(task: Task, plan: Plan, touched: np.ndarray, counter: np.ndarray) -> None:
    """Remove a string of nodes from each of some routes, near one random node.

    :param touched: bool (R,), scratch
    """
    routes, counts = plan.routes, plan.counts
    n_robots, n_nodes = routes.shape
    middle = int(_unit(counter) * n_nodes)
    n_strings = 1 + int(_unit(counter) * min(n_robots, _MOST_STRINGS))
    touched[:] = False
    for _ in range(n_strings):
        robot, at, near = _NONE, 0, _HUGE
        for i in range(n_robots):
            if touched[i]:
                continue
            for k in range(counts[i]):
                d = task.between[middle, routes[i, k]]
                if d < near:
                    robot, at, near = i, k, d
        if robot == _NONE:
            break
        touched[robot] = True
        count = counts[robot]
        size = min(count, 1 + int(_unit(counter) * _LONGEST_STRING))
        low = max(0, min(at - int(_unit(counter) * size), count - size))
        for k in range(low, count - size):
            routes[robot, k], routes[robot, k + size] = routes[robot, k + size], routes[robot, k]
        counts[robot] = count - size
    _measure(task, plan)


@njit(cache=True)
def _recreate(task: Task, plan: Plan, order: np.ndarray, counter: np.ndarray) -> None:
    """Insert the open nodes, one after the other in random order, where they gain.

    :param order: int64 (n,), scratch
    """
    n = 0
    for node in range(order.shape[0]):
        if plan.open_nodes[node]:
            k = int(_unit(counter) * (n + 1))
            order[n] = order[k]
            order[k] = node
            n += 1
    for k in range(n):
        node = order[k]
        cost, robot, place, extra = _best_place(node, task, plan, _BLINK, counter)
        if robot != _NONE and cost < task.prize[node]:
            _insert(node, robot, place, extra, plan)


@njit(cache=True)
def improve(task: Task, plan: Plan, now: Plan, best: Plan, rounds: int) -> int:
    """Complete a plan greedily, then improve it.

    :param plan: ``routes`` and ``counts`` of the plan to begin with; scratch from there on
    :param now: scratch of the same shapes
    :param best: overwritten with the best plan that was found
    :param rounds: rounds of ruin and recreate
    :return: its cost
    """
    counter = np.zeros(1, np.uint64)
    order = np.zeros(task.prize.shape[0], np.int64)
    touched = np.zeros(plan.counts.shape[0], np.bool_)
    _measure(task, plan)
    _greedy(task, plan, counter)
    cost = least = _measure(task, plan)
    _copy(plan, now)
    _copy(plan, best)
    hot = max(_HOT * task.prize.mean(), _COLD)
    for k in range(rounds):
        _ruin(task, plan, touched, counter)
        _recreate(task, plan, order, counter)
        new = _measure(task, plan)
        temperature = hot * (_COLD / hot) ** (k / rounds)
        if new < cost - temperature * np.log(1.0 - _unit(counter)):
            cost = new
            _copy(plan, now)
            if new < least:
                least = new
                _copy(plan, best)
        else:
            _copy(now, plan)
    return least
