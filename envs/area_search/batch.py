"""``BatchedAreaSearch``: the arrays of many teams, and every operation on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from area_search import cells as layout
from area_search import kernels, paths
from area_search.cells import N_ACTIONS
from area_search.random_streams import seed_key
from area_search.render import Snapshot, Window, draw_frame
from area_search.rewards import MAX_ROLES, REWARD_COMPONENTS
from area_search.scenes import Scene, get_scene, shown, unknown

MAX_EPISODE = 2**62

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


def observation_space(scene: Scene, sub_goal: str = "none") -> spaces.Dict:
    """Return one robot's observation space; no shape depends on the number of robots.

    :param scene: the task
    :param sub_goal: ``"none"``, ``"nearest"`` or ``"assigned"``
    :return: flat Dict of ``local`` uint8 (4, side, side), ``joint`` uint8 (2, height, width),
        ``position`` float32 (2,), ``state`` uint8 (5, height, width) and, unless ``sub_goal`` is
        ``"none"``, ``sub_goal`` float32 (2, 6) or (2, 11)
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
        high = np.full((len(paths.GOAL_SETS), paths.sub_goal_width(sub_goal)), np.inf, np.float32)
        high[:, : N_ACTIONS + 1] = 1.0
        boxes["sub_goal"] = spaces.Box(np.zeros_like(high), high, high.shape, np.float32)
    return spaces.Dict(boxes)


