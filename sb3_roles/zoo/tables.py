"""``sb3-roles tables`` and ``sb3-roles report``: tables and figures, beside those of the paper."""

from __future__ import annotations

import os
import sys
import time
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_roles.common.files import remove_stale
from sb3_roles.evaluation.report import PAGE
from sb3_roles.zoo.grid_command import (
    EXIT_ROWS_FAILED,
    RECORDS,
    add_folders,
    add_jobs,
    add_plan,
    check_logs,
    check_out,
    exit_code,
    said_if_stopped,
    tell,
)
from sb3_roles.zoo.machine import usable_cores
from sb3_roles.zoo.options import UsageError, names_of, whole_number
from sb3_roles.zoo.plans import read_plan_file
from sb3_roles.zoo.ray_options import LOCAL, import_ray
from sb3_roles.zoo.row_configs import PLAN
from sb3_roles.zoo.row_runs import named_runs

if TYPE_CHECKING:
    from sb3_roles.evaluation.grid.crews import Crew
    from sb3_roles.evaluation.grid.plan import Plan
    from sb3_roles.evaluation.grid.store import RecordStore
    from sb3_roles.evaluation.grid.survey import Survey
    from sb3_roles.zoo.options import Parser, Subparsers
    from sb3_roles.zoo.table_outputs import Made

_ABOUT = (
    "What was played once is kept in records, and only what is missing is played: a command that "
    "was interrupted goes on where it was. Learned rows are the runs of --log-folder with the "
    "configuration of the row, or else the weights that come with this package. "
    f"Exit code {EXIT_ROWS_FAILED}: a row failed and is left out."
)


def add_parser(subparsers: Subparsers) -> None:
    """Add the two commands."""
    tables = subparsers.add_parser(
        "tables",
        help="the tables and figures of the paper",
        description="Play what the tables and figures of a plan need, and write them as Markdown, "
        f"LaTeX, CSV and images. {_ABOUT}",
    )
    add_options(tables)
    tables.set_defaults(run=run)
    report = subparsers.add_parser(
        "report",
        help="tables, figures and episodes as one HTML page",
        description=f"What tables does, and {PAGE}, a page to look at all of it. {_ABOUT}",
    )
    add_options(report)
    report.set_defaults(run=run_report)


def add_options(parser: Parser) -> None:
    """Add the options that the two commands share."""
    for what, some, also in (
        ("tables", "I,II", "; none where figures are named and tables are not"),
        ("rows", "random,hmappo", ""),
        ("scenes", "easy,hard", ""),
        ("figures", "training,time_e", "; none where only tables, rows or scenes are named"),
    ):
        parser.add_argument(
            f"--{what}",
            type=names_of,
            action="extend",
            metavar="NAMES",
            help=f"only these, such as {some}{also}",
        )
    parser.add_argument(
        "--episodes",
        type=whole_number(1, 10**6),
        metavar="N",
        help="of each row and column, instead of the plan's; rows with a limit keep it",
    )
    parser.add_argument(
        "--quick", action="store_true", help="few episodes: minutes, and said in every caption"
    )
    who = parser.add_mutually_exclusive_group()
    add_jobs(who)
    who.add_argument(
        "--ray",
        metavar="ADDRESS",
        help=f"play on a Ray cluster: its address, or {LOCAL!r} to start one here (extra ray)",
    )
    add_folders(parser, Path("results"))
    parser.add_argument(
        "--runs",
        action="append",
        default=[],
        metavar="ROW=RUN",
        help="runs of a learned row, of its algorithm and else whatever their configuration: a run "
        "folder or a pattern; may be repeated",
    )
    add_plan(parser, PLAN, "only say what is there and what is missing")


def run(args: Namespace) -> int:
    """Play, and write tables and figures.

    :param args: parsed arguments
    :return: exit code: 0, or 3 if a row failed and was left out
    :raises UsageError: if a name, a plan or a run is wrong, before anything is played
    :raises OSError: if something can not be written
    """
    made = make(args)
    if isinstance(made, int):
        return made
    if len(made.tables) == 1:
        from sb3_roles.evaluation.tables.writers import to_markdown

        print(f"\n{to_markdown(made.tables)}", end="")
    return made.code


