"""One training job, from its configuration to the evaluation of what was learned."""

from __future__ import annotations

import shlex
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.logger import (
    HumanOutputFormat,
    KVWriter,
    Logger,
    SummaryWriter,
    TensorBoardOutputFormat,
)
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_roles.common.callbacks import RoleCallback, TeamMetricsCallback
from sb3_roles.common.checkpoint import CheckpointError, CheckpointFolder
from sb3_roles.common.env_failures import EnvironmentFailed, close_or_warn
from sb3_roles.common.files import remove_partial
from sb3_roles.common.group_play import RolloutsLost
from sb3_roles.common.names import one_line
from sb3_roles.common.not_finite import NOT_FINITE_FILE, NotFiniteError, dump
from sb3_roles.common.progress_callback import TeamProgressBar
from sb3_roles.common.team_wrapper import find_team_env
from sb3_roles.evaluation.callback import EvaluationCallback
from sb3_roles.evaluation.evaluators import (
    MixEvaluator,
    SceneEvaluator,
    VecEnvEvaluator,
    scenes_evaluator,
)
from sb3_roles.zoo.algorithms import get_algorithm
from sb3_roles.zoo.config import CONFIG_FILE, write_yaml
from sb3_roles.zoo.environments import AREA_SEARCH, ENVIRONMENTS, folder_name, scenes_of_run
from sb3_roles.zoo.launcher import process_settings
from sb3_roles.zoo.models import check_device, check_run, complete, make_env, make_model, told
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.ray_options import rollouts_on_ray
from sb3_roles.zoo.resumption import has_checkpoint, note_anew, note_inexact, read_newest
from sb3_roles.zoo.run_facts import PROGRESS
from sb3_roles.zoo.run_folder import (
    BEST,
    CHECKPOINTS,
    SCORES_FILE,
    RunLock,
    new_run,
    note_command,
    write_description,
)
from sb3_roles.zoo.stop_signals import StopSignals
from sb3_roles.zoo.training import CsvLog, train

# The periodic evaluation selects the best policy, on a stream that no --seed of a command reaches.
_SELECTION_SEED, _FINAL_SEED = 0, 1
_MAX_EVAL_TEAMS = 8


class TrainingFailed(Exception):
    """Training can not go on, as when a loss is not finite; the message is one line."""


def run_job(job: Mapping[str, Any], stop: StopSignals | None = None) -> int:
    """Train in a run folder, and evaluate.

    :param job: ``config``, ``options`` and ``resume``, plain data of ``zoo.train``, and where it is
        not this process's own ``command``, the words of a command line that repeats it
    :param stop: of the command, which may have heard a signal already
    :return: exit code: 0, or 130 or 143 after a signal
    :raises KeyboardInterrupt: after a signal before there was a run folder
    :raises UsageError: if environment, configuration or checkpoint do not fit
    :raises TrainingFailed: if a loss or reward is not finite, or the environment misbehaves
    """
    config, options = job["config"], job["options"]
    stop = StopSignals() if stop is None else stop
    check_device(options["device"])
    if options["tensorboard_log"] is not None:
        if SummaryWriter is None:
            raise UsageError("--tensorboard-log: install sb3_roles[tensorboard] to write its files")
        Path(options["tensorboard_log"]).mkdir(parents=True, exist_ok=True)
    if options["num_threads"] is not None:
        th.set_num_threads(options["num_threads"])
    # Before the folder is made: a wrong environment must leave nothing behind.
    env = make_env(config)
    try:
        goes_on = job["resume"] is not None and has_checkpoint(Path(job["resume"]))
        if goes_on:
            check_run(config, env, Path(job["resume"]))
        model = make_model(config, env, options["device"])
        if get_algorithm(config["algo"]).clones:
            _ask(config, model.check_data)  # type: ignore[attr-defined]
        # Before anything in the folder is touched, even its lock.
        if options.get("strict_resume") and not goes_on:
            note_anew(job)
        elif options.get("strict_resume"):
            folder = CheckpointFolder(Path(job["resume"]) / CHECKPOINTS)
            note_inexact(read_newest(folder, model, complete(config))[2], job)
        # Ray has a handler of its own.
        with rollouts_on_ray(model, config, options), stop.caught():
            with stop.waiting():
                run, lock = _open_run(job)
            try:
                stop.check()
                return _train_in(run, model, job, stop)
            except KeyboardInterrupt:
                print(f"stopped; to go on: {_resuming(run, config)}", flush=True)
                return stop.exit_code
            except EnvironmentFailed as error:
                if options["verbose"] > 1:
                    traceback.print_exception(error)
                raise TrainingFailed(f"{run}: {error}") from error
            finally:
                lock.release()
    finally:
        close_or_warn(env)


