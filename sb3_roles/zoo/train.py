"""``sb3-roles train`` and ``train.py``: train an algorithm, in a run folder as rl-zoo's."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_roles.common.names import shown
from sb3_roles.zoo.algorithms import ALGORITHMS
from sb3_roles.zoo.config import ConfigError
from sb3_roles.zoo.config_checks import VEC_ENVS
from sb3_roles.zoo.environments import ENVIRONMENTS
from sb3_roles.zoo.launcher import prepare_process
from sb3_roles.zoo.options import (
    DEVICES,
    MAX_TRAINING_SEED,
    KeyValues,
    check_folder,
    folder_name,
    int_text,
    key_value,
    one_of,
    parse_value,
    several_of,
    whole_number,
)
from sb3_roles.zoo.ray_options import add_ray_options, check_ray_options, connected_to
from sb3_roles.zoo.run_folder import BEST, CHECKPOINTS
from sb3_roles.zoo.stop_signals import StopSignals
from sb3_roles.zoo.train_jobs import DEFAULTS, GIVEN, RunName, new_jobs, resumed_job

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Subparsers

EXIT_ERROR, EXIT_DIVERGED = 2, 3
_NOT_BEGUN = "stopped before a run was begun"
_DESCRIPTION = (
    "Train an algorithm in a new run folder <logs>/<algo>/<env>_<i>, or resume a run. Steps are "
    "joint steps: one of a whole team."
)


def joint_steps(text: str) -> int:
    """Read a number of joint steps: ``500000`` or ``5e5``."""
    try:
        value = parse_value(text)
    except ValueError:
        value = None
    number = value if isinstance(value, (int, float)) and not isinstance(value, bool) else 0
    if not 1 <= number <= 10**12 or number != int(number):
        raise argparse.ArgumentTypeError(
            f"must be a whole number from 1 to {10**12} joint steps, got {shown(text)}"
        )
    return int(number)


def variation(text: str) -> tuple[str, str, Any]:
    """Read one change of ``--vary``: what was written, key and value."""
    return (text, *key_value(text))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.set_defaults(run=run)

    def add(*names: str, help: str, **options: Any) -> None:
        action = parser.add_argument(*names, default=None, help=help, **options)
        default = DEFAULTS.get(action.dest)
        if default is not None and default is not False:
            own = (
                f", {one.options[action.dest]} for {one.name}"
                for one in ALGORITHMS.values()
                if action.dest in one.options
            )
            action.help = f"{help} (default: {default}{''.join(own)})"

    add("--algo", type=several_of("algorithm", ALGORITHMS), metavar="NAME,...",
        help=f"from {', '.join(ALGORITHMS)}; with commas between, a run of each")  # fmt: skip
    add("--env", metavar="ID", help="environment, or module:factory of a PettingZoo ParallelEnv, "
        "which is imported and called")  # fmt: skip
    add("-n", "--n-timesteps", type=joint_steps, metavar="N", help="joint steps, instead of the "
        "configuration's")  # fmt: skip
    add("--scene", metavar="NAME", help="scene of the environment")
    add("--n-agents", type=int_text, metavar="N", help="robots in the team")
    pairs: dict[str, Any] = {
        "type": key_value,
        "nargs": "+",
        "action": KeyValues,
        "metavar": "KEY:VALUE",
    }
    add("--env-kwargs", **pairs, help="arguments of the environment, such as horizon:100")
    add("-params", "--hyperparams", **pairs, help="keys of the configuration to change, such as "
        "gamma:0.9 'policy_kwargs:{graph: false}'")  # fmt: skip
    add("--vary", type=variation, nargs="+", metavar="KEY:VALUE", help="a run with each of these "
        "changes instead of one run with all, such as gamma:0.9 gamma:0.95")  # fmt: skip
    add("-conf", "--conf-file", type=Path, metavar="FILE", help="configuration to read instead of "
        "zoo_configs/<algo>.yml; a run's config.yml stands for its --algo, --env, --seed and "
        "--vec-env, too, where they are not given")  # fmt: skip
    add("--seed", type=whole_number(0, MAX_TRAINING_SEED), metavar="S", help="seed of the run")
    add("--n-seeds", type=whole_number(1, 1000), metavar="K", help="runs with seeds S .. S+K-1, "
        "one after the other, or with --ray side by side")  # fmt: skip
    add("--vec-env", type=one_of("backend", VEC_ENVS), metavar="NAME", help="native, supersuit or "
        "auto")  # fmt: skip
    add("-f", "--log-folder", type=folder_name, metavar="DIR", help="folder of the runs")
    add("--eval-freq", type=whole_number(0, 10**12), metavar="N", help="joint steps between "
        "evaluations, 0 for none")  # fmt: skip
    add("--eval-episodes", type=whole_number(1, 10**6), metavar="N", help="team episodes of an "
        "evaluation")  # fmt: skip
    add("--save-freq", type=whole_number(0, 10**12), metavar="N", help="joint steps between "
        "checkpoints, 0 for one at the end")  # fmt: skip
    add("--log-interval", type=whole_number(1, 10**6), metavar="N", help="iterations between rows "
        "of the log")  # fmt: skip
    add("-tb", "--tensorboard-log", type=folder_name, metavar="DIR", help="folder for TensorBoard")
    add("--device", type=one_of("device", DEVICES), metavar="NAME", help="cpu, "
        "cuda or auto")  # fmt: skip
    add("--num-threads", type=whole_number(1, 1024), metavar="T", help="threads of torch; by "
        "default torch's own choice")  # fmt: skip
    add_ray_options(add)
    add("-P", "--progress", action="store_true", help="show a progress bar")
    add("--resume", type=folder_name, metavar="RUN", help="run folder to continue bit for bit; "
        "needs --env, too, if that is module:factory")  # fmt: skip
    add("--strict-resume", action="store_true", help="with --resume: go on only if nothing "
        "is known that keeps it from being bit for bit, such as other threads, versions or kinds "
        "of processors; else exit with code 2, and leave the run as it is")  # fmt: skip
    add("--verbose", type=whole_number(0, 2), metavar="N", help="0 prints the outcome only")


def add_parser(subparsers: Subparsers) -> None:
    """Add the command."""
    add_options(
        subparsers.add_parser(
            "train",
            help="train an algorithm",
            description=_DESCRIPTION,
            formatter_class=argparse.HelpFormatter,
        )
    )


def run(args: argparse.Namespace) -> int:
    """Train, once for each algorithm, change and seed.

    :param args: parsed arguments
    :return: 0; 2 if the configuration is wrong; 3 if a loss or reward is not finite, or the
        environment fails; 130 or 143 after a signal
    :raises UsageError: if the arguments do not go together
    """
    stop = StopSignals()
    try:
        with stop.caught():
            return _run(args, stop)
    except KeyboardInterrupt:
        print(f"{args.parser.prog}: {_NOT_BEGUN}", file=sys.stderr)
        return stop.exit_code


def _run(args: argparse.Namespace, stop: StopSignals) -> int:
    given = {key: value for key, value in vars(args).items() if key in GIVEN and value is not None}
    runs: list[RunName] = []
    try:
        if "resume" in given:
            jobs = [resumed_job(given)]
        else:
            runs, jobs = new_jobs(given)
        for job in jobs:
            check_ray_options(job["options"], job["config"], len(jobs) > 1)
        _check_folders(jobs[0]["options"], jobs[0]["resume"])
    except ConfigError as error:
        for line in error.lines:
            print(f"{args.parser.prog}: error: {line}", file=sys.stderr)
        return EXIT_ERROR
    with stop.at_once(f"{args.parser.prog}: {_NOT_BEGUN}"):
        prepare_process()
        from sb3_roles.zoo.job import TrainingFailed, run_job

    if len(jobs) > 1 and "ray" in given:
        return _fan_out(args, runs, jobs[0]["options"], stop)
    try:
        for job in jobs:
            code = run_job(job, stop)
            if code:
                return code
    except TrainingFailed as error:
        print(f"{args.parser.prog}: error: {error}", file=sys.stderr)
        return EXIT_DIVERGED
    return 0


def _check_folders(options: Mapping[str, Any], run: Path | None) -> None:
    for name in ("log_folder", "tensorboard_log"):
        if options[name] is not None:
            check_folder(f"--{name.replace('_', '-')}", Path(options[name]))
    for path in () if run is None else (run, run / CHECKPOINTS, run / BEST):
        check_folder("--resume", path)


def _fan_out(
    args: argparse.Namespace, runs: list[RunName], options: Mapping[str, Any], stop: StopSignals
) -> int:
    """Train all runs on a cluster."""
    cluster = connected_to(options["ray"])
    import torch as th

    from sb3_roles.zoo.ray_runs import RunOf, run_on_ray

    # The same as here, where a run alone would take torch's choice: sums depend on it.
    n_threads = options["num_threads"] or th.get_num_threads()
    try:
        # Ray has a handler of its own.
        with stop.caught():
            return run_on_ray(args.arguments, [RunOf(*run) for run in runs], options, n_threads)
    except KeyboardInterrupt:
        own = "" if options["env"] in ENVIRONMENTS else f" --env {options['env']}"
        print(f"stopped; each run goes on with: train.py --resume RUN{own}", flush=True)
        return stop.exit_code
    finally:
        cluster.disconnect()
