"""``sb3-roles evaluate``: play episodes with policies and scripted controllers, and compare them.

``sb3-roles simulate`` is the same for scripted controllers only.
"""

from __future__ import annotations

import json
import os
import re
from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_roles.baselines import CONTROLLER_NAMES, controller_class
from sb3_roles.zoo.config import CONFIG_FILE
from sb3_roles.zoo.enjoy import add_play_options
from sb3_roles.zoo.environments import AREA_SEARCH
from sb3_roles.zoo.loaded_run import load_run
from sb3_roles.zoo.options import (
    MAX_SEED,
    UsageError,
    add_scene_options,
    names_of,
    output_file,
    scene_of,
    whole_number,
)
from sb3_roles.zoo.published import find_published, is_published

if TYPE_CHECKING:
    from area_search.scenes import Scene
    from sb3_roles.baselines.base import Controller
    from sb3_roles.evaluation.records import EpisodeRecords
    from sb3_roles.zoo.options import Parser, Subparsers
    from sb3_roles.zoo.published import Published

DEFAULT = "random"
HELD_OUT_NOTE = (
    "The episodes come from held-out streams, which no training plays, neither to learn nor to "
    "select its best policy: of the same seed, they are other ones than those of a run. Every "
    "controller plays the same episodes. Intervals are 95 % confidence intervals: Student's t over "
    "the episodes, and bootstrap percentiles for time_e_paper."
)
_OUTPUTS = ("out", "render")
_OF_POLICIES = ("stochastic", "no_communication", "load_best")


def controllers_of(text: str) -> list[str]:
    """Read names that are separated by commas; a folder with a comma in its name is one.

    :param text: the value of ``--controller``, which may be given several times
    """
    return [text] if os.path.isdir(text) else names_of(text)


def add_parser(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "evaluate",
        help="play episodes with trained policies and scripted controllers",
        description="Play episodes of the area search with the policies of runs and with scripted "
        f"controllers, and print their metrics. {HELD_OUT_NOTE}",
    )
    parser.add_argument(
        "--controller",
        type=controllers_of,
        action="extend",
        required=True,
        metavar="NAME|RUN",
        help=f"a run folder, one of {', '.join(CONTROLLER_NAMES)}, or a learned row of the tables, "
        "whose weights come with this package, such as hmappo or hmappo/seed_1; several, separated "
        "by commas or with the option repeated, are compared on the same episodes, with the first "
        "as the reference",
    )
    parser.add_argument("--load-best", action="store_true", help="the best evaluated policy")
    add_play_options(parser)
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
        "--stream",
        choices=("held_out", "raw"),
        default="held_out",
        metavar="NAME",
        help="held_out: seed N stands for the stream 2**32 + N, which no training plays; raw: for "
        "the stream N itself, as for run_episodes",
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
        help="teams simulated together; changes the times only",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument(
        "--out",
        type=output_file(".parquet"),
        metavar="FILE.parquet",
        help="also write the records of all steps; with several controllers one file for each, "
        "FILE-NAME.parquet",
    )
    parser.add_argument(
        "--render",
        type=output_file(".png"),
        metavar="FILE.png",
        help="also draw the last frame of the first episode; with several controllers as --out",
    )


def run(args: Namespace) -> int:
    """Play the episodes and print the metrics.

    :param args: parsed arguments
    :return: exit code
    :raises UsageError: if the options do not describe a scene, there is no such controller, or it
        can not play the scene
    """
    scene = scene_of(args)
    names = getattr(args, "controller", [DEFAULT])
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"argument --controller: {name!r} is given twice")
    files = {option: output_files(getattr(args, option), option, names) for option in _OUTPUTS}
    # Numba and torch take their time to import: not before the arguments are known to be right.
    made = make_controllers(args, names)

    from sb3_roles.evaluation.metrics import paired_differences
    from sb3_roles.zoo.summaries import comparison_of, report_of, table_of

    played = [
        _play(args, scene, name, one, {option: paths.get(name) for option, paths in files.items()})
        for name, one in made.items()
    ]
    reports = [report_of(records) for records in played]
    differences = [
        {
            "controller": records.metadata["name"],
            "against": played[0].metadata["name"],
            "metrics": paired_differences(records, played[0]),
        }
        for records in played[1:]
    ]
    if args.json:
        several = {"controllers": reports, "differences": differences}
        print(json.dumps(several if differences else reports[0], indent=2, allow_nan=False))
    else:
        print(comparison_of(reports, differences) if differences else table_of(reports[0]))
        for file in (file for paths in files.values() for file in paths.values()):
            print(f"wrote {file}")
    return 0


