"""Processes that play the blocks of a grid."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

from sb3_roles.evaluation.grid.crews import Controllers, Finished, Make, Task, keep, play_block
from sb3_roles.evaluation.grid.store import RecordStore, Report, Span

if TYPE_CHECKING:
    from multiprocessing.context import SpawnProcess

MAX_TRIES = 3


@dataclass
class _Worker:
    process: SpawnProcess
    pipe: Connection
    task: Task | None = None


class Processes:
    """Spawned processes play, and keep what they played.

    One that dies is replaced, and its block is played again; a block that kills ``MAX_TRIES`` of
    them fails. When this process dies, they do.

    :param size: number of processes; they are started as tasks come
    :param make: see ``Make``
    :param store: where blocks are kept
    :param report: takes a line for each process that died
    """

    def __init__(self, size: int, make: Make, store: RecordStore, report: Report = print) -> None:
        self.size = size
        self._make, self._store, self._report = make, store, report
        self._context = multiprocessing.get_context("spawn")
        self._workers: list[_Worker] = []
        self._deaths: dict[tuple[int, Span], int] = {}

    @property
    def has_room(self) -> bool:
        """Whether a process has nothing to do, or can be started."""
        return len(self._busy()) < self.size

    def _busy(self) -> list[_Worker]:
        return [worker for worker in self._workers if worker.task is not None]

    def submit(self, task: Task) -> None:
        """Give a task to a process."""
        for worker in self._workers:
            if worker.task is None:
                break
        else:
            worker = self._start()
        worker.task = task
        # One that died meanwhile is noticed when its answer is waited for.
        with suppress(OSError):
            worker.pipe.send(task)

    def _start(self) -> _Worker:
        here, there = self._context.Pipe()
        process = self._context.Process(
            target=_work, args=(there, self._make, self._store.folder), daemon=True
        )
        with _no_interrupt():
            process.start()
        there.close()
        self._workers.append(_Worker(process, here))
        return self._workers[-1]

    def wait(self) -> Finished:
        """Wait for a process to finish its task."""
        while True:
            ready = wait([worker.pipe for worker in self._busy()])
            worker = next(one for one in self._busy() if one.pipe in ready)
            task = worker.task
            assert task is not None
            try:
                answer = worker.pipe.recv()
            except (EOFError, OSError):
                failed = self._bury(worker, task)
                if failed is not None:
                    return failed
                continue
            worker.task = None
            return Finished(task, *answer)

    def _bury(self, worker: _Worker, task: Task) -> Finished | None:
        """Replace a process that died, and give its task to another, or give the task up."""
        worker.pipe.close()
        worker.process.join()
        code = worker.process.exitcode or 0
        how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        self._workers.remove(worker)
        key = (task.owner, task.span)
        self._deaths[key] = self._deaths.get(key, 0) + 1
        place = f"{task.series.row}, {task.series.column.scene}"
        if self._deaths[key] < MAX_TRIES:
            self._report(f"{place}: a process {how}; its block is played again")
            self.submit(task)
            return None
        text = f"{MAX_TRIES} processes died of a block in {place}; the last one {how}"
        return Finished(task, error=f"{text} (9: there may be too little memory)")

    def close(self) -> None:
        """Kill the processes."""
        for worker in self._workers:
            worker.process.kill()
        for worker in self._workers:
            worker.process.join()
            worker.pipe.close()
        self._workers.clear()


@contextmanager
def _no_interrupt() -> Iterator[None]:
    """Start processes that do not hear Ctrl-C: they are stopped by the one that started them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # Its start lets Ctrl-C through again, and would do so in between.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(pipe: Connection, make: Make, folder: Path) -> None:
    """Play what comes through a pipe, until its other end is closed."""
    Thread(target=_die_with_parent, daemon=True).start()
    controllers, store = Controllers(make), RecordStore(folder)
    # An end that was killed is an error of the pipe, as is one that was closed.
    with suppress(EOFError, OSError):
        while True:
            task = pipe.recv()
            # Errors of the disk are part of the answer.
            _, *answer = keep(play_block(task, controllers), store)
            pipe.send(answer)


def _die_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)
