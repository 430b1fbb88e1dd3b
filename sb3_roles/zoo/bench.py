"""``sb3-roles bench``: the group of the measuring commands, one module each."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Subparsers

COMMANDS = ("sb3_roles.zoo.bench_env", "sb3_roles.zoo.bench_train")


def add_parser(subparsers: Subparsers) -> None:
    """Add the group and its commands."""
    parser = subparsers.add_parser("bench", help="measure speed", description="Measure speed.")
    group = parser.add_subparsers(dest="bench", metavar="benchmark", required=True)
    for command in COMMANDS:
        import_module(command).add_parser(group)
