"""The cells of a table as text, the same for Markdown and LaTeX."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from sb3_roles.common.durations import short_duration
from sb3_roles.evaluation.grid.plan import Column, Table
from sb3_roles.evaluation.metrics import MEANINGS
from sb3_roles.evaluation.tables.model import (
    TableResult,
    TableRow,
    Value,
    columns_by_team,
    is_capped,
)
from sb3_roles.evaluation.tables.notes import most_episodes, seeds_of
from sb3_roles.evaluation.tables.scores import CURVES

DASH = "\N{EN DASH}"


class Text(NamedTuple):
    """One number with what stands beside it; empty: nothing.

    :param mean: ours
    :param half: half the width of its interval
    :param beside: what stands in parentheses: the share of the episodes, the paper's number, the
        difference to it
    :param best: whether ours is marked
    """

    mean: str
    half: str = ""
    beside: tuple[str, ...] = ()
    best: bool = False


class Line(NamedTuple):
    """One row in one metric."""

    label: str
    bound: bool
    cells: tuple[Text, ...]
    decision: str


@dataclass(frozen=True)
class Block:
    """One team of one table: lines, in groups by metric.

    :param n_agents: robots in the team
    :param header: of all columns, the first one is that of the labels
    :param groups: what the metric is called -> its lines
    """

    n_agents: int
    header: tuple[str, ...]
    groups: dict[str, tuple[Line, ...]]


def blocks_of(table: TableResult) -> list[Block]:
    """Lay a table out, one block for each number of robots.

    :param table: its numbers
    """
    blocks = []
    for n_agents, columns in columns_by_team(table.spec).items():
        # Without numbers for all scenes there is no column for them.
        overall = any(
            (n_agents, m) in row.overall for row in table.rows for m in table.spec.metrics
        )
        groups = {
            MEANINGS[metric].label: tuple(
                Line(
                    label_of(row, table.rows),
                    row.bound,
                    _cells(row, table.spec, metric, columns, n_agents if overall else None),
                    _decision(row, columns),
                )
                for row in table.rows
            )
            for metric in table.spec.metrics
        }
        scenes = [table.spec.scenes[column.scene] for column in columns]
        header = ("Method", *scenes, *([f"Mean of {len(scenes)}"] if overall else []), "Decision")
        blocks.append(Block(n_agents, header, groups))
    return blocks


def label_of(row: TableRow, rows: Sequence[TableRow]) -> str:
    """Return what a row is called, with the marks that the notes explain.

    :param row: the row
    :param rows: all rows of its table
    """
    label = row.label
    if row.bound:
        label += " (bound)"
    if not row.values:
        return f"{label} ({'not trained' if row.budget == 'not trained' else 'not played'})"
    marks = ""
    if row.learned and seeds_of(row) == 1:
        marks += "\N{DAGGER}"
    if min(value.n_episodes for value in row.values.values()) < most_episodes(rows):
        marks += "\N{DOUBLE DAGGER}"
    return f"{label} {marks}".strip()


def _cells(
    row: TableRow, spec: Table, metric: str, columns: Sequence[Column], overall: int | None
) -> tuple[Text, ...]:
    cells = []
    for column in columns:
        value = row.values.get((column, metric))
        if value is None:
            paper = spec.paper.get((row.name, column, metric))
            cells.append(Text(DASH, beside=() if paper is None else (_paper(paper, metric),)))
        else:
            cells.append(text_of(value, metric))
    if overall is not None:
        of_all = row.overall.get((overall, metric))
        has_any = any((column, metric) in row.values for column in columns)
        cells.append(Text(DASH if has_any else "") if of_all is None else text_of(of_all, metric))
    return tuple(cells)


def text_of(value: Value, metric: str) -> Text:
    """Return a number of a table as text.

    :param value: the number
    :param metric: what it measures
    """
    beside = []
    if value.share is not None and value.mean is not None:
        beside.append(f"{100 * value.share:.0f} %")
    if value.printed:
        beside.append(DASH if value.paper is None else _paper(value.paper, metric))
        if value.difference is not None:
            beside.append(_number(value.difference, metric, "+"))
    if value.mean is None:
        return Text(DASH, beside=tuple(beside))
    half = ""
    if value.low is not None and value.high is not None:
        half = f"{(value.high - value.low) / 2:.1f}"
    return Text(_number(value.mean, metric), half, tuple(beside), value.best)


def _paper(paper: float, metric: str) -> str:
    if is_capped(paper, "%" if metric in CURVES else "steps"):
        return "100+"
    return _number(paper, metric)


def _number(number: float, metric: str, sign: str = "-") -> str:
    # Time_E of one curve is a whole step, that of several ones their mean.
    whole = metric == "time_e_paper" and float(number).is_integer()
    return f"{number:{sign}.{0 if whole else 1}f}"


def _decision(row: TableRow, columns: Sequence[Column]) -> str:
    seconds = row.decision_over(columns)
    return "" if seconds is None else short_duration(seconds)