def make_controllers(args: Namespace, names: Sequence[str]) -> dict[str, Controller]:
    """Make the controllers, or load them.

    :param args: parsed arguments, for how a policy acts
    :param names: run folders, or of scripted controllers and of learned rows
    :return: by name, in the same order
    :raises UsageError: if one does not exist, is damaged, needs a package that is missing, or can
        not act as the options say
    """
    shipped = {
        name: _published(name)
        for name in names
        if name not in CONTROLLER_NAMES and not _is_folder(name)
    }
    if shipped and getattr(args, "load_best", False):
        raise UsageError(
            f"argument --load-best: of {next(iter(shipped))} one set of weights comes with this "
            "package"
        )
    if all(name in CONTROLLER_NAMES for name in names):
        for option in _OF_POLICIES:
            if getattr(args, option, False):
                raise UsageError(
                    f"argument --{option.replace('_', '-')}: only policies of runs heed it, and "
                    "only scripted controllers are named"
                )
    made: dict[str, Controller] = {}
    for name in names:
        if name in CONTROLLER_NAMES:
            try:
                made[name] = controller_class(name)()
            except ImportError as error:
                raise UsageError(f"{name}: {error}") from error
        elif name in shipped:
            found = shipped[name]
            drawn = found.is_drawn(args.deterministic, args.stochastic)
            loaded = found.load(args.device, AREA_SEARCH)
            made[name] = loaded.controller(not drawn, not args.no_communication)
        else:
            loaded = load_run(Path(name), args.load_best, args.device, AREA_SEARCH)
            made[name] = loaded.controller(not args.stochastic, not args.no_communication)
    return made


def _is_folder(name: str) -> bool:
    """Whether a name stands for a run folder: one that is none is only meant if nothing else is."""
    # An empty name would be the folder that the command was started in.
    if not (name and Path(name).is_dir()):
        return False
    return (Path(name) / CONFIG_FILE).is_file() or not is_published(name)


def _published(name: str) -> Published:
    try:
        return find_published(name, "controller or run folder", CONTROLLER_NAMES)
    except UsageError as error:
        raise UsageError(f"argument --controller: {error}") from None


def output_files(path: Path | None, option: str, names: Sequence[str]) -> dict[str, Path]:
    """Name the output of each controller, and find out whether it can be written.

    :param path: the file, None for none; with several controllers ``-NAME`` joins its stem
    :param option: that named it
    :param names: of the controllers
    :raises UsageError: if a file can not be written, before a simulation that may be long
    """
    if path is None:
        return {}
    files = {names[0]: path}
    if len(names) > 1:
        parts = {name: re.sub(r"[^\w.-]+", "_", name).strip("_") for name in names}
        files = {name: path.with_stem(f"{path.stem}-{part}") for name, part in parts.items()}
    for file in files.values():
        if not os.access(file if file.exists() else file.parent, os.W_OK):
            raise UsageError(f"argument --{option}: {str(file)!r} can not be written")
    if len(set(files.values())) < len(names):
        raise UsageError(f"argument --{option}: two controllers would write to the same file")
    return files


def _play(
    args: Namespace,
    scene: Scene,
    name: str,
    controller: Controller,
    files: Mapping[str, Path | None],
) -> EpisodeRecords:
    from sb3_roles.evaluation.episodes import held_out_seed, run_episodes
    from sb3_roles.evaluation.records import write_records

    seed = args.seed if args.stream == "raw" else held_out_seed(args.seed)
    try:
        records = run_episodes(
            controller,
            scene,
            args.episodes,
            seed,
            args.first_episode,
            args.batch_size,
            name=name,
        )
    except ValueError as error:
        raise UsageError(f"{name}: {error}") from error
    if files["out"] is not None:
        write_records(records, files["out"])
    if files["render"] is not None:
        from sb3_roles.zoo.playback import draw_last

        draw_last(controller, scene, seed, args.first_episode, files["render"])
    return records
