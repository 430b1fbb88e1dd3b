"""Invariants of the area search, checked on whole batches of teams at every step.

A :class:`Watch` keeps a record of its own, made of the robots' positions and the maps at the reset
alone, and holds everything that the environment keeps, shows and rewards to it. All is plain numpy
over all teams at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from area_search import BatchedAreaSearch
from area_search import cells as layout

_MOVES = np.stack([layout.MOVE_ROWS, layout.MOVE_COLUMNS], axis=1)


def boards(batch: BatchedAreaSearch) -> np.ndarray:
    """Copy the maps without their borders.

    :param batch: any
    :return: uint8 (n_teams, height, width), see ``area_search.cells``
    """
    height, width = batch.observations["joint"].shape[-2:]
    border = (batch.cells.shape[1] - height) // 2
    return batch.cells[:, border : border + height, border : border + width].copy()


def has(board: np.ndarray, bit: int) -> np.ndarray:
    """Return where a bit is set.

    :param board: uint8
    :param bit: of ``area_search.cells``
    """
    return (board & bit) > 0


def shifted(maps: np.ndarray, row: int, column: int) -> np.ndarray:
    """Move maps by some cells; what comes in from beyond the edge is False.

    :param maps: bool (n_teams, height, width)
    :param row: cells to move down
    :param column: cells to move to the right
    """
    out = np.zeros_like(maps)
    height, width = maps.shape[1:]
    if abs(row) < height and abs(column) < width:
        inner = maps[:, max(-row, 0) : height - max(row, 0)]
        inner = inner[:, :, max(-column, 0) : width - max(column, 0)]
        out[
            :,
            max(row, 0) : height + min(row, 0),
            max(column, 0) : width + min(column, 0),
        ] = inner
    return out


@dataclass
class Seen:
    """One moment: the watch's own record, and the maps that the environment keeps.

    Arrays have the teams first; maps are bool (n_teams, height, width).
    """

    batch: BatchedAreaSearch
    board: np.ndarray
    """uint8 (n_teams, height, width)"""
    obstacle: np.ndarray
    targets: np.ndarray
    """All targets of the episode."""
    explored: np.ndarray
    """Union of the discs of all positions since the reset."""
    visited: np.ndarray
    """Cells that a robot stood on."""
    robots: np.ndarray
    frontier: np.ndarray
    wanted: np.ndarray
    """Positions that the rules allow, int (n_teams, n_agents, 2)."""
    grown: np.ndarray
    """int (n_teams,), cells that this step explored; 0 after a reset"""
    found: np.ndarray
    """int (n_teams,), targets that this step covered; 0 after a reset"""
    seen: np.ndarray
    """int (n_teams,), cells explored by steps since the reset"""
    covered: np.ndarray
    """int (n_teams,), targets covered by steps since the reset"""
    steps: np.ndarray
    """int (n_teams,)"""
    idle: np.ndarray
    """int (n_teams, n_agents), steps since the robot's last target"""
    stepped: np.ndarray
    """bool (n_teams,), whether this moment is a step and not a reset"""


Rule = Callable[[Seen], np.ndarray]
"""Returns bool (n_teams,): where it holds."""


