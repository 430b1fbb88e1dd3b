"""Environments and models from a checked configuration, and trained models from a run folder."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv

from sb3_roles.common.actor_weights import ACTORS, HOLDS, check_policy, load_actors
from sb3_roles.common.checkpoint import (
    Checkpoint,
    CheckpointError,
    CheckpointFolder,
    read_checkpoint,
)
from sb3_roles.common.checkpoint_reading import Outline, read_outline
from sb3_roles.common.env_failures import EnvironmentFailed
from sb3_roles.common.not_finite import guard_optimizer
from sb3_roles.common.role_wrapper import RoleWrapper
from sb3_roles.common.snapshot import load_weights
from sb3_roles.common.team_vec_env import make_team_vec_env
from sb3_roles.common.team_wrapper import TeamWrapper, find_team_env
from sb3_roles.evaluation.callback import WEIGHTS_FILE
from sb3_roles.zoo.algorithms import POLICY_ARGUMENTS, get_algorithm
from sb3_roles.zoo.config import read_run_config
from sb3_roles.zoo.environments import AREA_SEARCH, check_named, env_factory
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.ranges import Range
from sb3_roles.zoo.run_folder import BEST, CHECKPOINTS


def step_on_threads(env: VecEnv, n_threads: int) -> None:
    """Let an environment step its teams on some threads, if it can.

    :param env: possibly wrapped
    :param n_threads: at least 1; no result depends on it
    """
    if env.has_attr("n_threads"):
        env.set_attr("n_threads", n_threads)


def make_env(config: Mapping[str, Any], n_envs: int | None = None) -> VecEnv:
    """Make the environment of a configuration, with its wrappers.

    :param config: checked, see ``zoo.config``
    :param n_envs: teams; by default the configuration's
    :return: rows are robots; not seeded, which the model does; it steps on as many threads as torch
        if it can
    :raises UsageError: if the environment does not fit
    """
    algorithm = get_algorithm(config["algo"])
    factory = env_factory(config["env"], config["env_kwargs"])
    try:
        venv: VecEnv = make_team_vec_env(
            factory,
            config["n_envs"] if n_envs is None else n_envs,
            backend=config["vec_env"],
            expand_team_observations=not algorithm.whole_teams,
        )
        step_on_threads(venv, th.get_num_threads())
        if algorithm.wrapper == "team":
            return TeamWrapper(venv)
        roles = RoleWrapper(venv, **config["wrapper_kwargs"])
    except EnvironmentFailed:
        raise
    except (TypeError, ValueError) as error:
        raise UsageError(f"environment {config['env']}: {error}") from error
    if algorithm.whole_teams:
        return roles
    from sb3_roles.common.row_policies import MaskWrapper, OwnViewWrapper

    if algorithm.masks:
        return MaskWrapper(roles, blocked_moves=config["env"] == AREA_SEARCH)
    return OwnViewWrapper(roles)


def check_device(device: str) -> None:
    """Refuse a GPU that is not there; SB3 would silently take the CPU.

    :param device: see ``options.DEVICES``
    :raises UsageError: if torch finds no GPU
    """
    if device == "cuda" and not th.cuda.is_available():
        raise UsageError("--device cuda: torch finds no GPU")


def make_model(
    config: Mapping[str, Any], env: VecEnv, device: str = "auto", verbose: int = 0
) -> OnPolicyAlgorithm:
    """Make the untrained model of a configuration.

    :param config: checked, see ``zoo.config``
    :param env: of :func:`make_env`
    :param device: where to train
    :param verbose: see the algorithm
    :raises UsageError: if the configuration and the environment do not fit, or there is no such
        device
    """
    check_device(device)
    algorithm = get_algorithm(config["algo"])
    arguments = algorithm.arguments(config, find_team_env(env).n_agents)
    try:
        model: OnPolicyAlgorithm = algorithm.load()(
            algorithm.policy(config["policy"]),
            env,
            **arguments,
            seed=config["seed"],
            device=device,
            verbose=verbose,
        )
    except (TypeError, ValueError, RuntimeError) as error:
        raise UsageError(f"{config['algo']}: {error}") from error
    if not algorithm.checks_steps:
        guard_optimizer(model.policy)
    return model


def policy_outline(config: Mapping[str, Any], env: VecEnv) -> BasePolicy:
    """Return the policy of a configuration without memory for its weights.

    What they are can be compared with a file before either takes memory, however large a
    configuration, which may come from anybody, wants them.

    :param config: checked, see ``zoo.config``
    :param env: of :func:`make_env`
    :return: its tensors are of the device "meta"
    :raises UsageError: if the configuration and the environment do not fit
    """
    with th.device("meta"):
        return make_model(config, env, "meta").policy


def check_run(config: Mapping[str, Any], env: VecEnv, folder: Path) -> None:
    """Refuse to build a model for a run whose checkpoints are not of its policy.

    :param config: of the run, checked
    :param env: of :func:`make_env`
    :param folder: of the run
    :raises UsageError: saying why the newest one does not fit, if none does
    """
    outline = policy_outline(small_config(config, 1), env)
    checkpoints = CheckpointFolder(folder / CHECKPOINTS)
    if not checkpoints.paths():
        raise UsageError(
            f"{folder}: no checkpoint is left of what was trained: put {CHECKPOINTS}/ back, or "
            "begin a new run"
        )
    try:
        with warnings.catch_warnings():
            # Said when it is read.
            warnings.simplefilter("ignore")
            checkpoints.first(lambda path: check_policy(outline, read_outline(path)))
    except CheckpointError as error:
        raise UsageError(told(folder, error)) from error


def told(folder: Path, error: CheckpointError) -> str:
    """Return what is wrong with a file of a run, which the error may name already.

    :param folder: of the run
    :param error: what was found
    """
    return str(error) if str(error).startswith(f"{folder}") else f"{folder}: {error}"


def constructor_parameters(cls: type) -> dict[str, inspect.Parameter]:
    """Return the named arguments of a constructor, those behind ``**options`` included.

    :param cls: any class
    """
    found: dict[str, inspect.Parameter] = {}
    for base in cls.__mro__:
        if "__init__" not in vars(base):
            continue
        own = inspect.signature(vars(base)["__init__"]).parameters
        for one in own.values():
            if one.kind not in (one.VAR_KEYWORD, one.VAR_POSITIONAL):
                found.setdefault(one.name, one)
        if not any(one.kind is one.VAR_KEYWORD for one in own.values()):
            break
    del found["self"]
    return found


def complete(config: Mapping[str, Any]) -> dict[str, Any]:
    """Add the defaults of algorithm and policy, so that a run outlives a change of them.

    :param config: checked
    :return: the configuration, plain data
    """
    algorithm = get_algorithm(config["algo"])
    completed = dict(config)
    ranges = {key: one for key, one in algorithm.parameters.items() if key != "batch_size"}
    completed.update(_defaults(algorithm.load(), ranges, config))
    policy, given = algorithm.policy(config["policy"]), config["policy_kwargs"]
    ranges = POLICY_ARGUMENTS[config["policy"]]
    completed["policy_kwargs"] = {**given, **_defaults(policy, ranges, given)}
    return completed


def _defaults(cls: type, ranges: Mapping[str, Range], given: Mapping[str, Any]) -> dict[str, Any]:
    defaults = {}
    for name, parameter in constructor_parameters(cls).items():
        value = parameter.default
        value = list(value) if isinstance(value, tuple) else value
        if name in ranges and name not in given and ranges[name].problem(value) is None:
            defaults[name] = value
    return defaults


def small_config(config: Mapping[str, Any], n_teams: int) -> dict[str, Any]:
    """Return the configuration of fewer teams, with which nothing is trained.

    :param config: checked
    :param n_teams: number of teams
    """
    small = {**config, "n_envs": n_teams}
    if "batch_size" in config:
        small["batch_size"] = config.get("n_steps", 1)
    if "rollout_groups" in config:
        small["rollout_groups"] = 1
    return small


def steps_of(checkpoint: Checkpoint, name: str) -> int:
    """Return a number of steps that a checkpoint's manifest states.

    :param checkpoint: from a file, whose manifest may say anything
    :param name: ``env_steps`` (joint) or ``agent_steps``
    :return: 0 where it states none
    :raises CheckpointError: if it is no number of steps
    """
    steps = checkpoint.manifest.get(name, 0)
    if not isinstance(steps, int) or steps < 0:
        raise CheckpointError(f"damaged checkpoint: {name} is {steps!r}")
    return steps


def load_model(
    run: str | Path, best: bool = False, device: str = "auto", env: str | None = None
) -> OnPolicyAlgorithm:
    """Rebuild a run's model from ``config.yml``, and load its weights.

    No code of the folder runs: nothing is unpickled, and the ``module:factory`` of a run on an
    environment of your own is imported and called only if ``env`` names it, too. The model has an
    environment of one team, which was never reset. Where the file holds the actors alone, as
    ``sb3-roles publish`` writes it, the critics are untrained ones.

    :param run: the run folder
    :param best: the weights that evaluated best, instead of the latest ones
    :param device: where the model shall be
    :param env: the run's environment; may be left out for one that is part of this package
    :raises UsageError: if the folder is no run, its environment is another one than ``env`` or
        ``module:factory`` without ``env``, or its weights are damaged or do not fit
    """
    folder = Path(run)
    config = read_run_config(folder)
    check_named(folder, config["env"], env)
    small = small_config(config, 1)
    try:
        with warnings.catch_warnings(), th.random.fork_rng(devices=[]):
            warnings.filterwarnings("ignore", category=UserWarning, module="stable_baselines3")
            env_of_one = make_env(small)
            outline = policy_outline(small, env_of_one)

        def check(found: Outline) -> None:
            check_policy(outline, found)

        if best:
            checkpoint = read_checkpoint(folder / BEST / WEIGHTS_FILE, check, weights_only=True)
        else:
            _, checkpoint = CheckpointFolder(folder / CHECKPOINTS).newest(check, weights_only=True)
        with warnings.catch_warnings(), th.random.fork_rng(devices=[]):
            warnings.filterwarnings("ignore", category=UserWarning, module="stable_baselines3")
            model = make_model(small, env_of_one, device)
        if checkpoint.manifest.get(HOLDS) == ACTORS:
            load_actors(model.policy, checkpoint)
        else:
            load_weights(model, checkpoint)
        model.num_timesteps = steps_of(checkpoint, "agent_steps")
    except CheckpointError as error:
        raise UsageError(told(folder, error)) from error
    model.policy.set_training_mode(False)
    return model
