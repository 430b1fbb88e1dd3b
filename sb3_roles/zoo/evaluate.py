"""``sb3-roles evaluate``: as ``simulate``, for trained policies too."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_roles.baselines import CONTROLLER_NAMES, controller_class
from sb3_roles.common.names import closest
from sb3_roles.zoo.enjoy import add_play_options, load_run
from sb3_roles.zoo.options import UsageError, scene_of
from sb3_roles.zoo.simulate import add_episode_options, check_render, play

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Subparsers


def add_parser(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "evaluate",
        help="play episodes with a trained policy or a scripted controller",
        description="Play episodes of the area search with the policy of a run, or with a scripted "
        "controller, and print the metrics, mean ± standard error.",
    )
    parser.add_argument(
        "--controller",
        required=True,
        metavar="NAME|RUN",
        help=f"a run folder, or one of {', '.join(CONTROLLER_NAMES)}",
    )
    parser.add_argument("--load-best", action="store_true", help="the best evaluated policy")
    add_play_options(parser)
    add_episode_options(parser)
    parser.set_defaults(run=run)


def run(args: Namespace) -> int:
    """Play the episodes and print the metrics.

    :param args: parsed arguments
    :return: exit code
    :raises UsageError: if the options do not describe a scene, or there is no such controller
    """
    scene = scene_of(args)
    check_render(args.render)
    if args.controller in CONTROLLER_NAMES:
        return play(args, controller_class(args.controller)(), scene)
    folder = Path(args.controller)
    if not folder.is_dir():
        message = closest("controller or run folder", args.controller, CONTROLLER_NAMES)
        raise UsageError(f"argument --controller: {message}")
    loaded = load_run(folder, args.load_best, args.device)
    controller = loaded.controller(not args.stochastic, not args.no_communication)
    try:
        return play(args, controller, scene)
    except ValueError as error:
        raise UsageError(str(error)) from error
