"""``AreaSearchEnv``: the area-search task as a PettingZoo environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from area_search import kernels
from area_search.batch import BatchedAreaSearch
from area_search.render import Window, draw_frame
from area_search.rewards import REWARD_COMPONENTS
from area_search.scenes import Scene, mix_of, shown, unknown

ObsDict = dict[str, dict[str, np.ndarray]]
InfoDict = dict[str, dict[str, Any]]


class AreaSearchEnv(ParallelEnv[str, dict[str, np.ndarray], int]):
    """A team of robots searches an unknown map: explore cells, cover targets.

    A face of :class:`~area_search.batch.BatchedAreaSearch` with one team.

    * **Actions**: ``Discrete(5)``: stop, up, right, down, left; a blocked move does nothing.
    * **Observations**: a flat Dict per robot, uint8 maps of 0 and 1:
      ``local`` (4, 9, 9) obstacles (also off the map), frontier, known uncovered targets, robots
      around the robot, from the team's map; ``joint`` (2, height, width) the team's frontier and
      known uncovered targets; ``position`` float32 (2,) row and column; ``state``
      (5, height, width) true obstacles, frontier, true uncovered targets, robots, explored, for
      critics only; ``sub_goal`` float32, see ``area_search.paths``; with ``known_map``, ``known``
      (2, height, width) the team's known free cells and known obstacles; with ``time``, ``time``
      float32 (1,), the share of the horizon that is left.
    * **Rewards**: ``alpha * R_e + beta * R_c`` (Eq. 2); the components are in
      ``infos[robot]["reward_components"]``.
    * **Infos**: ``reward_components``; ``metrics`` of the step: ``explo_paper``, ``explo_true``,
      ``cover``; and at the end of an episode ``episode_metrics``, see
      :meth:`~area_search.batch.BatchedAreaSearch.episode_metrics`. A reset writes none of them.
    * **End**: all robots are truncated together at ``scene.horizon``; with
      ``early_stop_patience`` all are terminated once one of them has found nothing for long.

    :param scene: a :class:`Scene` or the name of one; a list of such, a mix, can be played by
        several teams alone, see :meth:`batched`
    :param sub_goal: ``"none"``, ``"nearest"``, ``"assigned"``, ``"routes"`` or ``"role_routes"``
    :param known_map: observe the team's map, too
    :param time: observe the share of the horizon that is left, too
    :param render_mode: ``None``, ``"rgb_array"`` or ``"human"`` (a pygame window)
    :param scene_options: fields of the scene to change, such as ``n_agents=8``
    :raises ValueError: if an option is unknown or out of range
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "area-search-v0",
        "render_modes": ["rgb_array", "human"],
        "render_fps": 5,
        "is_parallelizable": True,
    }
    team_observation_keys = BatchedAreaSearch.team_observation_keys
    reward_component_names = REWARD_COMPONENTS
    metric_names = kernels.METRICS

    def __init__(
        self,
        scene: Scene | str | Sequence[Scene | str] = "hard",
        sub_goal: str = "none",
        render_mode: str | None = None,
        known_map: bool = False,
        time: bool = False,
        **scene_options: Any,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            allowed = self.metadata["render_modes"]
            raise ValueError(unknown("render_mode", render_mode, allowed))
        self.sub_goal = sub_goal
        self.render_mode = render_mode
        self._batch = BatchedAreaSearch(scene, 1, sub_goal, known_map, time=time, **scene_options)
        self.scenes = self._batch.scenes
        self.team_observation_keys = self._batch.team_observation_keys
        self.possible_agents = list(self._batch.possible_agents)
        self.agents: list[str] = []
        self._space = self._batch.observation_space
        self._action_space = self._batch.action_space
        self._seeded = False
        self._roles: np.ndarray | None = None
        self._role_names: tuple[str, ...] = ("explore", "cover")
        self._path: list[np.ndarray] = []
        self._window: Window | None = None

    def observation_space(self, agent: str) -> spaces.Dict:
        """Return the observation space, the same object for every robot."""
        return self._space

    def action_space(self, agent: str) -> spaces.Discrete:
        """Return the action space, the same object for every robot."""
        return self._action_space

    @property
    def scene(self) -> Scene:
        """The task; an error if it is a mix of scenes."""
        return self._batch.scene

    @property
    def state_space(self) -> spaces.Space:
        """The space of :meth:`state`."""
        return self._space["state"]

    @property
    def goal_nearness(self) -> dict[str, tuple[str, tuple[int, int]]]:
        """Where a robot observes how near its goals are, see ``BatchedAreaSearch``."""
        return self._batch.goal_nearness

    def batched(self, n_teams: int) -> BatchedAreaSearch:
        """Return the same task for many teams at once, see ``make_team_vec_env``.

        :param n_teams: number of teams
        """
        shown = {"known_map": self._batch.known_map, "time": self._batch.time}
        return BatchedAreaSearch(self.scenes, n_teams, self.sub_goal, **shown)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObsDict, InfoDict]:
        """Start an episode.

        :param seed: start the stream of this seed with its episode 0; by default the next episode
            of the current stream, or a random stream at the first reset
        :param options: ``{"episode": k}`` starts episode k of the seed's stream instead
        :return: observations and empty infos per robot
        :raises ValueError: if the seed or an option is unknown or out of range, or the scene is a
            mix
        """
        if len(self.scenes) > 1:
            raise ValueError(
                f"one team can not play {mix_of(self.scenes)}: take the native backend, which "
                "plays many teams together, or one scene"
            )
        options = dict(options or {})
        episode = options.pop("episode", None)
        options.pop("options", None)  # what PettingZoo's own API test passes
        if options:
            raise ValueError(unknown("reset option", next(iter(options)), ["episode"]))
        if seed is None and not self._seeded:
            seed = int(np.random.SeedSequence().generate_state(1, np.uint64)[0])
        if seed is not None:
            # A list: the team has the stream for itself, and plays episodes k, k + 1, ...
            self._batch.reset([seed], 0 if episode is None else episode)
            self._seeded = True
        elif episode is not None:
            raise ValueError("reset option 'episode' needs a seed")
        else:
            self._batch.reset_teams(np.ones(1, np.bool_))
        self.agents = list(self.possible_agents)
        self._roles = None
        self._path = [self._batch.position[0].copy()]
        if self.render_mode == "human":
            self.render()
        return self._observations(), {agent: {} for agent in self.agents}

    def step(
        self, actions: Mapping[str, int]
    ) -> tuple[ObsDict, dict[str, float], dict[str, bool], dict[str, bool], InfoDict]:
        """Move every robot once.

        :param actions: for each robot an index into ``cells.ACTIONS``
        :return: observations, rewards, terminations, truncations, infos per robot
        :raises ValueError: if the episode has ended, a robot is missing or an action is not valid
        """
        if not self.agents:
            raise ValueError("the episode has ended: call reset() before step()")
        batch, agents = self._batch, self.agents
        moves = self._moves(actions)
        batch.step(moves)
        if self.render_mode is not None:
            self._path.append(batch.position[0].copy())
        terminated, truncated = bool(batch.terminated[0]), bool(batch.truncated[0])
        observations = self._observations()
        rewards = dict(zip(agents, batch.rewards[0].tolist(), strict=True))
        values = dict(zip(kernels.METRICS, batch.metric_values[0].tolist(), strict=True))
        explore, cover = REWARD_COMPONENTS
        infos: InfoDict = {
            agent: {"reward_components": {explore: r_e, cover: r_c}, "metrics": values.copy()}
            for agent, (r_e, r_c) in zip(agents, batch.reward_components[0].tolist(), strict=True)
        }
        terminations = dict.fromkeys(agents, terminated)
        truncations = dict.fromkeys(agents, truncated)
        if terminated or truncated:
            final = batch.episode_metrics(0)
            for info in infos.values():
                info["episode_metrics"] = final.copy()
            self.agents = []
        if self.render_mode == "human":
            self.render()
        return observations, rewards, terminations, truncations, infos

    def _moves(self, actions: Mapping[str, int]) -> np.ndarray:
        """Return one row of actions in the robots' order, or say whose is missing or wrong."""
        try:
            moves = np.array([[actions[agent] for agent in self.agents]])
        except (KeyError, ValueError):
            moves = np.empty(0)
        if moves.shape == (1, len(actions)) and moves.dtype.kind in "iu":
            return moves
        for agent in actions:
            if agent not in self.possible_agents:
                raise ValueError(unknown("robot in actions", agent, self.possible_agents))
        for agent in self.agents:
            if agent not in actions:
                raise ValueError(f"actions must hold one for each robot, none for {agent!r}")
            if np.ndim(actions[agent]) or np.asarray(actions[agent]).dtype.kind not in "iu":
                raise ValueError(
                    f"the action of {agent!r} must be a whole number, got {shown(actions[agent])}"
                )
        return moves

    def _observations(self) -> ObsDict:
        # One copy of each array for the whole team: observations stay valid for ever, and the
        # team's maps are shared by its robots. Order "K" keeps the channels last in memory.
        arrays = {key: value.copy("K") for key, value in self._batch.first_team.items()}
        own = [
            (key, array) for key, array in arrays.items() if key not in self.team_observation_keys
        ]
        team = {}
        for i, agent in enumerate(self.possible_agents):
            observation = arrays.copy()
            for key, array in own:
                observation[key] = array[i]
            team[agent] = observation
        return team

    def state(self) -> np.ndarray:
        """Return the global state: true obstacles, frontier, true targets, robots, explored.

        :return: uint8 (5, height, width)
        """
        return self._batch.state(0)

    def set_roles(
        self,
        roles: Sequence[int] | np.ndarray,
        role_names: Sequence[str] = ("explore", "cover"),
    ) -> None:
        """Tell which role each robot acts in: for shared rewards and for the colors of frames.

        :param roles: one index into ``role_names`` per robot
        :param role_names: what the roles are called in frames
        :raises ValueError: if the shape, type or a value is wrong
        """
        values = np.asarray(roles)
        if values.dtype.kind in "iu" and values.size and values.max() >= len(role_names):
            raise ValueError(f"roles must be in 0..{len(role_names) - 1}, got {values.tolist()}")
        self._batch.set_roles(values[None])
        self._roles, self._role_names = values.copy(), tuple(role_names)

    def get_state(self) -> dict[str, np.ndarray]:
        """Copy the whole simulation, see ``BatchedAreaSearch.get_state``."""
        return self._batch.get_state()

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from a copy of the simulation, see ``BatchedAreaSearch.set_state``."""
        self._batch.set_state(state)
        self._seeded = True
        ended = bool(self._batch.terminated[0] or self._batch.truncated[0])
        fresh = self._batch.steps[0] == 0
        self.agents = [] if ended and not fresh else list(self.possible_agents)
        self._roles = None
        self._path = [self._batch.position[0].copy()]

    def render(self) -> np.ndarray | None:
        """Draw the team: a frame for ``"rgb_array"``, the window for ``"human"``.

        :return: uint8 (height, width, 3), or None
        """
        if self.render_mode is None:
            return None
        earlier = np.array(self._path[:-1], np.int32).reshape(-1, len(self.possible_agents), 2)
        frame = draw_frame(
            self._batch.snapshot(0, roles=self._roles, role_names=self._role_names, path=earlier)
        )
        if self.render_mode == "rgb_array":
            return frame
        if self._window is None:
            self._window = Window()
        self._window.show(frame, self.metadata["render_fps"])
        return None

    def __getstate__(self) -> dict[str, Any]:
        # A window can not be copied; a copy opens its own.
        return {**self.__dict__, "_window": None}

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None
