"""Play the cells of a plan: what is in the store is read, what is missing is played and kept."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import torch as th

from area_search.scenes import get_scene
from sb3_roles.evaluation.episodes import describe, held_out_seed
from sb3_roles.evaluation.grid.crews import (
    Controllers,
    Crew,
    Here,
    Make,
    Parcel,
    Task,
    error_line,
)
from sb3_roles.evaluation.grid.entrants import Entrant, Entrants, Played, Results
from sb3_roles.evaluation.grid.plan import Cell, Plan
from sb3_roles.evaluation.grid.processes import Processes
from sb3_roles.evaluation.grid.progress import Estimates, Progress
from sb3_roles.evaluation.grid.store import RecordStore, Report, Series, Span, concatenate, spans
from sb3_roles.evaluation.records import EpisodeRecords

Files = Callable[[Entrant], Mapping[str, bytes]]
"""Reads what a learned entrant's controller is made of, see ``Parcel``."""


class Outcome(NamedTuple):
    """What :func:`play` returns.

    :param results: without the rows that failed
    :param failures: name of a row that failed -> one line
    """

    results: Results
    failures: Mapping[str, str]


class Count(NamedTuple):
    """Blocks of a row, and the estimated time of those that are missing."""

    there: int
    missing: int
    seconds: float


@dataclass
class _Part:
    """The episodes of one entrant in one cell."""

    cell: Cell
    entrant: Entrant
    parcel: Parcel
    series: Series
    spans: list[Span]
    blocks: dict[Span, EpisodeRecords] = field(default_factory=dict)

    def missing(self) -> list[Span]:
        return [span for span in self.spans if span not in self.blocks]

    def records(self) -> EpisodeRecords:
        return concatenate([self.blocks[span] for span in self.spans])


