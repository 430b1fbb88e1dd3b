"""``sb3-roles simulate``: ``evaluate`` for scripted controllers only."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from sb3_roles.baselines import CONTROLLER_NAMES
from sb3_roles.zoo.evaluate import DEFAULT, HELD_OUT_NOTE, add_episode_options, run
from sb3_roles.zoo.options import several_of

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Subparsers


def add_parser(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "simulate",
        help="play episodes with scripted controllers",
        description="Play episodes of the area search with scripted controllers and print their "
        f"metrics. {HELD_OUT_NOTE}",
    )
    parser.add_argument(
        "--controller",
        type=several_of("controller", CONTROLLER_NAMES),
        action="extend",
        default=argparse.SUPPRESS,
        metavar="NAME",
        help=f"one of {', '.join(CONTROLLER_NAMES)}; several, separated by commas, are compared "
        f"(default: {DEFAULT})",
    )
    add_episode_options(parser)
    parser.set_defaults(run=run)
