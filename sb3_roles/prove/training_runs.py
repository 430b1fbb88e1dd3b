"""Runs that are trained in this process, cut and resumed, and what two runs have in common."""

from __future__ import annotations

import csv
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_roles.common.checkpoint import Checkpoint, CheckpointFolder
from sb3_roles.zoo.config import CONFIG_FILE
from sb3_roles.zoo.job import run_callbacks, with_state
from sb3_roles.zoo.models import make_env, make_model
from sb3_roles.zoo.run_folder import BEST, CHECKPOINTS, SCORES_FILE
from sb3_roles.zoo.stop_signals import StopSignals
from sb3_roles.zoo.training import CsvLog, train

TIMINGS = ("time/fps", "time/time_elapsed")
"""Columns of ``progress.csv`` that differ from one run to the next; no others do."""
LOGS = ("progress.csv", "roles.csv", "evaluations.csv")
WHOLE = (CONFIG_FILE, SCORES_FILE, f"{BEST}/model.ckpt")
"""Files of a finished run that are the same to the last byte."""
EVALUATED = {"eval_freq": 40, "eval_episodes": 2, "verbose": 0}
NOT_EVALUATED = {**EVALUATED, "eval_freq": 0}


class Trained(NamedTuple):
    """What a training has left.

    :param model: the algorithm; its environment is closed
    :param newest: the run's newest checkpoint
    """

    model: OnPolicyAlgorithm
    newest: Checkpoint


@contextmanager
def torch_threads(number: int) -> Iterator[None]:
    """Let torch have a number of threads, and what it had before at the end.

    :param number: of threads
    """
    before = th.get_num_threads()
    th.set_num_threads(number)
    try:
        yield
    finally:
        th.set_num_threads(before)


def stir(seed: int) -> None:
    """Set the global generators to what another process might start with.

    :param seed: of that process
    """
    th.manual_seed(seed)
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002


def train_here(
    folder: Path,
    config: Mapping[str, Any],
    resume: bool = False,
    stop_at: int | None = None,
    save_freq: int = 0,
    options: Mapping[str, Any] = EVALUATED,
    checkpoints: CheckpointFolder | None = None,
    prepare: Callable[[OnPolicyAlgorithm], object] = lambda model: None,
    callbacks: Sequence[Any] = (),
    process: int = 99,
) -> Trained:
    """Train in this process as ``train.py`` does in one of its own, with its logs and callbacks.

    :param folder: of the run; made if it is not there
    :param config: checked
    :param resume: go on from the newest checkpoint of the folder
    :param stop_at: joint steps after which to stop early
    :param save_freq: joint steps between checkpoints; 0 for the last one only
    :param options: see ``job.run_callbacks``
    :param checkpoints: where they are written, instead of a plain folder
    :param prepare: called with the model before anything is restored
    :param callbacks: further ones, whose state is not kept
    :param process: stands for the state of the global generators that a process begins with
    """
    folder.mkdir(parents=True, exist_ok=True)
    stir(process)
    env = make_env(config)
    try:
        model = make_model(config, env, "cpu")
        # The constructor has seeded them with the run's seed; a resumed run must not rely on it.
        if resume:
            stir(process + 1)
        log = CsvLog(folder / "progress.csv")
        model.set_logger(Logger(str(folder), [log]))
        if checkpoints is None:
            checkpoints = CheckpointFolder(folder / CHECKPOINTS)
        checkpoints.prepare()
        prepare(model)
        with ExitStack() as stack:
            own = run_callbacks(folder, model, config, options, stack)
            train(
                model,
                config["n_timesteps"],
                checkpoints,
                StopSignals(),
                [*own, *callbacks],
                with_state(log, own, model),
                config,
                resume=checkpoints.newest()[1] if resume else None,
                save_freq=save_freq,
                stop_at=stop_at,
            )
        return Trained(model, checkpoints.newest()[1])
    finally:
        env.close()


# What two runs have in common


def without_times(state: Mapping[str, Any]) -> dict[str, Any]:
    """Return a checkpoint's state without the seconds that were measured."""
    # Whatever a log shows only later may hold times, too.
    values = {k: v for k, v in state["logger"]["values"].items() if not k.startswith("time/")}
    timeless = {key: value for key, value in state.items() if key != "elapsed_ns"}
    return {**timeless, "logger": {**state["logger"], "values": values}}


def untimed_rows(path: Path) -> list[list[str]]:
    """Read a log without the columns of times; an empty list where there is none.

    :param path: of a csv file
    """
    if not path.exists():
        return []
    with open(path, encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    timed = {i for i, name in enumerate(rows[0]) if name in TIMINGS}
    return [[cell for i, cell in enumerate(row) if i not in timed] for row in rows]


def difference(a: Any, b: Any, where: str) -> str | None:
    """Return the place of the first difference of two trees of values and arrays; None for none.

    Values are equal bit by bit: types, dtypes, shapes and signs of zeros count, and a NaN is equal
    to the same NaN.

    :param a: dicts, lists, tensors, arrays and plain values
    :param b: the other one
    :param where: what the place is called
    """
    if type(a) is not type(b):
        return f"{where} ({type(a).__name__}, {type(b).__name__})"
    if isinstance(a, dict):
        if set(a) != set(b):
            return f"{where}/{min(set(a) ^ set(b), key=str)} (in one only)"
        pairs = [(f"{where}/{key}", a[key], b[key]) for key in a]
    elif isinstance(a, (list, tuple)):
        if len(a) != len(b):
            return f"{where} ({len(a)} and {len(b)} entries)"
        pairs = [(f"{where}/{i}", x, y) for i, (x, y) in enumerate(zip(a, b, strict=True))]
    elif isinstance(a, (np.ndarray, th.Tensor)):
        return None if _same_array(a, b) else where
    else:
        return None if repr(a) == repr(b) else f"{where} ({a!r}, {b!r})"
    found = (difference(x, y, place) for place, x, y in pairs)
    return next((place for place in found if place is not None), None)


def _same_array(a: Any, b: Any) -> bool:
    if a.dtype != b.dtype or a.shape != b.shape:
        return False
    if isinstance(a, th.Tensor):
        # As bytes: a tensor of bfloat16 is no array.
        one, other = (t.cpu().contiguous().reshape(-1).view(th.uint8) for t in (a, b))
        return th.equal(one, other)
    return bool(a.tobytes() == b.tobytes())


def checkpoint_difference(a: Checkpoint, b: Checkpoint) -> str | None:
    """Return where two checkpoints of one run differ, but for times; None if they do not.

    :param a: one
    :param b: the other
    """
    steps = "env_steps"
    for name, one, other in (
        (steps, a.manifest[steps], b.manifest[steps]),
        ("policy", a.policy, b.policy),
        ("optimizer", a.optimizer, b.optimizer),
        ("state", without_times(a.state), without_times(b.state)),
    ):
        found = difference(one, other, name)
        if found is not None:
            return found
    return None


def log_difference(a: Path, b: Path) -> str | None:
    """Return the name of the first log that differs between two run folders; None for none.

    :param a: one
    :param b: the other
    """
    return next((name for name in LOGS if untimed_rows(a / name) != untimed_rows(b / name)), None)
