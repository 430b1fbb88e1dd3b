"""What a plan needs of a store of records, and what of it is there."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from area_search.scenes import get_scene
from sb3_roles.evaluation.episodes import describe, held_out_seed
from sb3_roles.evaluation.grid.crews import Controllers, Make, Parcel, error_line
from sb3_roles.evaluation.grid.entrants import Entrant, Entrants, Played, Results
from sb3_roles.evaluation.grid.plan import Cell, Plan
from sb3_roles.evaluation.grid.progress import Estimates, Left
from sb3_roles.evaluation.grid.store import (
    RecordStore,
    Report,
    Series,
    Span,
    concatenate,
    is_full,
    spans,
)
from sb3_roles.evaluation.records import EpisodeRecords

Pack = Callable[[Entrant], Parcel]
"""Packs all that an entrant's controller is made of, once, so that a training that goes on changes
nothing. The entrant of the parcel may be another one: its steps are those of the packed weights."""


class Count(NamedTuple):
    """Blocks of a row, and the time of those that are missing."""

    there: int
    missing: int
    left: Left


@dataclass
class Part:
    """The episodes of one entrant in one cell.

    :param cell: who plays where
    :param entrant: that plays
    :param parcel: what it is made of
    :param series: its stream of episodes
    :param spans: its blocks
    :param blocks: records of those that are there
    """

    cell: Cell
    entrant: Entrant
    parcel: Parcel
    series: Series
    spans: list[Span]
    blocks: dict[Span, EpisodeRecords] = field(default_factory=dict)

    def missing(self) -> list[Span]:
        """Return the blocks that are not there."""
        return [span for span in self.spans if span not in self.blocks]

    def mixed_versions(self) -> str:
        """Return the packages of which the blocks state several versions; empty if there is none.

        A block that does not state a version, as older ones of OR-Tools, may be of any.
        """
        found: dict[str, set[str]] = {}
        for block in self.blocks.values():
            for name, version in block.metadata["versions"].items():
                found.setdefault(name, set()).add(version)
        return "; ".join(
            f"{name} {', '.join(sorted(several))}"
            for name, several in found.items()
            if len(several) > 1
        )

    def records(self) -> EpisodeRecords:
        """Return all of its episodes, if none is missing."""
        return concatenate([self.blocks[span] for span in self.spans])


class Survey:
    """What a plan needs, and what of it is in the store.

    :param plan: what is to be played
    :param entrants: who plays for its rows
    :param store: of records
    :param make: makes the controllers; a row for which it raises has failed
    :param pack: see ``Pack``; by default parcels are empty, and ``make`` reads the folders of
        learned entrants, in every process that plays
    :param quick: play the quick form
    :param episodes: number of episodes instead of the plan's
    :param report: takes a line for each row that failed
    :raises OSError: if the store can not be read, or a disk is full
    """

    def __init__(
        self,
        plan: Plan,
        entrants: Entrants,
        store: RecordStore,
        make: Make,
        pack: Pack = Parcel,
        quick: bool = False,
        episodes: int | None = None,
        report: Report = print,
    ) -> None:
        self.plan, self._report = plan, report
        self.estimates = Estimates()
        self.failures: dict[str, str] = {}
        self._told_mixed = False
        self._parts: dict[str, list[Part]] = {}
        controllers = Controllers(make)
        for name in dict.fromkeys(row for row, _ in plan.cells()):
            span_list = spans(plan.episodes_of(name, quick, episodes), plan.rows[name].block)
            self._parts[name] = []
            for entrant in entrants.get(name, ()):
                try:
                    parcel = pack(entrant)
                    self._parts[name] += self._parts_of(parcel, controllers.get(parcel), span_list)
                except Exception as error:
                    if is_full(error):
                        raise
                    self.fail(name, error_line(error, entrant))
                    break
        self._read(store)

    def _parts_of(self, parcel: Parcel, controller: object, span_list: list[Span]) -> list[Part]:
        seed = held_out_seed(self.plan.seed)
        found = []
        for row, column in self.plan.cells():
            if row == parcel.entrant.row:
                scene = get_scene(column.scene, n_agents=column.n_agents)
                series = Series(row, column, describe(controller, scene, row), seed)  # type: ignore[arg-type]
                found.append(Part((row, column), parcel.entrant, parcel, series, span_list))
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
        self.tell_mixed()

    def tell_mixed(self) -> None:
        """Report, once, that the records of a cell were played with several versions."""
        mixed = [(part, found) for part in self.parts() if (found := part.mixed_versions())]
        if mixed and not self._told_mixed:
            self._told_mixed = True
            part, versions = mixed[0]
            row, column = part.cell
            n_cells = len({part.cell for part, _ in mixed})
            several = "s mix" if n_cells > 1 else " mixes"
            self._report(
                f"{n_cells} cell{several} records of several versions, such as {row}, "
                f"{column.scene}, {column.n_agents} robots: {versions}"
            )

    def take(self, part: Part, span: Span, records: EpisodeRecords) -> None:
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

    def parts(self) -> list[Part]:
        """Return the parts of all rows that did not fail."""
        return [part for parts in self._parts.values() for part in parts]

    def parcels(self) -> dict[str, Parcel]:
        """Return row -> the parcel of its first entrant; rows that failed are missing."""
        return {name: parts[0].parcel for name, parts in self._parts.items() if parts}

    def seconds_of(self, part: Part, span_list: Iterable[Span]) -> float:
        """Estimate what some blocks take; of a row that was not measured it is a guess."""
        row, column = part.cell
        n_episodes = sum(span.last - span.first for span in span_list)
        return self.estimates.seconds(self.plan.rows[row], column.n_agents, n_episodes)

    def left(self, waiting: Iterable[tuple[Part, Iterable[Span]]]) -> Left:
        """Estimate what the blocks that wait take, of rows that were measured."""
        seconds, known = 0.0, True
        for part, span_list in waiting:
            if self.estimates.knows(self.plan.rows[part.cell[0]]):
                seconds += self.seconds_of(part, span_list)
            elif any(span_list):
                known = False
        return Left(seconds, known)

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
                self.left((part, part.missing()) for part in parts),
            )
            for name, parts in self._parts.items()
        }

    def results(self) -> Results:
        """Return the records, if nothing is missing."""
        found: dict[Cell, list[Played]] = {cell: [] for cell in self.plan.cells()}
        for part in self.parts():
            found[part.cell].append(Played(part.entrant, part.records()))
        return {cell: played for cell, played in found.items() if played}
