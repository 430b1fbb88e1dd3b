"""The jobs that the options of ``train`` ask for: plain data, one for each run."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_roles.common.names import closest, shown
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
from sb3_roles.zoo.environments import AREA_SEARCH, check_named
from sb3_roles.zoo.options import DEVICES, UsageError
from sb3_roles.zoo.run_folder import ARGS_FILE

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
    "strict_resume": False,
    "verbose": 1,
}
GIVEN = frozenset(
    {
        *DEFAULTS,
        "n_timesteps",
        "scene",
        "n_agents",
        "env_kwargs",
        "hyperparams",
        "vary",
        "conf_file",
        "resume",
        "ray",
        "rollout_workers",
    }
)
# What may be given together with --resume; the rest is the run's.
_FREE = (
    "resume",
    "strict_resume",
    "env",
    "n_timesteps",
    "device",
    "num_threads",
    "progress",
    "verbose",
    "save_freq",
    "ray",
    "rollout_workers",
    "tensorboard_log",
)
_STORED = ("eval_freq", "eval_episodes", "save_freq", "log_interval", "tensorboard_log")
_STORED_RANGES: dict[str, tuple[int, int]] = {
    "eval_freq": (0, 10**12),
    "eval_episodes": (1, 10**6),
    "save_freq": (0, 10**12),
    "log_interval": (1, 10**6),
    "num_threads": (1, 1024),
}


RunName = tuple[str, str | None, int]
"""Algorithm, change of the configuration if there are several, and seed."""


def new_jobs(given: Mapping[str, Any]) -> tuple[list[RunName], list[dict[str, Any]]]:
    """Make the jobs of new runs.

    :param given: options of the command line
    :return: what tells the runs from each other; for each the configuration and the options
    :raises ConfigError: if a configuration is wrong
    :raises UsageError: if the options do not go together
    """
    if "strict_resume" in given:
        raise UsageError("--strict-resume needs --resume RUN")
    algos = given.get("algo", (None,))
    changes = given.get("vary", (None,))
    if len(algos) > 1 and "conf_file" in given:
        raise UsageError("--conf-file is of one algorithm: give one --algo, or none")
    runs, jobs = [], []
    for algo, change in itertools.product(algos, changes):
        own = {key: value for key, value in given.items() if key not in ("algo", "vary")}
        if algo is not None:
            own["algo"] = algo
        if change is not None:
            text, key, value = change
            if key in own.get("hyperparams", {}):
                raise UsageError(f"{key} is given in --vary and in --hyperparams")
            own["hyperparams"] = {**own.get("hyperparams", {}), key: value}
        options = _options(own)
        for seed in range(options["seed"], options["seed"] + options["n_seeds"]):
            jobs.append(_new_job(own, {**options, "seed": seed}))
            runs.append((options["algo"], None if change is None else text, seed))
    return runs, jobs


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


def _is_here(folder: str) -> bool:
    try:
        return Path(folder).resolve().is_relative_to(Path.cwd().resolve())
    except (OSError, ValueError, RuntimeError):
        return False


def resumed_job(given: Mapping[str, Any]) -> dict[str, Any]:
    """Make the job that continues a run.

    :param given: options of the command line
    :raises ConfigError: if the run folder is damaged
    :raises UsageError: if an option is the run's
    """
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
                [f"{path / ARGS_FILE}: {name} must be from {low} to {high}, got {shown(value)}"]
            )
    if options["device"] not in DEVICES:
        message = closest("device", options["device"], DEVICES)
        raise ConfigError([f"{path / ARGS_FILE}: {message}"])
    folder = options["tensorboard_log"]
    if folder is not None and not isinstance(folder, str):
        raise ConfigError([f"{path / ARGS_FILE}: tensorboard_log must be a text, got {folder!r}"])
    if folder is not None and "tensorboard_log" not in given and not _is_here(folder):
        # A run folder may come from anybody, and must not choose where files are written.
        raise ConfigError(
            [
                f"{path / ARGS_FILE}: tensorboard_log is {folder}, outside of the current folder: "
                f"add --tensorboard-log {folder} if you want that"
            ]
        )
    if "n_timesteps" in given:
        config["n_timesteps"] = given["n_timesteps"]
    return {"config": config, "options": options, "resume": path}
