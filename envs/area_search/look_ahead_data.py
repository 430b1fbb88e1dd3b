"""What the joint look-ahead works with: its constants, and named tuples of arrays for its kernels.

Kernels get what can be tuned in :class:`Rules`, never as globals: a cached kernel keeps the value
that a global of another file had when it was compiled.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from area_search.cells import (
    MOVE_COLUMNS,
    MOVE_ROWS,
    N_ACTIONS,
    disc_offsets,
    edge_offsets,
)
from area_search.scenes import Scene

DEPTH = 14
"""Steps that a route looks ahead; farther only to what is worth something at all."""
STEPS_LEFT = (0, 25, 50)
"""Steps left of an episode at which the two below are known; linear in between."""
DISCOUNTS = (0.85, 0.81, 0.69)
"""What a step later costs: far plans are never carried out, because the map grows meanwhile."""
CURIOSITY = (0.5, 1.05, 1.1)
"""What a target that is only expected counts, against a known one.

Towards the end it may be too late to cover what is found. These were searched for by an evolution
strategy, on episodes of seeds that no evaluation plays.
"""
LOAD = 100 / 375 / 4
"""Targets per free cell and robot in the paper's training scene."""
LOAD_POWER = 0.6
"""Power of ``LOAD`` over a scene's own, by which targets that are expected count more or less.

A team with fewer targets for each robot has less to do but to look for more. Of a few powers this
was the best, on episodes of a seed that no evaluation plays.
"""
CHANCES = (0.74, 0.5, 0.1, 0.02, 0.0)
"""Chance that an unseen cell near the team is free, by the known obstacles among its 4 neighbors.

Between what teams of this look-ahead meet in the paper's scenes with 40 % obstacles (0.69, 0.44,
0.1, 0.01, 0.01) and with 16 %; teams of ``greedy_assigned`` meet more free cells.
"""
OPTIMISM = 1.2
"""How much likelier than ``CHANCES`` a route may count on walking through an unseen cell.

A route that turns out to be blocked is planned anew, which costs less than never to try it.
"""
LEAST_ODDS = 0.4
"""A route whose way is open with a smaller chance than this is given up."""
ROLE_WORTHS = ((0.2, 1.0), (1.0, 0.2))
"""What known targets and unseen cells count in the roles explore and cover, 1 in the joint plan.

At most 1: the search bounds a role's gains by those of the joint plan. Far apart, so that a robot's
choice of a role matters. A row for each of ``paths.ROLE_ROUTES``.
"""
SLACK = 1.5
"""A route that is behind the best by this many targets at the present discount is given up."""
FIRM = 5
"""A robot plans again if a team mate is to get what it would have got within this many steps."""
ROUNDS = 2
"""Times that a robot plans at most, for the team to agree."""
ORDERS = 4
"""Plans of a team at most, each begun by another robot, of which the best is taken."""
ROUTES = 32
"""Routes in all these plans, where it takes more than one: large teams gain least by more plans."""

_WORTH_BITS, _DISCOUNT_BITS = 10, 20
TARGET_WORTH = 1 << _WORTH_BITS
ODDS_BITS = 10
CERTAIN = 1 << ODDS_BITS
WORTH_SCALE = float(1 << (_WORTH_BITS + _DISCOUNT_BITS))
NONE = -1


class Rules(NamedTuple):
    """What routes depend on besides the map; offsets are those of a flat padded map.

    ``offsets`` int64 (5,), of each action; ``disc`` int64 (k,), of the sensed cells; ``edges``
    int64 (5, k) and ``edge_counts`` int64 (5,), of the cells that come into view with each action,
    see :func:`~area_search.cells.edge_offsets`; ``discounts`` int64 (n,), by steps, the last one
    for all that are later, all above 0; ``worths`` int64 (5,), of an unseen cell by the number of
    known obstacles beside it; ``target``, that of a known target; ``left``, the longest that a
    route may be; ``passable`` int64 (5,), the odds that a route gives an unseen cell to be free, of
    ``CERTAIN``, by the number of known obstacles beside it; ``least_odds``, ``depth``, ``slack``,
    ``firm`` and ``rounds`` are the constants of these names, the slack as a worth; ``orders``, see
    :func:`n_orders`.
    """

    offsets: np.ndarray
    disc: np.ndarray
    edges: np.ndarray
    edge_counts: np.ndarray
    discounts: np.ndarray
    worths: np.ndarray
    target: int
    left: int
    passable: np.ndarray
    least_odds: int
    depth: int
    slack: int
    firm: int
    rounds: int
    orders: int


