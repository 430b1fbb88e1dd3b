"""Vehicle routing over what the team knows: the VRPC row (Tolstaya et al. 2021), and ours.

From the paper: known uncovered targets and frontier cells are the nodes; one open route per robot
over known free cells; costs are path lengths; no route is longer than the steps that are left; each
node can be left out at a penalty; new plans as the map grows; OR-Tools with PATH_CHEAPEST_ARC and
a bounded local search. The paper does not go beyond 8 robots.

That is :class:`VRPController`. What it shares with ours: frontier cells are thinned to those that
together see all that the frontier can see (greedy maximum coverage), and each is worth the
unexplored cells it adds; only the nearest nodes of each robot are kept, so that teams of any size
can be planned for; robots that a plan has no use for, many in a large team, plan once more as if
they were alone; where OR-Tools finds nothing better, greedy insertion answers.

:class:`RoutePlanner`, the row ``planner``, is ours: (1) What a node is worth falls linearly with
its time of arrival. The map grows while robots walk, so the far end of a plan is never carried out,
and an objective that is blind to order leaves near nodes for later; this is what makes it strong.
(2) Plans begin with what is left of the last one and are made by our own ruin and recreate, which
finds in a few milliseconds what OR-Tools needs seconds for; OR-Tools can go on from there
(``solutions``).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from area_search.cells import FRONTIER, KNOWN_TARGET
from sb3_roles.baselines.road_map import nearest_nodes, new_views, path_lengths
from sb3_roles.baselines.route_controller import RouteController, open_targets
from sb3_roles.baselines.routing import Routes, RoutingProblem, plan_routes

if TYPE_CHECKING:
    from area_search.batch import BatchedAreaSearch


class RoutePlanner(RouteController):
    """Plans routes over known targets and frontier cells, anew whenever the map has changed.

    A new plan is due when a goal appeared that the last plan did not know, when a robot's next goal
    is gone without it (a team mate covered it or saw behind it), and when a robot has nothing
    left to do. Without any node that it can reach in time a robot stays.

    :param rounds: see :class:`~sb3_roles.baselines.route_controller.RouteController`
    :param solutions: see there
    :param seconds: see there
    :param cold: see there
    :param target_prize: penalty for leaving out a known target
    :param cell_prize: the same for a frontier cell, per unexplored cell that it adds
    :param length_weight: cost of one step of a route
    :param interest: steps after which a node is worth nothing any more, 0 for never
    :param nodes_per_robot: nodes that are kept, the nearest of each robot
    :param plan_every: steps between plans that are due only because there is a new goal
    :raises ValueError: if an option is out of its range
    :raises ImportError: if OR-Tools is asked for (``solutions`` above 0) and missing
    """

    name = "planner"

    def __init__(
        self,
        rounds: int = 300,
        solutions: int = 0,
        seconds: float = 10.0,
        cold: bool = False,
        target_prize: int = 1000,
        cell_prize: int = 200,
        length_weight: int = 1,
        interest: int = 30,
        nodes_per_robot: int = 40,
        plan_every: int = 1,
    ) -> None:
        super().__init__(rounds, solutions, seconds, cold)
        self._whole(0, target_prize=target_prize, cell_prize=cell_prize)
        self._whole(0, length_weight=length_weight, interest=interest)
        self._whole(1, nodes_per_robot=nodes_per_robot, plan_every=plan_every)
        self.target_prize, self.cell_prize = target_prize, cell_prize
        self.length_weight, self.interest = length_weight, interest
        self.nodes_per_robot, self.plan_every = nodes_per_robot, plan_every

    def begin(self, batch: BatchedAreaSearch) -> None:
        """Take the teams to control; all of them have just begun an episode.

        :param batch: read only: positions, steps, and what the team knows of its map
        """
        super().begin(batch)
        self._goals = np.zeros((batch.n_teams, batch.cells[0].size), np.bool_)
        self._spare = np.zeros((batch.n_teams, batch.n_agents), np.bool_)

    def _known(self, batch: BatchedAreaSearch, team: int) -> np.ndarray:
        return batch.cells[team].reshape(-1)

    def _update(
        self,
        batch: BatchedAreaSearch,
        team: int,
        cells: np.ndarray,
        robots: np.ndarray,
        routes: Routes,
    ) -> Routes:
        goals = (cells & (FRONTIER | KNOWN_TARGET)) > 0
        goals[robots] = False
        left = [[cell for cell in route if goals[cell]] for route in routes]
        step, n_goals = int(batch.steps[team]), np.count_nonzero(goals)
        lost = any(
            old and new[:1] != old[:1] and old[0] != robot
            for old, new, robot in zip(routes, left, robots.tolist(), strict=True)
        )
        idle = n_goals > 0 and not all(left)
        known = self._goals[team]
        fresh = step % self.plan_every == 0 and bool(np.any(goals & ~known))
        if not (step == 0 or lost or idle or fresh):
            return left
        known[:] = goals
        spare = self._spare[team]
        if step == 0:
            spare[:] = False
        # What a robot does beside the plan is no part of it.
        own = [[] if alone else route for route, alone in zip(left, spare, strict=True)]
        problem, nodes = self._problem(batch.scene.horizon - step, cells, robots, goals)
        plan = self._solve(problem, self._start(problem, nodes, own))
        spare[:] = [not route for route in plan]
        self._send_spare(problem, plan)
        return [[int(nodes[k]) for k in route] for route in plan]

    def _problem(
        self, budget: int, cells: np.ndarray, robots: np.ndarray, goals: np.ndarray
    ) -> tuple[RoutingProblem, np.ndarray]:
        """Return what to solve, and the flat cells of its nodes, int64 (n,)."""
        prize = np.zeros(len(cells), np.int64)
        prize[open_targets(cells)] = self.target_prize
        frontier = np.flatnonzero((cells & FRONTIER > 0) & goals)
        views, added = new_views(cells, self._stride, self._disc, frontier, 1)
        prize[views] += self.cell_prize * added
        nodes = np.flatnonzero((prize > 0) & goals)
        first = path_lengths(cells, self._stride, robots, nodes)
        keep = nearest_nodes(first, budget, self.nodes_per_robot)
        nodes, first = nodes[keep], np.ascontiguousarray(first[:, keep])
        worth = prize[nodes]
        problem = RoutingProblem(
            first=first,
            between=path_lengths(cells, self._stride, nodes, nodes),
            prize=worth,
            lateness=worth // self.interest if self.interest else np.zeros_like(worth),
            budget=budget,
            length_weight=self.length_weight,
        )
        return problem, nodes

    def _start(self, problem: RoutingProblem, nodes: np.ndarray, routes: Routes) -> Routes:
        """What is left of the last plan, in nodes of the next problem."""
        index = {cell: k for k, cell in enumerate(nodes.tolist())}
        start = [[index[cell] for cell in route if cell in index] for route in routes]
        for robot, route in enumerate(start):
            # The map can only have brought the nodes nearer; the budget shrinks by 1 a step.
            while route and problem.arrivals(robot, route)[-1] > problem.budget:
                route.pop()
        return start

    def _send_spare(self, problem: RoutingProblem, plan: Routes) -> None:
        """Give routes to robots that the plan has no use for, where it has any nodes at all."""
        while True:
            spare = [robot for robot, route in enumerate(plan) if not route]
            if not spare or not len(problem.prize):
                return
            alone = replace(problem, first=np.ascontiguousarray(problem.first[spare]))
            wave = plan_routes(alone, self.rounds)
            for robot, route in zip(spare, wave, strict=True):
                plan[robot] = route
            if any(wave):
                continue
            # All are so far that they are worth nothing on arrival: go there all the same.
            for robot in spare:
                node = int(problem.first[robot].argmin())
                if problem.first[robot, node] <= problem.budget:
                    plan[robot] = [node]
            return


class VRPController(RoutePlanner):
    """VRPC, with the paper's objective and solver: no lateness, PATH_CHEAPEST_ARC, local search.

    :param solutions: plans that OR-Tools looks at
    :param seconds: wall-clock bound of its search for one plan
    :raises ValueError: if an option is out of its range
    :raises ImportError: if OR-Tools is missing
    """

    name = "vrpc"

    def __init__(self, solutions: int = 10, seconds: float = 10.0) -> None:
        super().__init__(rounds=0, solutions=solutions, seconds=seconds, cold=True, interest=0)
