"""``sb3-roles train`` and ``train.py``: train an algorithm, in a run folder as rl-zoo's."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_roles.common.names import closest
from sb3_roles.zoo.algorithms import ALGORITHMS
from sb3_roles.zoo.config import (
    ConfigError,
    load_identity,
    load_settings,
    merge,
    read_run_config,
    read_yaml,
    resolve,
)
from sb3_roles.zoo.config_checks import VEC_ENVS
from sb3_roles.zoo.environments import AREA_SEARCH, check_named
from sb3_roles.zoo.launcher import prepare_process
from sb3_roles.zoo.options import (
    DEVICES,
    MAX_TRAINING_SEED,
    KeyValues,
    UsageError,
    int_text,
    key_value,
    one_of,
    parse_value,
    whole_number,
)
from sb3_roles.zoo.ray_options import add_ray_options, check_ray_options, connected_to
from sb3_roles.zoo.run_folder import ARGS_FILE

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Subparsers

EXIT_ERROR, EXIT_DIVERGED = 2, 3
_DESCRIPTION = (
    "Train an algorithm in a new run folder <logs>/<algo>/<env>_<i>, or resume a run. Steps are "
    "joint steps: one of a whole team."
)
# Not argparse's own: with --resume it must be known what was given.
DEFAULTS: dict[str, Any] = {
    "algo": "hmappo",
    "env": AREA_SEARCH,
    "seed": 0,
    "n_seeds": 1,
    "vec_env": "auto",
    "log_folder": "logs",
    "eval_freq": 50_000,
    "eval_episodes": 100,
    "save_freq": 50_000,
    "log_interval": 1,
    "tensorboard_log": None,
    "device": "auto",
    "num_threads": None,
    "progress": False,
    "verbose": 1,
}
_GIVEN = frozenset(
    {
        *DEFAULTS,
        "n_timesteps",
        "scene",
        "n_agents",
        "env_kwargs",
        "hyperparams",
        "conf_file",
        "resume",
        "ray",
        "rollout_workers",
    }
)
# What may be given together with --resume; the rest is the run's.
_FREE = (
    "resume",
    "env",
    "n_timesteps",
    "device",
    "num_threads",
    "progress",
    "verbose",
    "save_freq",
    "ray",
    "rollout_workers",
)
_STORED = ("eval_freq", "eval_episodes", "save_freq", "log_interval", "tensorboard_log")
_STORED_RANGES: dict[str, tuple[int, int]] = {
    "eval_freq": (0, 10**12),
    "eval_episodes": (1, 10**6),
    "save_freq": (0, 10**12),
    "log_interval": (1, 10**6),
    "num_threads": (1, 1024),
}


def joint_steps(text: str) -> int:
    """Read a number of joint steps: ``500000`` or ``5e5``."""
    try:
        value = parse_value(text)
    except ValueError:
        value = None
    number = value if isinstance(value, (int, float)) and not isinstance(value, bool) else 0
    if not 1 <= number <= 10**12 or number != int(number):
        raise argparse.ArgumentTypeError(
            f"must be a whole number from 1 to {10**12} joint steps, got {text!r}"
        )
    return int(number)


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

    add("--algo", type=one_of("algorithm", ALGORITHMS), metavar="NAME",
        help=f"one of {', '.join(ALGORITHMS)}")  # fmt: skip
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
    add("-conf", "--conf-file", type=Path, metavar="FILE", help="configuration to read instead of "
        "zoo_configs/<algo>.yml; a run's config.yml stands for its --algo, --env, --seed and "
        "--vec-env, too, where they are not given")  # fmt: skip
    add("--seed", type=whole_number(0, MAX_TRAINING_SEED), metavar="S", help="seed of the run")
    add("--n-seeds", type=whole_number(1, 1000), metavar="K", help="runs with seeds S .. S+K-1, "
        "one after the other, or with --ray side by side")  # fmt: skip
    add("--vec-env", type=one_of("backend", VEC_ENVS), metavar="NAME", help="native, supersuit or "
        "auto")  # fmt: skip
    add("-f", "--log-folder", metavar="DIR", help="folder of the runs")
    add("--eval-freq", type=whole_number(0, 10**12), metavar="N", help="joint steps between "
        "evaluations, 0 for none")  # fmt: skip
    add("--eval-episodes", type=whole_number(1, 10**6), metavar="N", help="team episodes of an "
        "evaluation")  # fmt: skip
    add("--save-freq", type=whole_number(0, 10**12), metavar="N", help="joint steps between "
        "checkpoints, 0 for one at the end")  # fmt: skip
    add("--log-interval", type=whole_number(1, 10**6), metavar="N", help="iterations between rows "
        "of the log")  # fmt: skip
    add("-tb", "--tensorboard-log", metavar="DIR", help="folder for TensorBoard")
    add("--device", type=one_of("device", DEVICES), metavar="NAME", help="cpu, "
        "cuda or auto")  # fmt: skip
    add("--num-threads", type=whole_number(1, 1024), metavar="T", help="threads of torch; by "
        "default torch's own choice")  # fmt: skip
    add_ray_options(add)
    add("-P", "--progress", action="store_true", help="show a progress bar")
    add("--resume", type=Path, metavar="RUN", help="run folder to continue bit for bit; needs "
        "--env, too, if that is module:factory")  # fmt: skip
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
    """Train, once per seed.

    :param args: parsed arguments
    :return: 0; 2 if the configuration is wrong; 3 if a loss or reward is not finite; 130 or 143
        after a signal
    :raises UsageError: if the arguments do not go together
    """
    given = {key: value for key, value in vars(args).items() if key in _GIVEN and value is not None}
    try:
        if "resume" in given:
            jobs = [_resumed_job(given)]
        else:
            options = _options(given)
            seeds = range(options["seed"], options["seed"] + options["n_seeds"])
            jobs = [_new_job(given, {**options, "seed": seed}) for seed in seeds]
        for job in jobs:
            check_ray_options(job["options"], job["config"])
    except ConfigError as error:
        for line in error.lines:
            print(f"{args.parser.prog}: error: {line}", file=sys.stderr)
        return EXIT_ERROR
    prepare_process()
    if len(jobs) > 1 and "ray" in given:
        return _fan_out(args, jobs)
    from sb3_roles.zoo.job import TrainingFailed, run_job

    try:
        for job in jobs:
            code = run_job(job)
            if code:
                return code
    except TrainingFailed as error:
        print(f"{args.parser.prog}: error: {error}", file=sys.stderr)
        return EXIT_DIVERGED
    return 0


def _fan_out(args: argparse.Namespace, jobs: list[dict[str, Any]]) -> int:
    """Train all jobs, which differ in their seeds, on a cluster."""
    options = jobs[0]["options"]
    cluster = connected_to(options["ray"])
    import torch as th

    from sb3_roles.zoo.ray_runs import run_on_ray

    # The same as here, where a run alone would take torch's choice: sums depend on it.
    n_threads = options["num_threads"] or th.get_num_threads()
    seeds = [job["config"]["seed"] for job in jobs]
    try:
        return run_on_ray(args.arguments, seeds, options, n_threads)
    finally:
        cluster.disconnect()


def _options(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return all options: the given ones, those of a run's ``config.yml``, and the defaults."""
    file = given.get("conf_file")
    if file is None:
        return {**_defaults(given.get("algo", DEFAULTS["algo"])), **given}
    identity = load_identity(file)
    algo = identity.get("algo")
    if algo is not None and given.get("algo", algo) != algo:
        raise UsageError(f"{file} is of a run of {algo}: leave --algo {given['algo']} out")
    if "env" not in given and "env" in identity:
        check_named(file, identity["env"], None)
    options = {**identity, **given}
    return {**_defaults(options.get("algo", DEFAULTS["algo"])), **options}