class Timetable(NamedTuple):
    """The rules of a scene, by the number of steps that are left of an episode.

    ``rules``, those of an episode's beginning; ``discounts`` int64 (k, n) and ``worths``
    int64 (k, 5), see :class:`Rules`, by the number of steps left, the last row for all above;
    ``roles`` int64 (2, 2), ``ROLE_WORTHS`` as parts of ``CERTAIN``.
    """

    rules: Rules
    discounts: np.ndarray
    worths: np.ndarray
    roles: np.ndarray


@njit(cache=True)
def rules_at(timetable: Timetable, left: int) -> Rules:
    """Return the rules for a team that has so many steps left; with none left, as with one."""
    left = max(1, left)
    rules = timetable.rules
    row = min(left, timetable.discounts.shape[0] - 1)
    return Rules(
        rules.offsets,
        rules.disc,
        rules.edges,
        rules.edge_counts,
        timetable.discounts[row],
        timetable.worths[row],
        rules.target,
        left,
        rules.passable,
        rules.least_odds,
        rules.depth,
        rules.slack,
        rules.firm,
        rules.rounds,
        rules.orders,
    )


class Marks(NamedTuple):
    """Notes on the cells of one team's map, all as :func:`make_marks` made them between teams.

    ``sight`` int64 (n,), the worth of the unseen cells in a cell's disc, -1 while not known;
    ``unseen`` int64 (n,), worth of an unseen cell + 1, 0 while not known, and ``passable`` int64
    (n,), its odds, see :class:`Rules`, which say nothing while the worth is not known; ``noted``
    int32 (2, n), the cells of either that are known, their number int64 (2,) in ``n_noted``;
    ``claims`` int64 (n,), the best discount at which a robot's route gets a cell, 0 for none, and
    ``claimant`` int32 (n,), whose route that is.
    """

    sight: np.ndarray
    unseen: np.ndarray
    passable: np.ndarray
    noted: np.ndarray
    n_noted: np.ndarray
    claims: np.ndarray
    claimant: np.ndarray


class Labels(NamedTuple):
    """Partial routes of one search.

    ``cell`` int32 (k,), where each ends; ``value`` int64 (k,); ``parent`` int32 (k,), the route
    that it extends; ``odds`` int64 (k,), the chance that its way is open, of ``CERTAIN``; ``first``
    uint8 (k,), bit ``a`` set if it can begin with action ``a``; ``best`` int64 (n,), by cell the
    best value so far, -1 before and after; ``slot`` int32 (n,), by cell the last label, -1 before
    and after.
    """

    cell: np.ndarray
    value: np.ndarray
    parent: np.ndarray
    odds: np.ndarray
    first: np.ndarray
    best: np.ndarray
    slot: np.ndarray


class Routes(NamedTuple):
    """The routes of a team.

    ``starts`` int64 (n_agents,), where the robots are, which is no part of a route; ``cells``
    int32 (n_agents, n), ``lengths`` int64 (n_agents,), ``first`` uint8 (n_agents,), the
    actions that a route may begin with, as bits; ``worth`` int64 (n_agents, 5), by first action
    that of the best route found; ``begin`` int64 (n_agents,), steps until a route gets anything;
    ``robbed`` bool (n_agents,): a team mate's route gets what this one was to get before long.
    """

    starts: np.ndarray
    cells: np.ndarray
    lengths: np.ndarray
    first: np.ndarray
    worth: np.ndarray
    begin: np.ndarray
    robbed: np.ndarray


class Plans(NamedTuple):
    """The routes of a team that are best so far, and those that are being planned.

    ``starts`` and ``robbed`` are those of the draft; they are not kept with the best.
    """

    best: Routes
    draft: Routes


def discount_at(left: float) -> float:
    """Return what a step later costs with so many steps left of the episode."""
    return float(np.interp(left, STEPS_LEFT, DISCOUNTS))