def _resuming(run: Path, config: Mapping[str, Any]) -> str:
    """Return the command that goes on with a run; code that it is to call has to be named."""
    own = [] if config["env"] in ENVIRONMENTS else ["--env", config["env"]]
    return shlex.join(["train.py", "--resume", str(run), *own])


def _ask(config: Mapping[str, Any], question: Callable[[], object]) -> None:
    """Turn what an algorithm has to say of its data into an error of the command line."""
    try:
        question()
    except (ValueError, ImportError) as error:
        raise UsageError(f"{config['algo']}: {one_line(error)}") from error


def _get_demonstrations(run: Path, model: Any, job: Mapping[str, Any], new: bool) -> None:
    """Read or record what is cloned, and note what it is."""
    config, options = job["config"], job["options"]

    def report(count: int) -> None:
        if options["verbose"]:
            of = f"{model.n_demonstrations} episodes of {model.controller}"
            print(f"recorded {count} of {of}", flush=True)

    try:
        _ask(config, lambda: model.data(report))
    except KeyboardInterrupt:
        print(f"recording stopped; {run} keeps the episodes so far, and no policy", flush=True)
        raise
    print(model.summary(), flush=True)
    if new:
        write_yaml(run / "demonstrations.yml", model.facts)


def _open_run(job: Mapping[str, Any]) -> tuple[Path, RunLock]:
    """Make, or find, the run folder of a job, and lock it."""
    if job["resume"] is not None:
        path = Path(job["resume"])
        return path, RunLock(path)
    config, options = job["config"], job["options"]
    args = {key: str(value) if isinstance(value, Path) else value for key, value in options.items()}
    # A resumed run shall add in the same order, wherever it is resumed.
    args["num_threads"] = th.get_num_threads()
    whole = complete(config)
    path = new_run(Path(options["log_folder"]), config["algo"], config["env"])
    lock = RunLock(path)
    write_description(path, whole, args, _command(job))
    return path, lock


def _command(job: Mapping[str, Any]) -> list[str]:
    return list(job.get("command") or [Path(sys.argv[0]).name, *sys.argv[1:]])


