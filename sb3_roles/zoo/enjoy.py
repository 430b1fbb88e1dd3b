"""``sb3-roles enjoy``: play episodes with a trained policy, on the screen or into a video."""

from __future__ import annotations

import os
import sys
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from area_search.scenes import mix_of
from sb3_roles.zoo.environments import AREA_SEARCH
from sb3_roles.zoo.options import (
    DEVICES,
    MAX_SEED,
    KeyValues,
    UsageError,
    int_text,
    key_value,
    one_of,
    output_file,
    positive_number,
    whole_number,
)
from sb3_roles.zoo.video import ENDINGS, VideoWriter, check_video

if TYPE_CHECKING:
    import numpy as np

    from sb3_roles.evaluation.policies import PolicyController
    from sb3_roles.zoo.loaded_run import LoadedRun
    from sb3_roles.zoo.options import Subparsers
    from sb3_roles.zoo.playback import Show

_ALGO, _LOGS = "hmappo", Path("logs")
_PERCENT = ("explo_paper", "explo_true", "cover")


def add_parser(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "enjoy",
        help="watch a trained policy",
        description="Play episodes with a trained policy and print their metrics; in a window "
        "where there is a display, or into a video.",
    )
    parser.add_argument(
        "--algo", default=None, metavar="NAME", help=f"that was trained (default: {_ALGO})"
    )
    parser.add_argument(
        "--env",
        default=None,
        metavar="ID",
        help="environment, or module:factory of one's own, which is imported and called "
        f"(default: {AREA_SEARCH})",
    )
    parser.add_argument(
        "--pretrained",
        nargs="?",
        const="",
        metavar="ROW",
        help="play the weights that come with this package, of a learned row of the tables or "
        "ROW/seed_K, instead of a run; by default of the row called like the algorithm",
    )
    parser.add_argument(
        "-f",
        "--folder",
        type=Path,
        metavar="DIR",
        help=f"of the logs, or a run (default: {_LOGS})",
    )
    parser.add_argument(
        "--exp-id",
        type=whole_number(0, 10**9),
        metavar="N",
        help="run; 0: the latest (default: 0)",
    )
    parser.add_argument("--load-best", action="store_true", help="the best evaluated policy")
    add_play_options(parser)
    parser.add_argument(
        "--video",
        type=output_file(*ENDINGS),
        metavar="FILE",
        help="write an animation, .mp4 or .gif",
    )
    parser.add_argument("--scene", default=None, metavar="NAME", help="another scene (area search)")
    parser.add_argument(
        "--n-agents", type=int_text, default=None, metavar="N", help="another team size"
    )
    parser.add_argument(
        "--env-kwargs",
        type=key_value,
        nargs="+",
        action=KeyValues,
        default={},
        metavar="KEY:VALUE",
        help="arguments of the environment to change",
    )
    parser.add_argument(
        "--episodes", type=whole_number(1, 10**6), default=1, metavar="N", help="number of them"
    )
    parser.add_argument(
        "--seed", type=whole_number(0, MAX_SEED), default=0, metavar="N", help="of the episodes"
    )
    parser.add_argument("--no-render", action="store_true", help="open no window")
    parser.add_argument(
        "--fps", type=positive_number(240), default=5.0, metavar="X", help="frames per second"
    )
    parser.set_defaults(run=run)


def add_play_options(parser: Any) -> None:
    """Add the options that say how a policy acts."""
    choice = parser.add_mutually_exclusive_group()
    choice.add_argument(
        "--deterministic", action="store_true", help="take the likeliest actions (the default)"
    )
    choice.add_argument("--stochastic", action="store_true", help="draw the actions")
    parser.add_argument(
        "--no-communication", action="store_true", help="no messages between robots"
    )
    parser.add_argument(
        "--device",
        type=one_of("device", DEVICES),
        default="auto",
        metavar="NAME",
        help="cpu, cuda, or auto",
    )


def run(args: Namespace) -> int:
    """Play the episodes.

    :param args: parsed arguments
    :return: exit code
    :raises UsageError: if there is no such run, or an option does not fit it
    """
    from sb3_roles.zoo.algorithms import get_algorithm

    try:
        get_algorithm(args.algo or _ALGO)
    except ValueError as error:
        raise UsageError(f"argument --algo: {error}") from None
    if args.video is not None:
        check_video(args.video)
    loaded, drawn = _load(args)
    controller = loaded.controller(not drawn, not args.no_communication)
    config = _changed(loaded.config, args)
    print(f"{config['algo']} on {config['env']}, {loaded.folder}")
    with _display(args, f"{config['algo']} on {config['env']}") as show:
        outcomes = []
        for episode, (metrics, roles) in enumerate(_episodes(controller, config, args, show)):
            outcomes.append(metrics)
            print(f"episode {episode}: {_line(metrics, roles, controller.role_names)}", flush=True)
    if len(outcomes) > 1:
        names = [name for name in outcomes[0] if not name.startswith("t90")]
        means = {name: sum(outcome[name] for outcome in outcomes) / len(outcomes) for name in names}
        print(f"mean of {len(outcomes)}: {_line(means)}")
    if args.video is not None:
        print(f"wrote {args.video}")
    return 0


