"""What two training runs have in common."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_roles.common.checkpoint import Checkpoint

TIMINGS = ("time/fps", "time/time_elapsed")
"""Columns of ``progress.csv`` that differ from one run to the next; no others do."""
LOGS = ("progress.csv", "roles.csv", "evaluations.csv")


def without_times(state: Mapping[str, Any]) -> dict[str, Any]:
    """Return a checkpoint's state without the seconds that were measured."""
    return {key: value for key, value in state.items() if key != "elapsed_ns"}


def untimed_rows(path: Path) -> list[list[str]]:
    """Read a log without the columns of times; an empty list where there is none.

    :param path: of a csv file
    """
    if not path.exists():
        return []
    with open(path, encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    timed = {i for i, name in enumerate(rows[0]) if name in TIMINGS}
    return [[cell for i, cell in enumerate(row) if i not in timed] for row in rows]


def difference(a: Any, b: Any, where: str) -> str | None:
    """Return the place of the first difference of two trees of values and arrays; None for none.

    Values are equal bit by bit: types, dtypes and shapes count, and a NaN is equal to a NaN.

    :param a: dicts, lists, tensors, arrays and plain values
    :param b: the other one
    :param where: what the place is called
    """
    if type(a) is not type(b):
        return f"{where} ({type(a).__name__}, {type(b).__name__})"
    if isinstance(a, dict):
        if set(a) != set(b):
            return f"{where}/{min(set(a) ^ set(b), key=str)} (in one only)"
        pairs = [(f"{where}/{key}", a[key], b[key]) for key in a]
    elif isinstance(a, (list, tuple)):
        if len(a) != len(b):
            return f"{where} ({len(a)} and {len(b)} entries)"
        pairs = [(f"{where}/{i}", x, y) for i, (x, y) in enumerate(zip(a, b, strict=True))]
    elif isinstance(a, (np.ndarray, th.Tensor)):
        return None if _same_array(a, b) else where
    else:
        return None if a == b or (a != a and b != b) else f"{where} ({a!r}, {b!r})"
    found = (difference(x, y, place) for place, x, y in pairs)
    return next((place for place in found if place is not None), None)


def _same_array(a: Any, b: Any) -> bool:
    if a.dtype != b.dtype or a.shape != b.shape:
        return False
    if isinstance(a, th.Tensor):
        return th.equal(a, b)
    return bool(np.array_equal(a, b, equal_nan=a.dtype.kind == "f"))


def checkpoint_difference(a: Checkpoint, b: Checkpoint) -> str | None:
    """Return where two checkpoints of one run differ, but for times; None if they do not.

    :param a: one
    :param b: the other
    """
    steps = "env_steps"
    for name, one, other in (
        (steps, a.manifest[steps], b.manifest[steps]),
        ("policy", a.policy, b.policy),
        ("optimizer", a.optimizer, b.optimizer),
        ("state", without_times(a.state), without_times(b.state)),
    ):
        found = difference(one, other, name)
        if found is not None:
            return found
    return None


def log_difference(a: Path, b: Path) -> str | None:
    """Return the name of the first log that differs between two run folders; None for none.

    :param a: one
    :param b: the other
    """
    return next((name for name in LOGS if untimed_rows(a / name) != untimed_rows(b / name)), None)
