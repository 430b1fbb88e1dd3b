"""A training to be measured: where its time goes, the work that it does, and its memory.

Importing this module imports no torch, so that the settings that it reads can still be made.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from threading import Lock
from typing import Any

from sb3_roles.zoo.bench_memory import rollout_memory
from sb3_roles.zoo.bench_report import against, spread
from sb3_roles.zoo.config import load_settings, merge, resolve
from sb3_roles.zoo.environments import AREA_SEARCH

TUNED = "hmappo native"
# What the project aims at with its tuned default; reported as met or missed, never asserted.
RATE_TARGETS = {TUNED: 2_500}
RATE_AIMS = {TUNED: 4_000}
PARTS = ("environment", "inference", "buffer", "update")


class Stopwatch:
    """Adds up the time inside some methods of objects; what they call belongs to the outermost."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._inside = False

    def watch(self, part: str, owner: Any, method: str) -> None:
        """Count the time inside ``owner.method`` as that of a part.

        :param part: key in ``seconds``
        :param owner: any object; gets an attribute that shadows its method
        :param method: the method's name
        """
        original: Callable[..., Any] = getattr(owner, method)
        self.seconds.setdefault(part, 0.0)

        def timed(*args: Any, **options: Any) -> Any:
            if self._inside:
                return original(*args, **options)
            self._inside = True
            start = time.perf_counter()
            try:
                return original(*args, **options)
            finally:
                self.seconds[part] += time.perf_counter() - start
                self._inside = False

        setattr(owner, method, timed)


@dataclass
class Work:
    """What was done, counted where it is done.

    :param joint_steps: steps of whole teams
    :param robot_steps: the same times robots
    :param samples_times_epochs: robots' rows in all minibatches of all epochs
    :param optimizer_steps: steps of the optimizer
    """

    joint_steps: int = 0
    robot_steps: int = 0
    samples_times_epochs: int = 0
    optimizer_steps: int = 0


