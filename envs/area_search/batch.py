"""``BatchedAreaSearch``: the arrays of many teams, and every operation on them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from area_search import cells as layout
from area_search import kernels, paths
from area_search.arrays import TeamArrays
from area_search.cells import N_ACTIONS
from area_search.random_streams import seed_key
from area_search.render import Window, draw_frame
from area_search.rewards import MAX_ROLES, REWARD_COMPONENTS
from area_search.scenes import Scene, get_scenes, shown
from area_search.snapshot import Snapshot
from area_search.team_slices import TeamSlice, check_threads

MAX_EPISODE = 2**62


class BatchedAreaSearch(TeamArrays):
    """Many independent teams, simulated together; see the README for the rules of the task.

    All arrays are allocated once and overwritten by every step, the observations too: copy what
    must last. An episode is a function of (scene, seed, episode number) alone.

    :param scene: a :class:`Scene` or the name of one; or a list of such, a mix, of which each is
        played by an equal share of consecutive teams, see ``scenes.get_scenes``
    :param n_teams: number of teams
    :param sub_goal: ``"none"``, ``"nearest"``, ``"assigned"``, ``"routes"`` or ``"role_routes"``;
        which path features (``area_search.paths``) join the observation
    :param known_map: observe the team's map under the key ``known``, see :meth:`show_known_map`
    :param n_threads: threads that work on the teams of a step; it changes no result
    :param time: observe the share of the horizon that is left under the key ``time``, see
        :meth:`show_time`
    :param scene_options: fields of the scene, or of all scenes, to change
    :raises ValueError: if an option is unknown or out of range
    """

    reward_component_names = REWARD_COMPONENTS
    metric_names = kernels.METRICS

    def __init__(
        self,
        scene: Scene | str | Sequence[Scene | str] = "hard",
        n_teams: int = 1,
        sub_goal: str = "none",
        known_map: bool = False,
        n_threads: int = 1,
        time: bool = False,
        **scene_options: Any,
    ) -> None:
        if isinstance(n_teams, bool) or not isinstance(n_teams, int) or n_teams < 1:
            raise ValueError(f"n_teams must be a whole number of at least 1, got {n_teams!r}")
        scenes = get_scenes(scene, **scene_options)
        super().__init__(scenes, n_teams, sub_goal, known_map, check_threads(n_threads), time)
        self.possible_agents = [f"robot_{i}" for i in range(self.n_agents)]
        self.action_space = spaces.Discrete(N_ACTIONS)
        self._window: Window | None = None

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
        def begin(part: TeamSlice) -> None:
            part.begin(which)
            part.observe(which)

        self.roles[which] = 0
        self._threads.run(begin)
        self._started = True

    def step(self, actions: np.ndarray) -> None:
        """Move all robots once. Ended teams are not reset: see :meth:`reset_teams`.

        Read the outcome from ``observations``, ``rewards`` (n_teams, n_agents),
        ``reward_components`` (n_teams, n_agents, 2), ``terminated`` and ``truncated`` (n_teams,)
        and ``metrics``.

        :param actions: integer (n_teams, n_agents), indices into ``cells.ACTIONS``
        :raises ValueError: if the shape, type or a value is wrong
        """
        self._check_started()
        checked = self._checked_actions(actions)

        def step(part: TeamSlice) -> None:
            part.step(checked)
            part.observe(self._everyone)

        self._threads.run(step)

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

    @property
    def goal_nearness(self) -> dict[str, tuple[str, tuple[int, int]]]:
        """Where a robot observes how near its goals are: goal set -> key, and index in its array.

        The target comes first on a tie. Empty with ``sub_goal="none"``.
        """
        if self.sub_goal == "none":
            return {}
        # Behind the first moves, see ``area_search.paths``.
        order = ("target", "frontier")
        first = paths.first_goal_row(self.sub_goal)
        rows = {name: first + paths.GOAL_SETS.index(name) for name in order}
        return {name: ("sub_goal", (row, N_ACTIONS)) for name, row in rows.items()}

    def _metrics_so_far(self, team: int) -> dict[str, float]:
        """Metrics of the running episode; ``metrics`` are those of the last step."""
        values = np.zeros(len(kernels.METRICS))
        scene = self.scene_of(team)
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
        b, scene = self._border, self.scene_of(team)
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
