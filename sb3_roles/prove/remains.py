"""What a run and a grid of evaluations leave, as digests that times and places do not change."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_roles.common.checkpoint import Checkpoint, CheckpointFolder, encode_tree
from sb3_roles.evaluation.records import TIMINGS, EpisodeRecords, read_records
from sb3_roles.prove.training_runs import LOGS, WHOLE, untimed_rows, without_times
from sb3_roles.zoo.run_folder import CHECKPOINTS

_DECISION = "decision_us"


def digest(value: Any) -> str:
    """Return the sha256 of bytes, or of a tree of plain values, tensors and arrays.

    :param value: dtypes and shapes count, the order of keys does not
    """
    if isinstance(value, bytes):
        return hashlib.sha256(value).hexdigest()
    arrays: dict[str, np.ndarray] = {}
    text = json.dumps(encode_tree(_as_arrays(value), arrays), sort_keys=True)
    found = hashlib.sha256(text.encode())
    for name in sorted(arrays):
        one = arrays[name]
        found.update(f"{name} {one.dtype.str} {one.shape}".encode() + one.tobytes())
    return found.hexdigest()


def _as_arrays(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _as_arrays(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_arrays(item) for item in value]
    return value.numpy() if isinstance(value, th.Tensor) else value


def remains_of_checkpoint(checkpoint: Checkpoint) -> dict[str, str]:
    """Return what a checkpoint holds, but for times: digests by name.

    :param checkpoint: of a run
    """
    return {
        "weights": digest(checkpoint.policy),
        "optimizer": digest(checkpoint.optimizer),
        "state": digest(without_times(checkpoint.state)),
        "steps": digest(checkpoint.manifest["env_steps"]),
    }


def remains_of_run(run: Path) -> dict[str, str]:
    """Return what a run folder holds, but for times and places: digests by name.

    :param run: the folder
    """
    folder = CheckpointFolder(run / CHECKPOINTS)
    found = remains_of_checkpoint(folder.newest()[1])
    found["names of checkpoints"] = digest([path.name for path in folder.paths()])
    found |= {name: digest(untimed_rows(run / name)) for name in LOGS}
    whole = {name: run / name for name in WHOLE}
    return found | {name: digest(one.read_bytes()) for name, one in whole.items() if one.exists()}


def remains_of_records(records: EpisodeRecords) -> str:
    """Return a digest of records, but for the times of decisions and for places.

    :param records: of episodes
    """
    parts = {one.name: getattr(records, one.name) for one in fields(records)}
    return digest({name: part for name, part in parts.items() if name not in TIMINGS})


def remains_of_tables(folder: Path) -> dict[str, str]:
    """Return what ``tables`` has written, but for times of decisions: digests by name.

    :param folder: its ``--out``
    """
    return dict(_of_tables(folder))


def _of_tables(folder: Path) -> Iterator[tuple[str, str]]:
    for name, between in (("tables.md", "|"), ("tables.tex", "&")):
        lines = (folder / name).read_text(encoding="utf-8").splitlines()
        # The times of decisions are the last cell of a row.
        yield name, digest([line.strip(" |").rpartition(between)[0] or line for line in lines])
    text = (folder / "tables.csv").read_text(encoding="utf-8")
    rows = list(csv.DictReader(io.StringIO(text, newline="")))
    yield "tables.csv", digest([{k: v for k, v in row.items() if k != _DECISION} for row in rows])
    for path in sorted(folder.rglob("*.parquet")):
        yield str(path.relative_to(folder)), remains_of_records(read_records(path))


def first_odd(one: Mapping[str, str], other: Mapping[str, str]) -> str:
    """Return the names of what differs, a few words; empty if nothing does.

    :param one: of this module
    :param other: of the same thing done again
    """
    odd = [name for name in {**one, **other} if one.get(name) != other.get(name)]
    more = f" and {len(odd) - 3} more" if len(odd) > 3 else ""
    return f"{', '.join(odd[:3])}{more}"
