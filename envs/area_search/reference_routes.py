"""The joint look-ahead once more, in plain Python: slow, with sets, and independent of the kernels.

The tests hold ``area_search.look_ahead`` to it bit for bit. It shares with it only its constants,
and the formulas beside them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from area_search import look_ahead_data as constants

Cell = tuple[int, int]
MOVES: tuple[Cell, ...] = ((0, 0), (-1, 0), (0, 1), (1, 0), (0, -1))
_UNIT = 1 << 10
_FINEST = 1 << 20
_SURE = 1 << 10


@cache
def discount(steps: int, left: int) -> int:
    """What is left of a worth after some steps, in fixed point, never nothing."""
    return max(1, round(float(np.float64(constants.discount_at(left)) ** steps) * _FINEST))


@dataclass
class Label:
    """A partial route: its cells from the start on, worth, chance to be open, how it may begin."""

    path: list[Cell]
    value: int = 0
    odds: int = _SURE
    first: set[int] = field(default_factory=set)
    begin: int = 0


@dataclass
class TeamMap:
    """What a team knows, and what that is worth.

    :param ground: known free cells
    :param targets: known uncovered targets
    :param unexplored: cells of the map that nobody has seen
    :param disc: the cells of the map that a robot senses from a cell
    :param density: expected targets per free cell
    :param n_agents: robots in the team
    :param left: steps left of the episode
    """

    ground: set[Cell]
    targets: set[Cell]
    unexplored: set[Cell]
    disc: Callable[[Cell], set[Cell]]
    density: float
    n_agents: int
    left: int
    known_gains: dict[tuple[Cell, Cell], dict[Cell, int]] = field(default_factory=dict)

    def obstacles_beside(self, cell: Cell) -> int:
        """Count the known obstacles beside a cell; off the map all is known to be obstacles."""
        beside = [(cell[0] + dr, cell[1] + dc) for dr, dc in MOVES[1:]]
        return sum(c not in self.ground and c not in self.unexplored for c in beside)

    def unseen_worth(self, cell: Cell) -> int:
        """Return the worth of an unseen cell."""
        worths = constants.unseen_worths(self.density, self.n_agents, self.left)
        return max(1, round(float(worths[self.obstacles_beside(cell)] * _UNIT)))

    def odds_after(self, odds: int, before: Cell, cell: Cell) -> int:
        """Return the chance that a way is open, with one more move."""
        if cell in self.ground:
            return odds
        # Nobody walks blind: a cell has to be in view, too, for the next one to be entered.
        if cell not in self.unexplored or cell not in self.disc(before):
            return 0
        return odds * int(constants.passable_odds()[self.obstacles_beside(cell)]) // _SURE

    def gains(self, before: Cell, cell: Cell) -> dict[Cell, int]:
        """Return what a move gets: the worth of a target, and of the cells that come into view."""
        if (before, cell) not in self.known_gains:
            in_view = (self.disc(cell) - self.disc(before)) & self.unexplored
            targets = {cell} & self.targets
            self.known_gains[before, cell] = {c: self.unseen_worth(c) for c in in_view} | {
                c: _UNIT for c in targets
            }
        return self.known_gains[before, cell]


def search(
    known: TeamMap,
    start: Cell,
    claims: dict[Cell, tuple[int, int]],
    take: int = _SURE,
    see: int = _SURE,
) -> list[Label]:
    """Search for routes of one robot; if team mates leave it nothing, as if it were alone.

    :param claims: by cell the best discount at which a team mate gets it, and the mate
    :param take: what known targets count
    :param see: what unseen cells count
    :return: all labels, the best one first; that of the start alone if nothing is to be gained
    """
    labels, layer = [Label([start])], [Label([start])]
    best, top, t = {start: 0}, labels[0], 0
    least = int(constants.LEAST_ODDS * _SURE)
    while layer and t < known.left and (t < constants.DEPTH or top.value == 0):
        t += 1
        present = discount(t, known.left)
        hopeless = top.value - int(constants.SLACK * _UNIT) * present
        following: dict[Cell, Label] = {}
        for label in layer:
            if label.value < hopeless:
                continue
            for action in range(1, 5):
                before = label.path[-1]
                cell = (before[0] + MOVES[action][0], before[1] + MOVES[action][1])
                odds = known.odds_after(label.odds, before, cell)
                if odds < least:
                    continue
                taken, view = 0, 0
                for got, worth in known.gains(before, cell).items():
                    gain = max(0, present - claims.get(got, (0, 0))[0])
                    if got in known.targets:
                        taken += worth * take // _SURE * gain
                    else:
                        view += worth * gain
                value = label.value + (taken + view * see // _SURE) * odds // _SURE
                if value > label.value and cell in label.path:
                    value = label.value
                    if value <= best[cell]:
                        continue
                first = {action} if t == 1 else label.first
                if value == best.get(cell, -1) and cell in following:
                    following[cell].first |= first
                if value <= best.get(cell, -1):
                    continue
                best[cell] = value
                begin = label.begin or (t if value > 0 else 0)
                better = following.setdefault(cell, Label([]))
                better.path, better.value = [*label.path, cell], value
                better.odds = odds
                better.first, better.begin = set(first), begin
                if value > top.value:
                    top = better
        layer = list(following.values())
        labels += layer
    if top.value == 0 and claims:
        return search(known, start, {}, take, see)
    return [top, *(label for label in labels if label is not top)]


class TeamRoutes:
    """Routes of all robots of a team, planned in turn.

    :param known: the map
    :param robots: cells of the robots
    :param begin: the robot that plans first
    """

    def __init__(self, known: TeamMap, robots: list[Cell], begin: int) -> None:
        self.known = known
        self.found: list[list[Label]] = [[] for _ in robots]
        self.robbed: set[int] = set()
        order = [(begin + k) % len(robots) for k in range(len(robots))]
        for turn in range(constants.ROUNDS):
            for i in order:
                if turn > 0 and i not in self.robbed:
                    continue
                claims: dict[Cell, tuple[int, int]] = {}
                for j in order:
                    if j != i and self.found[j]:
                        self.claim(j, claims)
                self.robbed.discard(i)
                self.found[i] = search(known, robots[i], claims)
                self.claim(i, claims)

    def claim(self, i: int, claims: dict[Cell, tuple[int, int]]) -> None:
        """Claim what a robot's route gets, and note who gets less by that."""
        left = self.known.left
        path, odds = self.found[i][0].path, _SURE
        for t, cell in enumerate(path[1:], start=1):
            odds = self.known.odds_after(odds, path[t - 1], cell)
            claim = discount(t, left) * odds // _SURE
            for got in ({cell} & self.known.targets) | (
                self.known.disc(cell) & self.known.unexplored
            ):
                owned, owner = claims.get(got, (0, i))
                if owned < claim:
                    if owner != i and owned >= discount(constants.FIRM, left):
                        self.robbed.add(owner)
                    claims[got] = (claim, i)

    def total(self) -> int:
        """Return what all routes are worth together."""
        claims: dict[Cell, tuple[int, int]] = {}
        for i in range(len(self.found)):
            self.claim(i, claims)
        return sum(
            discounted * (_UNIT if cell in self.known.targets else self.known.unseen_worth(cell))
            for cell, (discounted, _) in claims.items()
        )