class TrainingCase:
    """One algorithm on one backend, warmed up by an iteration.

    :param name: what reports call it
    :param env: with all wrappers
    :param model: untrained
    """

    def __init__(self, name: str, env: Any, model: Any) -> None:
        from stable_baselines3.common.logger import Logger

        from sb3_roles.common.team_wrapper import find_team_env

        self.name, self.env, self.model = name, env, model
        self.model.set_logger(Logger(None, []))
        team_env = find_team_env(env)
        self.n_agents, self.n_teams = team_env.n_agents, team_env.n_teams
        self.rates: list[float] = []
        self.rollout_costs: list[float] = []
        self.update_costs: list[float] = []
        self.cpu_shares: list[float] = []
        self.work, self.seconds = Work(), 0.0
        self._train(1)
        self.watch = Stopwatch()
        self._watch()
        self._count()

    def _watch(self) -> None:
        policy, buffer = self.model.policy, self.model.rollout_buffer
        self.watch.watch("update", self.model, "train")
        self.watch.watch("environment", self.model.env, "step")
        if hasattr(self.model, "player"):
            # The policy itself runs on other threads.
            for method in ("act", "bootstrap", "last_values"):
                self.watch.watch("inference", self.model.player, method)
        else:
            self.watch.watch("inference", policy, "forward")
        for method in ("add_streams", "add", "compute_stream_returns",
                       "compute_returns_and_advantage"):  # fmt: skip
            if hasattr(buffer, method):
                self.watch.watch("buffer", buffer, method)

    def _count(self) -> None:
        lock = Lock()

        def count_step(*_: Any) -> None:
            self.work.optimizer_steps += 1

        def counting(evaluate: Callable[..., Any]) -> Callable[..., Any]:
            def counted(obs: Any, actions: Any = None, *args: Any, **options: Any) -> Any:
                if actions is not None:
                    with lock:  # parts of a minibatch may come from several threads
                        self.work.samples_times_epochs += len(actions)
                return evaluate(obs, actions, *args, **options)

            return counted

        policy = self.model.policy
        policy.optimizer.register_step_post_hook(count_step)
        for method in ("streams", "evaluate_actions"):
            if hasattr(policy, method):
                setattr(policy, method, counting(getattr(policy, method)))

    def _train(self, iterations: int) -> None:
        from sb3_roles.common.callbacks import TeamMetricsCallback

        rows = iterations * self.model.n_steps * self.env.num_envs
        self.model.learn(rows, TeamMetricsCallback(), reset_num_timesteps=False)

    def measure(self, iterations: int, num_threads: int | None = None) -> None:
        """Train for some iterations, and add rate and costs to their lists.

        :param iterations: rollouts and updates
        :param num_threads: threads of torch during this; None for those that there are
        """
        import torch as th

        threads = th.get_num_threads()
        self._set_threads(num_threads or threads)
        updates = self.watch.seconds["update"]
        cpu, start = time.process_time(), time.perf_counter()
        try:
            self._train(iterations)
        finally:
            seconds = time.perf_counter() - start
            self._set_threads(threads)
        done = iterations * self.model.n_steps * self.n_teams
        updates = self.watch.seconds["update"] - updates
        self.rates.append(done / seconds)
        self.cpu_shares.append((time.process_time() - cpu) / seconds)
        self.update_costs.append(updates / done)
        self.rollout_costs.append((seconds - updates) / done)
        self.work.joint_steps += done
        self.work.robot_steps += done * self.n_agents
        self.seconds += seconds

    def _set_threads(self, number: int) -> None:
        import torch as th

        from sb3_roles.zoo.models import step_on_threads

        th.set_num_threads(number)
        step_on_threads(self.env, number)

    def repeat_update(self) -> tuple[float, Work]:
        """Update once more on the last rollout, apart from all that :meth:`describe` returns.

        :return: seconds, and the work done
        """
        kept, seconds = self.work, dict(self.watch.seconds)
        self.work = done = Work(self.model.n_steps * self.n_teams)
        done.robot_steps = done.joint_steps * self.n_agents
        start = time.perf_counter()
        try:
            self.model.train()
        finally:
            taken = time.perf_counter() - start
            self.work, self.watch.seconds = kept, seconds
        return taken, done

    def describe(self) -> dict[str, Any]:
        """Return what was measured, plain data."""
        parts = {part: self.watch.seconds.get(part, 0.0) / self.seconds for part in PARTS}
        parts["rest"] = max(0.0, 1.0 - sum(parts.values()))
        rate = spread(self.rates)
        aim = RATE_AIMS.get(self.name)
        return {
            "name": self.name,
            "n_agents": self.n_agents,
            "n_teams": self.n_teams,
            "parameters": sum(one.numel() for one in self.model.policy.parameters()),
            "joint_steps_per_second": against(rate, RATE_TARGETS.get(self.name)),
            "aim": None if aim is None else against(rate, aim),
            # Processors in use: far below the number of threads, others had them.
            "cpu_share": statistics.median(self.cpu_shares),
            "share_of_time": parts,
            "observation_bytes_per_joint_step": self.buffer_bytes()
            / (self.model.n_steps * self.n_teams),
            "memory": rollout_memory(self.model, self.buffer_bytes()),
            "work": asdict(self.work),
        }

    def buffer_bytes(self) -> int:
        """Return the bytes of a rollout's observations."""
        buffer = self.model.rollout_buffer
        if hasattr(buffer, "nbytes"):
            return int(buffer.nbytes)
        return sum(array.nbytes for array in buffer.observations.values())

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


def configure(
    algo: str = "hmappo",
    backend: str = "native",
    changes: Mapping[str, Any] | None = None,
    n_envs: int | None = None,
) -> dict[str, Any]:
    """Return a tuned configuration with some changes, checked.

    :param algo: name of the algorithm
    :param backend: of ``make_team_vec_env``
    :param changes: see ``zoo.config.merge``
    :param n_envs: teams; None for those of the configuration. Of too few for a minibatch, the
        whole rollout is one, and groups of teams are as many as teams at most
    :raises ConfigError: if they do not fit
    """
    settings = merge(load_settings(algo, AREA_SEARCH), changes or {})
    if n_envs is not None:
        settings["n_envs"] = n_envs
        limits = {"batch_size": n_envs * settings["n_steps"], "rollout_groups": n_envs}
        for key, limit in limits.items():
            if key in settings:
                settings[key] = min(settings[key], limit)
    return resolve(algo, AREA_SEARCH, settings, 0, backend)


def training_case(name: str, config: Mapping[str, Any]) -> TrainingCase:
    """Make a case of a configuration.

    :param name: what reports call it
    :param config: see :func:`configure`
    :raises UsageError: if algorithm and environment do not fit
    """
    from sb3_roles.zoo.models import make_env, make_model

    env = make_env(config)
    return TrainingCase(name, env, make_model(config, env, "cpu"))