def run_report(args: Namespace) -> int:
    """Do what :func:`run` does, and write the page.

    :param args: parsed arguments
    :return: as of :func:`run`
    """
    made = make(args)
    if isinstance(made, int):
        return made
    from sb3_roles.zoo.table_outputs import write_page

    write_page(args, made, tell)
    return made.code


def read_plan(args: Namespace) -> Plan:
    """Read the part of a plan that the command line asks for.

    :param args: parsed arguments
    :raises UsageError: if the file or a name is wrong
    """
    from sb3_roles.evaluation.grid.plan import PlanError

    plan = read_plan_file(args.plan)
    try:
        return plan.select(args.tables, args.rows, args.scenes, args.figures)
    except PlanError as error:
        raise UsageError(str(error)) from None


def make(args: Namespace) -> Made | int:
    """Play what is missing, and write tables and figures.

    :param args: parsed arguments
    :return: the exit code of ``--dry-run``, which prints what there is
    """
    started, jobs = time.time(), args.jobs or usable_cores()
    plan = read_plan(args)
    if args.figures and find_spec("matplotlib") is None:
        raise UsageError("argument --figures: install sb3_roles[plots] to draw them")
    check_logs(args.log_folder)
    named_runs(args.runs, plan)
    check_out(args.out, write=not args.dry_run)
    # Read when they are imported: a job is one thread.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from sb3_roles.evaluation.grid.play import play
    from sb3_roles.evaluation.grid.store import RecordStore
    from sb3_roles.evaluation.grid.survey import Survey
    from sb3_roles.zoo.entrants import find_entrants, make_controller, pack
    from sb3_roles.zoo.table_outputs import FIGURES, write_all

    entrants = find_entrants(plan, args.log_folder, args.runs, tell)
    store = RecordStore(args.out / RECORDS, tell, set_aside=not args.dry_run)
    options: dict[str, Any] = {
        "pack": pack,
        "quick": args.quick,
        "episodes": args.episodes,
        "report": tell,
    }
    if args.dry_run:
        survey = Survey(plan, entrants, store, make_controller, **options)
        print("\n".join(_lines_of(survey, jobs)))
        return EXIT_ROWS_FAILED if survey.failures else 0
    for folder in (args.out, args.out / FIGURES):
        remove_stale(folder)
    with said_if_stopped(store), _crew(args, store) as crew:
        bar = sys.stderr.isatty()
        outcome = play(plan, entrants, store, make_controller, jobs, **options, crew=crew, bar=bar)
    made = write_all(args, plan, entrants, outcome, time.time() - started, tell)
    return made._replace(code=exit_code(outcome))


@contextmanager
def _crew(args: Namespace, store: RecordStore) -> Iterator[Crew | None]:
    if args.ray is None:
        yield None
        return
    import_ray()
    from sb3_roles.evaluation.grid.ray_crew import RayCrew, RayError
    from sb3_roles.zoo.entrants import make_controller

    try:
        crew = RayCrew(args.ray, make_controller, store, usable_cores())
    except RayError as error:
        raise UsageError(f"argument --ray: {error}") from None
    try:
        yield crew
    finally:
        crew.close()


def _lines_of(survey: Survey, jobs: int) -> Iterator[str]:
    from sb3_roles.evaluation.grid.progress import Left

    counts = survey.counts()
    for name, (there, missing, left) in counts.items():
        alone = " on one CPU" if left.known else ""
        rest = f", {left}{alone}" if missing else ""
        yield f"{name}: {there} blocks are there, {missing} are missing{rest}"
    total = sum(count.left.seconds for count in counts.values())
    whole = Left(total / jobs, all(count.left.known for count in counts.values()))
    if any(count.missing for count in counts.values()):
        yield f"{whole} with --jobs {jobs}"
    else:
        yield "nothing is missing"
