"""Runs of consecutive teams of a batch: the kernels' arguments for each, and threads to run them.

Teams do not depend on each other, so a batch may be stepped slice by slice, in any order or at
once. The kernels release the interpreter's lock; what one works on besides the teams' own arrays is
allocated for every slice. Plain threads, because parallel njit kills forked workers.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TYPE_CHECKING, Any

import numpy as np

from area_search import assignment, kernels, look_ahead, look_ahead_data, paths
from area_search import cells as layout

if TYPE_CHECKING:
    from area_search.arrays import TeamArrays
    from area_search.scenes import Scene


def check_threads(n_threads: int) -> int:
    """Return a number of threads.

    :param n_threads: at least 1
    :raises ValueError: if it is none
    """
    if isinstance(n_threads, bool) or not isinstance(n_threads, int) or n_threads < 1:
        raise ValueError(f"n_threads must be a whole number of at least 1, got {n_threads!r}")
    return n_threads


def even_slices(n: int, n_parts: int) -> list[slice]:
    """Divide a range into slices of nearly equal length, the longer ones first.

    :param n: length of the range, at least 1
    :param n_parts: how many at most; there is no empty one
    """
    parts = np.array_split(np.arange(n), min(n, n_parts))
    return [slice(int(part[0]), int(part[-1]) + 1) for part in parts]


class TeamSlice:
    """Some consecutive teams of a batch, as arguments of the kernels.

    :param arrays: the batch; its arrays must be overwritten, never replaced
    :param teams: which ones
    :param scene: what they play
    """

    def __init__(self, arrays: TeamArrays, teams: slice, scene: Scene) -> None:
        self.teams = teams
        border = arrays._border
        discs = layout.disc_offsets(scene.sensor_radius)
        edges, edge_counts = layout.edge_offsets(discs)

        def own(*names: str) -> tuple[np.ndarray, ...]:
            # Leading slices of contiguous arrays are contiguous: the kernels are compiled once.
            return tuple(getattr(arrays, name)[teams] for name in names)

        maps = own("cells", "_unseen", "_joint", "_state", "_goals", "position")
        self._reset_arguments: tuple[Any, ...] = (
            *own("keys", "episodes"),
            scene.n_free,
            scene.n_targets,
            float(scene.spawn_sigma),
            float(scene.spawn_sigma_growth),
            border,
            discs,
            *maps,
            *own("idle", "steps", "totals"),
            np.zeros(scene.n_cells, np.int64),  # free_cells
        )
        self._step_arguments: tuple[Any, ...] = (
            border,
            edges,
            edge_counts,
            scene.horizon,
            scene.early_stop_patience or 0,
            scene.n_free,
            scene.n_targets,
            float(scene.explore_normalizer),
            scene.reward_sharing == "same_role",
            float(scene.team_share),
            float(scene.alpha),
            float(scene.beta),
            *own("roles"),
            *maps,
            *own(
                "idle",
                "steps",
                "totals",
                "new_cells",
                "new_targets",
                "reward_components",
                "rewards",
                "metric_values",
                "terminated",
                "truncated",
            ),
            np.zeros(edges.shape[1:], np.int64),  # fresh
        )
        cells, position, goals = own("cells", "position", "_goals")
        self._observe_arguments: tuple[Any, ...] = (
            cells,
            position,
            border,
            layout.window_table(),
            layout.window_masks(scene.view_radius, scene.communication_radius),
            *own("_local_words", "_coordinates"),
        )
        self._known_arguments: tuple[Any, ...] = (
            (cells, border, *own("_known")) if arrays.known_map else ()
        )
        self._horizon = scene.horizon
        self._clock = own("_time", "steps") if arrays.time else ()
        self._sub_goal_kernel = {
            "none": None,
            "nearest": paths.nearest_sub_goals,
            "assigned": assignment.assigned_sub_goals,
            "routes": assignment.assigned_sub_goals,
            "role_routes": assignment.assigned_sub_goals,
        }[arrays.sub_goal]
        if self._sub_goal_kernel is not None:
            out = arrays.observations["sub_goal"][teams]
            self._sub_goal_arguments: tuple[Any, ...] = (
                cells,
                border,
                position,
                goals,
                *paths.search_scratch(arrays.sub_goal, arrays.n_agents, cells[0].size),
                out[:, :, paths.first_goal_row(arrays.sub_goal) :],
            )
        self._route_arguments: tuple[Any, ...] = ()
        if arrays.sub_goal in paths.ROUTE_SUB_GOALS:
            area, stride = cells[0].size, cells.shape[2]
            self._route_arguments = (
                cells,
                border,
                position,
                *own("steps"),
                look_ahead_data.make_timetable(scene, stride),
                look_ahead_data.make_marks(area),
                look_ahead_data.make_labels(area),
                look_ahead_data.make_plans(arrays.n_agents, area),
                paths.discount_table(),
                arrays.sub_goal == "role_routes",
                out,
            )

    def begin(self, which: np.ndarray) -> None:
        """Start the episodes of some teams.

        :param which: bool, of all teams of the batch
        """
        kernels.reset_teams(which[self.teams], *self._reset_arguments)

    def step(self, actions: np.ndarray) -> None:
        """Move all robots once.

        :param actions: int64, contiguous, of all teams of the batch
        """
        kernels.step_teams(actions[self.teams], *self._step_arguments)

    def observe(self, which: np.ndarray) -> None:
        """Write the observations of some teams.

        :param which: bool, of all teams of the batch
        """
        mine = which[self.teams]
        kernels.observe_teams(mine, *self._observe_arguments)
        if self._known_arguments:
            kernels.observe_known(mine, *self._known_arguments)
        if self._clock:
            # Of all teams: it changes with their steps alone.
            time, steps = self._clock
            time[:, 0] = (self._horizon - steps) / self._horizon
        if self._sub_goal_kernel is not None:
            self._sub_goal_kernel(mine, *self._sub_goal_arguments)
        if self._route_arguments:
            look_ahead.route_goals(mine, *self._route_arguments)


class SliceThreads:
    """Works on slices at once, the first share of them in the calling thread.

    :param shares: the slices of each thread, at least one thread
    """

    def __init__(self, shares: list[list[TeamSlice]]) -> None:
        self.shares = shares
        self._pool: ThreadPoolExecutor | None = None
        self._owner = 0

    def run(self, work: Callable[[TeamSlice], None]) -> None:
        """Work on all slices, and wait for the last."""

        def work_on(share: list[TeamSlice]) -> None:
            for one in share:
                work(one)

        first, *others = self.shares
        if not others:
            work_on(first)
            return
        # A forked process has none of its parent's threads.
        if self._pool is None or self._owner != os.getpid():
            self._pool, self._owner = ThreadPoolExecutor(len(others), "teams"), os.getpid()
        running = [self._pool.submit(work_on, other) for other in others]
        try:
            work_on(first)
        finally:
            wait(running)
        for one in running:
            one.result()