class BatchedAreaSearch:
    """Many independent teams, simulated together; see the README for the rules of the task.

    All arrays are allocated once and overwritten by every step, the observations too: copy what
    must last. An episode is a function of (scene, seed, episode number) alone.

    :param scene: a :class:`Scene` or the name of one
    :param n_teams: number of teams
    :param sub_goal: ``"none"``, ``"nearest"`` or ``"assigned"``; which path features
        (``area_search.paths``) join the observation
    :param scene_options: fields of the scene to change
    :raises ValueError: if an option is unknown or out of range
    """

    team_observation_keys = ("joint", "state")
    reward_component_names = REWARD_COMPONENTS
    metric_names = kernels.METRICS

    def __init__(
        self,
        scene: Scene | str = "hard",
        n_teams: int = 1,
        sub_goal: str = "none",
        **scene_options: Any,
    ) -> None:
        self.scene = get_scene(scene, **scene_options)
        if isinstance(n_teams, bool) or not isinstance(n_teams, int) or n_teams < 1:
            raise ValueError(f"n_teams must be a whole number of at least 1, got {n_teams!r}")
        self.n_teams = n_teams
        self.n_agents = self.scene.n_agents
        self.sub_goal = sub_goal
        self.possible_agents = [f"robot_{i}" for i in range(self.n_agents)]
        self.observation_space = observation_space(self.scene, sub_goal)
        self.action_space = spaces.Discrete(N_ACTIONS)
        self._window: Window | None = None
        self._started = False
        self._allocate()

    def _allocate(self) -> None:
        scene, m, n = self.scene, self.n_teams, self.n_agents
        self._border = layout.border_width(scene.view_radius, scene.sensor_radius)
        height, width = scene.height, scene.width
        padded = (height + 2 * self._border, width + 2 * self._border)

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
        scene = self.scene
        maps = (self.cells, self._unseen, self._joint, self._state, self._goals, self.position)
        self._reset_arguments: tuple[Any, ...] = (
            self.keys,
            self.episodes,
            scene.n_free,
            scene.n_targets,
            float(scene.spawn_sigma),
            float(scene.spawn_sigma_growth),
            self._border,
            layout.disc_offsets(scene.sensor_radius),
            *maps,
            self.idle,
            self.steps,
            self.totals,
            np.zeros(scene.n_cells, np.int64),  # free_cells
        )
        edges, edge_counts = layout.edge_offsets(layout.disc_offsets(scene.sensor_radius))
        self._step_arguments: tuple[Any, ...] = (
            self._border,
            edges,
            edge_counts,
            scene.horizon,
            scene.early_stop_patience or 0,
            scene.n_free,
            scene.n_targets,
            float(scene.explore_normalizer),
            scene.reward_sharing == "same_role",
            float(scene.alpha),
            float(scene.beta),
            self.roles,
            *maps,
            self.idle,
            self.steps,
            self.totals,
            self.new_cells,
            self.new_targets,
            self.reward_components,
            self.rewards,
            self.metric_values,
            self.terminated,
            self.truncated,
            np.zeros(edges.shape[1:], np.int64),  # fresh
        )
        self._observe_arguments: tuple[Any, ...] = (
            self.cells,
            self.position,
            self._border,
            layout.window_table(),
            layout.window_masks(scene.view_radius, scene.communication_radius),
            self._local_words,
            self._coordinates,
        )
        if self.sub_goal != "none":
            scratch = paths.search_scratch(self.sub_goal, self.n_agents, self.cells[0].size)
            self._sub_goal_arguments: tuple[Any, ...] = (
                self.cells,
                self._border,
                self.position,
                self._goals,
                *scratch,
                self.observations["sub_goal"],
            )

    def reset(
        self,
        seed: int | Sequence[int] | np.ndarray,
        episode: int | Sequence[int] | np.ndarray | None = None,
    ) -> None:
        """Start an episode in every team.

        :param seed: one seed for all teams, which then share its numbered episodes in turn: team
            ``m`` plays episodes m, m + n_teams, m + 2 n_teams, ...; or a seed per team, each with
            its own episodes 0, 1, 2, ...
        :param episode: number of the first episode to deal out or, with a seed per team, of every
            team; or one for each team
        :raises ValueError: if a seed or an episode is negative, or their number is not ``n_teams``
        """
        shared = np.ndim(seed) == 0
        seeds: list[Any] = [seed] if shared else list(seed)  # type: ignore[arg-type]
        if not shared and len(seeds) != self.n_teams:
            raise ValueError(
                f"seed must be one number or one for each of the {self.n_teams} teams, "
                f"got {len(seeds)}"
            )
        keys = [seed_key(one) for one in seeds]
        given = np.asarray(0 if episode is None else episode)
        if given.shape not in ((), (self.n_teams,)) or given.dtype.kind not in "iu":
            raise ValueError(
                f"episode must be one whole number or one for each of the {self.n_teams} "
                f"teams, got {shown(episode)}"
            )
        if given.min() < 0 or given.max() > MAX_EPISODE:
            raise ValueError(f"episode must be from 0 to {MAX_EPISODE}, got {shown(episode)}")
        dealt = shared and given.ndim == 0
        self.keys[:] = keys
        self.episodes[:] = given + np.arange(self.n_teams) if dealt else given
        self.episode_stride[:] = self.n_teams if shared else 1
        for array in (self.new_cells, self.new_targets, self.reward_components, self.rewards):
            array[:] = 0
        self.metric_values[:] = 0
        self.terminated[:] = False
        self.truncated[:] = False
        self._begin(self._everyone)

    def reset_teams(self, which: np.ndarray) -> None:
        """Start the next episode of some teams; what the last step reported stays readable.

        :param which: bool (n_teams,)
        """
        self._check_started()
        which = np.asarray(which)
        if which.shape != (self.n_teams,) or which.dtype != np.bool_:
            raise ValueError(
                f"which must be bool of shape ({self.n_teams},), "
                f"got {which.dtype} of shape {which.shape}"
            )
        self.episodes[which] += self.episode_stride[which]
        self._begin(which)

    def _begin(self, which: np.ndarray) -> None:
        kernels.reset_teams(which, *self._reset_arguments)
        self.roles[which] = 0
        self._started = True
        self._observe(which)

    def step(self, actions: np.ndarray) -> None:
        """Move all robots once. Ended teams are not reset: see :meth:`reset_teams`.

        Read the outcome from ``observations``, ``rewards`` (n_teams, n_agents),
        ``reward_components`` (n_teams, n_agents, 2), ``terminated`` and ``truncated`` (n_teams,)
        and ``metrics``.

        :param actions: integer (n_teams, n_agents), indices into ``cells.ACTIONS``
        :raises ValueError: if the shape, type or a value is wrong
        """
        self._check_started()
        kernels.step_teams(self._checked_actions(actions), *self._step_arguments)
        self._observe(self._everyone)

    def _check_started(self) -> None:
        if not self._started:
            raise ValueError("call reset() first: there is no episode yet")

    def _checked_actions(self, actions: np.ndarray) -> np.ndarray:
        actions = np.asarray(actions)
        if actions.shape != (self.n_teams, self.n_agents):
            raise ValueError(
                f"actions must have shape ({self.n_teams}, {self.n_agents}) "
                f"(teams, robots), got {actions.shape}"
            )
        if actions.dtype.kind not in "iu":
            raise ValueError(f"actions must be whole numbers, got {actions.dtype}")
        # One type and layout, so that the kernels are compiled once.
        actions = np.ascontiguousarray(actions, np.int64)
        wrong = kernels.first_invalid(actions, N_ACTIONS)
        if wrong >= 0:
            value = actions.flat[wrong]
            raise ValueError(f"actions must be in 0..{N_ACTIONS - 1}, got {value}")
        return actions

    def _observe(self, which: np.ndarray) -> None:
        kernels.observe_teams(which, *self._observe_arguments)
        if self.sub_goal == "nearest":
            paths.nearest_sub_goals(which, *self._sub_goal_arguments)
        elif self.sub_goal == "assigned":
            paths.assigned_sub_goals(which, *self._sub_goal_arguments)

    def set_roles(self, roles: np.ndarray) -> None:
        """Tell which role each robot acts in: for ``reward_sharing="same_role"`` and for frames.

        :param roles: integer (n_teams, n_agents), at least 0 and below ``rewards.MAX_ROLES``
        :raises ValueError: if the shape, type or a value is wrong
        """
        roles = np.asarray(roles)
        if roles.shape != self.roles.shape or roles.dtype.kind not in "iu":
            raise ValueError(
                f"roles must be whole numbers of shape {self.roles.shape}, "
                f"got {roles.dtype} of shape {roles.shape}"
            )
        if roles.min() < 0 or roles.max() >= MAX_ROLES:
            raise ValueError(f"roles must be in 0..{MAX_ROLES - 1}, got {roles.tolist()}")
        self.roles[:] = roles

    def get_state(self) -> dict[str, np.ndarray]:
        """Copy the whole simulation.

        :return: plain arrays by name; :meth:`set_state` continues from them bit for bit
        """
        return {name: getattr(self, name).copy() for name in _STATE_ARRAYS}

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from a copy of the simulation, made by a batch of the same scene and size.

        :param state: what :meth:`get_state` returned
        :raises ValueError: if an array is missing or unknown, or has another shape or type;
            nothing is changed then
        """
        if set(state) != set(_STATE_ARRAYS):
            wrong = sorted(set(state) ^ set(_STATE_ARRAYS))
            raise ValueError(f"state does not fit: missing or unknown arrays {', '.join(wrong)}")
        for name in _STATE_ARRAYS:
            have, want = np.asarray(state[name]), getattr(self, name)
            if have.shape != want.shape or have.dtype != want.dtype:
                raise ValueError(
                    f"state does not fit: {name} must be {want.dtype} of shape {want.shape}, "
                    f"got {have.dtype} of shape {have.shape}"
                )
        position, roles = np.asarray(state["position"]), np.asarray(state["roles"])
        if np.any(position < 0) or np.any(position >= (self.scene.height, self.scene.width)):
            raise ValueError("state does not fit: a position is not on the map")
        self._check_cells(np.asarray(state["cells"]), position)
        if np.any(roles < 0) or np.any(roles >= MAX_ROLES):
            raise ValueError(f"state does not fit: roles must be in 0..{MAX_ROLES - 1}")
        for name in _STATE_ARRAYS:
            getattr(self, name)[:] = state[name]
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
        options = {"scene": self.scene, "n_teams": self.n_teams, "sub_goal": self.sub_goal}
        return {"options": options, "arrays": self.get_state() if self._started else None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state["options"])  # type: ignore[misc]
        if state["arrays"] is not None:
            self.set_state(state["arrays"])

    def _metrics_so_far(self, team: int) -> dict[str, float]:
        """Metrics of the running episode; ``metrics`` are those of the last step."""
        values = np.zeros(len(kernels.METRICS))
        scene = self.scene
        kernels.measure(self.totals[team], scene.n_free, scene.n_targets, values)
        return dict(zip(kernels.METRICS, values.tolist(), strict=True))

    def episode_metrics(self, team: int) -> dict[str, float]:
        """Metrics of one team's episode so far; after its last step, those of the episode.

        :param team: index of the team
        :return: ``explo_paper`` (newly seen cells, obstacles included, start discs excluded,
            over free cells), ``explo_true`` (explored share of the free cells), ``cover`` (share of
            the targets covered), ``t90_paper`` and ``t90_true`` (0-based first step with
            explo_paper > 0.9 and explo_true >= 0.9; -1: never), ``length`` in steps
        """
        values = self._metrics_so_far(team)
        values["t90_paper"] = int(self.totals[team, kernels.T90_PAPER])
        values["t90_true"] = int(self.totals[team, kernels.T90_TRUE])
        values["length"] = int(self.steps[team])
        return values

    def state(self, team: int) -> np.ndarray:
        """Return one team's global state.

        :return: uint8 (5, height, width), see ``cells.STATE_CHANNELS``; a copy
        """
        return self.observations["state"][team].copy()

    def snapshot(self, team: int, **extra: Any) -> Snapshot:
        """Describe one team for a frame.

        :param team: index of the team
        :param extra: fields of :class:`~area_search.render.Snapshot` to add or replace
        :return: the snapshot, made of copies
        """
        b, scene = self._border, self.scene
        board = self.cells[team, b:-b, b:-b]
        values: dict[str, Any] = {
            "obstacle": (board & layout.OBSTACLE) > 0,
            "explored": (board & layout.EXPLORED) > 0,
            "frontier": (board & layout.FRONTIER) > 0,
            "target_open": (board & layout.TARGET) > 0,
            "target_covered": (board & layout.COVERED) > 0,
            "position": self.position[team].copy(),
            "title": f"{scene.name}, {scene.n_agents} robots",
            "step": int(self.steps[team]),
            "horizon": scene.horizon,
            "metrics": self._metrics_so_far(team),
            "sensor_radius": float(scene.sensor_radius),
            "view_radius": scene.view_radius,
            "communication_radius": float(scene.communication_radius),
        }
        values.update(extra)
        return Snapshot(**values)

    def render(self, team: int = 0, mode: str = "rgb_array") -> np.ndarray | None:
        """Draw one team.

        :param team: index of the team
        :param mode: ``"rgb_array"``, or ``"human"`` for a window
        :return: uint8 (height, width, 3), or None for a window
        """
        frame = draw_frame(self.snapshot(team))
        if mode == "rgb_array":
            return frame
        if self._window is None:
            self._window = Window()
        self._window.show(frame, 0.0)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None
