"""Loops of saves that are killed, in a process of their own: ``FOLDER SEED TRIALS``.

Each trial forks this process, which has imported what is needed and no more, so that a trial takes
milliseconds. Prints what was found as JSON.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_roles.common.checkpoint import CheckpointError, CheckpointFolder

_WITHIN = 0.04
"""Seconds after the first save in which a kill comes."""
_WEIGHTS = 60_000


def content(step: int) -> dict[str, Any]:
    """Return a checkpoint that tells its step in every number.

    :param step: of a run
    """
    weights = {"w": th.full((_WEIGHTS,), float(step))}
    return {
        "manifest": {"env_steps": step},
        "policy": weights,
        "optimizer": {"0.exp_avg": weights["w"] / 2},
        "state": {"last": np.full(1000, step)},
    }


def killed_loop(save: Callable[[int], object], delay: float) -> int:
    """Save in a loop, in a fork, and kill it.

    :param save: is told the number of the save, from 1
    :param delay: seconds after the first save
    :return: how many saves were done for certain
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        # So that it ends when this process is gone, and nobody reads what it writes.
        os.close(reading)
        number = 0
        try:
            while True:
                number += 1
                save(number)
                os.write(writing, b".")
        finally:
            os._exit(1)
    os.close(writing)
    done = len(os.read(reading, 1))
    time.sleep(delay)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    while more := len(os.read(reading, 1 << 16)):
        done += more
    os.close(reading)
    return done


def own_trial(folder: Path, delay: float, one_file: bool) -> tuple[bool, str]:
    """Kill a loop that saves checkpoints.

    :param folder: empty
    :param delay: see :func:`killed_loop`
    :param one_file: replace a single file again and again, which has no other one to go back to
    :return: whether the kill left a partial file, and what went wrong; empty if nothing did
    """
    checkpoints = CheckpointFolder(folder)
    checkpoints.prepare()
    done = killed_loop(lambda n: checkpoints.save(1 if one_file else n, **content(n)), delay)
    partial = any(folder.glob("*.partial"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            _, found = checkpoints.newest()
        except CheckpointError as error:
            return partial, f"after {done} saves: {error}"
    step = found.manifest["env_steps"]
    wanted = content(step)
    if step < done:
        return partial, f"save {done} was done, {step} is the newest"
    if not th.equal(found.policy["w"], wanted["policy"]["w"]):
        return partial, f"save {step} has the weights of another one"
    if len(caught) > 1:
        return partial, f"{len(caught)} warnings"
    checkpoints.prepare()
    odd = [path.name for path in folder.iterdir() if path not in checkpoints.paths()]
    return partial, f"{odd[0]} stays" if odd else ""


def stock_trial(model: Any, path: Path, delay: float) -> bool:
    """Kill a loop of ``model.save``, and return whether the file can be loaded."""
    killed_loop(lambda number: model.save(path), delay)
    try:
        type(model).load(path, device="cpu")
    except Exception:
        # Whatever it is: the zip, a member, or what is pickled in it.
        return False
    return True


def stock_model() -> Any:
    """Return a model of Stable-Baselines3 with about as many weights as a checkpoint here has."""
    from stable_baselines3 import PPO

    return PPO("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [160, 160]}, device="cpu")


def main(arguments: list[str]) -> None:
    """Run the trials.

    :param arguments: folder, seed, number of trials
    """
    folder, seed, n_trials = Path(arguments[0]), int(arguments[1]), int(arguments[2])
    th.set_num_threads(1)
    rng = np.random.default_rng([seed, 3])
    model = stock_model()
    failures, inside, unreadable = [], 0, 0
    for i in range(n_trials):
        own = folder / "own"
        own.mkdir()
        partial, problem = own_trial(own, float(rng.uniform(0, _WITHIN)), i % 2 == 1)
        inside += partial
        failures += [f"trial {i}: {problem}"] if problem else []
        shutil.rmtree(own)
        unreadable += not stock_trial(model, folder / "stock.zip", float(rng.uniform(0, _WITHIN)))
    print(json.dumps({"failures": failures, "inside": inside, "unreadable": unreadable}))


if __name__ == "__main__":
    main(sys.argv[1:])
