"""Options of the commands that measure training in rounds, and how their reports are printed."""

from __future__ import annotations

import json
from argparse import Namespace
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from sb3_roles.zoo.bench_report import Table, page
from sb3_roles.zoo.options import whole_number

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Parser


def add_round_options(parser: Parser, iterations: int, repeats: int) -> None:
    """Add what the commands that train have in common.

    :param parser: of the command
    :param iterations: default
    :param repeats: default
    """
    parser.add_argument(
        "--n-envs",
        type=whole_number(1, 100_000),
        default=None,
        metavar="N",
        help="teams that collect together (default: the configuration's)",
    )
    parser.add_argument(
        "--iterations",
        type=whole_number(1, 10_000),
        default=iterations,
        metavar="N",
        help="rollouts and updates of a case in a round; slow ones make one",
    )
    parser.add_argument(
        "--repeats",
        type=whole_number(1, 1000),
        default=repeats,
        metavar="N",
        help="number of rounds",
    )
    parser.add_argument(
        "--num-threads",
        type=whole_number(1, 1024),
        default=None,
        metavar="T",
        help="threads of torch",
    )
    add_forms(parser)


def add_forms(parser: Parser) -> None:
    """Add the forms in which a report can be printed."""
    forms = parser.add_mutually_exclusive_group()
    forms.add_argument("--json", action="store_true", help="print one JSON object")
    forms.add_argument("--markdown", action="store_true", help="print tables in Markdown")


def print_report(
    args: Namespace, report: Mapping[str, Any], head: Sequence[str], tables: Sequence[Table]
) -> None:
    """Print a report in the form that was asked for.

    :param args: parsed options of :func:`add_forms`
    :param report: plain data
    :param head: see ``bench_report.page``
    :param tables: the same
    """
    if args.json:
        print(json.dumps(report, indent=2, allow_nan=False))
    else:
        print(page(head, tables, args.markdown))
