"""``EpisodeRecords``, what was measured in episodes, and its files: one Parquet table each.

``pandas.read_parquet(path)`` alone reads a file, as a tidy table with one row for each step of each
episode (none after its end):

============================ ========== ==========================================================
column                       type       meaning
============================ ========== ==========================================================
``controller``               category   its name
``seed``                     uint64     of the stream of episodes
``episode``                  int64      number of the episode in the stream
``step``                     int32      0-based joint step; the row tells what is true after it
``seen``                     int32      cells first seen so far, obstacles included, starts not
``seen_free``                int32      free cells explored so far, start discs included
``covered``                  int32      targets covered so far
``n_free``, ``n_targets``    int32      of the map: ``seen / n_free`` is explo_paper, ``seen_free /
                                        n_free`` explo_true, ``covered / n_targets`` cover
``distance_0``, ...          int16      cells that robot 0, ... has moved so far
``role_0``, ...              int8       its role in this step, an index of ``role_names``; -1: none
``decision_seconds``         float32    time of the controller's decision, for one team
``cover_bound``              float64    only where the controller knows it: targets that nobody can
                                        exceed in this episode
============================ ========== ==========================================================

Everything else is JSON in the schema's metadata, under the key ``sb3_roles``:
``json.loads(pyarrow.parquet.read_schema(path).metadata[b"sb3_roles"])``. Robots have columns of
their own instead of a list in a single one, which pandas would read as Python objects.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from area_search import kernels
from sb3_roles.common.files import open_regular, write_atomically
from sb3_roles.common.names import one_line
from sb3_roles.evaluation.header import checked_scene

if TYPE_CHECKING:
    import pyarrow

FORMAT, FORMAT_VERSION = "sb3_roles episode records", 1
_KEY = b"sb3_roles"
_MAX_VALUES = 1 << 30
NEVER = kernels.NEVER
METRICS = kernels.METRICS
NO_ROLE = -1
COUNTS = {
    "seen": kernels.SEEN,
    "seen_free": kernels.SEEN_FREE,
    "covered": kernels.COVERED_SCORED,
}
"""Counts of a record -> columns of ``BatchedAreaSearch.totals``."""
TIMINGS = ("decision_seconds", "timing")
"""Fields of :class:`EpisodeRecords` that differ from one run to the next; no others do."""


class RecordsError(ValueError):
    """A file that holds no sound records, or records that fit no file; one line."""


class UnreadableError(RecordsError):
    """A file that could not be read, so that nothing is known of what it holds.

    :param path: of the file
    :param error: why
    """

    def __init__(self, path: str | Path, error: OSError | MemoryError) -> None:
        self.error = error
        why = getattr(error, "strerror", None) or f"not enough memory: {_short_line(error)}"
        super().__init__(f"{path}: {why}")


# Without eq=False the generated comparison would ask for the truth value of whole arrays.
@dataclass(frozen=True, eq=False)
class EpisodeRecords:
    """What was measured in E episodes of one scene; row e of every array is one episode.

    Index t of a second axis, of ``horizon`` entries, holds what is true after step t + 1. Counts
    keep their last value from the end of an episode on.

    All but the fields in ``TIMINGS`` is a function of the controller, the scene, the seed and the
    numbers of the episodes: it does not depend on how many teams were simulated together.

    :param metadata: JSON values; those of :func:`describe`, and ``seed`` of the stream,
        ``role_names`` (empty without roles) and ``versions`` of python, numpy, numba, where it was
        loaded torch, and of OR-Tools if the controller uses it
    :param episode: int64 (E,), number of the episode in the stream of the seed
    :param length: int64 (E,), joint steps until the episode ended
    :param counts: int32 (E, horizon) each, counted from the start of the episode. ``seen``: cells
        first seen in steps 1 .. t + 1, obstacles included; ``seen_free``: free cells explored,
        start discs included; ``covered``: targets covered
    :param n_free: int32 (E,), free cells of the map
    :param n_targets: int32 (E,), targets of the map
    :param distance: int16, or int32 for horizons beyond its range, (E, horizon, N): cells that each
        robot has moved since the start; a blocked move is none
    :param roles: int8 (E, horizon, N), role of each robot in step t + 1; -1 after the end of the
        episode, and everywhere for controllers without roles
    :param decision_seconds: float32 (E, horizon), time that the controller took to decide on the
        step, for one team: that of its ``predict`` for the batch, divided by the teams that were
        still playing. What the simulation does to make observations is not part of it. NaN after
        the end of the episode
    :param timing: ``seconds``, wall time of the whole simulation, compilation excluded, and
        ``batch_size``, the teams that were simulated together
    :param bounds: float64 (E,), targets that nobody can exceed in the episode, as the controller
        says; NaN where it says nothing
    """

    metadata: dict[str, Any]
    episode: np.ndarray
    length: np.ndarray
    counts: dict[str, np.ndarray]
    n_free: np.ndarray
    n_targets: np.ndarray
    distance: np.ndarray
    roles: np.ndarray
    decision_seconds: np.ndarray
    timing: dict[str, Any]
    bounds: np.ndarray

    @cached_property
    def curves(self) -> dict[str, np.ndarray]:
        """``explo_paper``, ``explo_true``, ``cover`` -> float64 (E, horizon), fractions."""
        free, targets = self.n_free[:, None], self.n_targets[:, None]
        parts = {"explo_paper": ("seen", free), "explo_true": ("seen_free", free)}
        parts["cover"] = ("covered", targets)
        return {name: self.counts[parts[name][0]] / parts[name][1] for name in METRICS}

    @cached_property
    def t90_true(self) -> np.ndarray:
        """Int64 (E,), 0-based first step with explo_true >= 0.9, -1 for never."""
        return _first(self.curves["explo_true"] >= 0.9)

    @cached_property
    def t90_paper(self) -> np.ndarray:
        """Int64 (E,), 0-based first step with explo_paper > 0.9, -1 for never."""
        return _first(self.curves["explo_paper"] > 0.9)

    @property
    def path_length(self) -> np.ndarray:
        """Float64 (E,), cells that a robot moved in the episode, mean over the team."""
        return self.distance[:, -1].mean(axis=1, dtype=np.float64)

    @property
    def seconds(self) -> float:
        """Wall time of the simulation, compilation excluded."""
        return float(self.timing["seconds"])


def _first(reached: np.ndarray) -> np.ndarray:
    return np.where(reached.any(axis=1), reached.argmax(axis=1), NEVER)


def held(values: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Return curves that keep their last value after the end of their episodes.

    :param values: (E, horizon, ...), arbitrary after the end
    :param length: integer (E,), joint steps of the episodes, at least 1
    """
    index = np.minimum(np.arange(values.shape[1]), length[:, None] - 1)
    return values[np.arange(len(values))[:, None], index]