def _best_plan(known: TeamMap, robots: list[Cell]) -> TeamRoutes:
    begins = range(constants.n_orders(len(robots)))
    return max((TeamRoutes(known, robots, begin) for begin in begins), key=TeamRoutes.total)


def route_features(
    known: TeamMap, robots: list[Cell], in_roles: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of ``sub_goal`` that are for a robot's route, and for that in each role.

    :return: float32 (n_agents, 11) and (n_agents, 2, 11), or (n_agents, 0, 11) without roles
    """
    plan = _best_plan(known, robots)
    roles = constants.role_worths().tolist() if in_roles else []
    of_roles = np.zeros((len(robots), len(roles), 11), np.float32)
    for i, robot in enumerate(robots):
        claims: dict[Cell, tuple[int, int]] = {}
        for j in range(len(robots)):
            if j != i:
                plan.claim(j, claims)
        for role, (take, see) in enumerate(roles):
            of_roles[i, role] = _features(search(known, robot, claims, take, see))
    return np.array([_features(found) for found in plan.found]), of_roles


def _features(found: list[Label]) -> np.ndarray:
    out = np.zeros(11, np.float32)
    top, *others = found
    if top.value > 0:
        out[list(top.first)] = 1.0
        out[5] = _nearness(top.begin)
        for label in (top, *others):
            for action in label.first:
                out[6 + action] = max(out[6 + action], label.value / (_UNIT * _FINEST))
    return out


def _nearness(distance: int) -> float:
    """0.9 ** distance, in fixed point."""
    return (
        round(float(np.float64(0.9) ** distance) * (1 << 32)) / (1 << 32) if distance < 212 else 0
    )
