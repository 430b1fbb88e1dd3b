"""Configurations: YAML files that map one to one to keyword arguments, checked as a whole.

The layout is rl-zoo's: an environment's name (or ``default``) at the top, then flat keys.
``n_timesteps``, ``n_steps`` and ``batch_size`` count joint steps, ``n_envs`` teams.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from copy import deepcopy
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import Any

from sb3_roles.common.files import open_regular, write_atomically
from sb3_roles.common.names import closest, printable, shown
from sb3_roles.zoo.algorithms import ALGORITHMS
from sb3_roles.zoo.config_checks import (
    IDENTITY,
    NESTED,
    RADIUS,
    config_problems,
    links_robots,
)
from sb3_roles.zoo.environments import scenes_of_run
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.ranges import problems

DEFAULT = "default"
CONFIG_FILE = "config.yml"
# In the source tree, and where setup.cfg puts them in an installed package.
_CONFIGS = (
    Path(__file__).resolve().parents[2] / "zoo_configs",
    Path(__file__).resolve().parent / "configs",
)
# PyYAML reads as much in some tenths of a second; the files of this package have up to 12 KB.
_MAX_BYTES = 1 << 16
_MOST_RUNS = 5


class ConfigError(UsageError):
    """A configuration that can not be run.

    :param lines: what is wrong, one line each
    """

    def __init__(self, lines: Iterable[str]) -> None:
        self.lines = tuple(printable(str(line)) for line in lines)
        super().__init__("; ".join(self.lines))


def read_yaml(path: Path) -> Any:
    """Read a YAML file of data.

    :param path: the file
    :raises ConfigError: if it can not be read
    """
    from sb3_roles.common.yaml_text import YamlError

    try:
        with open_regular(path) as file:
            # Bounded: it may grow while it is read.
            content = file.read(_MAX_BYTES + 1)
    except OSError as error:
        raise ConfigError([f"{path}: {error.strerror or error}"]) from None
    if len(content) > _MAX_BYTES:
        raise ConfigError([f"{path}: larger than {_MAX_BYTES} bytes, this is no configuration"])
    try:
        # A copy: callers may change what they get.
        return deepcopy(_parsed(content.decode("utf-8")))
    except UnicodeDecodeError as error:
        raise ConfigError(
            [f"{path}: not valid YAML: must be text in UTF-8, byte {error.start} is not"]
        ) from None
    except YamlError as error:
        raise ConfigError([f"{path}: not valid YAML: {error}"]) from None


@lru_cache(maxsize=32)
def _parsed(text: str) -> Any:
    """Read YAML once: plans name the same few files again and again, and PyYAML is slow."""
    from sb3_roles.common.yaml_text import load_yaml

    return load_yaml(text)


def write_yaml(path: Path, values: Mapping[str, Any]) -> None:
    """Write a YAML file of data, keys in their order, whole or not at all."""
    import yaml

    text = yaml.safe_dump(plain(values), sort_keys=False, allow_unicode=True)
    write_atomically(path, text.encode())


def plain(value: Any) -> Any:
    """Return values as they are read again from a file: dicts with texts as keys, and lists.

    :param value: possibly nested
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value


def config_file(algo: str) -> Path:
    """Return the file with an algorithm's configurations."""
    folder = next((path for path in _CONFIGS if path.is_dir()), _CONFIGS[0])
    return folder / f"{algo}.yml"


def load_settings(algo: str, env: str, file: Path | None = None) -> dict[str, Any]:
    """Read the keys of one environment.

    :param algo: name of the algorithm
    :param env: name of the environment; where the file does not have it, ``default`` is taken
    :param file: by default ``zoo_configs/<algo>.yml``; of a run's ``config.yml`` all keys are read
        but those of :func:`load_identity`
    :return: what the file says, unchecked
    :raises ConfigError: if there is no such file or key
    """
    path = config_file(algo) if file is None else file
    content = _read_mapping(path)
    if _is_of_a_run(content):
        settings = _without_identity(content)
    elif env in content or DEFAULT in content:
        settings = content[env if env in content else DEFAULT]
    else:
        message = closest("environment", env, [*map(str, content), DEFAULT])
        raise ConfigError([f"{path}: {message}"])
    if not isinstance(settings, dict):
        raise ConfigError([f"{path}: {env} must be keys and values, got {shown(settings)}"])
    return settings


