"""The printed numbers, each with ours beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

from sb3_roles.evaluation.tables.aggregate import MIN_EPISODES

if TYPE_CHECKING:
    from sb3_roles.evaluation.grid.plan import Column
    from sb3_roles.evaluation.tables.model import TableResult, Value


class Gap(NamedTuple):
    """One printed number beside ours.

    :param table: its name
    :param row: name of the row
    :param label: what readers call the row
    :param scene: what readers call the scene
    :param n_agents: robots
    :param metric: its name
    :param paper: as printed
    :param played: whether we have played there
    :param ours: None if it was not played, or does not exist: a time that is never reached
    :param difference: ours minus the paper's; None without ours, and where both are 100 % or more
    :param reached: see :func:`is_reached`
    """

    table: str
    row: str
    label: str
    scene: str
    n_agents: int
    metric: str
    paper: float
    played: bool
    ours: float | None
    difference: float | None
    reached: bool


def is_reached(value: Value) -> bool:
    """Whether ours is at least as good as printed, or its 95 % interval ends there.

    The less is known, the wider is an interval: that of fewer than ``MIN_EPISODES`` episodes does
    not count, the mean itself has to get there.

    :param value: of a cell
    """
    if value.mean is None or value.paper is None:
        return False
    steps = value.unit == "steps"
    end = value.low if steps else value.high
    if end is None or value.n_episodes < MIN_EPISODES:
        end = value.mean
    if steps:
        return min(value.mean, end) <= value.paper
    return max(value.mean, end) >= value.paper


def printed_cells(tables: Mapping[str, TableResult]) -> list[Gap]:
    """Return every printed number with ours, the largest difference first, those not played last.

    Nothing is further away than what is never reached. A number that two tables print is listed
    once, as the first prints it.

    :param tables: by name
    """
    found: dict[tuple[str, Column, str], Gap] = {}
    for name, table in tables.items():
        for row in table.rows:
            for (row_name, column, metric), paper in table.spec.paper.items():
                key = row_name, column, metric
                if row_name != row.name or paper is None or key in found:
                    continue
                value = row.values.get((column, metric))
                found[key] = Gap(
                    name,
                    row.name,
                    row.label,
                    table.spec.scenes[column.scene],
                    column.n_agents,
                    metric,
                    paper,
                    value is not None,
                    value.mean if value else None,
                    value.difference if value else None,
                    value is not None and is_reached(value),
                )
    return sorted(found.values(), key=_size, reverse=True)


def _size(cell: Gap) -> float:
    if not cell.played:
        return -1.0
    if cell.ours is None:
        return math.inf
    return abs(cell.difference or 0.0)