def unseen_worths(density: float, n_agents: int, left: float) -> np.ndarray:
    """Return what an unseen cell is worth, in targets, by the known obstacles beside it.

    It is the number of targets to be expected on it, times ``CURIOSITY`` and a power of how many
    fewer targets there are for each robot than ``LOAD``; never more than a known target.

    :param density: targets per free cell
    :param n_agents: robots in the team
    :param left: steps left of the episode
    :return: float64 (5,)
    """
    curiosity = np.interp(left, STEPS_LEFT, CURIOSITY)
    spare = (LOAD * n_agents / density) ** LOAD_POWER
    return np.minimum(1.0, np.array(CHANCES) * density * spare * curiosity)


def passable_odds() -> np.ndarray:
    """Return the odds that a route gives an unseen cell to be free, by the obstacles beside it.

    :return: int64 (5,), of ``CERTAIN``
    """
    return np.minimum(CERTAIN, np.round(np.array(CHANCES) * OPTIMISM * CERTAIN)).astype(np.int64)


def role_worths() -> np.ndarray:
    """Return ``ROLE_WORTHS`` in fixed point.

    :return: int64 (2, 2), by role those of a known target and of unseen cells, of ``CERTAIN``
    """
    return np.round(np.array(ROLE_WORTHS) * CERTAIN).astype(np.int64)


def n_orders(n_agents: int) -> int:
    """Return how many plans a team makes, see ``ORDERS`` and ``ROUTES``.

    :param n_agents: robots in the team
    """
    return max(1, min(ORDERS, n_agents, ROUTES // n_agents))


def make_timetable(scene: Scene, stride: int) -> Timetable:
    """Return the rules of a scene.

    :param scene: the task
    :param stride: cells per padded row
    """
    disc = disc_offsets(scene.sensor_radius)
    edges, edge_counts = edge_offsets(disc)
    place = np.array([stride, 1], np.int64)
    length = int(np.ceil(_DISCOUNT_BITS * np.log(2.0) / -np.log(max(DISCOUNTS)))) + 1
    left = range(STEPS_LEFT[-1] + 1)
    steps = np.arange(length)
    powers = np.stack([discount_at(n) ** steps for n in left])
    # A goal however far is worth something.
    discounts = np.maximum(1, np.round(powers * (1 << _DISCOUNT_BITS))).astype(np.int64)
    density = scene.n_targets / scene.n_free
    unseen = np.stack([unseen_worths(density, scene.n_agents, n) for n in left])
    worths = np.maximum(1, np.round(unseen * TARGET_WORTH)).astype(np.int64)
    rules = Rules(
        MOVE_ROWS * stride + MOVE_COLUMNS,
        disc @ place,
        edges @ place,
        edge_counts,
        discounts[-1],
        worths[-1],
        TARGET_WORTH,
        scene.horizon,
        passable_odds(),
        int(LEAST_ODDS * CERTAIN),
        DEPTH,
        int(SLACK * TARGET_WORTH),
        FIRM,
        ROUNDS,
        n_orders(scene.n_agents),
    )
    return Timetable(rules, discounts, worths, role_worths())


def make_marks(area: int) -> Marks:
    """Allocate the notes on a map; ``area`` padded cells."""
    return Marks(
        np.full(area, NONE, np.int64),
        np.zeros(area, np.int64),
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
        np.zeros(capacity, np.int64),
        np.zeros(capacity, np.uint8),
        np.full(area, NONE, np.int64),
        np.full(area, NONE, np.int32),
    )


def make_plans(n_agents: int, area: int) -> Plans:
    """Allocate the routes of a team; ``area`` padded cells."""
    return Plans(_make_routes(n_agents, area), _make_routes(n_agents, area))


def _make_routes(n_agents: int, area: int) -> Routes:
    return Routes(
        np.zeros(n_agents, np.int64),
        np.zeros((n_agents, area), np.int32),
        np.zeros(n_agents, np.int64),
        np.zeros(n_agents, np.uint8),
        np.zeros((n_agents, N_ACTIONS), np.int64),
        np.zeros(n_agents, np.int64),
        np.zeros(n_agents, np.bool_),
    )
