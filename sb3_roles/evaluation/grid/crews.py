"""Who plays the blocks of a grid, and how a block is played; see also ``processes``."""

from __future__ import annotations

import hashlib
import tempfile
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol

import torch as th

from area_search.scenes import get_scene
from sb3_roles.common.names import one_line
from sb3_roles.evaluation.episodes import describe, run_episodes
from sb3_roles.evaluation.grid.entrants import Entrant
from sb3_roles.evaluation.grid.store import RecordStore, Series, Span, is_full, named
from sb3_roles.evaluation.records import EpisodeRecords

if TYPE_CHECKING:
    from sb3_roles.baselines.base import Controller

Make = Callable[[Entrant], "Controller"]
"""Makes who plays for an entrant; a function of a module, so that other processes find it."""
_MAX_CONTROLLERS = 8
# Errors whose text says it all; of others, the name of the class helps.
_PLAIN = (ValueError, ImportError, OSError)


@dataclass(frozen=True)
class Parcel:
    """All that it takes to make an entrant's controller, wherever it shall play.

    :param entrant: who
    :param files: path within the run folder -> content, of a trained policy as it was when the
        parcel was packed: a training that goes on changes the folder
    """

    entrant: Entrant
    files: Mapping[str, bytes] = field(default_factory=dict)

    @cached_property
    def key(self) -> tuple[Entrant, str]:
        """Tells it from parcels of other entrants and other files."""
        digest = hashlib.sha256()
        for name, content in sorted(self.files.items()):
            digest.update(f"{name} {len(content)} ".encode() + content)
        return self.entrant, digest.hexdigest()

    def open(self, make: Make) -> Controller:
        """Make the controller.

        :param make: is given the entrant, with a folder of the files as its source
        :raises OSError: if the disk refuses the files
        """
        if not self.files:
            return make(self.entrant)
        with tempfile.TemporaryDirectory(prefix="sb3_roles-") as folder:
            for name, content in self.files.items():
                path = Path(folder, name)
                with named(path):
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.write_bytes(content)
            return make(replace(self.entrant, source=folder))


class Controllers:
    """Makes controllers, and keeps the last few: the weights of a run are loaded once.

    :param make: see ``Make``
    """

    def __init__(self, make: Make) -> None:
        self._make = make
        self._made: dict[tuple[Entrant, str], Controller] = {}

    def get(self, parcel: Parcel) -> Controller:
        """Return the controller of a parcel."""
        found = self._made.pop(parcel.key, None)
        self._made[parcel.key] = parcel.open(self._make) if found is None else found
        if len(self._made) > _MAX_CONTROLLERS:
            del self._made[next(iter(self._made))]
        return self._made[parcel.key]


class Task(NamedTuple):
    """One block to play.

    :param owner: number of whose it is, for the one who asked
    :param parcel: who plays
    :param series: what
    :param span: which episodes of it
    """

    owner: int
    parcel: Parcel
    series: Series
    span: Span


class Finished(NamedTuple):
    """What became of a task: records, which are kept, or why there are none.

    :param task: the task
    :param records: None if the controller failed
    :param error: one line about that
    :param stop: the store could not be written, or a disk is full: there is no point in going on
    """

    task: Task
    records: EpisodeRecords | None = None
    error: str = ""
    stop: OSError | None = None


class Crew(Protocol):
    """Plays tasks, in any order."""

    @property
    def size(self) -> int:
        """How many blocks are played at the same time."""

    @property
    def has_room(self) -> bool:
        """Whether one more task should be given to it now."""

    def submit(self, task: Task) -> None:
        """Take a task."""

    def wait(self) -> Finished:
        """Wait until a task is finished; each one is returned once."""

    def close(self) -> None:
        """Stop at once; what is not finished is dropped."""


def play_block(task: Task, controllers: Controllers) -> Finished:
    """Play a block, on one thread.

    :param task: what to play
    :param controllers: of this process
    :return: with an error if the controller can not be made or fails, whatever it raises; with
        ``stop`` if a disk is full
    """
    # Sums of networks depend on the number of threads.
    th.set_num_threads(1)
    (first, last), column = task.span, task.series.column
    try:
        controller = controllers.get(task.parcel)
        scene = get_scene(column.scene, n_agents=column.n_agents)
        name, wanted = task.series.row, task.series.description
        if describe(controller, scene, name) != wanted:
            raise ValueError("a worker made another controller: is its sb3_roles of this version?")
        n, seed = last - first, task.series.seed
        records = run_episodes(controller, scene, n, seed, first, batch_size=n, name=name)
    except Exception as error:
        if isinstance(error, OSError) and is_full(error):
            return Finished(task, stop=error)
        return Finished(task, error=error_line(error, task.parcel.entrant))
    return Finished(task, records)


def error_line(error: Exception, entrant: Entrant) -> str:
    """Return one line about the failure of a row.

    :param error: what was raised
    :param entrant: that failed
    """
    text = one_line(error)
    if not text or not isinstance(error, _PLAIN):
        text = f"{type(error).__name__}: {text}"
    return f"{entrant.source}: {text}" if entrant.learned and entrant.source not in text else text


def keep(finished: Finished, store: RecordStore) -> Finished:
    """Write what was played into the store."""
    if finished.records is not None:
        try:
            store.write(finished.task.series, finished.task.span, finished.records)
        except OSError as error:
            return Finished(finished.task, stop=error)
    return finished


class Here:
    """This process plays.

    :param make: see ``Make``
    :param store: where blocks are kept
    """

    size = 1

    def __init__(self, make: Make, store: RecordStore) -> None:
        self._controllers, self._store = Controllers(make), store
        self._tasks: deque[Task] = deque()

    @property
    def has_room(self) -> bool:
        """Whether nothing is to be played."""
        return not self._tasks

    def submit(self, task: Task) -> None:
        """Take a task."""
        self._tasks.append(task)

    def wait(self) -> Finished:
        """Play the task."""
        return keep(play_block(self._tasks.popleft(), self._controllers), self._store)

    def close(self) -> None:
        """Nothing is left to stop."""
