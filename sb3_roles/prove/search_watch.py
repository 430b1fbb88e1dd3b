"""Invariants of the area search, checked on whole batches of teams at every step.

A :class:`Watch` keeps a record of its own, made of the robots' positions and the maps at the reset
alone, and holds everything that the environment keeps, shows and rewards to it. All is plain numpy
over all teams at once.
"""

from __future__ import annotations

import numpy as np

from area_search import BatchedAreaSearch
from area_search import cells as layout
from sb3_roles.prove.search_maps import Seen, boards, has, shifted
from sb3_roles.prove.search_rules import RULES

_MOVES = np.stack([layout.MOVE_ROWS, layout.MOVE_COLUMNS], axis=1)


class Watch:
    """Follows a batch through steps and resets, and tells which invariants do not hold.

    Make it before or after the first reset, then call :meth:`begin` after each reset, and
    :meth:`step` instead of the batch's own.

    Its attribute ``broken`` counts the moments, team by team, in which something did not hold.

    :param batch: teams of one scene
    """

    def __init__(self, batch: BatchedAreaSearch) -> None:
        self.batch, self.scene, self.rules = batch, batch.scene, RULES
        shape = (batch.n_teams, self.scene.height, self.scene.width)
        self._disc = layout.disc_offsets(self.scene.sensor_radius)
        # What is off the map counts as explored.
        edge = int(self.scene.sensor_radius)
        self._padded = np.pad(
            np.zeros(shape, bool), ((0, 0), (edge, edge), (edge, edge)), constant_values=True
        )
        inner = self._padded[:, edge : edge + shape[1], edge : edge + shape[2]]
        self._maps = {name: np.zeros(shape, bool) for name in ("obstacle", "targets", "visited")}
        self._maps["explored"] = inner
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
        self._maps["obstacle"][which] = has(board, layout.OBSTACLE)[which]
        self._maps["targets"][which] = has(board, layout.TARGET | layout.COVERED)[which]
        self._maps["explored"][which] = self._maps["visited"][which] = False
        for count in (*self._counts.values(), self._idle):
            count[which] = 0
        self._wanted = self.batch.position.copy()
        # The others stand where they stood before: they see nothing new.
        grown, found = self._visit()
        return self._check(self._look(board, grown, found, ~which), which)

    def step(self, actions: np.ndarray) -> list[str]:
        """Make a step and check it.

        :param actions: int (n_teams, n_agents)
        :return: what does not hold, a line each
        """
        self._wanted = self._allowed(self.batch.position + _MOVES[actions])
        self.batch.step(actions)
        grown, found = self._visit()
        self._counts["steps"] += 1
        self._counts["seen"] += grown.sum(axis=1)
        self._counts["covered"] += found.sum(axis=1)
        self._idle = np.where(found, 0, self._idle + 1)
        everyone = np.ones(self.batch.n_teams, bool)
        return self._check(self._look(boards(self.batch), grown, found, everyone), everyone)

    def _visit(self) -> tuple[np.ndarray, np.ndarray]:
        """Let the robots look around, in index order; count what each is the first to get.

        :return: new cells and new targets, int (n_teams, n_agents)
        """
        team, edge = np.arange(self.batch.n_teams), int(self.scene.sensor_radius)
        grown, found = np.zeros_like(self._idle), np.zeros_like(self._idle)
        rows, columns = self._inside(self.batch.position)
        for i, (row, column) in enumerate(zip(rows.T, columns.T, strict=True)):
            in_view = (
                team[:, None],
                row[:, None] + edge + self._disc[:, 0],
                column[:, None] + edge + self._disc[:, 1],
            )
            grown[:, i] = (~self._padded[in_view]).sum(axis=1)
            self._padded[in_view] = True
            here = team, row, column
            found[:, i] = self._maps["targets"][here] & ~self._maps["visited"][here]
            self._maps["visited"][here] = True
        return grown, found

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

    def _look(
        self,
        board: np.ndarray,
        grown: np.ndarray,
        found: np.ndarray,
        stepped: np.ndarray,
    ) -> Seen:
        unseen, near = ~self._maps["explored"], np.zeros(board.shape, bool)
        for row in (-1, 0, 1):
            for column in (-1, 0, 1):
                near |= shifted(unseen, row, column)
        return Seen(
            batch=self.batch,
            board=board,
            robots=self._robots(),
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
