"""``sb3-roles bench``: the group of the measuring commands, one module each.

Without one of them it is the short form of the most important ones, as one table.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

from sb3_roles.zoo.bench_case import PARTS, TUNED, configure
from sb3_roles.zoo.bench_compare import RIVALS, rival_label
from sb3_roles.zoo.bench_memory import memory_cells
from sb3_roles.zoo.bench_report import Table, cells, machine_lines, plural
from sb3_roles.zoo.bench_rounds import add_round_options, print_report
from sb3_roles.zoo.machine import start_torch
from sb3_roles.zoo.options import UsageError

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Subparsers

COMMANDS = (
    "sb3_roles.zoo.bench_env",
    "sb3_roles.zoo.bench_train",
    "sb3_roles.zoo.bench_growth",
    "sb3_roles.zoo.bench_options",
)
_OWN = "short_"
_SECONDS_PER_CASE = 0.2
_CASES = {
    "native none": "batch of 128 teams",
    "native nearest": "the same, nearest sub-goals",
    "native assigned": "the same, assigned sub-goals",
    "native routes": "16 teams, assigned sub-goals and look-ahead routes",
    "native_vec_env none": "vectorized environment, native",
    "supersuit_vec_env none": "vectorized environment, SuperSuit",
    "pettingzoo none": "PettingZoo environment",
    "reference none": "plain-Python reference",
}


def add_parser(subparsers: Subparsers) -> None:
    """Add the group and its commands."""
    parser = subparsers.add_parser(
        "bench",
        help="measure speed",
        description="Measure speed. Without the name of a benchmark: environment, training of the "
        "tuned HMAPPO, and the same training by slower means, in a short form of a few minutes.",
    )
    add_round_options(parser, iterations=2, repeats=3)
    # The benchmarks have options of the same names, whose defaults would take their place.
    own = [action for action in parser._actions if action.dest != "help"]
    for action in own:
        action.dest = _OWN + action.dest
    parser.set_defaults(run=run)
    group = parser.add_subparsers(dest="bench", metavar="benchmark", required=False)
    for command in COMMANDS:
        import_module(command).add_parser(group)
    defaults = {action.dest: action.default for action in own}
    for one in group.choices.values():
        one.set_defaults(run=partial(_run_one, one.get_default("run"), defaults))


def _run_one(
    command: Callable[[Namespace], int], defaults: Mapping[str, Any], args: Namespace
) -> int:
    for name, default in defaults.items():
        if getattr(args, name) != default:
            option = name.removeprefix(_OWN).replace("_", "-")
            raise UsageError(f"--{option} stands before {args.bench!r}: give it behind the name")
    return command(args)


def run(args: Namespace) -> int:
    """Measure the short form and print the report.

    :param args: parsed arguments
    :return: exit code
    :raises UsageError: if the rivals in training do other work
    """
    own = Namespace(
        **{key.removeprefix(_OWN): one for key, one in vars(args).items() if key.startswith(_OWN)}
    )
    config = configure(n_envs=own.n_envs)
    machine = start_torch(own.num_threads)
    from sb3_roles.zoo import bench_env, bench_train
    from sb3_roles.zoo.env_cases import make_cases

    cases = bench_env.measure(make_cases(grown=False), _SECONDS_PER_CASE, own.repeats)
    report = {
        "config": {"iterations": own.iterations, "repeats": own.repeats},
        "machine": machine,
        "environment": bench_env.describe(cases),
        "training": bench_train.measure(
            {TUNED: config}, tuple(RIVALS), own.iterations, own.repeats
        ),
    }
    head = [*machine_lines(machine), plural(own.repeats, "interleaved round")]
    print_report(own, report, head, [_table(report)])
    return 0


def _table(report: Mapping[str, Any]) -> Table:
    table = Table(("4 robots, 25 x 25", "median", "range", "target"))
    rates = {case["name"]: case for case in report["environment"]["cases"]}
    for name, label in _CASES.items():
        rate = rates[f"{name} 4 robots 25x25"]["joint_steps_per_second"]
        table.add(f"environment, joint steps/s: {label}", *cells(rate, ",.0f"))
    training = report["training"]
    (tuned,) = training["cases"]
    teams = f"{tuned['n_teams']} teams"
    table.add(
        f"training, joint steps/s: tuned HMAPPO, {teams}",
        *cells(tuned["joint_steps_per_second"], ",.0f"),
    )
    for part in (*PARTS, "rest"):
        share = f"{100 * tuned['share_of_time'][part]:.1f}"
        table.add(f"time of training, %: {part}", share, "", "")
    for one in training["comparisons"]:
        table.add(f"times as fast as: {rival_label(one)}", *cells(one["ratio"], ".1f"))
    memory, peak = tuned["memory"], training["peak_resident_bytes"]
    table.add("observations of a rollout, MB", f"{memory['observation_bytes'] / 1e6:.1f}", "", "")
    float32, installed, target = memory_cells(memory)
    table.add("DictRolloutBuffer in float32 / as installed", float32, installed, target)
    table.add(
        "peak resident memory, with all rivals, MB",
        "?" if peak is None else f"{peak / 1e6:,.0f}",
        "",
        "",
    )
    return table
