"""Joint look-ahead: short routes for all robots of a team over what it knows, in numba.

A route is a sequence of moves over known free cells, and over unseen ones that may well be free. It
is worth what it covers and sees, each as much less as it comes later and as its way may be blocked:
a known target counts 1, an unseen cell as many targets as may be expected on it. A robot looks for
the route worth most; what a team mate's route gets earlier counts only by the time that it comes
sooner, so that the worths of a team's routes add up. Robots plan one after the other, and once more
in the light of what all others plan; of the plans that different robots begin, the best one counts.

Nothing is kept from one step to the next: routes are a function of the map, the positions and the
number of steps left.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from area_search.cells import EXPLORED, KNOWN_TARGET, N_ACTIONS
from area_search.look_ahead_data import (
    CERTAIN,
    NONE,
    ODDS_BITS,
    WORTH_SCALE,
    Labels,
    Marks,
    Plans,
    Routes,
    Rules,
    Timetable,
    rules_at,
)
from area_search.look_ahead_search import forget, keep, search
from area_search.paths import encode


@njit(cache=True, inline="always")
def _claim_cell(
    i: int, cell: int, discount: int, firm: int, marks: Marks, robbed: np.ndarray
) -> None:
    claims = marks.claims
    if claims[cell] < discount:
        # Who was to get it before long has to look for something else.
        if claims[cell] >= firm and marks.claimant[cell] != i:
            robbed[marks.claimant[cell]] = True
        claims[cell], marks.claimant[cell] = discount, i


@njit(cache=True)
def _claim(cells: np.ndarray, i: int, rules: Rules, routes: Routes, marks: Marks) -> None:
    """Claim for a robot what its route gets, with the discount at which it may get it."""
    discounts, disc = rules.discounts, rules.disc
    last, firm = discounts.shape[0] - 1, discounts[rules.firm]
    route, robbed, sight, unseen = routes.cells, routes.robbed, marks.sight, marks.unseen
    odds = CERTAIN
    for k in range(routes.lengths[i]):
        cell = route[i, k]
        if not cells[cell] & EXPLORED:
            odds = odds * marks.passable[cell] >> ODDS_BITS
        discount = discounts[min(k + 1, last)] * odds >> ODDS_BITS
        if cells[cell] & KNOWN_TARGET:
            _claim_cell(i, cell, discount, firm, marks, robbed)
        if sight[cell] > 0:
            for q in range(disc.shape[0]):
                seen = cell + disc[q]
                if unseen[seen] > 0:
                    _claim_cell(i, seen, discount, firm, marks, robbed)


@njit(cache=True)
def _release(i: int, disc: np.ndarray, routes: Routes, marks: Marks) -> None:
    """Free what a robot's route gets, for whoever claimed it."""
    for k in range(routes.lengths[i]):
        cell = routes.cells[i, k]
        marks.claims[cell] = 0
        if marks.sight[cell] > 0:
            for q in range(disc.shape[0]):
                marks.claims[cell + disc[q]] = 0


@njit(cache=True)
def _settle(cells: np.ndarray, rules: Rules, routes: Routes, marks: Marks) -> int:
    """Return what the routes of a team are worth together; all claims are free then."""
    claims, unseen = marks.claims, marks.unseen
    total = 0
    for i in range(routes.lengths.shape[0]):
        for k in range(routes.lengths[i]):
            cell = routes.cells[i, k]
            if cells[cell] & KNOWN_TARGET:
                total += rules.target * claims[cell]
                claims[cell] = 0
            if marks.sight[cell] > 0:
                for q in range(rules.disc.shape[0]):
                    seen = cell + rules.disc[q]
                    if unseen[seen] > 0:
                        total += unseen[seen] * claims[seen]
                        claims[seen] = 0
    return total


@njit(cache=True)
def _search_and_keep(
    i: int,
    cells: np.ndarray,
    target: int,
    see: int,
    rules: Rules,
    marks: Marks,
    labels: Labels,
    routes: Routes,
) -> None:
    """Plan for a robot over what is claimed, or as if it were alone if that leaves it nothing."""
    n_labels, top = search(cells, routes.starts[i], 1, target, see, rules, marks, labels)
    if top == 0:
        n_labels, top = search(cells, routes.starts[i], 0, target, see, rules, marks, labels)
    keep(i, n_labels, top, labels, routes)


@njit(cache=True)
def _plan_in_turn(
    first: int, cells: np.ndarray, rules: Rules, marks: Marks, labels: Labels, routes: Routes
) -> int:
    """Plan one after the other, a given robot first; return what all routes are worth together."""
    n_agents = routes.starts.shape[0]
    routes.lengths[:] = 0
    for turn in range(rules.rounds * n_agents):
        i = (first + turn) % n_agents
        if turn >= n_agents:
            if not routes.robbed[i]:
                continue
            for j in range(n_agents):
                _release(j, rules.disc, routes, marks)
            for k in range(n_agents):
                j = (first + k) % n_agents
                if j != i:
                    _claim(cells, j, rules, routes, marks)
        routes.robbed[i] = False
        _search_and_keep(i, cells, rules.target, CERTAIN, rules, marks, labels, routes)
        _claim(cells, i, rules, routes, marks)
    return _settle(cells, rules, routes, marks)


