"""``RoleCallback``: which roles the robots act in, and how often they change."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_roles.common.base_callback import TeamCallback, grown, role_wrapper_of, stacked
from sb3_roles.common.checks import check_positive
from sb3_roles.common.files import csv_bytes, write_atomically

_THIRDS = ("begin", "middle", "end")


class RoleEpisode(NamedTuple):
    """Which roles a team chose in one episode."""

    counts: np.ndarray
    """int64 (length, n_roles), robots in each role at each step"""
    switches: int
    """how often a robot's role differed from its role of the step before"""


class RoleCallback(TeamCallback):
    """Logs which roles are chosen; does nothing without a ``RoleWrapper``.

    ``roles/<name>`` is a role's share of the robots and steps of the last episodes,
    ``roles/<name>_begin``, ``_middle`` and ``_end`` that of each third of an episode, and
    ``roles/switch_rate`` the share of the steps, from an episode's second on, at which a robot's
    role is not that of the step before. :attr:`roles_per_step` is the share at each step.

    :param window: episodes to average over
    :param path: csv file for :attr:`roles_per_step`, written after every rollout
    :param verbose: see ``BaseCallback``
    """

    def __init__(self, window: int = 100, path: str | Path | None = None, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.path = None if path is None else Path(path)
        self.role_names: tuple[str, ...] = ()
        check_positive(window=window)
        self.window: deque[RoleEpisode] = deque(maxlen=window)

    def _init_callback(self) -> None:
        super()._init_callback()
        wrapper = role_wrapper_of(self.training_env)
        self.role_names = () if wrapper is None else wrapper.role_names
        if not self.role_names:
            return
        previous = self._running.get("previous", np.zeros(()))
        if previous.shape != (self.n_teams, self.n_agents):
            self._running = {
                "steps": np.zeros(self.n_teams, np.int64),
                "switches": np.zeros(self.n_teams, np.int64),
                "previous": np.zeros((self.n_teams, self.n_agents), np.int64),
                "counts": np.zeros((self.n_teams, 0, len(self.role_names)), np.int64),
            }

    def _on_step(self) -> bool:
        if not self.role_names:
            return True
        running, steps = self._running, self._running["steps"]
        # Not current_roles: the wrapper has cleared those of finished teams, or set the next ones.
        roles = np.asarray(self.locals["actions"])[:, 0].reshape(self.n_teams, self.n_agents)
        running["counts"] = grown(running["counts"], int(steps.max()) + 1)
        one_hot = roles[:, :, None] == np.arange(len(self.role_names))
        running["counts"][np.arange(self.n_teams), steps] = one_hot.sum(axis=1)
        differs = (roles != running["previous"]).sum(axis=1)
        running["switches"] += np.where(steps > 0, differs, 0)
        running["previous"][:] = roles
        steps += 1
        for team in self._ended():
            counts = running["counts"][team, : steps[team]].copy()
            self.window.append(RoleEpisode(counts, int(running["switches"][team])))
            for array in running.values():
                array[team] = 0
        return True

    @property
    def roles_per_step(self) -> np.ndarray:
        """Float64 (longest episode, n_roles): share of each role at each step, over the window."""
        if not self.window:
            return np.zeros((0, len(self.role_names)))
        counts = stacked([episode.counts for episode in self.window], 0).sum(axis=0)
        return counts / counts.sum(axis=1, keepdims=True)

    def summary(self) -> dict[str, float]:
        """Return what is logged, by name without ``roles/``."""
        if not self.window:
            return {}
        counts = stacked([episode.counts for episode in self.window], 0).sum(axis=0)
        total = counts.sum(axis=0) / counts.sum()
        summary = dict(zip(self.role_names, total.tolist(), strict=True))
        if len(counts) >= len(_THIRDS):
            for part, some in zip(_THIRDS, np.array_split(counts, len(_THIRDS)), strict=True):
                shares = some.sum(axis=0) / some.sum()
                for name, share in zip(self.role_names, shares.tolist(), strict=True):
                    summary[f"{name}_{part}"] = share
        pairs = sum(int(episode.counts[1:].sum()) for episode in self.window)
        if pairs:
            summary["switch_rate"] = sum(episode.switches for episode in self.window) / pairs
        return summary

    def _on_rollout_end(self) -> None:
        for name, value in self.summary().items():
            self.logger.record(f"roles/{name}", value)
        if self.path is not None and self.window:
            rows = [[t, *shares] for t, shares in enumerate(self.roles_per_step.tolist())]
            write_atomically(self.path, csv_bytes(["step", *self.role_names], rows))

    def get_state(self) -> dict[str, Any]:
        """Return what the coming records depend on."""
        return {
            **{name: array.copy() for name, array in self._running.items()},
            "window_counts": stacked([episode.counts for episode in self.window], 0),
            "window_switches": np.array([e.switches for e in self.window], np.int64),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from what :meth:`get_state` returned; before the training begins."""
        names = [name for name in ("steps", "switches", "previous", "counts") if name in state]
        self._running = {name: np.array(state[name], np.int64) for name in names}
        self.window.clear()
        for counts, switches in zip(
            np.asarray(state["window_counts"]), state["window_switches"], strict=True
        ):
            # Some robot has some role in every step that was played.
            played = counts.sum(axis=1) > 0
            self.window.append(RoleEpisode(np.array(counts[played], np.int64), int(switches)))
