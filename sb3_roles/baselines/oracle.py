"""The Oracle row of the tables: routes over all targets of the true map, planned at step 0.

This is no method but a bound, ours and not the paper's: a team that knows the whole map and walks
the best routes cannot be beaten on average by one that has to search. The plan is heuristic, so
what it covers is a *lower* bound of what full knowledge is worth; :func:`most_nodes` gives a cheap
upper bound, ``cover_bound`` in reports, and the two enclose the truth.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from area_search.cells import EXPLORED, OBSTACLE
from sb3_roles.baselines.road_map import nearest_nodes, new_views, path_lengths, reveal
from sb3_roles.baselines.route_controller import RouteController, open_targets
from sb3_roles.baselines.routing import FAR, Routes, RoutingProblem

if TYPE_CHECKING:
    from area_search.batch import BatchedAreaSearch


class OracleController(RouteController):
    """Plans once, on the true map with all its targets, and follows the plan to its end.

    With ``cell_prize=0`` a target that a team mate covered on its way is skipped. With cells in the
    plan every stop is visited, whether it is a target that is covered already or not: what is seen
    from there was planned for.

    After an episode's first step ``planned``, int64 (n_teams,), is the number of targets on the
    routes of each team, and ``bounds``, float64 (n_teams,), a number of targets that no plan
    exceeds; both are those of the current batch. Records keep the bounds.

    :param rounds: see :class:`~sb3_roles.baselines.route_controller.RouteController`
    :param solutions: see there
    :param seconds: see there
    :param cold: see there
    :param target_prize: prize of a target
    :param cell_prize: prize of each unexplored cell that is seen from a stop; 0 maximizes the
        covered targets alone
    :raises ValueError: if an option is out of its range
    :raises ImportError: if OR-Tools is asked for (``solutions`` above 0) and missing
    """

    name = "oracle"

    def __init__(
        self,
        rounds: int = 20_000,
        solutions: int = 0,
        seconds: float = 10.0,
        cold: bool = False,
        target_prize: int = 1000,
        cell_prize: int = 0,
    ) -> None:
        super().__init__(rounds, solutions, seconds, cold)
        self._whole(1, target_prize=target_prize)
        self._whole(0, cell_prize=cell_prize)
        self.target_prize, self.cell_prize = target_prize, cell_prize

    def begin(self, batch: BatchedAreaSearch) -> None:
        """Take the teams to control; all of them have just begun an episode.

        :param batch: read only, and all of it, hidden cells and targets too
        """
        super().begin(batch)
        self._revealed = np.zeros(batch.cells[0].size, np.uint8)
        self.planned = np.zeros(batch.n_teams, np.int64)
        self.bounds = np.full(batch.n_teams, np.nan)

    def _known(self, batch: BatchedAreaSearch, team: int) -> np.ndarray:
        reveal(batch.cells[team].reshape(-1), self._revealed)
        return self._revealed

    def _update(
        self,
        batch: BatchedAreaSearch,
        team: int,
        cells: np.ndarray,
        robots: np.ndarray,
        routes: Routes,
    ) -> Routes:
        if batch.steps[team] == 0:
            return self._plan(batch, team, cells, robots)
        if self.cell_prize == 0:
            is_open = np.zeros(len(cells), np.bool_)
            is_open[open_targets(cells)] = True
            return [[cell for cell in route if is_open[cell]] for route in routes]
        return [
            route[1:] if route[:1] == [robot] else route
            for route, robot in zip(routes, robots.tolist(), strict=True)
        ]

    def _plan(
        self, batch: BatchedAreaSearch, team: int, cells: np.ndarray, robots: np.ndarray
    ) -> Routes:
        budget = batch.scene.horizon
        targets = open_targets(cells)
        prize = np.zeros(len(cells), np.int64)
        prize[targets] = self.target_prize
        if self.cell_prize:
            free = np.flatnonzero(cells & (EXPLORED | OBSTACLE) == EXPLORED)
            known = batch.cells[team].reshape(-1)
            views, added = new_views(known, self._stride, self._disc, free, 1)
            prize[views] += self.cell_prize * added
        nodes = np.flatnonzero(prize)
        first = path_lengths(cells, self._stride, robots, nodes)
        keep = nearest_nodes(first, budget, len(nodes))
        # No robot stands on a target: those of the start cells are covered.
        nodes, first = nodes[keep], np.ascontiguousarray(first[:, keep])
        problem = RoutingProblem(
            first=first,
            between=path_lengths(cells, self._stride, nodes, nodes),
            prize=prize[nodes],
            lateness=np.zeros(len(nodes), np.int64),
            budget=budget,
        )
        plan = self._solve(problem, None)
        is_target = np.isin(nodes, targets)
        self.planned[team] = sum(int(is_target[k]) for route in plan for k in route)
        self.bounds[team] = most_nodes(
            first[:, is_target], problem.between[np.ix_(is_target, is_target)], budget
        )
        return [[int(nodes[k]) for k in route] for route in plan]


def most_nodes(first: np.ndarray, between: np.ndarray, budget: int) -> int:
    """Upper bound of the nodes that R routes can visit.

    Routes that visit k nodes form a forest of k edges, all starts taken as one root, no heavier
    than the budgets together; and of all forests with k edges the k lightest edges that
    Kruskal's algorithm takes weigh least.

    :param first: int64 (R, n), distance from each robot to each node
    :param between: int64 (n, n), distance between nodes
    :param budget: longest allowed route of each robot
    """
    nearest = first.min(axis=0, initial=FAR)
    within = nearest <= budget
    legs = _spanning_edges(nearest[within], np.ascontiguousarray(between[np.ix_(within, within)]))
    return int(np.searchsorted(np.cumsum(np.sort(legs)), budget * len(first), side="right"))


@njit(cache=True)
def _spanning_edges(root: np.ndarray, between: np.ndarray) -> np.ndarray:
    """Edge weights of a minimum spanning tree of the root and the nodes, by Prim's algorithm."""
    n = root.shape[0]
    reach = root.copy()
    inside = np.zeros(n, np.bool_)
    legs = np.zeros(n, np.int64)
    for k in range(n):
        best = -1
        for node in range(n):
            if not inside[node] and (best < 0 or reach[node] < reach[best]):
                best = node
        inside[best] = True
        legs[k] = reach[best]
        for node in range(n):
            reach[node] = min(reach[node], between[best, node])
    return legs