def distance_type(horizon: int) -> type[np.signedinteger[Any]]:
    """Return the smallest type for the distances of a horizon.

    :param horizon: joint steps; a robot moves at most one cell in each
    """
    return np.int16 if horizon <= np.iinfo(np.int16).max else np.int32


def write_records(records: EpisodeRecords, path: str | Path) -> None:
    """Write records to a Parquet file (zstd, pages with checksums), atomically.

    :param records: what :func:`~sb3_roles.evaluation.episodes.run_episodes` returned
    :param path: the file; its folder is made if it does not exist
    :raises RecordsError: if the seed needs more than 64 bits
    :raises OSError: if the disk refuses
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    header = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "metadata": records.metadata,
        "timing": records.timing,
        "sha256": _digest(records.metadata, records.timing),
    }
    table = pa.table(dict(_columns(records)), metadata={_KEY: json.dumps(header)})
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", write_page_checksum=True)
    write_atomically(Path(path), sink.getvalue().to_pybytes())


def _digest(*values: dict[str, Any]) -> str:
    """Vouch for what is beside the pages of a file, which have checksums of their own."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _columns(records: EpisodeRecords) -> Iterator[tuple[str, pyarrow.Array]]:
    import pyarrow as pa

    length, horizon = records.length, records.roles.shape[1]
    played = np.arange(horizon) < length[:, None]
    n_rows = int(length.sum())
    seed = records.metadata["seed"]
    if seed >= 2**64:
        raise RecordsError(f"the seed of records in a file must be below 2 ** 64, got {seed}")
    names = pa.array([records.metadata["name"]])
    yield "controller", pa.DictionaryArray.from_arrays(np.zeros(n_rows, np.int8), names)
    columns = {
        "seed": np.full(n_rows, seed, np.uint64),
        "episode": np.repeat(records.episode, length),
        "step": np.broadcast_to(np.arange(horizon, dtype=np.int32), played.shape)[played],
        **{name: counts[played] for name, counts in records.counts.items()},
        "n_free": np.repeat(records.n_free, length),
        "n_targets": np.repeat(records.n_targets, length),
    }
    for name, values in (("distance", records.distance), ("role", records.roles)):
        columns.update({f"{name}_{i}": values[played, i] for i in range(values.shape[2])})
    columns["decision_seconds"] = records.decision_seconds[played]
    if not np.isnan(records.bounds).all():
        columns["cover_bound"] = np.repeat(records.bounds, length)
    for name, column in columns.items():
        yield name, pa.array(column)


