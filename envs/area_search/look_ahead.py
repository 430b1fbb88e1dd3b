"""Joint look-ahead: short routes for all robots of a team over what it knows, in numba.

A route is a sequence of moves over known free cells. It is worth what it covers and sees, each as
much less as it comes later: a known target counts 1, an unseen cell as many targets as may be
expected on it. A robot looks for the route worth most; what a team mate's route gets earlier counts
only by the time that it comes sooner, so that the worths of a team's routes add up. Robots plan one
after the other, and once more in the light of what all others plan.

Nothing is kept from one step to the next: routes are a function of the map and the positions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from area_search.cells import (
    EXPLORED,
    KNOWN_TARGET,
    MOVE_COLUMNS,
    MOVE_ROWS,
    N_ACTIONS,
    OBSTACLE,
    disc_offsets,
    edge_offsets,
)
from area_search.paths import encode
from area_search.scenes import Scene

DEPTH = 10
"""Steps that a route looks ahead; farther only to what is worth something at all."""
DISCOUNT = 0.75
"""What a step later costs: far plans are never carried out, because the map grows meanwhile."""
CHANCES = (0.82, 0.55, 0.1, 0.02, 0.0)
"""Chance that an unseen cell near the team is free, by the known obstacles among its 4 neighbors.

Measured on teams of ``greedy_assigned`` in the paper's scenes, which differ in that by 0.03.
"""
SLACK = 1.5
"""A route that is behind the best by this many targets at the present discount is given up."""
FIRM = 5
"""A robot plans again if a team mate is to get what it would have got within this many steps."""
ROUNDS = 2
"""Times that a robot plans at most, for the team to agree."""

_WORTH_BITS, _DISCOUNT_BITS = 10, 20
TARGET_WORTH = 1 << _WORTH_BITS
WORTH_SCALE = float(1 << (_WORTH_BITS + _DISCOUNT_BITS))
_SLACK_WORTH = int(SLACK * TARGET_WORTH)
_NONE = -1
_KNOWN_FREE = EXPLORED
_KNOWN = EXPLORED | OBSTACLE


class Rules(NamedTuple):
    """What routes depend on besides the map; offsets are those of a flat padded map.

    ``offsets`` int64 (5,), of each action; ``disc`` int64 (k,), of the sensed cells; ``edges``
    int64 (5, k) and ``edge_counts`` int64 (5,), of the cells that come into view with each action,
    see :func:`~area_search.cells.edge_offsets`; ``discounts`` int64 (n,), by steps, the last one
    for all that are later, all above 0; ``worths`` int64 (5,), of an unseen cell by the number of
    known obstacles beside it.
    """

    offsets: np.ndarray
    disc: np.ndarray
    edges: np.ndarray
    edge_counts: np.ndarray
    discounts: np.ndarray
    worths: np.ndarray


class Marks(NamedTuple):
    """Notes on the cells of one team's map, all as :func:`make_marks` made them between teams.

    ``sight`` int64 (n,), the worth of the unseen cells in a cell's disc, -1 while not known;
    ``unseen`` int64 (n,), worth of an unseen cell + 1, 0 while not known; ``noted`` int32 (2, n),
    the cells of either that are known, their number int64 (2,) in ``n_noted``; ``claims``
    int64 (n,), the best discount at which a robot's route gets a cell, 0 for none, and ``claimant``
    int32 (n,), whose route that is.
    """

    sight: np.ndarray
    unseen: np.ndarray
    noted: np.ndarray
    n_noted: np.ndarray
    claims: np.ndarray
    claimant: np.ndarray


class Labels(NamedTuple):
    """Partial routes of one search.

    ``cell`` int32 (k,), where each ends; ``value`` int64 (k,); ``parent`` int32 (k,), the route
    that it extends; ``first`` uint8 (k,), bit ``a`` set if it can begin with action ``a``; ``best``
    int64 (n,), by cell the best value so far, -1 before and after; ``slot`` int32 (n,), by cell the
    last label, -1 before and after.
    """

    cell: np.ndarray
    value: np.ndarray
    parent: np.ndarray
    first: np.ndarray
    best: np.ndarray
    slot: np.ndarray


class Routes(NamedTuple):
    """The routes of a team.

    ``cells`` int32 (n_agents, n), ``lengths`` int64 (n_agents,), ``first`` uint8 (n_agents,), the
    actions that a route may begin with, as bits; ``worth`` int64 (n_agents, 5), by first action
    that of the best route found; ``begin`` int64 (n_agents,), steps until a route gets anything;
    ``robbed`` bool (n_agents,): a team mate's route gets what this one was to get before long.
    """

    cells: np.ndarray
    lengths: np.ndarray
    first: np.ndarray
    worth: np.ndarray
    begin: np.ndarray
    robbed: np.ndarray


def make_rules(scene: Scene, stride: int) -> Rules:
    """Return the rules of a scene; an unseen free cell has a target as often as any of the scene.

    :param scene: the task
    :param stride: cells per padded row
    """
    disc = disc_offsets(scene.sensor_radius)
    density = scene.n_targets / scene.n_free
    edges, edge_counts = edge_offsets(disc)
    place = np.array([stride, 1], np.int64)
    length = int(np.ceil(_DISCOUNT_BITS * np.log(2.0) / -np.log(DISCOUNT))) + 1
    # A goal however far is worth something.
    discounts = np.maximum(1, np.round(DISCOUNT ** np.arange(length) * (1 << _DISCOUNT_BITS)))
    return Rules(
        MOVE_ROWS * stride + MOVE_COLUMNS,
        disc @ place,
        edges @ place,
        edge_counts,
        discounts.astype(np.int64),
        np.maximum(1, np.round(np.array(CHANCES) * density * TARGET_WORTH)).astype(np.int64),
    )


def make_marks(area: int) -> Marks:
    """Allocate the notes on a map; ``area`` padded cells."""
    return Marks(
        np.full(area, _NONE, np.int64),
        np.zeros(area, np.int64),
        np.zeros((2, area), np.int32),
        np.zeros(2, np.int64),
        np.zeros(area, np.int64),
        np.zeros(area, np.int32),
    )


def make_labels(area: int) -> Labels:
    """Allocate the labels of a search on a map; ``area`` padded cells."""
    # A layer holds no cell twice and none that cannot be reached by then; behind DEPTH, a cell is
    # labeled once at most while nothing is found, and the layer in which something is ends it.
    capacity = 2 * area + sum(min(area, 2 * t * (t + 1) + 1) for t in range(DEPTH + 1))
    return Labels(
        np.zeros(capacity, np.int32),
        np.zeros(capacity, np.int64),
        np.zeros(capacity, np.int32),
        np.zeros(capacity, np.uint8),
        np.full(area, _NONE, np.int64),
        np.full(area, _NONE, np.int32),
    )


def make_routes(n_agents: int, area: int) -> Routes:
    """Allocate the routes of a team; ``area`` padded cells."""
    return Routes(
        np.zeros((n_agents, area), np.int32),
        np.zeros(n_agents, np.int64),
        np.zeros(n_agents, np.uint8),
        np.zeros((n_agents, N_ACTIONS), np.int64),
        np.zeros(n_agents, np.int64),
        np.zeros(n_agents, np.bool_),
    )


@njit(cache=True)
def place(stride: int, border: int, position: np.ndarray, starts: np.ndarray) -> None:
    """Write the robots' cells in the flat padded map, int64 (n_agents,)."""
    for i in range(starts.shape[0]):
        starts[i] = (position[i, 0] + border) * stride + position[i, 1] + border


