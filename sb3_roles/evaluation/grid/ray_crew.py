"""Play the blocks of a grid on a Ray cluster (extra ``ray``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

from sb3_roles.common.names import one_line
from sb3_roles.common.ray_cluster import RayError, cluster_cpus, connect, disconnect, ray
from sb3_roles.evaluation.grid.crews import (
    Controllers,
    Finished,
    Make,
    Task,
    keep,
    play_block,
)
from sb3_roles.evaluation.grid.store import RecordStore
from sb3_roles.evaluation.records import EpisodeRecords

__all__ = ["RayCrew", "RayError"]

# Losses of a worker or of its machine; errors of a controller are no reason to try again.
MAX_RETRIES = 5


class RayCrew:
    """Ray's workers play; the records come back here, where they are kept.

    Workers need no disk in common with this process, and no runs: the weights are sent to them.
    They need this package, of the same version.

    :param address: of a running cluster, ``HOST:PORT`` or ``"auto"``, or ``"local"`` to start one
    :param make: see ``Make``
    :param store: where blocks are kept
    :param n_cpus: workers of a local cluster
    :raises RayError: if there is no such cluster
    """

    def __init__(self, address: str, make: Make, store: RecordStore, n_cpus: int = 1) -> None:
        connect(address, n_cpus)
        self._make, self._store = make, store
        self._running: dict[Any, Task] = {}
        self._files: dict[Any, Any] = {}
        self._play = ray.remote(num_cpus=1, max_retries=MAX_RETRIES)(_play)

    @property
    def size(self) -> int:
        """CPUs of the cluster, which may come and go."""
        return cluster_cpus()

    @property
    def has_room(self) -> bool:
        """Whether a worker may soon have nothing to do."""
        return len(self._running) < 2 * self.size

    def submit(self, task: Task) -> None:
        """Send a task; the files of its parcel are sent once."""
        key = task.parcel.key
        if key not in self._files:
            self._files[key] = ray.put(dict(task.parcel.files))
        light = task._replace(parcel=replace(task.parcel, files={}))
        self._running[self._play.remote(light, self._files[key], self._make)] = task

    def wait(self) -> Finished:
        """Wait for the next block, and keep it."""
        (done,), _ = ray.wait(list(self._running), num_returns=1)
        task = self._running.pop(done)
        try:
            answer = ray.get(done)
        except ray.exceptions.RayError as failure:
            return Finished(task, error=f"Ray: {one_line(failure)[:200]}")
        return keep(Finished(task, *answer), self._store)

    def close(self) -> None:
        """Leave the cluster, which ends what it still plays, and stop it if it was started here."""
        disconnect()


@lru_cache(maxsize=1)
def _controllers(make: Make) -> Controllers:
    return Controllers(make)


def _play(
    task: Task, files: Mapping[str, bytes], make: Make
) -> tuple[EpisodeRecords | None, str, OSError | None]:
    """Play a block in a worker of Ray, which is used for one task after the other."""
    task = task._replace(parcel=replace(task.parcel, files=files))
    finished = play_block(task, _controllers(make))
    return finished.records, finished.error, finished.stop