def read_records(path: str | Path) -> EpisodeRecords:
    """Read what :func:`write_records` wrote. Nothing in the file is executed.

    :param path: the file
    :return: the records, equal in every array and value to those that were written
    :raises UnreadableError: if there is no file, or the system does not let it be read
    :raises RecordsError: naming the file, if it is damaged, of another format version, or no file
        of records at all
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with open_regular(path) as file:
            # Arrow's threads, once started, may abort the process when it ends (apache/arrow
            # issue 34314): all is read in this one, which is as fast for files of this size.
            parquet = pq.ParquetFile(file, pre_buffer=False, page_checksum_verification=True)
            # A few bytes can stand for any number of equal rows.
            about = parquet.metadata
            if about.num_rows * about.num_columns > _MAX_VALUES:
                raise RecordsError(f"{path}: {about.num_rows} rows, more than are ever recorded")
            table = parquet.read(use_threads=False)
    except (OSError, pa.ArrowException) as error:
        # Of damage, Arrow raises an OSError that has no number.
        if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.strerror):
            raise UnreadableError(path, error) from None
        raise RecordsError(f"{path}: damaged, or no Parquet file: {_short_line(error)}") from error
    text = (table.schema.metadata or {}).get(_KEY)
    if text is None:
        raise RecordsError(f"{path}: a Parquet file, but not one of episode records")
    try:
        header = json.loads(text, parse_constant=_no_number)
        if header["format"] != FORMAT:
            raise RecordsError(f"{path}: a Parquet file, but not one of episode records")
        if header["format_version"] != FORMAT_VERSION:
            raise RecordsError(
                f"{path}: records of format version {header['format_version']!r}, this program "
                f"reads {FORMAT_VERSION}"
            )
        if header["sha256"] != _digest(header["metadata"], header["timing"]):
            raise RecordsError(f"{path}: damaged records: the metadata are not what was written")
        return _from_table(table, header["metadata"], header["timing"])
    except RecordsError:
        raise
    except (LookupError, TypeError, ValueError, RecursionError, pa.ArrowException) as error:
        raise RecordsError(f"{path}: damaged records: {_short_line(error)}") from error


def _no_number(name: str) -> None:
    raise ValueError(f"the metadata hold {name}, which is no JSON")


def _short_line(error: Exception) -> str:
    text = one_line(error)
    return text if len(text) <= 200 else f"{text[:197]}..."


def _from_table(
    table: pyarrow.Table, metadata: dict[str, Any], timing: dict[str, Any]
) -> EpisodeRecords:
    scene = checked_scene(metadata, timing)
    horizon = scene.horizon

    def column(name: str, dtype: Any) -> np.ndarray:
        values = table.column(name).to_numpy()
        if values.dtype != dtype:
            raise ValueError(f"column {name} is {values.dtype}, not {np.dtype(dtype)}")
        return values

    step = column("step", np.int32)
    first = np.flatnonzero(step == 0)
    length = np.diff(first, append=len(step))
    # Steps that count up from 0 in every episode: no row is missing, and none is out of place.
    if first[0] != 0 or length.max() > horizon:
        raise ValueError("the steps do not begin at 0, or go beyond the horizon")
    if not np.array_equal(step, np.arange(len(step)) - np.repeat(first, length)):
        raise ValueError("the steps of an episode do not count up from 0")
    # Only the early stop ends an episode before: the arrays are no larger than the rows account
    # for.
    if length.min() < min(horizon, scene.early_stop_patience or horizon):
        raise ValueError(f"an episode of {length.min()} steps ended before its scene can end it")
    played = np.arange(horizon) < length[:, None]

    def spread(name: str, dtype: Any, fill: float | None = None) -> np.ndarray:
        values = np.zeros(played.shape, dtype)
        values[played] = column(name, dtype)
        if fill is None:
            return held(values, length)
        values[~played] = fill
        return values

    def robots(name: str, dtype: Any, fill: float | None = None) -> np.ndarray:
        parts = [spread(f"{name}_{i}", dtype, fill) for i in range(scene.n_agents)]
        return np.stack(parts, axis=2)

    def of_map(name: str, known: int) -> np.ndarray:
        values = column(name, np.int32)[first]
        if np.any(values != known):
            raise ValueError(f"column {name} is not the scene's {known}")
        return values

    seconds = column("decision_seconds", np.float32)
    if not np.all((seconds >= 0) & (seconds < np.inf)):
        raise ValueError("column decision_seconds has entries that are no times")
    bounds = np.full(len(first), np.nan)
    if "cover_bound" in table.column_names:
        bounds = column("cover_bound", np.float64)[first]
        if np.isinf(bounds).any():
            raise ValueError("column cover_bound has entries that bound nothing")
    return EpisodeRecords(
        metadata=metadata,
        episode=column("episode", np.int64)[first],
        length=length,
        counts={name: spread(name, np.int32) for name in COUNTS},
        n_free=of_map("n_free", scene.n_free),
        n_targets=of_map("n_targets", scene.n_targets),
        distance=robots("distance", distance_type(horizon)),
        roles=robots("role", np.int8, NO_ROLE),
        decision_seconds=spread("decision_seconds", np.float32, np.nan),
        timing=timing,
        bounds=bounds,
    )
