"""A folder of records, in blocks: what was played once is not played again.

A block is the episodes ``first .. last - 1`` of one controller in one column. Blocks lie on a fixed
grid, and one that is asked for is either there as a whole or played as a whole: results do not
depend on where a run was interrupted, nor on what was asked for before.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_roles.common.files import remove_stale
from sb3_roles.common.names import one_line
from sb3_roles.evaluation.grid.plan import Column
from sb3_roles.evaluation.records import (
    EpisodeRecords,
    RecordsError,
    UnreadableError,
    read_records,
    write_records,
)

SUFFIX, DAMAGED = ".parquet", ".damaged"
_DIGITS = 16
# Of the machine and not of a file: the next one would fare no better.
_STOP = (errno.EMFILE, errno.ENFILE, errno.EIO, errno.ENOMEM)
_FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))

Report = Callable[[str], None]
"""Takes one line for the user."""


def is_full(error: BaseException) -> bool:
    """Whether an error says that a disk, or the user's part of it, is full."""
    return isinstance(error, OSError) and error.errno in _FULL


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Let an error of the disk be about a path that users know: no temporary file, nor none."""
    try:
        yield
    except OSError as error:
        error.filename = str(path)
        raise


class Span(NamedTuple):
    """Episodes ``first .. last - 1``."""

    first: int
    last: int


def spans(n_episodes: int, block: int) -> list[Span]:
    """Return the blocks of episodes 0 .. n_episodes - 1; the last one may be shorter.

    :param n_episodes: at least 1
    :param block: episodes of a block, at least 1
    """
    return [Span(low, min(low + block, n_episodes)) for low in range(0, n_episodes, block)]


@dataclass(frozen=True)
class Series:
    """The stream of episodes that one controller plays in one column.

    :param row: name of the row it plays for
    :param column: where
    :param description: what :func:`~sb3_roles.evaluation.episodes.describe` says of it, with the
        row as the name
    :param seed: of the stream
    """

    row: str
    column: Column
    description: Mapping[str, Any]
    seed: int

    @property
    def folder(self) -> Path:
        """Where its blocks are, within the folder of the store."""
        place = f"{self.column.scene}-{self.column.n_agents}"
        digest = self.description["config_hash"][:_DIGITS]
        return Path(self.row, place, f"{digest}-{self.seed}")


class RecordStore:
    """Keeps blocks of records, one file each.

    Several processes may use one store: files appear whole, and writers of the same block write the
    same records. Nothing is deleted but partial files that a killed writer left behind.

    :param folder: of the store; it is made when something is written
    :param report: takes a line for each file that can not be trusted
    :param set_aside: rename such files, so that they can be looked at; otherwise they stay until
        they are replaced
    """

    def __init__(self, folder: Path, report: Report = print, set_aside: bool = True) -> None:
        self.folder, self._report, self._set_aside = folder, report, set_aside

    def path(self, series: Series, span: Span) -> Path:
        """Return the file of a block: ``<row>/<scene>-<robots>/<hash>-<seed>/<first>-<last>``."""
        return self.folder / series.folder / f"{span.first}-{span.last}{SUFFIX}"

    def read(self, series: Series, span: Span) -> EpisodeRecords | None:
        """Read a block.

        :param series: whose it is
        :param span: its episodes
        :return: None if it is not there, or its file can not be read, is damaged or of something
            else
        :raises OSError: if nothing can be read now: there are too many open files, the disk fails,
            or the memory is full
        """
        path = self.path(series, span)
        if not path.is_file():
            return None
        try:
            records = read_records(path)
            _check(path, records, series, span)
        except UnreadableError as error:
            # It may be sound: it stays until it is replaced.
            number = getattr(error.error, "errno", None)
            if number in _STOP:
                raise OSError(number, os.strerror(number), str(path)) from error
            self._report(f"{one_line(error)}; it is played again")
            return None
        except RecordsError as error:
            self._report(f"{one_line(error)}; {self._put_aside(path)}it is played again")
            return None
        return records

    def write(self, series: Series, span: Span, records: EpisodeRecords) -> None:
        """Keep a block.

        :param series: whose it is
        :param span: its episodes
        :param records: of these episodes
        :raises OSError: if the disk refuses
        """
        path = self.path(series, span)
        with named(path):
            write_records(records, path)

    def clean(self) -> None:
        """Remove partial files of writers that were killed, see ``files.remove_stale``."""
        remove_stale(self.folder, below=True)

    def unused(self, rows: Collection[str], used: Collection[Series]) -> list[Path]:
        """Find records of the same rows that are not those of any series in use.

        :param rows: names of rows
        :param used: series of which records are used
        :return: folders of other versions, weights or seeds, below that of the store
        """
        folders = {series.folder for series in used}
        places = {folder.parent for folder in folders}
        found = [
            path.relative_to(self.folder) for row in rows for path in self.folder.glob(f"{row}/*/*")
        ]
        return [path for path in sorted(found) if path.parent in places and path not in folders]

    def _put_aside(self, path: Path) -> str:
        if not self._set_aside:
            return ""
        number, target = 1, path.with_name(path.name + DAMAGED)
        while target.exists():
            number += 1
            target = path.with_name(f"{path.name}{DAMAGED}-{number}")
        try:
            path.rename(target)
        except OSError:
            # A read-only folder, or another process was faster.
            return ""
        return f"renamed to {target.name}, "


def _check(path: Path, records: EpisodeRecords, series: Series, span: Span) -> None:
    """Refuse a sound file that is not what its place says; its header may be anybody's."""
    wanted = {**series.description, "seed": series.seed}
    for key, value in wanted.items():
        if records.metadata[key] != value:
            raise RecordsError(f"{path}: its {key} is not that of the records that belong there")
    if not np.array_equal(records.episode, np.arange(*span)):
        raise RecordsError(f"{path}: holds other episodes than its name says")


def concatenate(blocks: Sequence[EpisodeRecords]) -> EpisodeRecords:
    """Join the records of consecutive blocks of one series.

    :param blocks: at least one, in the order of their episodes
    :return: ``timing`` holds the sum of the seconds and the largest batch; ``versions`` that differ
        are listed
    :raises ValueError: if they are not of one series, or an episode is missing
    """
    first = blocks[0]
    if len(blocks) == 1:
        return first
    shared = {key: value for key, value in first.metadata.items() if key != "versions"}
    for block in blocks:
        if {key: value for key, value in block.metadata.items() if key != "versions"} != shared:
            raise ValueError("the blocks are not of one controller, scene and seed")
    episode = np.concatenate([block.episode for block in blocks])
    if np.any(np.diff(episode) != 1):
        raise ValueError("the blocks are not consecutive")

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(block, name) for block in blocks])

    return EpisodeRecords(
        metadata={**first.metadata, "versions": _versions(blocks)},
        episode=episode,
        length=joined("length"),
        counts={
            name: np.concatenate([block.counts[name] for block in blocks]) for name in first.counts
        },
        n_free=joined("n_free"),
        n_targets=joined("n_targets"),
        distance=joined("distance"),
        roles=joined("roles"),
        decision_seconds=joined("decision_seconds"),
        timing={
            "seconds": sum(block.seconds for block in blocks),
            "batch_size": max(block.timing["batch_size"] for block in blocks),
        },
        bounds=joined("bounds"),
    )


def _versions(blocks: Sequence[EpisodeRecords]) -> dict[str, str]:
    names = dict.fromkeys(name for block in blocks for name in block.metadata["versions"])
    found = {}
    for name in names:
        several = {block.metadata["versions"].get(name, "none") for block in blocks}
        found[name] = ", ".join(sorted(several))
    return found
