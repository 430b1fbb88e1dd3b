"""How long the rest of a grid takes, and how that is shown."""

from __future__ import annotations

import sys
from collections import defaultdict
from typing import Any, NamedTuple

from sb3_roles.common.durations import long_duration
from sb3_roles.evaluation.grid.plan import Cell, Row
from sb3_roles.evaluation.grid.store import Report

# Seconds of a block of one robot, of a row that was never measured: blocks are chosen to take about
# the same time, whatever an episode takes.
_PRIOR = 1.0
# Between rows that plan for all robots at once and rows where each robot decides for itself.
_EXPONENT = 0.5


class Left(NamedTuple):
    """An estimate of what is left to play.

    :param seconds: of rows that were measured
    :param known: whether there are no others
    """

    seconds: float
    known: bool

    def __str__(self) -> str:
        if self.known:
            return f"about {long_duration(self.seconds)}"
        return f"more than {long_duration(self.seconds)}" if self.seconds else "time not known yet"

    def text(self) -> str:
        """Say how much is left, for the end of a line."""
        return f"{self} left" if self.known or self.seconds else str(self)


class Estimates:
    """Estimates the time of episodes by what others of their row took."""

    def __init__(self) -> None:
        # (row, robots or 0 for any) -> [seconds, size of all episodes]
        self._sums: dict[tuple[str, int], list[float]] = defaultdict(lambda: [0.0, 0.0])

    def add(self, row: Row, n_agents: int, n_episodes: int, seconds: float) -> None:
        """Learn from episodes that were played.

        :param row: that played
        :param n_agents: robots in the team
        :param n_episodes: number of episodes
        :param seconds: that they took
        """
        for key in ((row.name, n_agents), (row.name, 0)):
            self._sums[key][0] += seconds
            self._sums[key][1] += n_agents**_EXPONENT * n_episodes

    def knows(self, row: Row) -> bool:
        """Whether episodes of a row were measured; otherwise its seconds only serve for an order.

        :param row: that plays
        """
        return (row.name, 0) in self._sums

    def seconds(self, row: Row, n_agents: int, n_episodes: int) -> float:
        """Estimate what episodes take, in seconds.

        :param row: that plays
        :param n_agents: robots in the team
        :param n_episodes: number of episodes
        """
        size = n_agents**_EXPONENT * n_episodes
        for key in ((row.name, n_agents), (row.name, 0)):
            if key in self._sums:
                seconds, measured = self._sums[key]
                return size * seconds / measured
        return _PRIOR * size / row.block


class Progress:
    """Shows what was played: a bar on a terminal, elsewhere a line for each finished cell.

    :param n_blocks: blocks to play
    :param n_cells: cells to finish
    :param report: takes the lines
    :param bar: show a bar on stderr instead
    """

    def __init__(self, n_blocks: int, n_cells: int, report: Report, bar: bool = False) -> None:
        self._n_cells, self._report = n_cells, report
        self._finished = 0
        self._bar: Any = None
        if bar and n_blocks:
            from tqdm import tqdm  # type: ignore[import-untyped]

            form = "{percentage:3.0f}%|{bar}| {n_fmt} of {total_fmt} blocks, {elapsed}{postfix}"
            self._bar = tqdm(total=n_blocks, bar_format=form, file=sys.stderr, leave=False)

    def block_done(self, left: Left) -> None:
        """One more block was played, or is no longer wanted."""
        if self._bar is not None:
            self._bar.set_postfix_str(left.text(), refresh=False)
            self._bar.update()
            self._bar.refresh()

    def cell_done(self, cell: Cell, n_episodes: int, left: Left) -> None:
        """All blocks of a cell are there."""
        self._finished += 1
        if self._bar is None:
            row, column = cell
            rest = "" if left == (0.0, True) else f", {left.text()}"
            self._report(
                f"{row}, {column.scene}, {column.n_agents} robots: {n_episodes} episodes; "
                f"{self._finished} of {self._n_cells} cells{rest}"
            )

    def close(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.close()
