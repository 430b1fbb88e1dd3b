"""Play the cells of a plan: what is in the store is read, what is missing is played and kept."""

from __future__ import annotations

import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from types import FrameType
from typing import NamedTuple

import torch as th

from sb3_roles.common.interrupts import interrupt
from sb3_roles.evaluation.grid.crews import Crew, Here, Make, Parcel, Task
from sb3_roles.evaluation.grid.entrants import Entrants, Results
from sb3_roles.evaluation.grid.plan import Plan
from sb3_roles.evaluation.grid.processes import Processes
from sb3_roles.evaluation.grid.progress import Left, Progress
from sb3_roles.evaluation.grid.store import RecordStore, Report, Span
from sb3_roles.evaluation.grid.survey import Pack, Part, Survey


class Outcome(NamedTuple):
    """What :func:`play` returns.

    :param results: without the rows that failed
    :param failures: name of a row that failed -> one line
    :param parcels: name of a row that did not fail, and has an entrant -> what its first one was
        made of; its ``open`` makes the controller that played
    """

    results: Results
    failures: Mapping[str, str]
    parcels: Mapping[str, Parcel]


def play(
    plan: Plan,
    entrants: Entrants,
    store: RecordStore,
    make: Make,
    jobs: int = 1,
    quick: bool = False,
    episodes: int | None = None,
    report: Report = print,
    *,
    pack: Pack = Parcel,
    crew: Crew | None = None,
    bar: bool = False,
) -> Outcome:
    """Play what is missing of a plan, and return all of it.

    A block is kept as soon as it was played, so that nothing but unfinished blocks is lost when the
    program ends, however it does. The records are the same, bit for bit but for ``TIMINGS``,
    whatever played them and in whatever order: each block is simulated as one batch, on one thread.
    A row whose controller can not be made, or fails, is left out; the others are played.

    :param plan: what to play
    :param entrants: who plays for its rows
    :param store: of records
    :param make: makes the controller of an entrant; a function of a module
    :param jobs: processes that play; 1 for this one
    :param quick: play the quick form
    :param episodes: number of episodes instead of the plan's
    :param report: takes lines: finished cells, rows left out, files that can not be trusted
    :param pack: see ``Pack``; by default ``make`` reads the folders of learned entrants whenever it
        is called
    :param crew: plays instead of ``jobs`` processes, and is not closed
    :param bar: show a progress bar on stderr
    :raises OSError: if the store can not be read or written, or a disk is full
    """
    threads = th.get_num_threads()
    th.set_num_threads(1)
    try:
        store.clean()
        survey = Survey(plan, entrants, store, make, pack, quick, episodes, report)
        if crew is not None:
            _carry_out(survey, crew, report, bar)
        else:
            own = Here(make, store) if jobs == 1 else Processes(jobs, make, store, report)
            try:
                _carry_out(survey, own, report, bar)
            finally:
                own.close()
        survey.tell_mixed()
        return Outcome(survey.results(), survey.failures, survey.parcels())
    finally:
        th.set_num_threads(threads)


@contextmanager
def _interruptible() -> Iterator[Callable[[], None]]:
    """Yield what raises KeyboardInterrupt if there was a Ctrl-C.

    Where it reaches Python in the middle of a callback, the exception is printed there and lost.
    """
    heard = False

    def hear(number: int, frame: FrameType | None) -> None:
        nonlocal heard
        heard = True
        interrupt(number, frame)

    def check() -> None:
        if heard:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield check
        return
    earlier = signal.signal(signal.SIGINT, hear)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, earlier)


def _carry_out(survey: Survey, crew: Crew, report: Report, bar: bool) -> None:
    waiting = {id(part): deque(part.missing()) for part in survey.parts()}
    running: dict[tuple[int, Span], Part] = {}
    n_blocks = sum(map(len, waiting.values()))
    n_cells = len({part.cell for part in survey.parts() if waiting[id(part)]})
    progress = Progress(n_blocks, n_cells, report, bar)

    def left() -> Left:
        rest = [(part, list(waiting[id(part)])) for part in survey.parts()]
        rest += [(part, [span]) for (_, span), part in running.items()]
        seconds, known = survey.left(rest)
        return Left(seconds / crew.size, known)

    def submit_next() -> bool:
        parts = [part for part in survey.parts() if waiting[id(part)]]
        if not parts:
            return False
        # Cheap blocks first: there is something to read soon.
        part = min(parts, key=lambda one: survey.seconds_of(one, [waiting[id(one)][0]]))
        span = waiting[id(part)].popleft()
        running[id(part), span] = part
        crew.submit(Task(id(part), part.parcel, part.series, span))
        return True

    with closing(progress), _interruptible() as check:
        while True:
            check()
            while crew.has_room and submit_next():
                pass
            if not running:
                return
            done = crew.wait()
            part = running.pop((done.task.owner, done.task.span))
            if done.stop is not None:
                raise done.stop
            row = part.cell[0]
            if done.records is not None:
                survey.take(part, done.task.span, done.records)
            elif row not in survey.failures:
                survey.fail(row, done.error)
            progress.block_done(left())
            if survey.is_whole(part.cell):
                n_episodes = part.spans[-1].last
                progress.cell_done(part.cell, n_episodes, left())