def load_identity(file: Path) -> dict[str, Any]:
    """Read what a run's ``config.yml`` says of the command line that made it.

    :param file: any configuration
    :return: ``algo``, ``env``, ``seed`` and ``vec_env``, as far as the file has them; empty where
        it is the configuration of no run
    :raises ConfigError: if there is no such file, or one of them is wrong
    """
    content = _read_mapping(file)
    if not _is_of_a_run(content):
        return {}
    identity = {key: content[key] for key in IDENTITY if key in content}
    found = problems("", identity, IDENTITY)
    if found:
        raise ConfigError([f"{file}: {line}" for line in found])
    return identity


def _read_mapping(path: Path) -> dict[Any, Any]:
    content = read_yaml(path)
    if not isinstance(content, dict):
        got = "nothing" if content is None else type(content).__name__
        raise ConfigError([f"{path}: must be keys and values, got {got}"])
    return content


def _is_of_a_run(content: Mapping[Any, Any]) -> bool:
    # Any other file has names of environments at its top.
    return "n_timesteps" in content


def _without_identity(content: Mapping[Any, Any]) -> dict[Any, Any]:
    return {key: value for key, value in content.items() if key not in IDENTITY}


def merge(settings: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings with some of them replaced; ``..._kwargs`` are merged key by key."""
    merged = dict(settings)
    for key, value in overrides.items():
        old = merged.get(key)
        if key in NESTED and isinstance(value, Mapping) and isinstance(old, Mapping):
            value = {**old, **value}
        merged[key] = value
    return merged


def resolve(
    algo: str, env: str, settings: Mapping[str, Any], seed: int = 0, vec_env: str = "auto"
) -> dict[str, Any]:
    """Make the whole configuration of a run from settings, and check it.

    :param algo: name of the algorithm
    :param env: name of the environment, or ``module:factory``
    :param settings: keys of a configuration file; none of those of :func:`load_identity`
    :param seed: seed of the run
    :param vec_env: backend of ``make_team_vec_env``
    :return: what ``config.yml`` holds: plain data
    :raises ConfigError: listing all that is wrong
    """
    algorithm = ALGORITHMS.get(algo)
    if algorithm is None:
        raise ConfigError([closest("algorithm", algo, ALGORITHMS)])
    # A file must not choose what is imported, nor a key change what the run folder is called.
    odd = [key for key in settings if key in IDENTITY]
    if odd:
        raise ConfigError(
            f"{key} is no hyperparameter: give --{key.replace('_', '-')}" for key in odd
        )
    config: dict[str, Any] = {
        "algo": algo,
        "env": env,
        "seed": seed,
        "vec_env": vec_env,
        "n_timesteps": None,
        "n_envs": 8,
        **{key: {} for key in NESTED[:2]},
        "policy": next(iter(algorithm.policies)),
        "policy_kwargs": {},
    }
    for key, value in settings.items():
        config[key] = {} if key in NESTED and value is None else value
    steps = config["n_timesteps"]
    if isinstance(steps, float) and steps.is_integer():
        # The usual way to write it is 5.0e+5.
        config["n_timesteps"] = int(steps)
    found = config_problems(config)
    if found:
        raise ConfigError(found)
    if links_robots(config):
        radius = scenes_of_run(config)[0].communication_radius
        config["policy_kwargs"] = {**config["policy_kwargs"], RADIUS: radius}
    return config


def _no_run(folder: Path) -> str:
    """Say that a folder is none of a run, and which runs there are in it, or beside it."""
    where = folder if folder.is_dir() else folder.parent
    what = "no run folder, without config.yml" if folder.is_dir() else "no such run folder"
    found = [path.parent for depth in ("*", "*/*") for path in where.glob(f"{depth}/{CONFIG_FILE}")]
    names = sorted(str(path.relative_to(where)) for path in found)
    if not names:
        return f"{folder}: {what}"
    close = get_close_matches(folder.name, names, n=1)
    hint = f"; did you mean {str(where / close[0])!r}?" if close else ""
    more = f" and {len(names) - _MOST_RUNS} more" if len(names) > _MOST_RUNS else ""
    return f"{folder}: {what}; runs in {where}: {', '.join(names[:_MOST_RUNS])}{more}{hint}"


def read_run_config(run: Path) -> dict[str, Any]:
    """Read and check the configuration of a run folder.

    :param run: the folder
    :raises ConfigError: if it is none, or its configuration is wrong
    """
    if not run.is_dir() or not os.path.lexists(run / CONFIG_FILE):
        raise ConfigError([_no_run(run)])
    content = _read_mapping(run / CONFIG_FILE)
    settings = _without_identity(content)
    try:
        return resolve(
            str(content.get("algo")),
            str(content.get("env")),
            settings,
            content.get("seed", 0),
            content.get("vec_env", "auto"),
        )
    except ConfigError as error:
        raise ConfigError([f"{run / CONFIG_FILE}: {line}" for line in error.lines]) from None
