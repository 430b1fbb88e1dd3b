"""What ``sb3-roles tables`` and ``sb3-roles report`` write of what was played."""

from __future__ import annotations

import shlex
import sys
import time
from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from sb3_roles._version import __version__
from sb3_roles.common.durations import long_duration
from sb3_roles.common.files import write_atomically
from sb3_roles.evaluation.grid.crews import Parcel
from sb3_roles.evaluation.grid.entrants import Entrant, Entrants, Results
from sb3_roles.evaluation.grid.plan import Plan
from sb3_roles.evaluation.grid.play import Outcome
from sb3_roles.evaluation.grid.store import Report
from sb3_roles.evaluation.report import PAGE
from sb3_roles.evaluation.tables.model import TableResult, make_tables
from sb3_roles.evaluation.tables.writers import to_csv, to_latex, to_markdown
from sb3_roles.zoo.entrants import make_controller
from sb3_roles.zoo.run_folder import source_commit

FIGURES = "figures"


class Made(NamedTuple):
    """What was played and made of it.

    :param plan: the part that was asked for
    :param entrants: row -> who played; without rows that failed
    :param results: see ``Results``
    :param tables: by name
    :param figures: name -> caption, of the figures that were drawn
    :param facts: about the making, for readers
    :param parcels: row -> what its first entrant was made of when it played
    :param code: exit code of the command
    """

    plan: Plan
    entrants: Mapping[str, Sequence[Entrant]]
    results: Results
    tables: Mapping[str, TableResult]
    figures: Mapping[str, str]
    facts: Mapping[str, Any]
    parcels: Mapping[str, Parcel]
    code: int = 0


def write_all(
    args: Namespace,
    plan: Plan,
    entrants: Entrants,
    outcome: Outcome,
    seconds: float,
    tell: Report,
) -> Made:
    """Write tables and figures into ``args.out``, and print which files.

    :param args: parsed arguments
    :param plan: the part that was asked for
    :param entrants: row -> who played
    :param outcome: what they played
    :param seconds: that all took
    :param tell: takes lines about figures that can not be drawn
    :raises OSError: if a file can not be written; an earlier one is whole then
    """
    played = {name: ones for name, ones in entrants.items() if name not in outcome.failures}
    logs = {
        name: [Path(one.source) for one in ones]
        for name, ones in played.items()
        if plan.rows[name].learned
    }
    tables = _write_tables(args, plan, outcome.results)
    figures = _draw(args, plan, outcome.results, logs, tell)
    facts = _facts(seconds)
    return Made(plan, played, outcome.results, tables, figures, facts, outcome.parcels)


def write_page(args: Namespace, made: Made, tell: Report = print) -> None:
    """Write the report, with a few episodes that the weights of the tables play once more.

    :param args: parsed arguments
    :param made: what :func:`write_all` returned
    :param tell: takes lines: how many episodes are played, and rows that can not play them
    :raises OSError: if the file can not be written
    """
    from sb3_roles.evaluation.report.page import write_report
    from sb3_roles.evaluation.report.traces import record_traces

    path, folder = args.out / PAGE, args.out / FIGURES
    images = {name: (folder / f"{name}.svg").read_text(encoding="utf-8") for name in made.figures}
    traces = record_traces(
        made.plan,
        made.entrants,
        # Not from its folder, which may hold other weights by now, or be gone.
        lambda entrant: made.parcels[entrant.row].open(make_controller),
        tell=tell,
    )
    write_report(path, made.plan, made.tables, images, made.figures, traces, made.facts, args.quick)
    print(f"wrote {path}")


def _write_tables(args: Namespace, plan: Plan, results: Results) -> dict[str, TableResult]:
    tables = make_tables(plan, results, args.quick)
    if tables:
        for suffix, content in (
            ("md", to_markdown(tables).encode()),
            ("tex", to_latex(tables).encode()),
            ("csv", to_csv(tables)),
        ):
            path = args.out / f"tables.{suffix}"
            write_atomically(path, content)
            print(f"wrote {path}")
    return tables


def _draw(
    args: Namespace, plan: Plan, results: Results, logs: Mapping[str, list[Path]], tell: Report
) -> dict[str, str]:
    """Draw the figures that can be drawn; their names and captions."""
    if not plan.figures:
        return {}
    try:
        from sb3_roles.evaluation.figures.draw import caption, draw_figures

        paths = draw_figures(plan, results, logs, args.out / FIGURES, args.quick, tell)
    except ImportError:
        tell("no figures: install sb3_roles[plots] to draw them")
        return {}
    for path in paths:
        print(f"wrote {path}")
    drawn = {path.stem for path in paths}
    return {
        name: caption(figure, args.quick, plan, results, logs)
        for name, figure in plan.figures.items()
        if name in drawn
    }


def _facts(seconds: float) -> dict[str, Any]:
    return {
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "version": f"sb3_roles {__version__}, commit {source_commit(Path(__file__)) or 'unknown'}",
        "made": f"{time.strftime('%Y-%m-%d %H:%M')} in {long_duration(seconds)}",
    }
