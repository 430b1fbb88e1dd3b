"""The memory of a batch of teams: its arrays, and copies of them to continue from."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from gymnasium import spaces

from area_search import cells as layout
from area_search import kernels, paths
from area_search.cells import N_ACTIONS
from area_search.rewards import MAX_ROLES, REWARD_COMPONENTS
from area_search.scenes import Scene, only_scene, unknown
from area_search.team_slices import SliceThreads, TeamSlice, check_threads, even_slices

# Everything that the future of a run depends on, and what the last step reported. All else is
# derived from it.
_STATE_ARRAYS = (
    "keys",
    "episodes",
    "episode_stride",
    "cells",
    "position",
    "roles",
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
)


def observation_space(
    scene: Scene, sub_goal: str = "none", known_map: bool = False, time: bool = False
) -> spaces.Dict:
    """Return one robot's observation space; no shape depends on the number of robots.

    :param scene: the task
    :param sub_goal: ``"none"``, ``"nearest"``, ``"assigned"``, ``"routes"`` or ``"role_routes"``
    :param known_map: with the key ``known``
    :param time: with the key ``time``
    :return: flat Dict of ``local`` uint8 (4, side, side), ``joint`` uint8 (2, height, width),
        ``position`` float32 (2,), ``state`` uint8 (5, height, width); unless ``sub_goal`` is
        ``"none"``, ``sub_goal`` float32 (2, 6), (2, 11) or (3, 11); with ``known_map``, ``known``
        uint8 (2, height, width); with ``time``, ``time`` float32 (1,), the share of the horizon
        that is left
    :raises ValueError: if ``sub_goal`` is unknown
    """
    if sub_goal not in paths.SUB_GOALS:
        raise ValueError(unknown("sub_goal", sub_goal, paths.SUB_GOALS))
    side = 2 * scene.view_radius + 1
    size = (scene.height, scene.width)
    last = np.array([scene.height - 1, scene.width - 1], np.float32)
    boxes: dict[str, spaces.Space] = {
        "local": spaces.Box(0, 1, (len(layout.LOCAL_CHANNELS), side, side), np.uint8),
        "joint": spaces.Box(0, 1, (len(layout.JOINT_CHANNELS), *size), np.uint8),
        "position": spaces.Box(np.zeros(2, np.float32), last, (2,), np.float32),
        "state": spaces.Box(0, 1, (len(layout.STATE_CHANNELS), *size), np.uint8),
    }
    if sub_goal != "none":
        high = np.full(paths.sub_goal_shape(sub_goal), np.inf, np.float32)
        high[:, : N_ACTIONS + 1] = 1.0
        boxes["sub_goal"] = spaces.Box(np.zeros_like(high), high, high.shape, np.float32)
    if known_map:
        boxes["known"] = spaces.Box(0, 1, (len(layout.KNOWN_CHANNELS), *size), np.uint8)
    if time:
        boxes["time"] = spaces.Box(0.0, 1.0, (1,), np.float32)
    return spaces.Dict(boxes)


class TeamArrays:
    """All arrays of a batch, allocated once, and the kernels' arguments made of them.

    :param scenes: the task; of several, each is played by an equal share of consecutive teams
    :param n_teams: number of teams
    :param sub_goal: ``"none"``, ``"nearest"``, ``"assigned"``, ``"routes"`` or ``"role_routes"``
    :param known_map: observe the key ``known``, too
    :param n_threads: see :attr:`n_threads`
    :param time: observe the key ``time``, too
    """

    team_observation_keys: tuple[str, ...] = ("joint", "state")

    def __init__(
        self,
        scenes: tuple[Scene, ...],
        n_teams: int,
        sub_goal: str,
        known_map: bool = False,
        n_threads: int = 1,
        time: bool = False,
    ) -> None:
        self.scenes = scenes
        self._common = scenes[0]  # for what all scenes agree in
        self._state_names = (*_STATE_ARRAYS, *(("scene_index",) if len(scenes) > 1 else ()))
        self.n_teams = n_teams
        self.n_agents = self._common.n_agents
        self.sub_goal = sub_goal
        self.known_map = self.time = False
        self.observation_space = observation_space(self._common, sub_goal)
        self._started = False
        self._n_threads = n_threads
        self._allocate()
        if known_map:
            self.show_known_map()
        if time:
            self.show_time()

    def _allocate(self) -> None:
        scene, m, n = self._common, self.n_teams, self.n_agents
        self._border = layout.border_width(scene.view_radius, scene.sensor_radius)
        height, width = scene.height, scene.width
        padded = (height + 2 * self._border, width + 2 * self._border)

        self.scene_index = np.arange(m) * len(self.scenes) // m
        self.keys = np.zeros((m, 2), np.uint64)
        self.episodes = np.zeros(m, np.int64)
        self.episode_stride = np.ones(m, np.int64)
        self.cells = np.zeros((m, *padded), np.uint8)
        self.position = np.zeros((m, n, 2), np.int32)
        self.roles = np.zeros((m, n), np.int8)
        self.idle = np.zeros((m, n), np.int32)
        self.steps = np.zeros(m, np.int32)
        self.totals = np.zeros((m, kernels.N_TOTALS), np.int64)
        self.new_cells = np.zeros((m, n), np.int32)
        self.new_targets = np.zeros((m, n), np.int32)
        self.reward_components = np.zeros((m, n, len(REWARD_COMPONENTS)), np.float32)
        self.rewards = np.zeros((m, n), np.float32)
        self.metric_values = np.zeros((m, len(kernels.METRICS)), np.float64)
        self.terminated = np.zeros(m, np.bool_)
        self.truncated = np.zeros(m, np.bool_)

        self._unseen = np.zeros_like(self.cells)
        self._goals = np.zeros((m, len(paths.GOAL_SETS)), np.int64)
        self._everyone = np.ones(m, np.bool_)

        # Channels last, so that the views below are what a convolution on CPU wants.
        side = 2 * scene.view_radius + 1
        local = np.zeros((m, n, side, side, len(layout.LOCAL_CHANNELS)), np.uint8)
        self._local_words = local.view(np.uint32)[..., 0]
        self._joint = np.zeros((m, height, width, len(layout.JOINT_CHANNELS)), np.uint8)
        self._state = np.zeros((m, height, width, len(layout.STATE_CHANNELS)), np.uint8)
        self._coordinates = np.zeros((m, n, 2), np.float32)
        self.observations: dict[str, np.ndarray] = {
            "local": np.moveaxis(local, -1, -3),
            "joint": np.moveaxis(self._joint, -1, -3),
            "position": self._coordinates,
            "state": np.moveaxis(self._state, -1, -3),
        }
        if self.sub_goal != "none":
            shape = self.observation_space["sub_goal"].shape or ()
            self.observations["sub_goal"] = np.zeros((m, n, *shape), np.float32)
        self.first_team = {key: value[0] for key, value in self.observations.items()}
        self.metrics = {name: self.metric_values[:, k] for k, name in enumerate(kernels.METRICS)}
        self._bind_kernels()

    def _bind_kernels(self) -> None:
        """Gather each kernel's arguments once: they are the same arrays at every step."""
        # Without searches a step is over before another thread has begun.
        n_threads = 1 if self.sub_goal == "none" else self._n_threads
        parts = even_slices(self.n_teams, n_threads)
        self._threads = SliceThreads([self._slices(part) for part in parts])

    def _slices(self, teams: slice) -> list[TeamSlice]:
        """Divide consecutive teams into runs of teams that play the same scene."""
        changes = np.flatnonzero(np.diff(self.scene_index[teams])) + teams.start + 1
        bounds = [teams.start, *changes.tolist(), teams.stop]
        return [
            TeamSlice(self, slice(start, stop), self.scene_of(start))
            for start, stop in pairwise(bounds)
        ]

    @property
    def scene(self) -> Scene:
        """The task that all teams play.

        :raises ValueError: if they play several, see :meth:`scene_of`
        """
        return only_scene(self.scenes)

    def scene_of(self, team: int) -> Scene:
        """Return the scene that a team plays.

        :param team: index of the team
        """
        return self.scenes[self.scene_index[team]]

    @property
    def n_threads(self) -> int:
        """Threads that work on the teams of a step; what they compute does not depend on it.

        With ``sub_goal="none"`` one does, whatever is set.
        """
        return self._n_threads

    @n_threads.setter
    def n_threads(self, n_threads: int) -> None:
        if n_threads != self._n_threads:
            self._n_threads = check_threads(n_threads)
            self._bind_kernels()

    def show_known_map(self) -> None:
        """Observe the key ``known`` from now on, if it is not observed yet.

        It is the team's map: uint8 (n_teams, 2, height, width), the known free cells and the known
        obstacles, see ``cells.KNOWN_CHANNELS``. Nothing else changes.
        """
        if self.known_map:
            return
        self.known_map = True
        size = (self._common.height, self._common.width, len(layout.KNOWN_CHANNELS))
        self._known = np.zeros((self.n_teams, *size), np.uint8)
        self._show("known", np.moveaxis(self._known, -1, -3))

    def show_time(self) -> None:
        """Observe the key ``time`` from now on, if it is not observed yet.

        It is the share of the horizon that is left: float32 (n_teams, 1), 1 after a reset and 0
        after the last step. Nothing else changes.
        """
        if self.time:
            return
        self.time = True
        self._time = np.zeros((self.n_teams, 1), np.float32)
        self._show("time", self._time)

    def _show(self, key: str, array: np.ndarray) -> None:
        """Add an observation that a team shares, (n_teams, ...)."""
        options = self.known_map, self.time
        self.observation_space = observation_space(self._common, self.sub_goal, *options)
        self.team_observation_keys = (*self.team_observation_keys, key)
        self.observations[key] = array
        self.first_team[key] = array[0]
        self._bind_kernels()
        if self._started:
            self._observe(self._everyone)

    def _observe(self, which: np.ndarray) -> None:
        self._threads.run(lambda part: part.observe(which))

    def get_state(self) -> dict[str, np.ndarray]:
        """Copy the whole simulation.

        :return: plain arrays by name; :meth:`set_state` continues from them bit for bit
        """
        return {name: getattr(self, name).copy() for name in self._state_names}

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from a copy of the simulation, made by a batch of the same scenes and size.

        Which team plays which scene of a mix is part of it.

        :param state: what :meth:`get_state` returned
        :raises ValueError: if an array is missing or unknown, or has another shape or type;
            nothing is changed then
        """
        if set(state) != set(self._state_names):
            wrong = sorted(set(state) ^ set(self._state_names))
            raise ValueError(f"state does not fit: missing or unknown arrays {', '.join(wrong)}")
        for name in self._state_names:
            have, want = np.asarray(state[name]), getattr(self, name)
            if have.shape != want.shape or have.dtype != want.dtype:
                raise ValueError(
                    f"state does not fit: {name} must be {want.dtype} of shape {want.shape}, "
                    f"got {have.dtype} of shape {have.shape}"
                )
        position, roles = np.asarray(state["position"]), np.asarray(state["roles"])
        if np.any(position < 0) or np.any(position >= self._joint.shape[1:3]):
            raise ValueError("state does not fit: a position is not on the map")
        self._check_cells(np.asarray(state["cells"]), position)
        if np.any(roles < 0) or np.any(roles >= MAX_ROLES):
            raise ValueError(f"state does not fit: roles must be in 0..{MAX_ROLES - 1}")
        index = np.asarray(state.get("scene_index", self.scene_index))
        if np.any(index < 0) or np.any(index >= len(self.scenes)):
            raise ValueError(f"state does not fit: scene_index must be below {len(self.scenes)}")
        moved = np.any(index != self.scene_index)
        for name in self._state_names:
            getattr(self, name)[:] = state[name]
        if moved:
            self._bind_kernels()
        self._started = True
        for m in range(self.n_teams):
            kernels.rebuild(
                self.cells[m],
                self._unseen[m],
                self._joint[m],
                self._state[m],
                self._goals[m],
                self._border,
            )
        self._observe(self._everyone)

    def _check_cells(self, cells: np.ndarray, position: np.ndarray) -> None:
        # Moves and searches rely on the border instead of checking bounds.
        inside = np.zeros(cells.shape[1:], np.bool_)
        inside[self._border : -self._border, self._border : -self._border] = True
        if np.any(cells[:, ~inside] != layout.BORDER):
            raise ValueError("state does not fit: the maps have another size or border")
        row, column = position[..., 0] + self._border, position[..., 1] + self._border
        under = cells[np.arange(self.n_teams)[:, None], row, column]
        if np.any(under & layout.OBSTACLE):
            raise ValueError("state does not fit: a robot is on an obstacle")

    # Pickling (SuperSuit copies environments that way) would tear the views of one memory apart.
    def __getstate__(self) -> dict[str, Any]:
        options = {
            "scene": self.scenes,
            "n_teams": self.n_teams,
            "sub_goal": self.sub_goal,
            "known_map": self.known_map,
            "n_threads": self.n_threads,
            "time": self.time,
        }
        return {"options": options, "arrays": self.get_state() if self._started else None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state["options"])  # type: ignore[misc]
        if state["arrays"] is not None:
            self.set_state(state["arrays"])
