"""``sb3-roles bench``: the group of the measuring commands, one module each.

Without one of them it is the short form of the most important ones, as one table.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

from sb3_roles.zoo.bench_case import PARTS, TUNED, configure, start_torch
from sb3_roles.zoo.bench_compare import RIVALS, rival_label
from sb3_roles.zoo.bench_memory import memory_cells
from sb3_roles.zoo.bench_report import Table, cells, machine_lines, plural
from sb3_roles.zoo.bench_rounds import add_round_options, print_report
from sb3_roles.zoo.options import UsageError

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Subparsers

COMMANDS = (
    "sb3_roles.zoo.bench_env",
    "sb3_roles.zoo.bench_train",
    "sb3_roles.zoo.bench_growth",
    "sb3_roles.zoo.bench_options",
)
_SECONDS_PER_CASE = 0.2
_CASES = {
    "native none": "batch of 128 teams",
    "native nearest": "the same, nearest sub-goals",
    "native assigned": "the same, assigned sub-goals",
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
    parser.set_defaults(run=run)
    given = {action.dest: action.default for action in parser._actions}
    group = parser.add_subparsers(dest="bench", metavar="benchmark", required=False)
    for command in COMMANDS:
        import_module(command).add_parser(group)
    for name, one in group.choices.items():
        # They have the same options, and would forget what stands in front of their names.
        one.set_defaults(run=partial(one.get_default("run")))
    del given


def run(args: Namespace) -> int:
    """Measure the short form and print the report.

    :param args: parsed arguments
    :return: exit code
    """
    return 0
