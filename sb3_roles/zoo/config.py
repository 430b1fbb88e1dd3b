"""Configurations: YAML files that map one to one to keyword arguments, checked as a whole.

The layout is rl-zoo's: an environment's name (or ``default``) at the top, then flat keys.
``n_timesteps``, ``n_steps`` and ``batch_size`` count joint steps, ``n_envs`` teams.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from sb3_roles.common.names import closest
from sb3_roles.common.roles import ROLES
from sb3_roles.zoo.algorithms import ALGORITHMS, POLICY_ARGUMENTS, Algorithm
from sb3_roles.zoo.environments import AREA_SEARCH, REWARD_COMPONENTS, env_problems
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.ranges import Choice, Items, Range, Weights, Whole, problems

DEFAULT = "default"
NESTED = ("env_kwargs", "wrapper_kwargs", "policy_kwargs")
REWARD_SHARING = ("own", "same_role", "team")
VEC_ENVS = ("auto", "native", "supersuit")
CONFIG_FILE = "config.yml"
# In the source tree, and where setup.cfg puts them in an installed package.
_CONFIGS = (
    Path(__file__).resolve().parents[2] / "zoo_configs",
    Path(__file__).resolve().parent / "configs",
)
_RUN: dict[str, Range] = {"n_timesteps": Whole(1, 1e12), "n_envs": Whole(1, 1e5)}
_MAX_BYTES = 1 << 20


class ConfigError(UsageError):
    """A configuration that can not be run.

    :param lines: what is wrong, one line each
    """

    def __init__(self, lines: Iterable[str]) -> None:
        self.lines = tuple(" ".join(str(line).split()) for line in lines)
        super().__init__("; ".join(self.lines))


def read_yaml(path: Path) -> Any:
    """Read a YAML file of data.

    :param path: the file
    :raises ConfigError: if it can not be read
    """
    import yaml

    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ConfigError([f"{path}: larger than {_MAX_BYTES} bytes, this is no configuration"])
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError([f"{path}: {error.strerror or error}"]) from None
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError([f"{path}: not valid YAML: {error}"]) from None


def write_yaml(path: Path, values: Mapping[str, Any]) -> None:
    """Write a YAML file of data, keys in their order."""
    import yaml

    text = yaml.safe_dump(_plain(values), sort_keys=False, allow_unicode=True)
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value


def config_file(algo: str) -> Path:
    """Return the file with an algorithm's configurations."""
    folder = next((path for path in _CONFIGS if path.is_dir()), _CONFIGS[0])
    return folder / f"{algo}.yml"


def load_settings(algo: str, env: str, file: Path | None = None) -> dict[str, Any]:
    """Read the keys of one environment.

    :param algo: name of the algorithm
    :param env: name of the environment; where the file does not have it, ``default`` is taken
    :param file: by default ``zoo_configs/<algo>.yml``; a run's ``config.yml`` will do
    :return: what the file says, unchecked
    :raises ConfigError: if there is no such file or key
    """
    path = config_file(algo) if file is None else file
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise ConfigError([f"{path}: must be keys and values, got {type(content).__name__}"])
    if "n_timesteps" in content:
        settings = {key: value for key, value in content.items() if key not in _IDENTITY}
    elif env in content or DEFAULT in content:
        settings = content[env if env in content else DEFAULT]
    else:
        message = closest("environment", env, [*content, DEFAULT])
        raise ConfigError([f"{path}: {message}"])
    if not isinstance(settings, dict):
        raise ConfigError([f"{path}: {env} must be keys and values, got {settings!r}"])
    return settings


