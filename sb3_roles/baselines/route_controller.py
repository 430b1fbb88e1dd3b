"""What the VRPC, planner and Oracle rows share: robots that follow planned routes over the map."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from area_search.cells import KNOWN_TARGET, border_width, disc_offsets
from sb3_roles.baselines.base import ScriptedController
from sb3_roles.baselines.ortools_routing import improve_routes, load_ortools
from sb3_roles.baselines.road_map import first_moves
from sb3_roles.baselines.routing import Routes, RoutingProblem, plan_routes
from sb3_roles.common.checks import check_whole

if TYPE_CHECKING:
    from area_search.batch import BatchedAreaSearch


class RouteController(ScriptedController):
    """Plans a route for each robot and walks along it; subclasses say where to and when anew.

    A plan has up to three stages, and takes the best that any of them found: greedy insertion,
    which always answers; ``rounds`` of ruin and recreate; OR-Tools from there on, or from its own
    PATH_CHEAPEST_ARC. The first two are functions of the problem. So is the third as long as
    ``seconds`` does not cut it short before ``solutions``: results are reproducible on any machine
    with the same version of OR-Tools only if ``seconds`` is generous.

    :param rounds: rounds of ruin and recreate
    :param solutions: plans that OR-Tools looks at, 0 to do without OR-Tools
    :param seconds: wall-clock bound of OR-Tools' search for one plan
    :param cold: let OR-Tools begin with PATH_CHEAPEST_ARC instead of the plan of the stages before
    :raises ValueError: if an option is out of its range
    :raises ImportError: if OR-Tools is asked for and missing
    """

    name: ClassVar[str]

    def __init__(self, rounds: int, solutions: int, seconds: float, cold: bool) -> None:
        self.description: dict[str, Any] = {}
        self._whole(0, rounds=rounds, solutions=solutions)
        self._number("seconds", seconds)
        self.description["cold"] = self.cold = bool(cold)
        self.rounds, self.solutions, self.seconds = rounds, solutions, seconds
        if solutions:
            load_ortools(f"the controller {self.name}")

    def _whole(self, low: int, **options: int) -> None:
        check_whole(low, **options)
        # Plain numbers, for JSON.
        self.description.update({name: int(value) for name, value in options.items()})

    def _number(self, option: str, value: float) -> None:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < 1e6:
            raise ValueError(f"{option} must be a number from 0 to 1e6, got {value!r}")
        self.description[option] = value

    def begin(self, batch: BatchedAreaSearch) -> None:
        """Take the teams to control; all of them have just begun an episode.

        :param batch: the teams
        """
        super().begin(batch)
        scene = batch.scene
        self._border = border_width(scene.view_radius, scene.sensor_radius)
        self._stride = batch.cells.shape[2]
        self._disc = disc_offsets(scene.sensor_radius)
        self._routes: list[Routes] = [[[] for _ in range(batch.n_agents)] for _ in batch.steps]
        self.n_plans = 0

    def act(self, batch: BatchedAreaSearch) -> np.ndarray:
        """Take the next step along every robot's route, planning first where that is due.

        :param batch: the teams
        :return: int64 (n_teams, n_agents)
        """
        actions = np.zeros((batch.n_teams, batch.n_agents), np.int64)
        for team in range(batch.n_teams):
            place = batch.position[team].astype(np.int64) + self._border
            robots = place[:, 0] * self._stride + place[:, 1]
            if batch.steps[team] == 0:
                self._routes[team] = [[] for _ in robots]
            cells = self._known(batch, team)
            routes = self._update(batch, team, cells, robots, self._routes[team])
            self._routes[team] = routes
            goals = np.array([route[0] if route else -1 for route in routes], np.int64)
            first_moves(cells, self._stride, robots, goals, actions[team])
        return actions

    @abstractmethod
    def _known(self, batch: BatchedAreaSearch, team: int) -> np.ndarray:
        """Return the map to plan on: uint8 (cells of the padded map,), read only."""

    @abstractmethod
    def _update(
        self,
        batch: BatchedAreaSearch,
        team: int,
        cells: np.ndarray,
        robots: np.ndarray,
        routes: Routes,
    ) -> Routes:
        """Bring one team's routes up to date.

        :param cells: what :meth:`_known` returned
        :param robots: int64 (R,), the flat cells of the robots
        :param routes: the flat cells that each robot was to visit, in order
        :return: those that it is to visit now; none of them its own
        """

    def _solve(self, problem: RoutingProblem, start: Sequence[Sequence[int]] | None) -> Routes:
        self.n_plans += 1
        best = plan_routes(problem, self.rounds, start)
        if self.solutions:
            begin = None if self.cold else best
            other = improve_routes(problem, self.solutions, self.seconds, begin)
            if other is not None and problem.cost(other) < problem.cost(best):
                best = other
        return best


def open_targets(cells: np.ndarray) -> np.ndarray:
    """Return the flat cells of the known uncovered targets, int64 (n,)."""
    return np.flatnonzero(cells & KNOWN_TARGET)
