"""From what was played to tables: the numbers, their intervals, and the paper's beside them.

``tables.writers`` writes them as Markdown, LaTeX and CSV.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from sb3_roles.common.names import span_text
from sb3_roles.evaluation.grid.entrants import Entrant, Played, Results
from sb3_roles.evaluation.grid.plan import Column, Plan, Row, Table
from sb3_roles.evaluation.tables.aggregate import Comparison, last_value, time_above
from sb3_roles.evaluation.tables.notes import most_episodes, notes_of
from sb3_roles.evaluation.tables.scores import (
    CURVES,
    Score,
    check_results,
    decision_of,
    score_cell,
    score_scenes,
    values_of,
)


@dataclass(frozen=True)
class Value:
    """One number of a table.

    :param mean: percent or steps; None: does not exist, a dash
    :param low: lower end of the 95 % interval, None where there is none
    :param high: its upper end
    :param unit: ``"%"`` or ``"steps"``
    :param printed: whether the paper prints this cell; a dash counts
    :param paper: what it prints; None for a dash, and for what is not printed
    :param best: better than every other row of the table but the bounds, see
        ``aggregate.Comparison``
    :param n_episodes: of each training run; the fewest, where they differ
    :param n_seeds: training runs; 0 for a scripted row
    :param share: of the episodes that get there, in [0, 1]; ``t90_true`` only
    """

    mean: float | None
    low: float | None
    high: float | None
    unit: str
    printed: bool
    paper: float | None
    best: bool
    n_episodes: int
    n_seeds: int
    share: float | None

    @property
    def capped(self) -> bool:
        """Whether the paper prints 100 %, which stands for 100 or more."""
        return is_capped(self.paper, self.unit)

    @property
    def difference(self) -> float | None:
        """Mean minus the paper's number; None if one is missing, or both are 100 % or more.

        A mean below a printed 100 % is behind by at least this difference.
        """
        if self.mean is None or self.paper is None or (self.capped and self.mean >= self.paper):
            return None
        return self.mean - self.paper


def is_capped(paper: float | None, unit: str) -> bool:
    """Say whether a printed number stands for 100 % or more.

    :param paper: as printed
    :param unit: of the metric
    """
    return unit == "%" and paper is not None and paper >= 100


@dataclass(frozen=True)
class TableRow:
    """One row of a table.

    :param name: key of the row in the plan
    :param label: what readers see
    :param about: half a sentence for readers
    :param learned: whether it is trained
    :param drawn: its actions are drawn, instead of the likeliest ones being taken
    :param bound: it knows what a team can not know, and is no rival
    :param budget: what it was trained for, ``"3 runs of 500,000 joint steps"``; ``"not trained"``
        without a run; empty for a scripted row
    :param values: (column, metric) -> number; what was not played is missing
    :param overall: (robots, metric) -> number over all scenes of the table; only where there are
        two or more and the row played all of them, and for ``explo_paper``, ``explo_true`` and
        ``cover``
    :param decision: column -> median seconds of a decision on a joint step, a team's share of that
        for all teams of its batch
    :param batch: teams that were decided for together, at most; 0 if nothing was played
    :param shipped: the weights that come with this package have played
    """

    name: str
    label: str
    about: str
    learned: bool
    drawn: bool
    bound: bool
    budget: str
    values: Mapping[tuple[Column, str], Value]
    overall: Mapping[tuple[int, str], Value]
    decision: Mapping[Column, float]
    batch: int
    shipped: bool = False

    def decision_over(self, columns: Iterable[Column]) -> float | None:
        """Return the median of the decision times in some columns.

        :param columns: of the table
        :return: seconds; None if none of them was played
        """
        times = [self.decision[column] for column in columns if column in self.decision]
        return statistics.median(times) if times else None


@dataclass(frozen=True)
class TableResult:
    """One table.

    :param spec: what it is made of
    :param rows: as in ``spec``, but bounds last
    :param notes: sentences that a reader needs with it
    :param quick: whether it is the quick form
    """

    spec: Table
    rows: tuple[TableRow, ...]
    notes: tuple[str, ...]
    quick: bool

    @property
    def caption(self) -> str:
        """Number and caption, and, if so, that it is the quick form."""
        caption = f"Table {self.spec.name}. {self.spec.caption}."
        if not self.quick:
            return caption
        return f"{caption} QUICK FORM: {most_episodes(self.rows)} episodes, for a look only."


def make_tables(plan: Plan, results: Results, quick: bool = False) -> dict[str, TableResult]:
    """Make the tables of a plan.

    :param plan: which tables
    :param results: what was played, may be a part of what the plan asks for
    :param quick: whether they are the quick form, which the captions then say
    :return: name of a table -> table. The same for the same episodes, but for decision times
    :raises ValueError: if the results are not of the same episodes
    """
    stream = check_results(results)
    played = {cell: list(entrants) for cell, entrants in results.items() if entrants}
    # Tables share cells.
    needed = {
        (row, column)
        for spec in plan.tables.values()
        for row in spec.rows
        for column in spec.columns
    }
    scores = {cell: score_cell(entrants) for cell, entrants in played.items() if cell in needed}
    comparison = Comparison()
    tables = {}
    for name, spec in plan.tables.items():
        rows = [_row(plan.rows[row], spec, played, scores) for row in spec.rows]
        rows = _marked(rows, spec, played, comparison)
        rows.sort(key=lambda row: row.bound)
        notes = notes_of(plan, spec, rows, stream, quick)
        tables[name] = TableResult(spec, tuple(rows), tuple(notes), quick)
    return tables


_Played = Mapping[tuple[str, Column], Sequence[Played]]


def _row(
    row: Row,
    spec: Table,
    played: _Played,
    scores: Mapping[tuple[str, Column], Mapping[str, Score]],
) -> TableRow:
    values, decision = {}, {}
    for column in spec.columns:
        if (row.name, column) not in played:
            continue
        decision[column] = decision_of(played[row.name, column])
        for metric in spec.metrics:
            printed = (row.name, column, metric) in spec.paper
            paper = spec.paper.get((row.name, column, metric))
            values[column, metric] = _value(scores[row.name, column][metric], printed, paper)
    overall = {}
    for n_agents, columns in columns_by_team(spec).items():
        cells = _cells(row.name, columns, played)
        if len(columns) > 1 and cells:
            for metric, score in score_scenes(cells).items():
                if metric in spec.metrics:
                    overall[n_agents, metric] = _value(score)
    own = [entrants for (name, _), entrants in played.items() if name == row.name]
    budget = _budget([one.entrant for entrants in own for one in entrants])
    return TableRow(
        row.name,
        row.label,
        row.about,
        row.learned,
        row.drawn,
        row.bound,
        budget if row.learned else "",
        values,
        overall,
        decision,
        max((one.records.timing["batch_size"] for ones in own for one in ones), default=0),
        any(one.entrant.shipped for ones in own for one in ones),
    )


def _value(score: Score, printed: bool = False, paper: float | None = None) -> Value:
    mean, low, high, unit, share, n_episodes, n_seeds = score
    return Value(mean, low, high, unit, printed, paper, False, n_episodes, n_seeds, share)


def columns_by_team(spec: Table) -> dict[int, list[Column]]:
    """Return the columns of a table by their number of robots.

    :param spec: the table
    """
    teams: dict[int, list[Column]] = {}
    for column in spec.columns:
        teams.setdefault(column.n_agents, []).append(column)
    return teams


def _cells(row: str, columns: Sequence[Column], played: _Played) -> list[Sequence[Played]]:
    """Return what a row played in all of the columns; nothing unless it played them all."""
    cells = [played[row, column] for column in columns if (row, column) in played]
    return cells if len(cells) == len(columns) else []


def _budget(entrants: Sequence[Entrant]) -> str:
    runs = {one.source: one.env_steps for one in entrants}
    if not runs:
        return "not trained"
    text = "1 run" if len(runs) == 1 else f"{len(runs)} runs"
    steps = sorted(each for each in runs.values() if each is not None)
    if not steps:
        return text
    return f"{text} of {span_text(steps[0], steps[-1])} joint steps"


def _marked(
    rows: Sequence[TableRow], spec: Table, played: _Played, comparison: Comparison
) -> list[TableRow]:
    """Mark the best row of each column and metric, and of all scenes together."""
    values = {row.name: dict(row.values) for row in rows}
    overall = {row.name: dict(row.overall) for row in rows}
    rivals = [row for row in rows if not row.bound]
    for metric in spec.metrics:
        # The episodes that reach 90 % are other ones for each row: there is nothing to pair.
        if metric == "t90_true":
            continue
        for column in spec.columns:
            cells = {
                row.name: [played[row.name, column]]
                for row in rivals
                if (column, metric) in row.values
            }
            best = _best(cells, metric, comparison)
            # Later than the last step is no time.
            if best is not None and values[best][column, metric].mean is not None:
                values[best][column, metric] = replace(values[best][column, metric], best=True)
        for n_agents, columns in columns_by_team(spec).items():
            cells = {
                row.name: _cells(row.name, columns, played)
                for row in rivals
                if (n_agents, metric) in row.overall
            }
            best = _best(cells, metric, comparison)
            if best is not None:
                overall[best][n_agents, metric] = replace(
                    overall[best][n_agents, metric], best=True
                )
    return [replace(row, values=values[row.name], overall=overall[row.name]) for row in rows]


def _best(
    cells: Mapping[str, Sequence[Sequence[Played]]], metric: str, comparison: Comparison
) -> str | None:
    if metric in CURVES:
        rows = {name: values_of(each, metric) for name, each in cells.items()}
        return comparison.best(rows, last_value)
    rows = {name: values_of(each, "explo_paper", whole=True) for name, each in cells.items()}
    return comparison.best(rows, time_above, larger_is_better=False)
