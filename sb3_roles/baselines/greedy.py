"""The Greedy rows of the tables: robots walk to the nearest thing to do on the team's map.

The paper's Greedy (Section V-B): each robot selects the nearest frontier or target cell as its
sub-goal, and the next one when it has got there, by Manhattan distance; how it walks around
obstacles is left open. Ours: distances are those of shortest paths over the known free cells, goals
that are gone are given up, and all of the variant that shares the goals out.

Ties are many on a grid, and how they are broken decides more than it should: robots start close
together, and those that break ties alike walk together from then on. Here nothing depends on the
compass or on a cell's place in the map. Among several shortest paths a robot takes one that goes
straight on, else any; among equally near goals it takes any. "Any" is a hash of (seed, episode,
step, robot), so that an episode is the same in any batch.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from area_search.cells import FRONTIER, KNOWN_TARGET, N_ACTIONS, border_width
from area_search.matching import (
    CURSOR,
    HEAD,
    LISTED,
    N_ENDS,
    NOBODY,
    TAIL,
    assign,
    cell_order,
    count_goals,
    next_goal,
    share_searches,
)
from area_search.paths import expand, start_at
from area_search.random_streams import draw, episode_key, mix
from sb3_roles.baselines.base import ScriptedController

if TYPE_CHECKING:
    from area_search.batch import BatchedAreaSearch

TARGET_LEAD = 2
"""How many cells nearer a target counts than it is, in ``greedy_assigned``."""

_NO_GOAL = -1
_GOALS = FRONTIER | KNOWN_TARGET

# Separates these draws from those of the map, which have the same seed and episode.
_TAG = np.uint64(0x4752454544592121)  # "GREEDY!!"
# Half of the bits order the cells, half choose the move.
_HALF = 32


class Walker(ScriptedController):
    """Calls a kernel that walks, with the teams' maps and what the controller keeps."""

    def begin(self, batch: BatchedAreaSearch) -> None:
        """Take the teams to control; all of them have just begun an episode.

        :param batch: read only: positions, and what the team knows of its map
        """
        super().begin(batch)
        self._border = border_width(batch.scene.view_radius, batch.scene.sensor_radius)
        self._arrays = self._allocate(batch.n_teams, batch.n_agents, batch.cells[0].size)

    @abstractmethod
    def _allocate(self, n_teams: int, n: int, area: int) -> tuple[np.ndarray, ...]:
        """Return the kernel's memory and scratch; ``n`` robots a team, ``area`` padded cells."""

    @abstractmethod
    def _walk(self, *arguments: Any) -> None:
        """Call the kernel."""

    def act(self, batch: BatchedAreaSearch) -> np.ndarray:
        """Take the first step to every robot's goal.

        :param batch: the teams
        :return: int64 (n_teams, n_agents)
        """
        actions = np.empty((batch.n_teams, batch.n_agents), np.int64)
        self._walk(
            batch.keys,
            batch.episodes,
            batch.steps,
            batch.cells,
            self._border,
            batch.position,
            *self._arrays,
            actions,
        )
        return actions


class GreedyController(Walker):
    """Every robot for itself: the nearest goal, then the next.

    A robot picks the nearest frontier cell or known uncovered target, a target first on a tie, and
    keeps it until it gets there or the goal is gone: a frontier cell that is none any more, a
    target that a team mate covered. The cell on which it stands is no goal. Without any goal that
    it can reach on the known map, it stays.
    """

    def _allocate(self, n_teams: int, n: int, area: int) -> tuple[np.ndarray, ...]:
        return (
            np.zeros((n_teams, n), np.int64),  # heading
            np.full((n_teams, n), _NO_GOAL, np.int64),  # goal
            np.zeros((n_teams, n), np.uint8),  # wanted
            np.zeros(area, np.int32),  # distance
            np.zeros(area, np.uint8),  # moves
            np.zeros(area, np.int32),  # queue
        )

    def _walk(self, *arguments: Any) -> None:
        _walk_alone(*arguments)


class GreedyAssignedController(Walker):
    """The team shares its goals out one to one, anew at each step.

    Robots and goals are matched nearest pair first. A target counts as ``TARGET_LEAD`` cells nearer
    than it is. A frontier goal blocks its 3 x 3 neighborhood for team mates, because its robot will
    see what they would go for; a target blocks its own cell. A robot for which no goal is left
    goes to the one nearest to it, as a team mate does; without any that it can reach, it stays.
    """

    def _allocate(self, n_teams: int, n: int, area: int) -> tuple[np.ndarray, ...]:
        return (
            np.zeros((n_teams, n), np.int64),  # heading
            np.zeros((n, area), np.int32),  # distance
            np.zeros((n, area), np.uint8),  # moves
            np.zeros((n, area), np.int32),  # queue
            np.zeros((n, N_ENDS), np.int64),  # ends
            np.zeros((n, area), np.int32),  # lists
            np.zeros(area, np.uint8),  # blocked
            np.zeros(n, np.int64),  # source
            np.zeros(n, np.int64),  # chosen
        )

    def _walk(self, *arguments: Any) -> None:
        _walk_assigned(*arguments)


@njit(cache=True)
def random_bits(key: np.ndarray, episode: int, counter: int) -> int:
    """Draw 63 bits that depend on the episode and a counter alone."""
    first = mix(key[0] ^ _TAG)
    word = draw(first, mix(episode_key(key, episode) ^ _TAG), np.uint64(counter))
    return int(np.int64(word >> np.uint64(1)))


