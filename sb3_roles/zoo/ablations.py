"""``sb3-roles ablations``: what each change of a training does, on episodes of their own."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_roles.common.files import write_atomically
from sb3_roles.zoo.config import ConfigError, config_file, read_yaml
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
from sb3_roles.zoo.launcher import prepare_process
from sb3_roles.zoo.machine import usable_cores
from sb3_roles.zoo.options import DEVICES, UsageError, names_of, one_of, whole_number
from sb3_roles.zoo.row_configs import ABLATIONS, PLAN, config_of_row

if TYPE_CHECKING:
    from sb3_roles.evaluation.grid.plan import Plan
    from sb3_roles.evaluation.grid.play import Outcome
    from sb3_roles.zoo.ablation_file import Ablations
    from sb3_roles.zoo.ablation_runs import Found
    from sb3_roles.zoo.options import Subparsers


def add_parser(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "ablations",
        help="compare variants of a training, one change at a time",
        description="Find the runs of the variants of zoo_configs/ablations.yml by configuration, "
        "number of joint steps and seed, play what is missing of their episodes, and write the "
        "studies as Markdown and CSV. What was played once is kept in records. Runs that are "
        "missing are listed with the command that trains them, or trained with --train. Exit code "
        f"{EXIT_ROWS_FAILED}: a variant could not be trained or played, and is left out.",
    )
    parser.add_argument(
        "--studies", type=names_of, action="extend", metavar="NAMES", help="only these"
    )
    parser.add_argument(
        "--scenes",
        type=names_of,
        action="extend",
        metavar="NAMES",
        help="play in these, instead of those of the studies",
    )
    parser.add_argument(
        "--n-agents",
        type=_numbers,
        action="extend",
        metavar="NUMBERS",
        help="robots, such as 4,8, instead of those of the studies",
    )
    parser.add_argument(
        "--episodes",
        type=whole_number(2, 10**6),
        metavar="N",
        help="of each run and column, instead of the file's",
    )
    parser.add_argument(
        "--train",
        action="store_true",
        help="train the runs that are missing, one after the other, and go on with those that "
        "were begun",
    )
    parser.add_argument(
        "--num-threads",
        type=whole_number(1, 1024),
        metavar="T",
        help="threads of torch in trainings; by default torch's own choice",
    )
    parser.add_argument(
        "--device",
        type=one_of("device", DEVICES),
        metavar="NAME",
        help="of trainings: cpu, cuda or auto, which is the default",
    )
    add_jobs(parser)
    add_folders(parser, Path("results") / ABLATIONS)
    parser.add_argument(
        "--runs",
        type=Path,
        nargs="+",
        action="extend",
        default=[],
        metavar="FOLDER",
        help="further folders of runs, which are like --log-folder; nothing is trained there",
    )
    add_plan(parser, ABLATIONS, "only list the runs that are there and missing")
    parser.set_defaults(run=run)


def _numbers(text: str) -> list[int]:
    """Read whole numbers with commas between."""
    number = whole_number(1, 10**6)
    try:
        return [number(name) for name in names_of(text)]
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(
            f"must be numbers of robots with commas between, got {text!r}"
        ) from None


def run(args: Namespace) -> int:
    """Train if it is told, play, and write the studies.

    :param args: parsed arguments
    :return: exit code: 0; 3 if a variant failed; that of a training that a signal stopped
    :raises UsageError: if the file, a name or a folder is wrong, before anything is trained
    :raises OSError: if something can not be written
    """
    if args.train and args.dry_run:
        raise UsageError("give --train or --dry-run, not both")
    ablations = read_ablations(args)
    jobs = args.jobs or usable_cores()
    for folder in (args.log_folder, *args.runs):
        first = folder == args.log_folder
        if not (first and args.train):
            check_logs(folder, "--log-folder" if first else "--runs")
    check_out(args.out, write=not args.dry_run)
    if args.train:
        prepare_process()
    else:
        # Read when they are imported: a job is one thread.
        os.environ.setdefault("OMP_NUM_THREADS", "1")
    from sb3_roles.zoo.ablation_runs import find_runs, missing_lines

    folders = [args.log_folder, *args.runs]
    found = find_runs(ablations, folders, tell)
    failed = False
    if args.train:
        code, failed = _train(args, ablations, found)
        if code:
            return code
        found = find_runs(ablations, folders, tell)
    for name, variant in ablations.variants.items():
        if variant.runs_of == name:
            for line in missing_lines(variant, found[name], args.log_folder):
                tell(line)
    if args.dry_run:
        print("\n".join(_counts(ablations, found)))
        return 0
    plan = ablations.plan()
    outcome = _play(args, plan, ablations, found, jobs)
    _write(args, plan, ablations, outcome)
    return max(exit_code(outcome), EXIT_ROWS_FAILED if failed else 0)


def read_ablations(args: Namespace) -> Ablations:
    """Read the part of the file that the command line asks for.

    :param args: parsed arguments
    :raises UsageError: if the file or a name is wrong, or its episodes are those of the tables
    """
    from sb3_roles.evaluation.grid.plan import PlanError
    from sb3_roles.zoo.ablation_file import parse_ablations

    file = config_file(ABLATIONS) if args.plan is None else args.plan
    content, tables = read_yaml(file), read_yaml(config_file(PLAN))
    try:
        ablations = parse_ablations(content)
        for name, variant in ablations.variants.items():
            if variant.runs_of == name:
                config_of_row(variant.row, "variant")
    except (PlanError, ConfigError) as error:
        raise UsageError(f"{file}: {error}") from None
    if ablations.seed == tables["seed"]:
        raise UsageError(
            f"{file}: seed must not be {ablations.seed}, that of {PLAN}.yml: what was chosen on "
            "episodes looks better on them than it is"
        )
    try:
        return ablations.select(args.studies, args.scenes, args.n_agents)
    except PlanError as error:
        raise UsageError(str(error)) from None


def _train(args: Namespace, ablations: Ablations, found: Mapping[str, Found]) -> tuple[int, bool]:
    from sb3_roles.zoo.ablation_runs import train_missing

    options = {"num_threads": args.num_threads, "device": args.device, "verbose": 0}
    given = {key: value for key, value in options.items() if value is not None}
    failed = False
    for name, variant in ablations.variants.items():
        if variant.runs_of != name:
            continue
        code, one_failed = train_missing(variant, found[name], args.log_folder, given, tell)
        failed |= one_failed
        if code:
            return code, failed
    return 0, failed


def _counts(ablations: Ablations, found: Mapping[str, Found]) -> list[str]:
    lines = []
    for name, variant in ablations.variants.items():
        one = found[name]
        of = f"{len(one.runs)} of {len(variant.seeds)} runs of {variant.n_timesteps:,} joint steps"
        where = "".join(f", {run.folder}" for run in one.runs.values())
        lines.append(f"{name}: {of}{where}")
    return lines


def _play(
    args: Namespace, plan: Plan, ablations: Ablations, found: Mapping[str, Found], jobs: int
) -> Outcome:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from sb3_roles.evaluation.grid.play import play
    from sb3_roles.evaluation.grid.store import RecordStore
    from sb3_roles.zoo.entrants import make_controller, pack

    entrants = {
        name: [run.entrant(variant.row) for run in found[name].runs.values()]
        for name, variant in ablations.variants.items()
    }
    store = RecordStore(args.out / RECORDS, tell)
    with said_if_stopped(store):
        return play(
            plan,
            entrants,
            store,
            make_controller,
            jobs,
            episodes=args.episodes,
            report=tell,
            pack=pack,
            bar=sys.stderr.isatty(),
        )


def _write(args: Namespace, plan: Plan, ablations: Ablations, outcome: Outcome) -> None:
    from sb3_roles.evaluation.tables.ablations import About, compare, to_csv, to_markdown
    from sb3_roles.zoo.ablation_runs import changes_of, commands_of

    tables = []
    for name, study in ablations.studies.items():
        reference = ablations.variants[study.reference]
        about = {
            key: About(
                changes_of(ablations.variants[key], reference),
                ablations.variants[key].n_timesteps,
                len(ablations.variants[key].seeds),
            )
            for key in study.variants
        }
        tables += compare(plan.tables[name], study.note, about, outcome.results)
    commands: dict[str, None] = {}
    for variant in ablations.variants.values():
        commands.update(dict.fromkeys(commands_of(variant, args.log_folder)))
    made_by = shlex.join(["sb3-roles", *args.arguments])
    markdown = to_markdown(tables, plan, list(commands), made_by)
    for suffix, content in (("md", markdown.encode()), ("csv", to_csv(tables, plan))):
        path = args.out / f"{ABLATIONS}.{suffix}"
        write_atomically(path, content)
        print(f"wrote {path}")
