"""What the joint look-ahead works with: its constants, and named tuples of arrays for its kernels.

Kernels get what can be tuned in :class:`Rules`, never as globals: a cached kernel keeps the value
that a global of another file had when it was compiled.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from area_search.cells import (
    MOVE_COLUMNS,
    MOVE_ROWS,
    N_ACTIONS,
    disc_offsets,
    edge_offsets,
)
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
NONE = -1


class Rules(NamedTuple):
    """What routes depend on besides the map; offsets are those of a flat padded map.

    ``offsets`` int64 (5,), of each action; ``disc`` int64 (k,), of the sensed cells; ``edges``
    int64 (5, k) and ``edge_counts`` int64 (5,), of the cells that come into view with each action,
    see :func:`~area_search.cells.edge_offsets`; ``discounts`` int64 (n,), by steps, the last one
    for all that are later, all above 0; ``worths`` int64 (5,), of an unseen cell by the number of
    known obstacles beside it; ``depth``, ``slack``, ``firm`` and ``rounds`` are the constants of
    these names, the slack as a worth.
    """

    offsets: np.ndarray
    disc: np.ndarray
    edges: np.ndarray
    edge_counts: np.ndarray
    discounts: np.ndarray
    worths: np.ndarray
    depth: int
    slack: int
    firm: int
    rounds: int


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
        DEPTH,
        int(SLACK * TARGET_WORTH),
        FIRM,
        ROUNDS,
    )


def make_marks(area: int) -> Marks:
    """Allocate the notes on a map; ``area`` padded cells."""
    return Marks(
        np.full(area, NONE, np.int64),
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
        np.full(area, NONE, np.int64),
        np.full(area, NONE, np.int32),
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