class Watch:
    """Follows a batch through steps and resets, and tells which invariants do not hold.

    Make it before or after the first reset, then call :meth:`begin` after each reset, and
    :meth:`step` instead of the batch's own.

    Its attribute ``broken`` counts the moments, team by team, in which something did not hold.

    :param batch: teams of one scene
    """

    def __init__(self, batch: BatchedAreaSearch) -> None:
        from sb3_roles.prove.search_rules import RULES

        self.batch, self.scene, self.rules = batch, batch.scene, RULES
        shape = (batch.n_teams, self.scene.height, self.scene.width)
        self._disc = layout.disc_offsets(self.scene.sensor_radius)
        self._maps = {
            name: np.zeros(shape, bool) for name in ("obstacle", "targets", "explored", "visited")
        }
        self._counts = {name: np.zeros(batch.n_teams, int) for name in ("steps", "seen", "covered")}
        self._idle = np.zeros((batch.n_teams, batch.n_agents), int)
        self._wanted = batch.position.copy()
        self.broken = 0

    def begin(self, which: np.ndarray | None = None) -> list[str]:
        """Start the record of some teams anew, and check them.

        :param which: bool (n_teams,), the teams that were reset; None for all
        :return: what does not hold, a line each
        """
        which = np.ones(self.batch.n_teams, bool) if which is None else which
        board = boards(self.batch)
        maps = self._maps
        maps["obstacle"][which] = has(board, layout.OBSTACLE)[which]
        maps["targets"][which] = has(board, layout.TARGET | layout.COVERED)[which]
        robots = self._robots()
        maps["explored"][which] = self._in_view(robots)[which]
        maps["visited"][which] = robots[which]
        for count in (*self._counts.values(), self._idle):
            count[which] = 0
        self._wanted = self.batch.position.copy()
        none = np.zeros(self.batch.n_teams, int)
        return self._check(self._look(board, robots, none, none, ~which), which)

    def step(self, actions: np.ndarray) -> list[str]:
        """Make a step and check it.

        :param actions: int (n_teams, n_agents)
        :return: what does not hold, a line each
        """
        self._wanted = self._allowed(self.batch.position + _MOVES[actions])
        self.batch.step(actions)
        board, robots, maps = boards(self.batch), self._robots(), self._maps
        grown = self._in_view(robots) & ~maps["explored"]
        found = robots & maps["targets"] & ~maps["visited"]
        maps["explored"] |= grown
        maps["visited"] |= robots
        n_grown, n_found = grown.sum(axis=(1, 2)), found.sum(axis=(1, 2))
        self._counts["steps"] += 1
        self._counts["seen"] += n_grown
        self._counts["covered"] += n_found
        row, column = self._inside(self.batch.position)
        finds = found[np.arange(len(found))[:, None], row, column]
        # Of several robots on a new target the first one has it.
        first = (row[:, :, None] == row[:, None]) & (column[:, :, None] == column[:, None])
        finds &= ~np.tril(first, -1).any(axis=2)
        self._idle = np.where(finds, 0, self._idle + 1)
        everyone = np.ones(self.batch.n_teams, bool)
        return self._check(self._look(board, robots, n_grown, n_found, everyone), everyone)

    def _inside(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        last = np.array([self.scene.height - 1, self.scene.width - 1])
        row, column = np.moveaxis(np.clip(position, 0, last), 2, 0)
        return row, column

    def _allowed(self, wanted: np.ndarray) -> np.ndarray:
        row, column = self._inside(wanted)
        inside = (row == wanted[..., 0]) & (column == wanted[..., 1])
        team = np.arange(len(wanted))[:, None]
        free = inside & ~self._maps["obstacle"][team, row, column]
        return np.where(free[..., None], wanted, self.batch.position)

    def _robots(self) -> np.ndarray:
        out = np.zeros((self.batch.n_teams, self.scene.height, self.scene.width), bool)
        row, column = self._inside(self.batch.position)
        out[np.arange(self.batch.n_teams)[:, None], row, column] = True
        return out

    def _in_view(self, robots: np.ndarray) -> np.ndarray:
        out = np.zeros_like(robots)
        for row, column in self._disc.tolist():
            out |= shifted(robots, row, column)
        return out

    def _look(
        self,
        board: np.ndarray,
        robots: np.ndarray,
        grown: np.ndarray,
        found: np.ndarray,
        stepped: np.ndarray,
    ) -> Seen:
        unseen, near = ~self._maps["explored"], np.zeros_like(robots)
        for row in (-1, 0, 1):
            for column in (-1, 0, 1):
                near |= shifted(unseen, row, column)
        return Seen(
            batch=self.batch,
            board=board,
            robots=robots,
            frontier=self._maps["explored"] & ~self._maps["obstacle"] & near,
            wanted=self._wanted,
            grown=grown,
            found=found,
            idle=self._idle,
            stepped=stepped,
            **self._maps,
            **self._counts,
        )

    def _check(self, seen: Seen, which: np.ndarray) -> list[str]:
        lines, broken = [], np.zeros(self.batch.n_teams, bool)
        for name, rule in self.rules.items():
            wrong = np.flatnonzero(which & ~rule(seen))
            broken[wrong] = True
            if len(wrong):
                team = int(wrong[0])
                when = f"step {seen.steps[team]}" if seen.stepped[team] else "reset"
                lines.append(
                    f"{name}: {len(wrong)} of {self.batch.n_teams} teams, first team {team}, "
                    f"{when} of episode {self.batch.episodes[team]}, {self.scene.name}, "
                    f"{self.batch.n_agents} robots"
                )
        self.broken += int(broken.sum())
        return lines