_IDENTITY = ("algo", "env", "seed", "vec_env")


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
    :param settings: keys of a configuration file
    :param seed: seed of the run
    :param vec_env: backend of ``make_team_vec_env``
    :return: what ``config.yml`` holds: plain data
    :raises ConfigError: listing all that is wrong
    """
    algorithm = ALGORITHMS.get(algo)
    if algorithm is None:
        raise ConfigError([closest("algorithm", algo, ALGORITHMS)])
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
    return config


def config_problems(config: Mapping[str, Any]) -> list[str]:
    """Find all that is wrong with a whole configuration.

    :param config: as :func:`resolve` returns it
    :return: one line per problem
    """
    algo, env = config.get("algo"), config.get("env")
    if not isinstance(algo, str) or algo not in ALGORITHMS:
        return [closest("algorithm", algo, ALGORITHMS)]
    algorithm = ALGORITHMS[algo]
    if not isinstance(env, str):
        return [f"env must be a name or module:factory, got {env!r}"]
    top: dict[str, Range] = {
        **_RUN,
        "seed": Whole(0, 2**63 - 1),
        "vec_env": Choice(VEC_ENVS),
        "policy": Choice(tuple(algorithm.policies)),
        **algorithm.parameters,
    }
    nested = {key: config[key] for key in NESTED if key in config}
    flat = {key: config[key] for key in config if key not in (*nested, "algo", "env")}
    # The nested keys are here for the closest match of a mistyped one.
    found = problems("", flat, {**top, **dict.fromkeys(NESTED, Weights())})
    for key, value in nested.items():
        if not isinstance(value, Mapping):
            found.append(f"{key} must be keys and values, got {value!r}")
    if isinstance(config.get("env_kwargs"), Mapping):
        found += env_problems(env, config["env_kwargs"])
    if isinstance(config.get("wrapper_kwargs"), Mapping):
        found += _wrapper_problems(algorithm, env, config["wrapper_kwargs"])
    policy = config.get("policy")
    if isinstance(config.get("policy_kwargs"), Mapping) and policy in POLICY_ARGUMENTS:
        found += problems("policy_kwargs", config["policy_kwargs"], POLICY_ARGUMENTS[policy])
    return found or _together(config)


def _wrapper_problems(algorithm: Algorithm, env: str, options: Mapping[str, Any]) -> list[str]:
    if algorithm.wrapper == "team":
        if options:
            return [f"wrapper_kwargs must be empty: {algorithm.name} has no roles, got {options}"]
        return []
    roles = options.get("roles", ["explore", "cover"])
    role_names = tuple(roles) if isinstance(roles, list) else ()
    found = problems(
        "wrapper_kwargs",
        options,
        {
            "roles": Items(Choice(tuple(ROLES)), least=1),
            "role_weights": Weights(optional=True),
            "primitive_weights": Choice(("identity", "role_reward"), matrix=True),
            "reward_sharing": Choice(REWARD_SHARING),
            "role_every": Whole(1, 1e6),
            "role_control": Choice(("learned", "random", *role_names)),
        },
    )
    if not algorithm.holds_roles and not found:
        for key, only in (("role_every", 1), ("role_control", "learned")):
            if options.get(key, only) != only:
                found.append(
                    f"wrapper_kwargs.{key} must be {only} for {algorithm.name}, whose policy "
                    f"chooses a role at every step, got {options[key]!r}"
                )
    if env == AREA_SEARCH and not found:
        found += _component_problems(options)
    return found


def _component_problems(options: Mapping[str, Any]) -> list[str]:
    tables = {"role_weights": options.get("role_weights") or {}}
    matrix = options.get("primitive_weights")
    if isinstance(matrix, Mapping):
        tables |= {f"primitive_weights.{role}": weights for role, weights in matrix.items()}
    return [
        f"wrapper_kwargs.{table}: {closest('reward component', name, REWARD_COMPONENTS)}"
        for table, weights in tables.items()
        for name in weights
        if name not in REWARD_COMPONENTS
    ]


def _together(config: Mapping[str, Any]) -> list[str]:
    """What is wrong with values that are right one by one."""
    n_steps, batch_size = config.get("n_steps"), config.get("batch_size")
    if n_steps is None or batch_size is None or batch_size <= n_steps * config["n_envs"]:
        return []
    return [
        f"batch_size must be at most n_steps x n_envs = {n_steps} x {config['n_envs']} = "
        f"{n_steps * config['n_envs']} joint steps, got {batch_size}"
    ]


def read_run_config(run: Path) -> dict[str, Any]:
    """Read and check the configuration of a run folder.

    :param run: the folder
    :raises ConfigError: if it is none, or its configuration is wrong
    """
    if not run.is_dir():
        raise ConfigError([f"{run}: no such run folder"])
    content = read_yaml(run / CONFIG_FILE)
    if not isinstance(content, dict):
        raise ConfigError([f"{run / CONFIG_FILE}: must be keys and values"])
    settings = {key: value for key, value in content.items() if key not in _IDENTITY}
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
