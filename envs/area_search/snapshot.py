"""``Snapshot``: everything that one frame shows of one team."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


# Without eq=False the generated comparison would ask for the truth value of whole arrays.
@dataclass(frozen=True, eq=False, kw_only=True)
class Snapshot:
    """Everything that one frame shows of one team.

    H and W are the rows and columns of the map, N is the number of robots.

    :param obstacle: bool (H, W), the true obstacles
    :param explored: bool (H, W), the cells that the team has sensed
    :param frontier: bool (H, W), explored free cells next to an unexplored cell
    :param target_open: bool (H, W), every target not yet covered, seen or not
    :param target_covered: bool (H, W)
    :param position: int (N, 2), row and column of each robot; N >= 1
    :param roles: int (N,), indices into ``role_names``; None for robots without roles
    :param role_names: names of the roles
    :param path: int (T, N, 2), earlier positions, the latest last; None to draw no paths
    :param step: steps taken so far
    :param horizon: steps of a whole episode
    :param metrics: fractions by name, shown as percentages in this order; NaN shows as a dash
    :param sensor_radius: Euclidean, in cells
    :param view_radius: half-width of the observation window, in cells
    :param communication_radius: Euclidean, in cells; robots strictly nearer are linked
    :param title: first line of the side panel

    :raises ValueError: if an array has the wrong shape or dtype, or an entry is out of range
    """

    obstacle: np.ndarray
    explored: np.ndarray
    frontier: np.ndarray
    target_open: np.ndarray
    target_covered: np.ndarray
    position: np.ndarray
    step: int
    horizon: int
    metrics: Mapping[str, float]
    sensor_radius: float
    view_radius: int
    communication_radius: float
    roles: np.ndarray | None = None
    role_names: tuple[str, ...] = ("explore", "cover")
    path: np.ndarray | None = None
    title: str = ""

    def __post_init__(self) -> None:
        shape = self.obstacle.shape
        if len(shape) != 2 or 0 in shape:
            raise ValueError(f"obstacle must have shape (H, W) with H, W >= 1, got {shape}")
        for name in ("obstacle", "explored", "frontier", "target_open", "target_covered"):
            _check_array(name, getattr(self, name), shape, "bool")
        n_agents = len(self.position)
        if n_agents < 1:
            raise ValueError("position must hold at least one robot, got none")
        _check_array("position", self.position, (n_agents, 2), "integer")
        if np.any(self.position < 0) or np.any(self.position >= shape):
            raise ValueError(f"position must lie on the map of shape {shape} (row, column)")
        if self.roles is not None:
            _check_array("roles", self.roles, (n_agents,), "integer")
            if np.any(self.roles < 0) or np.any(self.roles >= len(self.role_names)):
                raise ValueError(
                    f"roles must be indices into role_names {self.role_names}, "
                    f"got {self.roles.tolist()}"
                )
        if self.path is not None:
            _check_array("path", self.path, (len(self.path), n_agents, 2), "integer")


def _check_array(name: str, array: np.ndarray, shape: tuple[int, ...], dtype: str) -> None:
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    if not np.issubdtype(array.dtype, np.bool_ if dtype == "bool" else np.integer):
        raise ValueError(f"{name} must have dtype {dtype}, got {array.dtype}")
