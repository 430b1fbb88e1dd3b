"""Play numbered episodes with a controller and record what the metrics need."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from area_search import kernels
from area_search.batch import BatchedAreaSearch
from area_search.scenes import Scene, get_scene

if TYPE_CHECKING:
    from sb3_roles.baselines.base import Controller, States

NEVER = kernels.NEVER
METRICS = kernels.METRICS
NO_ROLE = -1


# Without eq=False the generated comparison would ask for the truth value of whole arrays.
@dataclass(frozen=True, eq=False)
class EpisodeRecords:
    """What was measured in E episodes of one scene; row e of every array is one episode.

    :param episode: int64 (E,), number of the episode in the stream of the seed
    :param length: int64 (E,), joint steps until the episode ended
    :param curves: ``explo_paper``, ``explo_true``, ``cover`` -> float64 (E, horizon), fractions;
        index t holds the value after step t + 1, and from the end on the last value
    :param t90_true: int64 (E,), 0-based first step with explo_true >= 0.9, -1 for never
    :param t90_paper: int64 (E,), 0-based first step with explo_paper > 0.9, -1 for never
    :param seconds: wall time of the simulation, compilation excluded
    :param roles: int8 (E, horizon, N), role of each robot in step t + 1; -1 after the end of the
        episode, and everywhere for controllers without roles
    """

    episode: np.ndarray
    length: np.ndarray
    curves: dict[str, np.ndarray]
    t90_true: np.ndarray
    t90_paper: np.ndarray
    seconds: float
    roles: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 0), np.int8))


class Player:
    """Lets a controller act on the teams of a batch that has just been reset.

    :param controller: see :class:`~sb3_roles.baselines.base.Controller`
    :param batch: the teams; the caller reads the outcome of a step from it
    :param deterministic: handed to the controller
    """

    def __init__(
        self, controller: Controller, batch: BatchedAreaSearch, deterministic: bool = False
    ) -> None:
        self._controller, self._batch = controller, batch
        self._deterministic = deterministic
        self._uses_observation = getattr(controller, "uses_observation", True)
        self._state: States | None = None
        self._episode_start = np.ones(batch.n_teams * batch.n_agents, np.bool_)
        begin = getattr(controller, "begin", None)
        if begin is not None:
            begin(batch)

    def step(self) -> None:
        """Choose actions for all teams and step them.

        :raises ValueError: if the controller does not return one action for each row
        """
        batch, rows = self._batch, len(self._episode_start)
        observation = row_observations(batch) if self._uses_observation else {}
        actions, self._state = self._controller.predict(
            observation, self._state, self._episode_start, self._deterministic
        )
        if actions.shape != (rows,):
            raise ValueError(
                f"{type(self._controller).__name__}.predict returned actions of shape "
                f"{actions.shape}, expected ({rows},): one for each of {batch.n_teams} teams x "
                f"{batch.n_agents} robots"
            )
        self._episode_start[:] = False
        batch.step(actions.reshape(batch.n_teams, batch.n_agents))

    @property
    def roles(self) -> np.ndarray | None:
        """Int8 (n_teams, n_agents), the roles of the last step, if the controller has any."""
        return getattr(self._controller, "roles", None)


def row_observations(batch: BatchedAreaSearch) -> dict[str, np.ndarray]:
    """Return the observations with one row per robot, contiguous by team, as SB3 models take them.

    :param batch: the teams
    :return: key -> (n_teams * n_agents, ...); maps of a team are repeated, the other arrays are
        views that the next step overwrites
    """
    rows = {}
    for key, value in batch.observations.items():
        if key in batch.team_observation_keys:
            rows[key] = np.repeat(value, batch.n_agents, axis=0)
        else:
            rows[key] = value.reshape(batch.n_teams * batch.n_agents, *value.shape[2:])
    return rows


def run_episodes(
    controller: Controller,
    scene: Scene | str,
    n_episodes: int,
    seed: int,
    first_episode: int = 0,
    batch_size: int = 256,
    sub_goal: str | None = None,
    deterministic: bool = False,
) -> EpisodeRecords:
    """Play episodes ``first_episode`` .. ``first_episode + n_episodes - 1`` of a seed's stream.

    With a controller whose actions are a function of the episode, as those of all scripted ones
    are, the records do not depend on ``batch_size``, nor on how episodes are split over calls.

    :param controller: see :class:`~sb3_roles.baselines.base.Controller`
    :param scene: the task
    :param n_episodes: number of episodes
    :param seed: seed of the stream
    :param first_episode: number of the first one
    :param batch_size: teams that are simulated together
    :param sub_goal: path features in the observation, see ``area_search.paths``; by default those
        that the controller names in its own ``sub_goal``, or none
    :param deterministic: handed to the controller
    :return: the records, in the order of the episodes
    :raises ValueError: if a number is out of range
    """
    scene = get_scene(scene)
    for name, value, low in (
        ("n_episodes", n_episodes, 1),
        ("first_episode", first_episode, 0),
        ("batch_size", batch_size, 1),
    ):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < low:
            raise ValueError(f"{name} must be a whole number of at least {low}, got {value!r}")
    shape = (n_episodes, scene.horizon)
    records = EpisodeRecords(
        episode=np.arange(first_episode, first_episode + n_episodes, dtype=np.int64),
        length=np.zeros(n_episodes, np.int64),
        curves={name: np.zeros(shape) for name in METRICS},
        t90_true=np.full(n_episodes, NEVER, np.int64),
        t90_paper=np.full(n_episodes, NEVER, np.int64),
        seconds=0.0,
        roles=np.full((*shape, scene.n_agents), NO_ROLE, np.int8),
    )
    if sub_goal is None:
        sub_goal = str(getattr(controller, "sub_goal", "none"))
    _warm_up(controller, scene, seed, sub_goal)
    start = time.perf_counter()
    batch: BatchedAreaSearch | None = None
    for low in range(0, n_episodes, batch_size):
        rows = slice(low, min(low + batch_size, n_episodes))
        episodes = records.episode[rows]
        if batch is None or batch.n_teams != len(episodes):
            batch = BatchedAreaSearch(scene, len(episodes), sub_goal)
        batch.reset([seed] * len(episodes), episodes)
        _play(Player(controller, batch, deterministic), batch, records, rows)
    object.__setattr__(records, "seconds", time.perf_counter() - start)
    return records


def _warm_up(controller: Controller, scene: Scene, seed: int, sub_goal: str) -> None:
    # Compiles the kernels. A learned controller is not asked: it would advance its generator.
    batch = BatchedAreaSearch(scene, 1, sub_goal)
    batch.reset([seed], 0)
    if hasattr(controller, "begin"):
        Player(controller, batch).step()
    else:
        batch.step(np.zeros((1, scene.n_agents), np.int64))


def _play(player: Player, batch: BatchedAreaSearch, records: EpisodeRecords, rows: slice) -> None:
    # Ended teams go on moving, because the batch steps as a whole; nothing of it is recorded.
    playing = np.ones(batch.n_teams, np.bool_)
    for t in range(batch.scene.horizon):
        player.step()
        for name, values in batch.metrics.items():
            curve = records.curves[name][rows]
            curve[:, t] = values if t == 0 else np.where(playing, values, curve[:, t - 1])
        if player.roles is not None:
            records.roles[rows][playing, t] = player.roles[playing]
        ended = playing & (batch.terminated | batch.truncated)
        if not ended.any():
            continue
        records.length[rows][ended] = t + 1
        records.t90_true[rows][ended] = batch.totals[ended, kernels.T90_TRUE]
        records.t90_paper[rows][ended] = batch.totals[ended, kernels.T90_PAPER]
        playing &= ~ended
        if not playing.any():
            for curves in records.curves.values():
                curves[rows, t + 1 :] = curves[rows, t : t + 1]
            return
