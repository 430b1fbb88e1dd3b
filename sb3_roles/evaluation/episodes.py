"""Play numbered episodes with a controller and record what the metrics need."""

from __future__ import annotations

import hashlib
import json
import platform
import sys
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from area_search.batch import BatchedAreaSearch
from area_search.scenes import Scene, get_scene
from sb3_roles._version import __version__
from sb3_roles.common.checks import check_whole
from sb3_roles.common.names import closest
from sb3_roles.evaluation.records import COUNTS, NO_ROLE, EpisodeRecords, distance_type, held

if TYPE_CHECKING:
    from sb3_roles.baselines.base import Controller

# Seeds of training teams have 32 bits, see ``team_seeds``: no stream from here on is one of them.
HELD_OUT = 2**32
# Beyond the held-out streams of all seeds below 2 ** 63, which is what the command line takes.
SELECTION = 3 * 2**62
_VERSIONS = ("numpy", "numba", "torch")


def held_out_seed(seed: int) -> int:
    """Return the seed of a stream of area-search episodes that no training run plays.

    :param seed: of the evaluation, at least 0
    """
    return HELD_OUT + seed


def selection_seed(seed: int) -> int:
    """Return the seed of a stream on which a training run selects its best policy.

    No training plays it, and it is none of the streams that results are measured on: a policy that
    was selected on episodes looks better on them than it is.

    :param seed: of the evaluation, at least 0 and below 2 ** 62
    """
    return SELECTION + seed


STREAMS = {"held_out": held_out_seed, "selection": selection_seed}
"""Kinds of streams that no training plays -> seed of such a stream."""


def stream_seed(stream: str, seed: int) -> int:
    """Return the seed of a stream of one of the kinds.

    :param stream: a name of ``STREAMS``
    :param seed: of the evaluation
    :raises ValueError: if there is no such kind
    """
    if stream not in STREAMS:
        raise ValueError(closest("stream", stream, STREAMS))
    return STREAMS[stream](seed)


def stream_of(seed: int) -> tuple[str, int]:
    """Say which stream a seed is that of: the inverse of :func:`stream_seed`.

    :param seed: what :func:`run_episodes` was given
    :return: kind, ``"raw"`` for one that a training may play, and the number within the kind
    """
    for kind, first in (("selection", SELECTION), ("held_out", HELD_OUT)):
        if seed >= first:
            return kind, seed - first
    return "raw", seed


def describe(controller: Controller, scene: Scene, name: str | None = None) -> dict[str, Any]:
    """Say who plays what: all that decides about the results but the seed and the episodes.

    A controller may have the attributes ``name`` and ``description``, a dict of JSON values which
    tells it from others of its class; and ``deterministic`` and ``communicate``, where it has such
    a choice.

    :param controller: see :class:`~sb3_roles.baselines.base.Controller`
    :param scene: the task
    :param name: a label; by default the controller's, or that of its class
    :return: ``name``; ``controller`` (its class), ``controller_options``, ``scene`` (its fields),
        ``deterministic`` and ``communication`` (None: no such choice), ``version`` of the package;
        and ``config_hash``, the sha256 of canonical JSON of all these but ``name``
    :raises ValueError: if the description is not made of JSON values
    """
    config = {
        "controller": type(controller).__name__,
        "controller_options": getattr(controller, "description", {}),
        "scene": scene.facts(),
        "deterministic": getattr(controller, "deterministic", None),
        "communication": getattr(controller, "communicate", None),
        "version": __version__,
    }
    try:
        text = json.dumps(config, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"the description of {config['controller']} is no JSON: {error}") from None
    if name is None:
        name = str(getattr(controller, "name", config["controller"]))
    # What was written, not what was given: tuples have become lists, as in a file.
    return {
        "name": name,
        **json.loads(text),
        "config_hash": hashlib.sha256(text.encode()).hexdigest(),
    }


def _versions(controller: Controller) -> dict[str, str]:
    # Loaded or not: records must not tell who else has played in this process.
    routes_of_ortools = getattr(controller, "solutions", 0) > 0
    names = (*_VERSIONS, "ortools") if routes_of_ortools else _VERSIONS
    loaded = {name: sys.modules[name].__version__ for name in names if name in sys.modules}
    return {"python": platform.python_version(), **loaded}


class Player:
    """Lets a controller act on the teams of a batch that has just been reset.

    :param controller: see :class:`~sb3_roles.baselines.base.Controller`
    :param batch: the teams; the caller reads the outcome of a step from it
    :raises ValueError: if the controller has no ``begin``
    """

    def __init__(self, controller: Controller, batch: BatchedAreaSearch) -> None:
        begin = getattr(controller, "begin", None)
        if begin is None:
            raise ValueError(
                f"{type(controller).__name__} has no begin(batch), which a controller of episodes "
                "must have: evaluation.policies.PolicyController makes one of an SB3 model"
            )
        self._controller, self._batch = controller, batch
        self.decision_seconds = 0.0
        """Time that the controller took to decide on the last step, for the whole batch."""
        begin(batch)

    def step(self) -> None:
        """Choose actions for all teams and step them.

        :raises ValueError: if the controller does not return one action for each row
        """
        batch = self._batch
        start = time.perf_counter()
        actions, _ = self._controller.predict({})
        self.decision_seconds = time.perf_counter() - start
        rows = batch.n_teams * batch.n_agents
        if actions.shape != (rows,):
            raise ValueError(
                f"{type(self._controller).__name__}.predict returned actions of shape "
                f"{actions.shape}, expected ({rows},): one for each of {batch.n_teams} teams x "
                f"{batch.n_agents} robots"
            )
        batch.step(actions.reshape(batch.n_teams, batch.n_agents))

    @property
    def roles(self) -> np.ndarray | None:
        """Int8 (n_teams, n_agents), the roles of the last step, if the controller has any."""
        return getattr(self._controller, "roles", None)

    @property
    def bounds(self) -> np.ndarray | None:
        """Float (n_teams,), targets that nobody can exceed, if the controller knows that."""
        return getattr(self._controller, "bounds", None)