def _load(args: Namespace) -> tuple[LoadedRun, bool]:
    """Load what the command line asks for; also whether its actions are drawn."""
    from sb3_roles.zoo.config import CONFIG_FILE
    from sb3_roles.zoo.loaded_run import load_run
    from sb3_roles.zoo.published import find_published
    from sb3_roles.zoo.run_folder import find_run

    if args.pretrained is not None:
        for option in ("folder", "exp_id", "load_best"):
            if (value := getattr(args, option)) is not None and value is not False:
                name = option.replace("_", "-")
                raise UsageError(f"argument --{name}: it is of a run, and not for --pretrained")
        found = find_published(args.pretrained or args.algo or _ALGO)
        drawn = found.is_drawn(args.deterministic, args.stochastic)
        return found.load(args.device, args.env, args.algo), drawn
    folder = _LOGS if args.folder is None else args.folder
    if not (folder / CONFIG_FILE).is_file():
        folder = find_run(folder, args.algo or _ALGO, args.env or AREA_SEARCH, args.exp_id or 0)
    loaded = load_run(folder, args.load_best, args.device, args.env, args.algo)
    return loaded, args.stochastic


def _changed(config: Mapping[str, Any], args: Namespace) -> dict[str, Any]:
    """Return the configuration of the run with the changes of the command line."""
    from sb3_roles.zoo.environments import env_problems, scenes_of_run

    options = dict(config.get("env_kwargs") or {})
    if config["env"] == AREA_SEARCH:
        # For training only: an episode that is watched is played to its end.
        options.pop("early_stop_patience", None)
    options.update(args.env_kwargs)
    for name in ("scene", "n_agents"):
        if getattr(args, name) is not None:
            options[name] = getattr(args, name)
    found = env_problems(config["env"], options)
    if found:
        raise UsageError("; ".join(found))
    changed = {**config, "env_kwargs": options}
    scenes = scenes_of_run(changed) if config["env"] == AREA_SEARCH else ()
    if len(scenes) > 1:
        raise UsageError(f"it was trained on {mix_of(scenes)}: add --scene NAME")
    return changed


def _episodes(
    controller: PolicyController, config: Mapping[str, Any], args: Namespace, show: Show | None
) -> Iterator[tuple[dict[str, float], np.ndarray]]:
    from sb3_roles.common.team_vec_env import team_seeds
    from sb3_roles.zoo.environments import env_factory, scenes_of_run
    from sb3_roles.zoo.playback import play_env, play_scene

    try:
        if config["env"] == AREA_SEARCH:
            from sb3_roles.evaluation.episodes import held_out_seed

            scene, links = scenes_of_run(config)[0], bool(controller.communicate)
            # The episodes that `evaluate --seed` scores.
            seed = held_out_seed(args.seed)
            for episode in range(args.episodes):
                yield play_scene(controller, scene, seed, episode, show, links)
            return
        drawn = {} if show is None else {"render_mode": "rgb_array"}
        env = env_factory(config["env"], {**config["env_kwargs"], **drawn})()
        try:
            for seed in team_seeds(args.seed, args.episodes):
                yield play_env(controller, env, seed, show)
        finally:
            env.close()
    except ValueError as error:
        raise UsageError(str(error)) from error


@contextmanager
def _display(args: Namespace, title: str) -> Iterator[Show | None]:
    """Give what takes the frames: a video, a window, or None where nothing is drawn."""
    if args.video is not None:
        with VideoWriter(args.video, args.fps) as video:
            yield video.add
        return
    if args.no_render or not _has_screen():
        if not args.no_render:
            print("no display: metrics only; --video FILE.gif makes an animation")
        yield None
        return
    from area_search.render import Window

    window = Window(title)

    def show(frame: np.ndarray) -> None:
        if not window.show(frame, args.fps):
            raise KeyboardInterrupt

    try:
        yield show
    finally:
        window.close()


def _has_screen() -> bool:
    if sys.platform in ("darwin", "win32"):
        return True
    names = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    return any(os.environ.get(name) for name in names)


def _line(
    metrics: Mapping[str, float],
    roles: np.ndarray | None = None,
    role_names: Sequence[str] = (),
) -> str:
    parts = []
    for name, value in metrics.items():
        if name in _PERCENT:
            parts.append(f"{name} {100 * value:.1f} %")
        elif name.startswith("t90") and value < 0:
            parts.append(f"{name} -")
        else:
            parts.append(f"{name} {value:g}")
    if roles is not None and roles.size and roles.min() >= 0:
        parts += [f"{name} {100 * (roles == k).mean():.0f} %" for k, name in enumerate(role_names)]
        if len(roles) > 1:
            parts.append(f"role switches {100 * (roles[1:] != roles[:-1]).mean():.0f} %")
    return ", ".join(parts)
