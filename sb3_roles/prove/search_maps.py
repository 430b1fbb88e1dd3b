"""What is known of a batch of teams at one moment, as maps and counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from area_search import BatchedAreaSearch


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
    """int (n_teams, n_agents), cells that each robot is the first to see"""
    found: np.ndarray
    """int (n_teams, n_agents), targets that each robot is the first to stand on"""
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