@njit(cache=True)
def _look(cells: np.ndarray, rules: Rules, cell: int, marks: Marks) -> int:
    """Note what there is to see from a cell; return the sum of its worth."""
    total = 0
    for k in range(rules.disc.shape[0]):
        seen = cell + rules.disc[k]
        if cells[seen] & EXPLORED:
            continue
        if marks.unseen[seen] == 0:
            n_obstacles = 0
            for action in range(1, N_ACTIONS):
                n_obstacles += (cells[seen + rules.offsets[action]] & _KNOWN) == _KNOWN
            marks.unseen[seen] = rules.worths[n_obstacles]
            marks.noted[1, marks.n_noted[1]] = seen
            marks.n_noted[1] += 1
        total += marks.unseen[seen]
    marks.sight[cell] = total
    marks.noted[0, marks.n_noted[0]] = cell
    marks.n_noted[0] += 1
    return int(total)


@njit(cache=True)
def forget(marks: Marks) -> None:
    """Forget what is noted of a map, but for claims."""
    for k in range(marks.n_noted[0]):
        marks.sight[marks.noted[0, k]] = _NONE
    for k in range(marks.n_noted[1]):
        marks.unseen[marks.noted[1, k]] = 0
    marks.n_noted[:] = 0


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
def _claim(
    cells: np.ndarray, i: int, target: int, sees: bool, rules: Rules, routes: Routes, marks: Marks
) -> None:
    """Claim for a robot what its route gets, with the discount at which it gets it."""
    discounts, disc = rules.discounts, rules.disc
    last, firm = discounts.shape[0] - 1, discounts[FIRM]
    route, robbed, sight, unseen = routes.cells, routes.robbed, marks.sight, marks.unseen
    for k in range(routes.lengths[i]):
        cell = route[i, k]
        discount = discounts[min(k + 1, last)]
        if target > 0 and cells[cell] & KNOWN_TARGET:
            _claim_cell(i, cell, discount, firm, marks, robbed)
        if sees and sight[cell] > 0:
            for q in range(disc.shape[0]):
                seen = cell + disc[q]
                if unseen[seen] > 0:
                    _claim_cell(i, seen, discount, firm, marks, robbed)