def _train_in(
    run: Path, model: OnPolicyAlgorithm, job: Mapping[str, Any], stop: StopSignals
) -> int:
    config, options = complete(job["config"]), job["options"]
    checkpoints = CheckpointFolder(run / CHECKPOINTS)
    checkpoints.prepare()
    if (run / BEST).is_symlink():
        # As of checkpoints: a run folder must not choose where files are written.
        raise UsageError(f"{run / BEST}: is a symbolic link, where a run has a folder: remove it")
    for folder in (run, run / BEST):
        remove_partial(folder)
    resume, begun = None, 0
    reasons: list[str] = []
    if job["resume"] is not None and not has_checkpoint(run):
        note_anew(job)
    elif job["resume"] is not None:
        again = bool(options.get("strict_resume"))
        resume, begun, reasons = read_newest(checkpoints, model, config, again)
        note_inexact(reasons, job)
        if options.get("n_timesteps", begun) < begun:
            wanted = options["n_timesteps"]
            raise UsageError(f"{run} has {begun} joint steps already, more than -n {wanted}")

    with ExitStack() as stack:
        log = CsvLog(run / PROGRESS)
        logger = _logger(run, log, config, options)
        stack.callback(logger.close)
        model.set_logger(logger)
        callbacks = run_callbacks(run, model, config, options, stack)
        _print_start(run, model, config, None if resume is None else begun)
        if get_algorithm(config["algo"]).clones:
            _get_demonstrations(run, model, job, resume is None)

        def begin() -> None:
            if job["resume"] is not None:
                # A new n_timesteps is the run's from now on.
                write_yaml(run / CONFIG_FILE, config)
                note_command(run, _command(job))

        bar = [TeamProgressBar()] if options["progress"] else []
        try:
            steps = train(
                model,
                config["n_timesteps"],
                checkpoints,
                stop,
                [*callbacks, *bar],
                stateful=with_state(log, callbacks, model),
                config=config,
                resume=resume,
                save_freq=options["save_freq"],
                log_interval=options["log_interval"],
                begin=begin,
            )
        except CheckpointError as error:
            since = f" (since then: {'; '.join(reasons)})" if reasons else ""
            raise UsageError(told(run, error) + since) from error
        except (UsageError, EnvironmentFailed):
            raise
        except NotFiniteError as error:
            message = f"{run}: {_kept(run, model, error)}"
            if options["verbose"] > 1:
                raise
            raise TrainingFailed(message) from error
        except (FloatingPointError, ValueError) as error:
            # Observations of another shape, teams that fall apart.
            if options["verbose"] > 1:
                raise
            raise TrainingFailed(f"{run}: {one_line(error)}") from error
        except RolloutsLost as error:
            message = f"{run}: {error}; --resume goes on from the last checkpoint"
            raise TrainingFailed(message) from error
        except RuntimeError as error:
            # Torch's way to say so, on a CPU and on a GPU.
            if "memory" not in str(error):
                raise
            raise MemoryError(one_line(error)) from error
    print(f"{run}: {steps} joint steps; checkpoints: {len(checkpoints.paths())}", flush=True)
    stop.check()
    if options["verbose"]:
        print(f"evaluating {options['eval_episodes']} held-out episodes", flush=True)
    _evaluate(run, model, config, options["eval_episodes"])
    # Of a signal that came while the scores were written: no other run shall begin.
    stop.check()
    return 0


def _kept(run: Path, model: OnPolicyAlgorithm, error: NotFiniteError) -> str:
    """Keep what numbers that are not finite were found in; return the whole message."""
    steps = model.num_timesteps // find_team_env(model.env).n_agents
    buffer: Any = model.rollout_buffer
    if not error.tensors and getattr(buffer, "taken", None) is not None:
        # Of a stock algorithm, whose optimizer knows no minibatch.
        error = error.found_in(f"update {model._n_updates + 1}", buffer.named(buffer.taken))
    message = f"after {steps} joint steps: {one_line(error)}"
    path = run / NOT_FINITE_FILE
    try:
        return f"{message}; it is kept in {path}" if dump(path, error) else message
    except OSError as failure:
        return f"{message}; {path} could not be written: {failure.strerror or failure}"


def run_callbacks(
    run: Path,
    model: OnPolicyAlgorithm,
    config: Mapping[str, Any],
    options: Mapping[str, Any],
    stack: ExitStack,
) -> list[Any]:
    """Make the callbacks of a run.

    :param run: folder of what they write
    :param model: to be trained
    :param config: checked
    :param options: ``eval_freq``, ``eval_episodes`` and ``verbose``
    :param stack: closes what they have open
    """
    window = model._stats_window_size
    callbacks: list[Any] = [TeamMetricsCallback(window)]
    if get_algorithm(config["algo"]).wrapper == "role":
        callbacks.append(RoleCallback(window, run / "roles.csv"))
    if options["eval_freq"]:
        n_episodes = options["eval_episodes"]
        evaluation = EvaluationCallback(
            eval_freq=options["eval_freq"],
            n_episodes=n_episodes,
            seed=_SELECTION_SEED,
            evaluate=make_evaluate(config, n_episodes, _SELECTION_SEED, "selection"),
            folder=run,
            verbose=options["verbose"],
        )
        stack.callback(evaluation.close)
        callbacks.append(evaluation)
    return callbacks