@njit(cache=True)
def first_move(moves: int, heading: int, bits: int) -> int:
    """Choose among the first moves of the shortest paths: straight on, else any."""
    if (moves >> heading) & 1:
        return heading
    n = 0
    for action in range(N_ACTIONS):
        n += (moves >> action) & 1
    skip = (bits & ((1 << _HALF) - 1)) % n
    for action in range(N_ACTIONS):
        if (moves >> action) & 1:
            if skip == 0:
                return action
            skip -= 1
    return 0


@njit(cache=True)
def _walk_alone(
    keys: np.ndarray,
    episodes: np.ndarray,
    steps: np.ndarray,
    cells: np.ndarray,
    border: int,
    position: np.ndarray,
    heading: np.ndarray,
    goal: np.ndarray,
    wanted: np.ndarray,
    distance: np.ndarray,
    moves: np.ndarray,
    queue: np.ndarray,
    actions: np.ndarray,
) -> None:
    """Choose the actions of :class:`GreedyController`.

    :param heading: int64 (n_teams, n_agents), the last actions
    :param goal: int64 (n_teams, n_agents), the cells that are kept as goals, or -1
    :param wanted: uint8 (n_teams, n_agents), the bit that makes a kept cell a goal
    """
    stride, n_agents = cells.shape[2], position.shape[1]
    for m in range(position.shape[0]):
        flat = cells[m].reshape(-1)
        nothing = count_goals(flat, _GOALS) == 0
        for i in range(n_agents):
            bits = random_bits(keys[m], episodes[m], steps[m] * n_agents + i)
            salt = 1 + (bits >> _HALF)
            start = (position[m, i, 0] + border) * stride + position[m, i, 1] + border
            best = goal[m, i]
            kept = best != _NO_GOAL and best != start and flat[best] & wanted[m, i] > 0
            if not kept:
                best = _NO_GOAL
            head, tail = 0, start_at(start, distance, moves, queue)
            while head < tail and not nothing:
                cell = queue[head]
                if kept and cell == best:
                    break
                if not kept and best != _NO_GOAL and distance[cell] > distance[best]:
                    break
                head += 1
                tail = expand(flat, stride, cell, distance, moves, queue, tail)
                if kept or cell == start or not flat[cell] & _GOALS:
                    continue
                target = flat[cell] & KNOWN_TARGET
                better = best == _NO_GOAL or target > flat[best] & KNOWN_TARGET
                if not better and target == flat[best] & KNOWN_TARGET:
                    better = cell_order(cell, salt) < cell_order(best, salt)
                if better:
                    best = cell
            goal[m, i] = best
            action = 0
            if best != _NO_GOAL:
                wanted[m, i] = KNOWN_TARGET if flat[best] & KNOWN_TARGET else FRONTIER
                action = first_move(moves[best], heading[m, i], bits)
            heading[m, i] = actions[m, i] = action
            for k in range(tail):
                moves[queue[k]] = 0


@njit(cache=True)
def _walk_assigned(
    keys: np.ndarray,
    episodes: np.ndarray,
    steps: np.ndarray,
    cells: np.ndarray,
    border: int,
    position: np.ndarray,
    heading: np.ndarray,
    distance: np.ndarray,
    moves: np.ndarray,
    queue: np.ndarray,
    ends: np.ndarray,
    lists: np.ndarray,
    blocked: np.ndarray,
    source: np.ndarray,
    chosen: np.ndarray,
    actions: np.ndarray,
) -> None:
    """Choose the actions of :class:`GreedyAssignedController`.

    :param heading: int64 (n_teams, n_agents), the last actions
    :param ends: with ``lists``, ``blocked``, ``source`` and ``chosen``, see
        :func:`area_search.matching.assign`
    """
    stride, n_agents = cells.shape[2], position.shape[1]
    for m in range(position.shape[0]):
        flat = cells[m].reshape(-1)
        share_searches(position[m], source)
        for i in range(n_agents):
            if source[i] == i:
                start = (position[m, i, 0] + border) * stride + position[m, i, 1] + border
                tail = start_at(start, distance[i], moves[i], queue[i])
                # The start is searched already: it is no goal.
                ends[i, HEAD] = 1
                ends[i, TAIL] = expand(flat, stride, start, distance[i], moves[i], queue[i], tail)
                ends[i, LISTED] = ends[i, CURSOR] = 0
        n_goals = count_goals(flat, _GOALS)
        counter = steps[m] * (n_agents + 1)
        salt = 1 + (random_bits(keys[m], episodes[m], counter) >> _HALF)
        assign(
            flat,
            stride,
            _GOALS,
            n_goals,
            KNOWN_TARGET,
            TARGET_LEAD,
            salt,
            source,
            distance,
            moves,
            queue,
            ends,
            lists,
            blocked,
            chosen,
        )
        for i in range(n_agents):
            s, goal, action = source[i], chosen[i], 0
            if goal == NOBODY:
                # Nothing is blocked any more: the nearest goal of all.
                ends[s, CURSOR] = 0
                goal = next_goal(
                    flat,
                    stride,
                    _GOALS,
                    n_goals,
                    TARGET_LEAD,
                    salt,
                    s,
                    distance,
                    moves,
                    queue,
                    ends,
                    lists,
                    blocked,
                )
            if goal != NOBODY:
                bits = random_bits(keys[m], episodes[m], counter + 1 + i)
                action = first_move(moves[s, goal], heading[m, i], bits)
            heading[m, i] = actions[m, i] = action
        for i in range(n_agents):
            if source[i] == i:
                for k in range(ends[i, TAIL]):
                    moves[i, queue[i, k]] = 0
