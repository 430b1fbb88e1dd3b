"""The routing problem of the VRPC, planner and Oracle rows for OR-Tools (extra ``vrp``).

Importing this file does not import OR-Tools; :func:`load_ortools` does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from sb3_roles.baselines.routing import FAR, Routes, RoutingProblem

# Off: the default operators that try a cubic number of neighbors, or solve sub-problems. With them
# a step of the local search on 80 nodes takes 20 ms and finds nothing more.
_OPERATORS_OFF = (
    "use_relocate_pair",
    "use_light_relocate_pair",
    "use_exchange_pair",
    "use_relocate_expensive_chain",
    "use_relocate_subtrip",
    "use_exchange_subtrip",
    "use_lin_kernighan",
    "use_shortest_path_swap_active",
    "use_shortest_path_two_opt",
    "use_swap_active_chain",
    "use_global_cheapest_insertion_path_lns",
    "use_local_cheapest_insertion_path_lns",
    "use_relocate_path_global_cheapest_insertion_insert_unperformed",
    "use_global_cheapest_insertion_visit_types_lns",
    "use_local_cheapest_insertion_visit_types_lns",
)

# A plan takes about 7 branches of the search tree; more than this many is a search that is stuck.
_LEAST_BRANCHES, _BRANCHES = 1000, 50


def load_ortools(who: str) -> tuple[Any, Any]:
    """Import OR-Tools' routing library.

    :param who: what needs it, for the message
    :return: the modules ``pywrapcp`` and ``routing_enums_pb2``
    :raises ImportError: in one line that names the extra, if OR-Tools is missing or broken
    """
    try:
        return (
            import_module("ortools.constraint_solver.pywrapcp"),
            import_module("ortools.constraint_solver.routing_enums_pb2"),
        )
    except ImportError as error:
        raise ImportError(
            f"{who} plans with OR-Tools, which is not here ({error}): pip install sb3_roles[vrp]"
        ) from error


def improve_routes(
    problem: RoutingProblem,
    solutions: int,
    seconds: float,
    start: Sequence[Sequence[int]] | None = None,
) -> Routes | None:
    """Plan with OR-Tools: a first solution, then guided local search.

    :param problem: what to solve
    :param solutions: plans to look at, the first one included: a bound in work, with one in
        branches beside it, so that the result is the same on every machine unless ``seconds`` ends
        the search before
    :param seconds: wall-clock bound; 0 for no search at all
    :param start: the first plan; by default PATH_CHEAPEST_ARC makes it, as in the paper
    :return: for each robot the nodes that it visits, in order; None if there was no time for a plan
    :raises ImportError: if OR-Tools is missing
    """
    pywrapcp, enums = load_ortools("improve_routes")
    n_robots, n_nodes = problem.first.shape
    milliseconds = math.floor(seconds * 1000.0)
    if n_nodes == 0 or milliseconds < 1 or solutions < 1:
        return None
    # Robots, then nodes, then the common end of all routes, which costs nothing to reach.
    end = n_robots + n_nodes
    manager = pywrapcp.RoutingIndexManager(
        end + 1, n_robots, list(range(n_robots)), [end] * n_robots
    )
    model = pywrapcp.RoutingModel(manager)
    out = [[*row, 0] for row in problem.between.tolist()]
    rows = [[FAR] * n_robots + [*row, 0] for row in problem.first.tolist()]
    rows += [[FAR] * n_robots + row for row in out]
    rows.append([0] * (end + 1))
    steps = model.RegisterTransitMatrix(rows)
    weight = problem.length_weight
    cost = model.RegisterTransitMatrix([[weight * leg for leg in row] for row in rows])
    model.SetArcCostEvaluatorOfAllVehicles(cost)
    model.AddDimension(steps, 0, problem.budget, True, "length")
    arrival = model.GetDimensionOrDie("length")
    for node in range(n_nodes):
        index = manager.NodeToIndex(n_robots + node)
        model.AddDisjunction([index], int(problem.prize[node]))
        if problem.lateness[node]:
            arrival.SetCumulVarSoftUpperBound(index, 0, int(problem.lateness[node]))
    parameters = pywrapcp.DefaultRoutingSearchParameters()
    parameters.first_solution_strategy = enums.FirstSolutionStrategy.PATH_CHEAPEST_ARC
    parameters.local_search_metaheuristic = enums.LocalSearchMetaheuristic.GUIDED_LOCAL_SEARCH
    parameters.solution_limit = solutions
    parameters.time_limit.FromMilliseconds(milliseconds)
    # Where there is nothing to improve, guided local search turns on the spot until time is up.
    model.AddSearchMonitor(model.solver().BranchesLimit(_LEAST_BRANCHES + solutions * _BRANCHES))
    for name in _OPERATORS_OFF:
        setattr(parameters.local_search_operators, name, 2)  # BOOL_FALSE
    if start is None:
        found = model.SolveWithParameters(parameters)
    else:
        model.CloseModelWithParameters(parameters)
        indices = [[manager.NodeToIndex(n_robots + k) for k in route] for route in start]
        first = model.ReadAssignmentFromRoutes(indices, True)
        found = model.SolveFromAssignmentWithParameters(first, parameters)
    if found is None:
        return None
    routes: Routes = []
    for robot in range(n_robots):
        route, index = [], found.Value(model.NextVar(model.Start(robot)))
        while not model.IsEnd(index):
            route.append(manager.IndexToNode(index) - n_robots)
            index = found.Value(model.NextVar(index))
        routes.append(route)
    return routes