def with_state(log: CsvLog, callbacks: Sequence[Any], model: OnPolicyAlgorithm) -> list[Any]:
    """Return what a checkpoint keeps the state of, beside the model's weights and counters.

    :param log: the run's
    :param callbacks: of :func:`run_callbacks`
    :param model: an algorithm may know more than weights and counters
    """
    return [log, *callbacks, *([model] if hasattr(model, "get_state") else [])]


def _logger(
    run: Path, log: CsvLog, config: Mapping[str, Any], options: Mapping[str, Any]
) -> Logger:
    writers: list[KVWriter] = [log]
    if options["verbose"] and not options["progress"]:
        writers.append(HumanOutputFormat(sys.stdout))
    if options["tensorboard_log"] is not None:
        name = f"{config['algo']}_{folder_name(run.name)}"
        writers.append(TensorBoardOutputFormat(str(Path(options["tensorboard_log"]) / name)))
    return Logger(str(run), writers)


def make_evaluate(
    config: Mapping[str, Any], n_episodes: int, seed: int, stream: str = "held_out"
) -> SceneEvaluator | MixEvaluator | VecEnvEvaluator:
    """Make what evaluates a model on episodes of its task that no training plays.

    :param config: checked
    :param n_episodes: team episodes
    :param seed: of the stream
    :param stream: ``"held_out"``, to measure a policy, or ``"selection"``, to select one
    :return: a function of the model; to be closed
    """
    if config["env"] == AREA_SEARCH:
        return scenes_evaluator(scenes_of_run(config), n_episodes, seed, stream=stream)
    env = make_env(config, min(_MAX_EVAL_TEAMS, n_episodes))
    return VecEnvEvaluator(env, n_episodes, seed, stream=stream)


def _evaluate(
    run: Path, model: OnPolicyAlgorithm, config: Mapping[str, Any], n_episodes: int
) -> None:
    with closing(make_evaluate(config, n_episodes, _FINAL_SEED)) as evaluate:
        scores = evaluate(model)
    # A mix rounds them up to equal shares.
    n_episodes = int(scores["n_episodes"])
    about = {"episodes": n_episodes, "stream": "held_out", "seed": _FINAL_SEED}
    write_yaml(run / SCORES_FILE, {**about, "scores": dict(scores)})
    shown = ("explo_paper", "explo_true", "cover")
    if config["env"] == AREA_SEARCH:
        text = ", ".join(f"{name} {100 * scores[name]:.1f} %" for name in shown)
    else:
        text = ", ".join(f"{name} {value:.4g}" for name, value in scores.items())
    note = f", {evaluate.note}" if evaluate.note else ""
    print(f"{n_episodes} held-out episodes of seed {_FINAL_SEED}{note}: {text}", flush=True)


def _print_start(
    run: Path, model: OnPolicyAlgorithm, config: Mapping[str, Any], resumed_at: int | None
) -> None:
    team_env = find_team_env(model.env)
    print(
        f"{'training' if resumed_at is None else 'resuming'} {config['algo']} on {config['env']}: "
        f"{team_env.n_teams} teams of {team_env.n_agents} ({type(team_env).__name__}), joint steps "
        f"{resumed_at or 0} to {config['n_timesteps']} in whole rollouts of "
        f"{model.n_steps * team_env.n_teams}, seed {config['seed']}, "
        f"{model.device.type}, {th.get_num_threads()} threads, {process_settings()}\n"
        f"run folder {run}, {time.strftime('%Y-%m-%d %H:%M:%S')}",
        flush=True,
    )
