"""Routes with prizes: what the VRPC, planner and Oracle rows solve for every plan.

Several robots start in different places, each may travel so far and ends anywhere; every node that
some robot visits saves its prize. This is the team orienteering problem with open routes, or in the
paper's words a vehicle routing problem with drop penalties. It is solved here by our own kernels of
``ruin_recreate``, and in ``ortools_routing`` by OR-Tools.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sb3_roles.baselines.ruin_recreate import Plan, Task, improve

FAR = 1 << 20
"""A distance that no budget allows: between cells that no path joins."""
Routes = list[list[int]]


# Without eq=False the generated comparison would ask for the truth value of whole arrays.
@dataclass(frozen=True, eq=False)
class RoutingProblem:
    """Open routes of R robots over n optional nodes.

    The cost of a plan, which is to be minimized, is ``length_weight`` x the length of all routes
    + over the visited nodes, ``lateness`` x the time of arrival + the prizes of the nodes that no
    route visits.

    :param first: int64 (R, n), distance from each robot to each node, ``FAR`` if there is no path
    :param between: int64 (n, n), distance between nodes, symmetric
    :param prize: int64 (n,), what leaving a node out costs (the paper's drop penalty)
    :param lateness: int64 (n,), cost of each step until a node is visited; all 0 in the paper
    :param budget: longest allowed route of each robot, below ``FAR``
    :param length_weight: cost of one step
    """

    first: np.ndarray
    between: np.ndarray
    prize: np.ndarray
    lateness: np.ndarray
    budget: int
    length_weight: int = 1

    def arrivals(self, robot: int, route: Sequence[int]) -> list[int]:
        """Times at which a robot reaches the nodes of its route, in steps."""
        times = [int(self.first[robot, route[0]])] if route else []
        for a, b in pairwise(route):
            times.append(times[-1] + int(self.between[a, b]))
        return times

    def cost(self, routes: Sequence[Sequence[int]]) -> int:
        """Cost of a plan, see the class.

        :param routes: for each robot the nodes that it visits, in order
        :raises ValueError: if a node is visited twice, or a route is longer than the budget
        """
        visited = [node for route in routes for node in route]
        if len(set(visited)) != len(visited) or len(routes) != len(self.first):
            raise ValueError("a plan has one route per robot and visits no node twice")
        total = int(self.prize.sum()) - sum(int(self.prize[node]) for node in visited)
        for robot, route in enumerate(routes):
            times = self.arrivals(robot, route)
            if times and times[-1] > self.budget:
                raise ValueError(
                    f"the route of robot {robot} is {times[-1]} steps long, "
                    f"the budget is {self.budget}"
                )
            total += self.length_weight * (times[-1] if times else 0)
            total += sum(int(self.lateness[k]) * t for k, t in zip(route, times, strict=True))
        return total


def plan_routes(
    problem: RoutingProblem, rounds: int = 0, start: Sequence[Sequence[int]] | None = None
) -> Routes:
    """Plan by greedy insertion, then by ruin and recreate.

    :param problem: what to solve
    :param rounds: rounds of ruin and recreate, 0 for the greedy plan
    :param start: a plan within the budget to complete and improve, instead of an empty one
    :return: for each robot the nodes that it visits, in order; never worse than ``start``
    """
    n_robots, n_nodes = problem.first.shape
    if n_nodes == 0:
        return [[] for _ in range(n_robots)]
    task = Task(
        problem.first,
        problem.between,
        problem.prize,
        problem.lateness,
        problem.budget,
        problem.length_weight,
    )
    plan, now, best = (_empty_plan(n_robots, n_nodes) for _ in range(3))
    for robot, route in enumerate(start or ()):
        plan.counts[robot] = len(route)
        plan.routes[robot, : len(route)] = route
    improve(task, plan, now, best, rounds)
    return [best.routes[robot, : best.counts[robot]].tolist() for robot in range(n_robots)]


def _empty_plan(n_robots: int, n_nodes: int) -> Plan:
    return Plan(
        np.zeros((n_robots, n_nodes), np.int64),
        np.zeros(n_robots, np.int64),
        np.zeros(n_robots, np.int64),
        np.ones(n_nodes, np.bool_),
    )
