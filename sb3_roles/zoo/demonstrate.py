"""``sb3-roles demonstrate``: record a scripted controller, for behavior cloning."""

from __future__ import annotations

import sys
from argparse import Namespace
from typing import TYPE_CHECKING

from sb3_roles.baselines import CONTROLLER_NAMES
from sb3_roles.zoo.options import (
    MAX_TRAINING_SEED,
    UsageError,
    add_scene_options,
    one_of,
    output_file,
    scene_of,
    whole_number,
)

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Subparsers


def add_parser(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "demonstrate",
        help="record a scripted controller for behavior cloning",
        description="Record what a scripted controller does in numbered episodes that no training "
        "and no evaluation plays. A file that exists is continued: an interrupted recording goes "
        "on, and a finished one can be given more episodes.",
    )
    parser.add_argument(
        "--controller",
        type=one_of("controller", CONTROLLER_NAMES),
        default="planner",
        metavar="NAME",
        help=f"one of {', '.join(CONTROLLER_NAMES)}",
    )
    add_scene_options(parser)
    parser.add_argument(
        "--episodes", type=whole_number(1, 10**6), default=200, metavar="N", help="number of them"
    )
    parser.add_argument(
        "--seed",
        type=whole_number(0, MAX_TRAINING_SEED),
        default=0,
        metavar="N",
        help="of the episodes",
    )
    parser.add_argument(
        "--batch-size",
        type=whole_number(1, 10**4),
        default=25,
        metavar="N",
        help="episodes that are recorded together, and then written to the file",
    )
    parser.add_argument(
        "--out", type=output_file(".npz"), required=True, metavar="FILE.npz", help="the recording"
    )
    parser.set_defaults(run=run)


def run(args: Namespace) -> int:
    """Record the episodes.

    :param args: parsed arguments
    :return: exit code
    :raises UsageError: if the options do not describe a scene, the controller needs what is not
        installed, or the file is of other episodes
    """
    scene = scene_of(args)
    from area_search.kernels import METRICS
    from sb3_roles.gnn.demonstrations import DemonstrationError
    from sb3_roles.gnn.recording import record

    def report(count: int) -> None:
        print(f"{count} of {args.episodes} episodes", file=sys.stderr, flush=True)

    try:
        found = record(
            args.controller,
            scene,
            args.episodes,
            args.seed,
            args.out,
            batch_size=args.batch_size,
            report=report,
        )
    except DemonstrationError as error:
        raise UsageError(f"argument --out: {error}") from None
    except ImportError as error:
        raise UsageError(f"argument --controller: {error}") from None
    means = zip(METRICS, 100 * found.metrics.mean(axis=0), strict=True)
    print(
        f"{args.out}: {len(found)} episodes of {args.controller}, {found.n_steps} steps of "
        f"{found.n_agents} robots: " + ", ".join(f"{name} {value:.1f} %" for name, value in means)
    )
    return 0