def _defaults(algo: str) -> dict[str, Any]:
    return {**DEFAULTS, **ALGORITHMS[algo].options}


def _new_job(given: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the plain data of a job: its configuration and its options."""
    algo, env = options["algo"], options["env"]
    settings = load_settings(algo, env, given.get("conf_file"))
    overrides = dict(given.get("hyperparams", {}))
    env_kwargs = dict(overrides.get("env_kwargs") or {})
    for key, value in given.get("env_kwargs", {}).items():
        if key in env_kwargs and env_kwargs[key] != value:
            raise UsageError(f"{key} is given in --env-kwargs and in --hyperparams")
        env_kwargs[key] = value
    for key in ("scene", "n_agents"):
        if key in given:
            if key in env_kwargs:
                flag = "--" + key.replace("_", "-")
                raise UsageError(f"give {flag} or --env-kwargs {key}:..., not both")
            env_kwargs[key] = given[key]
    if env_kwargs:
        overrides["env_kwargs"] = env_kwargs
    if "n_timesteps" in given:
        overrides["n_timesteps"] = given["n_timesteps"]
    config = resolve(algo, env, merge(settings, overrides), options["seed"], options["vec_env"])
    return {"config": config, "options": options, "resume": None}


def _resumed_job(given: Mapping[str, Any]) -> dict[str, Any]:
    odd = [key for key in given if key not in _FREE]
    if odd:
        name = odd[0].replace("_", "-")
        raise UsageError(f"--resume continues a run as it is: leave --{name} out")
    path = Path(given["resume"])
    config = read_run_config(path)
    check_named(path, config["env"], given.get("env"))
    stored = read_yaml(path / ARGS_FILE)
    if not isinstance(stored, dict):
        raise ConfigError([f"{path / ARGS_FILE}: must be keys and values"])
    names = (*_STORED, "device", "num_threads")
    defaults = _defaults(config["algo"])
    options = {**defaults, **{name: stored.get(name, defaults[name]) for name in names}, **given}
    for name, (low, high) in _STORED_RANGES.items():
        value = options[name]
        whole = isinstance(value, int) and not isinstance(value, bool) and low <= value <= high
        if not whole and not (name == "num_threads" and value is None):
            raise ConfigError(
                [f"{path / ARGS_FILE}: {name} must be from {low} to {high}, got {value!r}"]
            )
    if options["device"] not in DEVICES:
        message = closest("device", options["device"], DEVICES)
        raise ConfigError([f"{path / ARGS_FILE}: {message}"])
    folder = options["tensorboard_log"]
    if folder is not None and not isinstance(folder, str):
        raise ConfigError([f"{path / ARGS_FILE}: tensorboard_log must be a text, got {folder!r}"])
    if "n_timesteps" in given:
        config["n_timesteps"] = given["n_timesteps"]
    return {"config": config, "options": options, "resume": path}
