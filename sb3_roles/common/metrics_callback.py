"""``TeamMetricsCallback``: what happened in the teams' episodes."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from sb3_roles.common.base_callback import TeamCallback, grown, role_wrapper_of, stacked
from sb3_roles.common.checks import check_positive
from sb3_roles.common.role_wrapper import STREAMS
from sb3_roles.common.thresholds import first_above

PAPER_CURVE = "explo_paper"
_TIME_PREFIX = "t90_"


class TeamEpisode(NamedTuple):
    """What is known of one finished episode of a team."""

    metrics: dict[str, float]
    returns: np.ndarray
    """float64 (n_streams,), each the sum over the robots of the team"""
    curve: np.ndarray
    """float64 (length,), explo_paper after each step; empty where it is no metric"""


class TeamMetricsCallback(TeamCallback):
    """Logs the means over the last episodes of teams; one team's episode is one episode.

    ``rollout/`` holds every number in the infos' ``episode_metrics``, in the environment's unit
    (fractions for area search), and ``return`` (``return_role``, ``return_primitive`` with roles),
    the sum over the robots of a team. Names that begin with ``t90_`` are first steps, -1 for never:
    the mean is over the episodes that get there, ``t90_..._share`` is their share (``t90_share``
    that of ``t90_true``). ``time_e_paper`` is the first 0-based step at which the mean curve of
    ``explo_paper`` exceeds 0.9. ``team_episodes`` counts all episodes of the training.
    ``time/env_steps`` and ``time/agent_steps`` are the steps of teams and of robots so far; SB3's
    ``time/total_timesteps`` is the latter, too.

    :param window: episodes to average over
    :param verbose: see ``BaseCallback``
    """

    def __init__(self, window: int = 100, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.team_episodes = 0
        check_positive(window=window)
        self.window: deque[TeamEpisode] = deque(maxlen=window)

    def _init_callback(self) -> None:
        super()._init_callback()
        self._roles = role_wrapper_of(self.training_env)
        n_streams = 1 if self._roles is None else len(STREAMS)
        if len(self._running.get("steps", ())) != self.n_teams:
            self._running = {
                "steps": np.zeros(self.n_teams, np.int64),
                "returns": np.zeros((self.n_teams, n_streams)),
                "curves": np.zeros((self.n_teams, 0)),
            }

    def _on_step(self) -> bool:
        running, steps = self._running, self._running["steps"]
        rewards = np.asarray(self.locals["rewards"], np.float64)[:, None]
        if self._roles is not None:
            rewards = self._roles.stream_rewards.astype(np.float64)
        running["returns"] += rewards.reshape(self.n_teams, self.n_agents, -1).sum(axis=1)
        curve = self.team_env.metrics.get(PAPER_CURVE)
        if curve is not None:
            running["curves"] = grown(running["curves"], int(steps.max()) + 1)
            running["curves"][np.arange(self.n_teams), steps] = curve
        steps += 1
        for team in self._ended():
            self._finish(int(team), self.locals["infos"][team * self.n_agents])
        return True

    def _finish(self, team: int, info: Mapping[str, Any]) -> None:
        running = self._running
        length = int(running["steps"][team])
        metrics = {"length": float(length)}
        for name, value in info.get("episode_metrics", {}).items():
            if isinstance(value, (int, float, np.number, np.bool_)):
                metrics[name] = float(value)
        self.window.append(
            TeamEpisode(
                metrics, running["returns"][team].copy(), running["curves"][team, :length].copy()
            )
        )
        self.team_episodes += 1
        for array in running.values():
            array[team] = 0

    def summary(self) -> dict[str, float]:
        """Return what is logged, by name without ``rollout/``."""
        summary: dict[str, float] = {"team_episodes": self.team_episodes}
        if not self.window:
            return summary
        for name in dict.fromkeys(name for episode in self.window for name in episode.metrics):
            values = np.array([e.metrics[name] for e in self.window if name in e.metrics])
            if name.startswith(_TIME_PREFIX):
                share = "t90_share" if name == "t90_true" else f"{name}_share"
                summary[share] = float(np.mean(values >= 0))
                values = values[values >= 0]
            if len(values):
                summary[name] = float(values.mean())
        names = ["return"]
        if self.window[-1].returns.size > 1:
            names = [f"return_{stream}" for stream in STREAMS]
        means = np.mean([episode.returns for episode in self.window], axis=0)
        summary.update(zip(names, means.tolist(), strict=True))
        time = self._time_e_paper()
        return summary if time is None else {**summary, "time_e_paper": time}

    def _time_e_paper(self) -> float | None:
        curves = [episode.curve for episode in self.window]
        longest = max(len(curve) for curve in curves)
        if longest == 0:
            return None
        # An episode that ended early keeps its last value.
        full = [np.pad(c, (0, longest - len(c)), "edge") for c in curves if len(c)]
        time = int(first_above(np.mean(full, axis=0, keepdims=True))[0])
        return None if time == longest else float(time)

    def _on_rollout_end(self) -> None:
        self.logger.record("time/env_steps", self.joint_steps)
        self.logger.record("time/agent_steps", int(self.model.num_timesteps))
        for name, value in self.summary().items():
            self.logger.record(f"rollout/{name}", value)

    def get_state(self) -> dict[str, Any]:
        """Return what the coming records depend on."""
        names = list(dict.fromkeys(name for e in self.window for name in e.metrics))
        missing = float("nan")
        return {
            **{name: array.copy() for name, array in self._running.items()},
            "team_episodes": self.team_episodes,
            "metric_names": names,
            "window_metrics": np.array(
                [[e.metrics.get(name, missing) for name in names] for e in self.window]
            ),
            "window_returns": np.array([episode.returns for episode in self.window]),
            "window_curves": stacked([episode.curve for episode in self.window], missing),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from what :meth:`get_state` returned; before the training begins."""
        self._running = {
            name: np.array(state[name], dtype)
            for name, dtype in (("steps", np.int64), ("returns", float), ("curves", float))
        }
        self.team_episodes = int(state["team_episodes"])
        self.window.clear()
        curves = np.asarray(state["window_curves"])
        for values, returns, curve in zip(
            np.asarray(state["window_metrics"]), state["window_returns"], curves, strict=True
        ):
            named = zip(state["metric_names"], values.tolist(), strict=True)
            self.window.append(
                TeamEpisode(
                    {name: value for name, value in named if not np.isnan(value)},
                    np.array(returns, np.float64),
                    np.array(curve[~np.isnan(curve)], np.float64),
                )
            )