class Survey:
    """What a plan needs, and what of it is in the store.

    :param plan: what is to be played
    :param entrants: who plays for its rows
    :param store: of records
    :param make: makes the controllers; a row for which it raises has failed
    :param files: reads the files of learned entrants; without it ``make`` reads them, in every
        process that plays
    :param quick: play the quick form
    :param episodes: number of episodes instead of the plan's
    :param report: takes a line for each row that failed
    """

    def __init__(
        self,
        plan: Plan,
        entrants: Entrants,
        store: RecordStore,
        make: Make,
        files: Files | None = None,
        quick: bool = False,
        episodes: int | None = None,
        report: Report = print,
    ) -> None:
        self.plan, self._report = plan, report
        self.estimates = Estimates()
        self.failures: dict[str, str] = {}
        self._parts: dict[str, list[_Part]] = {}
        controllers = Controllers(make)
        for name in dict.fromkeys(row for row, _ in plan.cells()):
            span_list = spans(plan.episodes_of(name, quick, episodes), plan.rows[name].block)
            self._parts[name] = []
            for entrant in entrants.get(name, ()):
                try:
                    parcel = Parcel(entrant, files(entrant) if files and entrant.learned else {})
                    self._parts[name] += self._parts_of(parcel, controllers.get(parcel), span_list)
                except Exception as error:
                    self.fail(name, error_line(error, entrant))
                    break
        self._read(store)

    def _parts_of(self, parcel: Parcel, controller: object, span_list: list[Span]) -> list[_Part]:
        seed = held_out_seed(self.plan.seed)
        found = []
        for row, column in self.plan.cells():
            if row == parcel.entrant.row:
                scene = get_scene(column.scene, n_agents=column.n_agents)
                series = Series(row, column, describe(controller, scene, row), seed)  # type: ignore[arg-type]
                found.append(_Part((row, column), parcel.entrant, parcel, series, span_list))
        return found

    def _read(self, store: RecordStore) -> None:
        for part in self.parts():
            for span in part.spans:
                records = store.read(part.series, span)
                if records is not None:
                    self.take(part, span, records)
        series = [part.series for part in self.parts()]
        others = store.unused(list(self._parts), series)
        if others:
            several = "s of records are" if len(others) > 1 else " of records is"
            self._report(
                f"{store.folder}: {len(others)} folder{several} of other weights, versions or "
                f"seeds and not used, such as {others[0]}"
            )

    def take(self, part: _Part, span: Span, records: EpisodeRecords) -> None:
        """Add a block, and learn what it took."""
        part.blocks[span] = records
        row, column = part.cell
        n_episodes = span.last - span.first
        self.estimates.add(self.plan.rows[row], column.n_agents, n_episodes, records.seconds)

    def fail(self, row: str, error: str) -> None:
        """Leave a row out."""
        self.failures[row] = error
        self._parts.pop(row, None)
        self._report(f"{row} is left out: {error}")

    def parts(self) -> list[_Part]:
        """Return the parts of all rows that did not fail."""
        return [part for parts in self._parts.values() for part in parts]

    def seconds_of(self, part: _Part, span_list: Iterable[Span]) -> float:
        """Estimate what some blocks take."""
        row, column = part.cell
        n_episodes = sum(span.last - span.first for span in span_list)
        return self.estimates.seconds(self.plan.rows[row], column.n_agents, n_episodes)

    def is_whole(self, cell: Cell) -> bool:
        """Whether nothing of a cell is missing."""
        parts = [part for part in self._parts.get(cell[0], ()) if part.cell == cell]
        return bool(parts) and not any(part.missing() for part in parts)

    def counts(self) -> dict[str, Count]:
        """Return row -> its blocks; rows that failed are missing."""
        return {
            name: Count(
                sum(len(part.blocks) for part in parts),
                sum(len(part.missing()) for part in parts),
                sum(self.seconds_of(part, part.missing()) for part in parts),
            )
            for name, parts in self._parts.items()
        }

    def results(self) -> Results:
        """Return the records, if nothing is missing."""
        found: dict[Cell, list[Played]] = {cell: [] for cell in self.plan.cells()}
        for part in self.parts():
            found[part.cell].append(Played(part.entrant, part.records()))
        return {cell: played for cell, played in found.items() if played}


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
    files: Files | None = None,
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
    :param files: reads the files of learned entrants once, so that a training that goes on
        meanwhile changes nothing; without it, ``make`` reads their folders whenever it is called
    :param crew: plays instead of ``jobs`` processes, and is not closed
    :param bar: show a progress bar on stderr
    :raises OSError: if the store can not be written
    """
    threads = th.get_num_threads()
    th.set_num_threads(1)
    try:
        store.clean()
        survey = Survey(plan, entrants, store, make, files, quick, episodes, report)
        if crew is not None:
            _carry_out(survey, crew, report, bar)
        else:
            own = Here(make, store) if jobs == 1 else Processes(jobs, make, store, report)
            try:
                _carry_out(survey, own, report, bar)
            finally:
                own.close()
        return Outcome(survey.results(), survey.failures)
    finally:
        th.set_num_threads(threads)


def _carry_out(survey: Survey, crew: Crew, report: Report, bar: bool) -> None:
    waiting = {id(part): deque(part.missing()) for part in survey.parts()}
    running: dict[tuple[int, Span], _Part] = {}
    n_blocks = sum(map(len, waiting.values()))
    n_cells = len({part.cell for part in survey.parts() if waiting[id(part)]})
    progress = Progress(n_blocks, n_cells, report, bar)

    def seconds_left() -> float:
        rest = sum(survey.seconds_of(part, waiting[id(part)]) for part in survey.parts())
        rest += sum(survey.seconds_of(part, [span]) for (_, span), part in running.items())
        return rest / crew.size

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

    try:
        while True:
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
            progress.block_done(seconds_left())
            if survey.is_whole(part.cell):
                n_episodes = part.spans[-1].last
                progress.cell_done(part.cell, n_episodes, seconds_left())
    finally:
        progress.close()