@njit(cache=True)
def _release(i: int, sees: bool, disc: np.ndarray, routes: Routes, marks: Marks) -> None:
    """Free what a robot's route gets, for whoever claimed it."""
    for k in range(routes.lengths[i]):
        cell = routes.cells[i, k]
        marks.claims[cell] = 0
        if sees and marks.sight[cell] > 0:
            for q in range(disc.shape[0]):
                marks.claims[cell + disc[q]] = 0


@njit(cache=True)
def _search(
    cells: np.ndarray,
    start: int,
    target: int,
    sees: bool,
    respect: int,
    rules: Rules,
    marks: Marks,
    labels: Labels,
) -> tuple[int, int]:
    """Search for the best route of one robot, layer by layer; a layer is a step.

    A route that comes to a cell with no more than another had there, at that time or before, is
    given up, and so is one that falls far behind the best. Nothing is gained twice in one cell.

    :param target: worth of a target
    :param sees: whether unseen cells are worth anything
    :param respect: 1 to count only what is gained over the claims, 0 to count all
    :return: number of labels, and the index of the best
    """
    cell_of, value_of, parent_of, first_of = labels.cell, labels.value, labels.parent, labels.first
    best, slot, claims = labels.best, labels.slot, marks.claims
    sights, unseen, offsets = marks.sight, marks.unseen, rules.offsets
    edges, edge_counts, discounts = rules.edges, rules.edge_counts, rules.discounts
    cell_of[0], value_of[0], parent_of[0], first_of[0] = start, 0, _NONE, 0
    best[start], slot[start] = 0, 0
    low, high, top, top_value, t = 0, 1, 0, 0, 0
    last = discounts.shape[0] - 1
    while low < high and (t < DEPTH or top_value == 0):
        t += 1
        discount = discounts[min(t, last)]
        hopeless = top_value - _SLACK_WORTH * discount
        end = high
        for k in range(low, high):
            before = value_of[k]
            if before < hopeless:
                continue
            for action in range(1, N_ACTIONS):
                cell = cell_of[k] + offsets[action]
                if cells[cell] & _KNOWN != _KNOWN_FREE:
                    continue
                value = before
                if cells[cell] & KNOWN_TARGET:
                    value += target * max(0, discount - respect * claims[cell])
                if sees:
                    sight = sights[cell]
                    if sight < 0:
                        sight = _look(cells, rules, cell, marks)
                    if sight > 0:
                        if value + sight * discount < best[cell]:
                            continue
                        for q in range(edge_counts[action]):
                            seen = cell + edges[action, q]
                            gain = discount - respect * claims[seen]
                            if gain > 0:
                                value += unseen[seen] * gain
                if value < best[cell]:
                    continue
                here = slot[cell]
                # Equally good at the same time: both ways are as good to begin with.
                if value == best[cell] and here < high:
                    continue
                if value > before:
                    own = k
                    while own >= 0 and cell_of[own] != cell:
                        own = parent_of[own]
                    if own >= 0:
                        # It got what there is when it came by before.
                        value = before
                        if value <= best[cell]:
                            continue
                first = np.uint8(1 << action) if t == 1 else first_of[k]
                if value == best[cell]:
                    first_of[here] |= first
                    continue
                best[cell] = value
                if here < high:
                    here = end
                    end += 1
                    slot[cell] = here
                    cell_of[here] = cell
                value_of[here], parent_of[here], first_of[here] = value, k, first
                if value > top_value:
                    top, top_value = here, value
        low, high = high, end
    for k in range(high):
        best[cell_of[k]] = _NONE
        slot[cell_of[k]] = _NONE
    return high, top


