"""The kernels and the plain-Python reference, played side by side and compared byte by byte."""

from __future__ import annotations

from typing import Any

import numpy as np

from area_search import BatchedAreaSearch, Scene
from area_search.reference import ReferenceAreaSearch


def _differs(name: str, found: Any, expected: Any) -> list[str]:
    found, expected = np.asarray(found), np.asarray(expected)
    if found.dtype != expected.dtype or found.shape != expected.shape:
        return [f"{name} is {found.dtype} {found.shape}, not {expected.dtype} {expected.shape}"]
    if np.array_equal(found, expected):
        return []
    index = tuple(int(i) for i in np.argwhere(found != expected)[0])
    return [f"{name}{list(index) if index else ''} is {found[index]}, not {expected[index]}"]


def differences(batch: BatchedAreaSearch, team: int, reference: ReferenceAreaSearch) -> list[str]:
    """Compare everything that a user can see of a team.

    :param batch: of the kernels
    :param team: index of the team
    :param reference: of the same episode, after as many steps
    :return: what differs, a line each
    """
    observations, found = reference.observe(), []
    for key, array in batch.observations.items():
        if key in batch.team_observation_keys:
            expected = observations[0][key]
        else:
            expected = np.stack([observation[key] for observation in observations])
        found += _differs(f"observation {key!r}", array[team], expected)
    if not reference.n_steps:
        return found
    metrics = batch.episode_metrics(team)
    pairs = {
        "reward components": (batch.reward_components[team], reference.reward_components()),
        "rewards": (batch.rewards[team], reference.rewards()),
        "terminated": (bool(batch.terminated[team]), reference.terminated),
        "truncated": (bool(batch.truncated[team]), reference.truncated),
        "t90_paper": (metrics["t90_paper"], reference.t90_paper),
        "t90_true": (metrics["t90_true"], reference.t90_true),
        "length": (metrics["length"], reference.n_steps),
    }
    expected_metrics = reference.metrics()
    for name in batch.metric_names:
        pairs[name] = (float(metrics[name]), float(expected_metrics[name]))
    for name, (of_batch, of_reference) in pairs.items():
        found += _differs(name, of_batch, of_reference)
    return found


class SideBySide:
    """Teams in random play, by the kernels and by the reference.

    :param scene: the task
    :param seed: of the episodes, the actions and the roles
    :param sub_goal: see ``BatchedAreaSearch``
    :param n_teams: number of teams
    :param options: ``known_map`` and ``time`` of both
    """

    def __init__(
        self, scene: Scene, seed: int, sub_goal: str, n_teams: int, **options: bool
    ) -> None:
        self._scene, self._seed, self._sub_goal, self._options = scene, seed, sub_goal, options
        self._rng = np.random.default_rng(seed)
        self.batch = BatchedAreaSearch(scene, n_teams, sub_goal, **options)
        self.batch.reset(seed)
        self._episodes = np.arange(n_teams)
        self._references = [self._reference(int(episode)) for episode in self._episodes]
        self.ended = 0

    def _reference(self, episode: int) -> ReferenceAreaSearch:
        return ReferenceAreaSearch(
            self._scene, self._seed, episode, self._sub_goal, **self._options
        )

    def differences(self) -> list[list[str]]:
        """Compare each team as it is now; see :func:`differences`."""
        return [differences(self.batch, m, one) for m, one in enumerate(self._references)]

    def step(self) -> list[list[str]]:
        """Make a random step in random roles, compare each team, and reset those that have ended.

        :return: for each team what differs, a line each
        """
        batch, shape = self.batch, (self.batch.n_teams, self._scene.n_agents)
        actions, roles = self._rng.integers(0, 5, shape), self._rng.integers(0, 3, shape)
        batch.set_roles(roles)
        batch.step(actions)
        for reference, moves, own in zip(self._references, actions, roles, strict=True):
            reference.roles = own.tolist()
            reference.step(moves.tolist())
        found = self.differences()
        done = batch.terminated | batch.truncated
        if done.any():
            self.ended += int(done.sum())
            batch.reset_teams(done)
            self._episodes[done] += batch.n_teams
            for m in np.flatnonzero(done):
                self._references[m] = self._reference(int(self._episodes[m]))
                found[m] += differences(batch, int(m), self._references[m])
        return found
