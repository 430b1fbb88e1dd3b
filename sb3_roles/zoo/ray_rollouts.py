"""Rollouts of a run on a Ray cluster: ``train.py --ray ADDRESS --rollout-workers K``."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import torch as th

from sb3_roles.common.group_play import (
    GroupRecord,
    GroupStage,
    GroupTask,
    RolloutsLost,
    TaskPlayer,
)
from sb3_roles.common.names import one_line
from sb3_roles.common.ray_cluster import ray
from sb3_roles.common.rollout_steps import Learner
from sb3_roles.common.snapshot import kept_rng

# Losses of a worker or of its machine; errors of an environment are none. A task that ends its
# worker every time must not be tried forever.
MAX_RETRIES = 20


class RayPlayer(TaskPlayer):
    """Ray's workers play the groups of teams; what they play depends on nothing but the task.

    Workers need no disk in common with this process, but this package, of the same version; and
    processors of the same kind, because others round in another way.

    :param learner: the algorithm, on the CPU
    :param config: its configuration, checked
    :param n_workers: tasks at once, at most
    """

    def __init__(self, learner: Learner, config: Mapping[str, Any], n_workers: int) -> None:
        super().__init__(learner)
        self._n_workers = n_workers
        # Text, because workers keep what they have made of it.
        self._config = json.dumps(dict(config), sort_keys=True)
        self._play = ray.remote(num_cpus=1, max_retries=MAX_RETRIES)(play_task)

    def run(
        self, tasks: Sequence[GroupTask], weights: Mapping[str, th.Tensor]
    ) -> list[GroupRecord]:
        """Play some tasks; see :class:`TaskPlayer`.

        :raises RolloutsLost: if the cluster is lost
        """
        # Ray draws names and delays from Python's generator, which is part of checkpoints.
        with kept_rng():
            return self._run(tasks, weights)

    def _run(
        self, tasks: Sequence[GroupTask], weights: Mapping[str, th.Tensor]
    ) -> list[GroupRecord]:
        sent = ray.put(dict(weights))
        # As where all groups are played in one process, see ``rollout_steps.inner_threads``.
        n_threads = 1 if len(tasks) > 1 else th.get_num_threads()
        left = list(range(len(tasks)))
        running: dict[Any, int] = {}
        records: dict[int, GroupRecord] = {}
        try:
            while left or running:
                while left and len(running) < self._n_workers:
                    index = left.pop(0)
                    running[self.submit(tasks[index], sent, n_threads)] = index
                (done,), _ = ray.wait(list(running), num_returns=1)
                records[running.pop(done)] = ray.get(done)
        except ray.exceptions.RayTaskError as error:
            # What the task said, as if it had been played here.
            raise error.cause from None
        except ray.exceptions.RayError as error:
            raise RolloutsLost(f"Ray: {one_line(error)[:200]}") from None
        return [records[index] for index in range(len(tasks))]

    def submit(self, task: GroupTask, weights: Any, n_threads: int) -> Any:
        """Send one task; return what Ray knows it by."""
        return self._play.remote(self._config, os.getcwd(), task, weights, n_threads)


def play_task(
    config: str, folder: str, task: GroupTask, weights: Mapping[str, th.Tensor], n_threads: int
) -> GroupRecord:
    """Play a task in a worker, which is used for one after the other.

    :param config: of the run, JSON
    :param folder: where a module of one's own with the environment may be
    :param task: the task
    :param weights: of the policy
    :param n_threads: of torch
    """
    th.set_num_threads(n_threads)
    if folder not in sys.path:
        sys.path.append(folder)
    return _stage(config, task.n_teams).play(task, weights)


# Two sizes of groups in a run.
@lru_cache(maxsize=2)
def _stage(config: str, n_teams: int) -> GroupStage:
    from sb3_roles.zoo.launcher import prepare_process
    from sb3_roles.zoo.models import make_env, make_model, small_config

    prepare_process()
    small = small_config(json.loads(config), n_teams)
    env = make_env(small)
    model: Any = make_model(small, env, "cpu")
    # The model's, which may have one more wrapper.
    return GroupStage(model, model.env)