@njit(cache=True)
def _keep(i: int, n_labels: int, top: int, labels: Labels, routes: Routes) -> None:
    """Write down what a search found."""
    parent, value = labels.parent, labels.value
    length, k = 0, top
    while k > 0:
        length += 1
        k = parent[k]
    routes.lengths[i], routes.begin[i] = length, 0
    routes.first[i] = labels.first[top]
    k = top
    while k > 0:
        if value[k] > 0:
            routes.begin[i] = length
        length -= 1
        routes.cells[i, length] = labels.cell[k]
        k = parent[k]
    worth = routes.worth[i]
    worth[:] = 0
    for k in range(1, n_labels):
        for action in range(1, N_ACTIONS):
            if (labels.first[k] >> action) & 1:
                worth[action] = max(worth[action], value[k])


@njit(cache=True)
def plan_routes(
    cells: np.ndarray,
    starts: np.ndarray,
    target: int,
    sees: bool,
    rules: Rules,
    marks: Marks,
    labels: Labels,
    routes: Routes,
) -> None:
    """Plan the routes of a team.

    :param cells: uint8 (n,), the padded map, flat
    :param starts: int64 (n_agents,), the cells of the robots
    :param target: worth of a known target, ``TARGET_WORTH`` or 0
    :param sees: whether unseen cells are worth anything
    :param marks: those of this map, or fresh ones; to be forgotten when the map changes
    :param routes: overwritten; a robot for which team mates leave nothing plans as if it were
        alone, and if nothing can be reached its route is empty
    """
    n_agents = starts.shape[0]
    routes.lengths[:] = 0
    for turn in range(ROUNDS * n_agents):
        i = turn % n_agents
        if turn >= n_agents:
            if not routes.robbed[i]:
                continue
            for j in range(n_agents):
                _release(j, sees, rules.disc, routes, marks)
            for j in range(n_agents):
                if j != i:
                    _claim(cells, j, target, sees, rules, routes, marks)
        routes.robbed[i] = False
        n_labels, top = _search(cells, starts[i], target, sees, 1, rules, marks, labels)
        if top == 0:
            n_labels, top = _search(cells, starts[i], target, sees, 0, rules, marks, labels)
        _keep(i, n_labels, top, labels, routes)
        _claim(cells, i, target, sees, rules, routes, marks)
    for j in range(n_agents):
        _release(j, sees, rules.disc, routes, marks)


@njit(cache=True, nogil=True)
def route_goals(
    which: np.ndarray,
    cells: np.ndarray,
    border: int,
    position: np.ndarray,
    rules: Rules,
    marks: Marks,
    labels: Labels,
    routes: Routes,
    starts: np.ndarray,
    table: np.ndarray,
    out: np.ndarray,
) -> None:
    """Per robot: how its route begins, and what routes are worth by first move.

    :param which: bool (n_teams,), the teams to write
    :param cells: uint8 (n_teams, height + 2 border, width + 2 border)
    :param position: int32 (n_teams, n_agents, 2)
    :param starts: int64 (n_agents,), scratch
    :param table: int64, see :func:`~area_search.paths.discount_table`
    :param out: float32 (n_teams, n_agents, rows, 11); the last row is overwritten: five flags of
        the moves with which the robot's route can begin, ``0.9 ** steps`` until it gets anything,
        and per first move the worth of the best route found, in targets; all 0 without a route
    """
    row = out.shape[2] - 1
    for m in range(position.shape[0]):
        if not which[m]:
            continue
        flat = cells[m].reshape(-1)
        place(cells.shape[2], border, position[m], starts)
        plan_routes(flat, starts, TARGET_WORTH, True, rules, marks, labels, routes)
        forget(marks)
        for i in range(position.shape[1]):
            features = out[m, i, row]
            begin = routes.begin[i] if routes.lengths[i] > 0 else _NONE
            encode(features[: N_ACTIONS + 1], begin, routes.first[i], table)
            for action in range(N_ACTIONS):
                features[N_ACTIONS + 1 + action] = routes.worth[i, action] / WORTH_SCALE
