"""``sb3-roles simulate``: play episodes with a scripted controller and print its metrics."""

from __future__ import annotations

import json
import os
from argparse import Namespace
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from sb3_roles._version import __version__
from sb3_roles.baselines import CONTROLLER_NAMES, controller_class
from sb3_roles.zoo.options import (
    MAX_SEED,
    UsageError,
    add_scene_options,
    one_of,
    output_file,
    scene_of,
    whole_number,
)

if TYPE_CHECKING:
    from pathlib import Path

    from area_search.scenes import Scene
    from sb3_roles.baselines.base import Controller
    from sb3_roles.zoo.options import Parser, Subparsers

_NOTES = {
    "explo_paper": "the paper's: newly seen cells / free cells, can exceed 100 %",
    "explo_true": "explored share of the free cells",
    "cover": "share of the targets covered",
    "time_e_paper": "first step with a mean explo_paper above 90 %",
    "t90_true": "first step with explo_true at 90 %",
    "t90_paper": "first step with explo_paper above 90 %",
    "length": "steps of an episode",
}


def add_parser(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "simulate",
        help="play episodes with a scripted controller",
        description="Play episodes of the area search with a scripted controller and print its "
        "metrics, mean ± standard error.",
    )
    parser.add_argument(
        "--controller",
        type=one_of("controller", CONTROLLER_NAMES),
        default="random",
        metavar="NAME",
        help=f"one of {', '.join(CONTROLLER_NAMES)}",
    )
    add_episode_options(parser)
    parser.set_defaults(run=run)


def add_episode_options(parser: Parser) -> None:
    """Add the options that say which episodes are played, and what is reported of them."""
    add_scene_options(parser)
    parser.add_argument(
        "--episodes", type=whole_number(1, 10**7), default=500, metavar="N", help="number of them"
    )
    parser.add_argument(
        "--seed", type=whole_number(0, MAX_SEED), default=0, metavar="N", help="of the episodes"
    )
    parser.add_argument(
        "--first-episode",
        type=whole_number(0, 10**12),
        default=0,
        metavar="N",
        help="number of the first episode in the seed's stream",
    )
    parser.add_argument(
        "--batch-size",
        type=whole_number(1, 10**6),
        default=256,
        metavar="N",
        help="teams simulated together; changes the speed only",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument(
        "--render",
        type=output_file(".png"),
        metavar="FILE.png",
        help="also draw the last frame of the first episode",
    )


def run(args: Namespace) -> int:
    """Play the episodes and print the metrics.

    :param args: parsed arguments
    :return: exit code
    :raises UsageError: if the options do not describe a scene
    """
    scene = scene_of(args)
    # Numba takes its time to import: not before the arguments are known to be right.
    check_render(args.render)
    return play(args, controller_class(args.controller)(), scene)


def play(args: Namespace, controller: Controller, scene: Scene) -> int:
    """Play the episodes of :func:`add_episode_options` and print the metrics.

    :param args: parsed arguments; ``controller`` is what the report calls it
    :param controller: who acts
    :param scene: the task
    :return: exit code
    """
    from sb3_roles.evaluation.episodes import run_episodes
    from sb3_roles.evaluation.metrics import summarize

    records = run_episodes(
        controller, scene, args.episodes, args.seed, args.first_episode, args.batch_size
    )
    if args.render is not None:
        _render(controller, scene, args.seed, args.first_episode, args.render)
    report = {
        "config": {
            "controller": args.controller,
            "episodes": args.episodes,
            "first_episode": args.first_episode,
            "scene": asdict(scene),
            "seed": args.seed,
            "version": __version__,
        },
        "metrics": summarize(records),
        "joint_steps": int(records.length.sum()),
        "seconds": records.seconds,
        "episodes_per_second": args.episodes / records.seconds,
    }
    print(json.dumps(report, indent=2, allow_nan=False) if args.json else _table(report))
    return 0


def check_render(path: Path | None) -> None:
    """Find out whether the picture can be written, before the simulation, which may be long.

    :param path: the file, or None
    :raises UsageError: if it can not
    """
    if path is not None and not os.access(path if path.exists() else path.parent, os.W_OK):
        raise UsageError(f"argument --render: {str(path)!r} can not be written")


def _table(report: dict[str, Any]) -> str:
    config, scene = report["config"], report["config"]["scene"]
    lines = [
        f"{config['controller']} on {scene['name']}: {scene['n_agents']} robots, "
        f"{config['episodes']} episodes, seed {config['seed']}",
        f"{scene['height']} x {scene['width']} cells, {100 * scene['free_fraction']:g} % free, "
        f"{scene['n_targets']} targets, horizon {scene['horizon']}",
        "",
    ]
    for name, metric in report["metrics"].items():
        note = _NOTES[name]
        if "share" in metric:
            note += f"; {100 * metric['share']:.1f} % of the episodes get there"
        lines.append(f"{name:13}{_value(metric):>24}   {note}")
    lines += [
        "",
        f"{report['episodes_per_second']:,.0f} episodes/s, "
        f"{report['joint_steps'] / report['seconds']:,.0f} joint steps/s",
    ]
    return "\n".join(lines)


def _value(metric: dict[str, Any]) -> str:
    if metric["mean"] is None:
        return "-      "
    error = "" if metric["se"] is None else f" ± {metric['se']:.2f}"
    return f"{metric['mean']:.2f}{error} {metric['unit']:5}"


def _render(controller: Controller, scene: Scene, seed: int, episode: int, path: Path) -> None:
    # pygame greets on stdout, where only the report belongs.
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    import io

    import numpy as np
    import pygame

    from area_search.batch import BatchedAreaSearch
    from area_search.render import draw_frame
    from sb3_roles.evaluation.episodes import Player

    batch = BatchedAreaSearch(scene, 1, str(getattr(controller, "sub_goal", "none")))
    batch.reset([seed], episode)
    player = Player(controller, batch)
    trail = []
    while not (batch.terminated[0] or batch.truncated[0]):
        trail.append(batch.position[0].copy())
        player.step()
    shown: dict[str, Any] = {"path": np.array(trail)}
    if player.roles is not None:
        shown["roles"] = player.roles[0]
        shown["role_names"] = getattr(controller, "role_names", ("explore", "cover"))
    frame = draw_frame(batch.snapshot(0, **shown))
    image = io.BytesIO()
    pygame.image.save(pygame.surfarray.make_surface(frame.swapaxes(0, 1)), image, "frame.png")
    path.write_bytes(image.getvalue())