@njit(cache=True)
def _copy(routes: Routes, to: Routes) -> None:
    """Copy the routes of a team."""
    to.lengths[:] = routes.lengths
    to.first[:] = routes.first
    to.worth[:] = routes.worth
    to.begin[:] = routes.begin
    for i in range(routes.lengths.shape[0]):
        to.cells[i, : routes.lengths[i]] = routes.cells[i, : routes.lengths[i]]


@njit(cache=True)
def plan_routes(
    cells: np.ndarray,
    border: int,
    position: np.ndarray,
    steps: int,
    timetable: Timetable,
    marks: Marks,
    labels: Labels,
    plans: Plans,
) -> None:
    """Plan the routes of a team.

    :param cells: uint8 (height + 2 border, width + 2 border), its map
    :param position: int32 (n_agents, 2)
    :param steps: of its episode so far
    :param marks: notes on the map are left, for further searches; :func:`forget` them then
    :param plans: overwritten; a robot for which team mates leave nothing plans as if it were
        alone, and if nothing can be reached its route is empty
    """
    draft = plans.draft
    starts = draft.starts
    for i in range(starts.shape[0]):
        starts[i] = (position[i, 0] + border) * cells.shape[1] + position[i, 1] + border
    rules = rules_at(timetable, timetable.rules.left - steps)
    flat = cells.reshape(-1)
    best_total = -1
    for first in range(rules.orders):
        total = _plan_in_turn(first, flat, rules, marks, labels, draft)
        if total > best_total:
            best_total = total
            _copy(draft, plans.best)


@njit(cache=True)
def _describe(i: int, routes: Routes, table: np.ndarray, features: np.ndarray) -> None:
    """Write the features of a robot's route, see :func:`route_goals`."""
    begin = routes.begin[i] if routes.lengths[i] > 0 else NONE
    encode(features[: N_ACTIONS + 1], begin, routes.first[i], table)
    for action in range(N_ACTIONS):
        features[N_ACTIONS + 1 + action] = routes.worth[i, action] / WORTH_SCALE


@njit(cache=True)
def _plan_in_roles(
    i: int,
    cells: np.ndarray,
    rules: Rules,
    roles: np.ndarray,
    marks: Marks,
    labels: Labels,
    plans: Plans,
    table: np.ndarray,
    features: np.ndarray,
) -> None:
    """Write the features of a robot's route in each role, if all team mates follow the plan."""
    routes, n_agents = plans.best, plans.best.lengths.shape[0]
    for j in range(n_agents):
        if j != i:
            _claim(cells, j, rules, routes, marks)
    for role in range(roles.shape[0]):
        target = rules.target * roles[role, 0] >> ODDS_BITS
        _search_and_keep(i, cells, target, roles[role, 1], rules, marks, labels, plans.draft)
        _describe(i, plans.draft, table, features[role])
    for j in range(n_agents):
        _release(j, rules.disc, routes, marks)


@njit(cache=True, nogil=True)
def route_goals(
    which: np.ndarray,
    cells: np.ndarray,
    border: int,
    position: np.ndarray,
    steps: np.ndarray,
    timetable: Timetable,
    marks: Marks,
    labels: Labels,
    plans: Plans,
    table: np.ndarray,
    in_roles: bool,
    out: np.ndarray,
) -> None:
    """Per robot: how its route begins, and what routes are worth by first move.

    :param which: bool (n_teams,), the teams to write
    :param cells: uint8 (n_teams, height + 2 border, width + 2 border)
    :param position: int32 (n_teams, n_agents, 2)
    :param steps: int32 (n_teams,), steps of the episodes so far
    :param table: int64, see :func:`~area_search.paths.discount_table`
    :param in_roles: write a row for each role, too
    :param out: float32 (n_teams, n_agents, rows, 11); the last row is overwritten: five flags of
        the moves with which the robot's route can begin, ``0.9 ** steps`` until it gets anything,
        and per first move the worth of the best route found, in targets; all 0 without a route.
        With ``in_roles``, the first rows are overwritten with the same of the route that the robot
        would take in each role, over what the others' routes get
    """
    for m in range(position.shape[0]):
        if not which[m]:
            continue
        plan_routes(cells[m], border, position[m], steps[m], timetable, marks, labels, plans)
        rules, roles = rules_at(timetable, timetable.rules.left - steps[m]), timetable.roles
        flat = cells[m].reshape(-1)
        for i in range(position.shape[1]):
            features = out[m, i]
            _describe(i, plans.best, table, features[features.shape[0] - 1])
            if in_roles:
                _plan_in_roles(i, flat, rules, roles, marks, labels, plans, table, features)
        forget(marks)
