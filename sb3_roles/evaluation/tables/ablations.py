"""Tables of variants that are compared with one of them, as Markdown and CSV."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sb3_roles.common.files import csv_bytes
from sb3_roles.evaluation.grid.entrants import Played, Results
from sb3_roles.evaluation.grid.plan import Column, Plan, Table
from sb3_roles.evaluation.metrics import MEANINGS, summarize
from sb3_roles.evaluation.tables.differences import ALIKE, Difference, difference
from sb3_roles.evaluation.tables.scores import check_results
from sb3_roles.evaluation.tables.text import DASH
from sb3_roles.evaluation.tables.writers import aligned, markdown_text

COMPARED = ("cover", "explo_paper")
"""Metrics of which differences are shown; the first one decides first."""
CSV_COLUMNS = (
    *("study", "scene", "n_agents", "variant", "label", "change", "metric"),
    *("mean", "lowest", "highest", "reference", "difference", "low", "high", "verdict"),
    *("over_seeds", "n_timesteps", "seeds", "n_episodes", "drawn", "note"),
)
_DAGGER = "\N{DAGGER}"


class About(NamedTuple):
    """What readers are told of a variant.

    :param change: what it has otherwise than the reference of the study; empty for that itself
    :param n_timesteps: joint steps that its runs are trained for
    :param n_seeds: runs that it should have
    """

    change: str
    n_timesteps: int
    n_seeds: int


class Spread(NamedTuple):
    """The scores of some runs; None: does not exist, as a time that a run never gets to.

    :param mean: over the runs
    :param lowest: of the runs
    :param highest: of the runs
    """

    mean: float | None
    lowest: float | None
    highest: float | None


@dataclass(frozen=True)
class Line:
    """One variant in one column.

    :param variant: name of its row in the plan
    :param about: it
    :param seeds: of the runs that played; empty if none did
    :param n_episodes: of each run; 0 if none played
    :param scores: metric -> what the runs score, percent or steps; empty if none played
    :param differences: metric of ``COMPARED`` -> from the reference, percentage points; empty where
        one of the two did not play, and for the reference
    """

    variant: str
    about: About
    seeds: tuple[int, ...]
    n_episodes: int
    scores: Mapping[str, Spread]
    differences: Mapping[str, Difference]

    @property
    def verdict(self) -> str:
        """What the intervals tell, in a word or two; empty without a difference."""
        if not self.differences:
            return ""
        words = {metric: each.verdict for metric, each in self.differences.items()}
        told = [f"{metric} {word}" for metric, word in words.items() if word != ALIKE]
        text = ALIKE if not told else ", ".join(told)
        if len(told) == len(words) and len(set(words.values())) == 1:
            text = next(iter(words.values()))
        over_seeds = all(each.over_seeds for each in self.differences.values())
        return text if over_seeds else f"{text} {_DAGGER}"


@dataclass(frozen=True)
class StudyTable:
    """A study in one column.

    :param study: its table in the plan; the first row is the reference
    :param column: where
    :param note: for readers
    :param lines: one for each row
    """

    study: Table
    column: Column
    note: str
    lines: tuple[Line, ...]


def compare(
    study: Table, note: str, about: Mapping[str, About], results: Results
) -> list[StudyTable]:
    """Score the variants of a study, and compare them with the first one.

    :param study: a table of the plan, the reference first
    :param note: for readers
    :param about: variant -> what readers are told of it
    :param results: what was played; cells may be missing
    :return: one for each column
    :raises ValueError: if a cell holds other episodes than the others
    """
    cells = {cell: played for cell, played in results.items() if cell[0] in study.rows}
    check_results(cells)
    tables = []
    for column in study.columns:
        reference = results.get((study.rows[0], column), ())
        lines = tuple(
            _line(name, about[name], study, results.get((name, column), ()), reference)
            for name in study.rows
        )
        tables.append(StudyTable(study, column, note, lines))
    return tables


def _line(
    name: str, about: About, study: Table, played: Sequence[Played], reference: Sequence[Played]
) -> Line:
    if not played:
        return Line(name, about, (), 0, {}, {})
    summaries = [summarize(records) for _, records in played]
    scores = {
        metric: _spread([each[metric]["mean"] for each in summaries]) for metric in study.metrics
    }
    seeds = tuple(who.training_seed for who, _ in played if who.training_seed is not None)
    differences = {}
    if reference and name != study.rows[0]:
        same = [who.source for who, _ in played] == [who.source for who, _ in reference]
        differences = {
            metric: difference(_finals(played, metric), _finals(reference, metric), same)
            for metric in COMPARED
        }
    return Line(name, about, seeds, len(played[0].records.episode), scores, differences)


def _spread(values: Sequence[float | None]) -> Spread:
    known = [value for value in values if value is not None]
    # A mean of some of the runs would pass for one of all.
    if len(known) < len(values):
        return Spread(None, None, None)
    return Spread(float(np.mean(known)), min(known), max(known))


def _finals(played: Sequence[Played], metric: str) -> np.ndarray:
    """Return what episodes end with, percent: float64 (runs, episodes)."""
    return np.array([100.0 * records.curves[metric][:, -1] for _, records in played])


def to_markdown(
    tables: Sequence[StudyTable], plan: Plan, commands: Sequence[str], made_by: str
) -> str:
    """Write studies for people.

    :param tables: of all studies
    :param plan: of the studies
    :param commands: that train the runs, one a line
    :param made_by: command line that wrote this
    """
    parts = [
        "# Ablations",
        f"Made by `{made_by}`.",
        "\n".join(f"* {x}" for x in _notes(tables, plan)),
    ]
    for name, study in plan.tables.items():
        own = [table for table in tables if table.study.name == name]
        parts.append(f"## {markdown_text(study.caption)}")
        parts += [markdown_text(own[0].note)] if own and own[0].note else []
        for table in own:
            scene = study.scenes[table.column.scene]
            parts.append(f"**{markdown_text(scene)}, {table.column.n_agents} robots**")
            parts.append(_markdown_table(table, plan))
            notes = "\n".join(f"* {note}" for note in _own_notes(table, plan))
            parts += [notes] if notes else []
    if commands:
        parts += ["## Trainings", "```\n" + "\n".join(commands) + "\n```"]
    return "\n\n".join(parts) + "\n"


def _notes(tables: Sequence[StudyTable], plan: Plan) -> Iterator[str]:
    counts = sorted({line.n_episodes for table in tables for line in table.lines if line.seeds})
    episodes = " to ".join(f"{count:,}" for count in dict.fromkeys((*counts[:1], *counts[-1:])))
    yield (
        f"{episodes or 'No'} episodes of each run: those of the held-out stream of seed "
        f"{plan.seed}, which no training plays, neither to learn nor to select, and on which no "
        "table of results is made. All runs play the same ones."
    )
    yield (
        "A score is the mean of the runs' means, (lowest .. highest run) behind it; "
        f"time_e_paper is {MEANINGS['time_e_paper'].text}, and one of several runs is a mean only "
        "where all of them get there."
    )
    yield (
        "Differences are from the first line, in percentage points, with a 95 % interval "
        "(Student's t) that holds the noise of the paired episodes and of the trainings, which are "
        "taken for two independent samples of one variance, and are paired where the same weights "
        "play with other roles."
    )
    yield (
        f"Helped: {ALIKE}, unless the interval is on one side of 0. {_DAGGER}: one run each, so "
        "that the interval is over episodes only and speaks for these weights; another training "
        "may come out otherwise."
    )
    n = sum(len(line.differences) for table in tables for line in table.lines)
    if n:
        yield (
            f"There are {n} intervals here. Of equal variants, one interval in twenty is on one "
            f"side of 0 by chance, and of those with {_DAGGER} more."
        )


def _own_notes(table: StudyTable, plan: Plan) -> Iterator[str]:
    for line in table.lines:
        row = plan.rows[line.variant]
        drawn = "its actions are drawn" if row.drawn else ""
        about = "; ".join(text for text in (row.about, drawn) if text)
        if about:
            yield f"{markdown_text(row.label)}: {markdown_text(about)}."
        if line.about.n_timesteps != table.lines[0].about.n_timesteps:
            yield f"{markdown_text(row.label)}: of another budget than the first line."


def _markdown_table(table: StudyTable, plan: Plan) -> str:
    header = ["Variant", "Changed", *(MEANINGS[metric].short for metric in table.study.metrics)]
    header += [f"{metric} difference" for metric in COMPARED]
    lines = [[*header, "Helped", "Joint steps", "Runs"]]
    for line in table.lines:
        change = "" if line is table.lines[0] else line.about.change or "nothing"
        cells = [plan.rows[line.variant].label, change]
        cells += [_score(line.scores.get(metric)) for metric in table.study.metrics]
        cells += [_signed(line.differences.get(metric)) for metric in COMPARED]
        n_runs = f"{len(line.seeds)}"
        if len(line.seeds) < line.about.n_seeds:
            n_runs += f" of {line.about.n_seeds}"
        verdict = "reference" if line is table.lines[0] else line.verdict
        lines.append(
            [
                markdown_text(cell)
                for cell in (*cells, verdict, f"{line.about.n_timesteps:,}", n_runs)
            ]
        )
    return aligned(lines, texts=2)


def _score(spread: Spread | None) -> str:
    if spread is None or spread.mean is None:
        return DASH
    if spread.lowest == spread.highest:
        return f"{spread.mean:.1f}"
    return f"{spread.mean:.1f} ({spread.lowest:.1f} .. {spread.highest:.1f})"


def _signed(found: Difference | None) -> str:
    if found is None:
        return DASH
    if found.low is None:
        return f"{found.mean:+.1f}"
    return f"{found.mean:+.1f} ({found.low:+.1f} .. {found.high:+.1f})"


def to_csv(tables: Sequence[StudyTable], plan: Plan) -> bytes:
    """Write studies as a csv file, one line for each variant, column and metric.

    :param tables: of all studies
    :param plan: of the studies
    """
    return csv_bytes(CSV_COLUMNS, _csv_lines(tables, plan))


def _csv_lines(tables: Sequence[StudyTable], plan: Plan) -> Iterator[list[object]]:
    for table in tables:
        for line in table.lines:
            row = plan.rows[line.variant]
            for metric in table.study.metrics:
                spread = line.scores.get(metric, Spread(None, None, None))
                found = line.differences.get(metric)
                compared: list[object] = [""] * 6
                if found is not None:
                    numbers = map(_number, (found.mean, found.low, found.high))
                    compared = [table.study.rows[0], *numbers, found.verdict, found.over_seeds]
                yield [
                    *(table.study.name, *table.column, line.variant, row.label, line.about.change),
                    *(metric, *map(_number, spread), *compared, line.about.n_timesteps),
                    *(" ".join(map(str, line.seeds)), line.n_episodes or "", row.drawn, row.about),
                ]


def _number(value: float | None) -> str:
    return "" if value is None else format(value, ".6g")