def run_episodes(
    controller: Controller,
    scene: Scene | str,
    n_episodes: int,
    seed: int,
    first_episode: int = 0,
    batch_size: int = 256,
    sub_goal: str | None = None,
    *,
    n_agents: int | None = None,
    name: str | None = None,
) -> EpisodeRecords:
    """Play episodes ``first_episode`` .. ``first_episode + n_episodes - 1`` of a seed's stream.

    Controllers act as a function of the episode alone, so the records depend neither on
    ``batch_size`` nor on how episodes are split over calls, and two controllers that are given the
    same seed play the same episodes. Training plays streams of seeds below 2 ** 32:
    :func:`held_out_seed` makes one that no training plays, neither to learn nor to select.

    :param controller: see :class:`~sb3_roles.baselines.base.Controller`
    :param scene: the task
    :param n_episodes: number of episodes
    :param seed: seed of the stream
    :param first_episode: number of the first one
    :param batch_size: teams that are simulated together
    :param sub_goal: path features in the observation, see ``area_search.paths``; by default those
        that the controller names in its own ``sub_goal``, or none
    :param n_agents: robots in the team, instead of the scene's
    :param name: what the records call the controller, see :func:`describe`
    :return: the records, in the order of the episodes
    :raises ValueError: if a number is out of range
    """
    scene = get_scene(scene) if n_agents is None else get_scene(scene, n_agents=n_agents)
    check_whole(1, n_episodes=n_episodes, batch_size=batch_size)
    check_whole(0, first_episode=first_episode)
    if sub_goal is None:
        sub_goal = str(getattr(controller, "sub_goal", "none"))
    metadata = describe(controller, scene, name)
    # A step of one team compiles the kernels, or loads them.
    batch = BatchedAreaSearch(scene, 1, sub_goal)
    batch.reset([seed], first_episode)
    Player(controller, batch).step()
    records = _empty(scene, n_episodes, first_episode)
    start = time.perf_counter()
    for low in range(0, n_episodes, batch_size):
        rows = slice(low, min(low + batch_size, n_episodes))
        episodes = records.episode[rows]
        if batch.n_teams != len(episodes):
            batch = BatchedAreaSearch(scene, len(episodes), sub_goal)
        batch.reset([seed] * len(episodes), episodes)
        player = Player(controller, batch)
        _play(player, batch, records, rows)
    records.timing.update(seconds=time.perf_counter() - start, batch_size=int(batch_size))
    names = [] if player.roles is None else list(getattr(controller, "role_names", ()))
    records.metadata.update(metadata, seed=int(seed), role_names=names)
    records.metadata.update(versions=_versions(controller))
    return records


def _empty(scene: Scene, n_episodes: int, first_episode: int) -> EpisodeRecords:
    shape = (n_episodes, scene.horizon)
    return EpisodeRecords(
        metadata={},
        episode=np.arange(first_episode, first_episode + n_episodes, dtype=np.int64),
        length=np.zeros(n_episodes, np.int64),
        counts={name: np.zeros(shape, np.int32) for name in COUNTS},
        n_free=np.full(n_episodes, scene.n_free, np.int32),
        n_targets=np.full(n_episodes, scene.n_targets, np.int32),
        distance=np.zeros((*shape, scene.n_agents), distance_type(scene.horizon)),
        roles=np.full((*shape, scene.n_agents), NO_ROLE, np.int8),
        decision_seconds=np.full(shape, np.nan, np.float32),
        timing={},
        bounds=np.full(n_episodes, np.nan),
    )


def _play(player: Player, batch: BatchedAreaSearch, records: EpisodeRecords, rows: slice) -> None:
    # Ended teams go on moving, because the batch steps as a whole; nothing of it is recorded.
    playing = np.ones(batch.n_teams, np.bool_)
    length, distance = records.length[rows], records.distance[rows]
    moved = np.zeros((batch.n_teams, batch.n_agents), distance.dtype)
    for t in range(batch.scene.horizon):
        before = batch.position.copy()
        player.step()
        moved += (batch.position != before).any(axis=2)
        distance[:, t] = moved
        for name, column in COUNTS.items():
            records.counts[name][rows, t] = batch.totals[:, column]
        if player.roles is not None:
            records.roles[rows][playing, t] = player.roles[playing]
        records.decision_seconds[rows][playing, t] = player.decision_seconds / playing.sum()
        ended = playing & (batch.terminated | batch.truncated)
        length[ended] = t + 1
        playing &= ~ended
        if not playing.any():
            break
    if player.bounds is not None:
        records.bounds[rows] = player.bounds
    if length.min() < batch.scene.horizon:
        distance[:] = held(distance, length)
        for counts in records.counts.values():
            counts[rows] = held(counts[rows], length)
