"""The scores of a card, from the records that ``sb3-roles tables`` keeps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_roles.zoo.model_card import SCORE_COLUMNS, SCORES
from sb3_roles.zoo.options import UsageError

if TYPE_CHECKING:
    from sb3_roles.evaluation.grid.plan import Plan, Row
    from sb3_roles.evaluation.records import EpisodeRecords
    from sb3_roles.zoo.row_runs import Run

_DIGITS = 3


def scores_of(
    run: Run, row: Row, plan: Plan, records: Path, episodes: int | None = None
) -> dict[str, Any] | None:
    """Score a run in the cells of a plan, as far as all of its episodes there were played.

    :param run: published weights
    :param row: that they play for
    :param plan: with its cells, their episodes and the seed of the stream
    :param records: folder of records, which may not exist
    :param episodes: of each cell, instead of the plan's
    :return: ``stream`` and ``seed``, ``columns``, and one list for each of the ``cells``; None
        without any
    :raises UsageError: if the weights can not be loaded
    """
    from sb3_roles.evaluation.episodes import held_out_seed, stream_of
    from sb3_roles.evaluation.grid.store import RecordStore
    from sb3_roles.evaluation.grid.survey import Survey
    from sb3_roles.zoo.entrants import make_controller, pack

    part = plan.select(tables=tuple(plan.tables), figures=tuple(plan.figures), rows=(row.name,))
    survey = Survey(
        part,
        {row.name: [run.entrant(row)]},
        RecordStore(records, _quiet, set_aside=False),
        make_controller,
        pack=pack,
        episodes=episodes,
        report=_quiet,
    )
    if survey.failures:
        raise UsageError(survey.failures[row.name])
    cells = [_cell(one.records()) for one in survey.parts() if not one.missing()]
    stream, seed = stream_of(held_out_seed(plan.seed))
    if not cells:
        return None
    return {"stream": stream, "seed": seed, "columns": list(SCORE_COLUMNS), "cells": cells}


def _quiet(line: str) -> None:
    # Of what a store lacks, or can not be read, nothing is scored.
    pass


def _cell(records: EpisodeRecords) -> list[Any]:
    from sb3_roles.evaluation.metrics import summarize

    scene, summary = records.metadata["scene"], summarize(records)
    values: list[Any] = [scene["name"], scene["n_agents"], len(records.episode)]
    for metric in SCORES:
        entry = summary[metric]
        values += [_rounded(one) for one in (entry["mean"], *(entry["ci95"] or (None, None)))]
    return [*values, _rounded(summary["t90_true"]["share"])]


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(float(value), _DIGITS)


def merged(old: Mapping[str, Any] | None, new: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Join scores of the same weights: of a cell, those over more episodes, or else the new ones.

    :param old: of the card so far
    :param new: of the records
    :return: nothing that was known is lost, unless it is of another stream than the new ones
    """
    if old is None or new is None:
        return dict(new or old or {}) or None
    if (old["stream"], old["seed"], old["columns"]) != (new["stream"], new["seed"], new["columns"]):
        return dict(new)
    cells = {tuple(cell[:2]): cell for cell in old["cells"]}
    for cell in new["cells"]:
        before = cells.get(tuple(cell[:2]))
        if before is None or before[2] <= cell[2]:
            cells[tuple(cell[:2])] = cell
    return {**new, "cells": list(cells.values())}
