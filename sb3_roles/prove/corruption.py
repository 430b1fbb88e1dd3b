"""R5: damaged checkpoints are refused with one line."""

from __future__ import annotations

import warnings
from collections import Counter
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger

from sb3_roles.common.actor_weights import ACTORS, HOLDS, actor_weights, stored
from sb3_roles.common.checkpoint import (
    Checkpoint,
    CheckpointError,
    CheckpointFolder,
    read_checkpoint,
    write_checkpoint,
)
from sb3_roles.evaluation.callback import WEIGHTS_FILE, EvaluationCallback
from sb3_roles.prove.damage import BYTES, CHECKPOINTS, damaged_bytes
from sb3_roles.prove.promises import Outcome, Setting
from sb3_roles.prove.small_runs import ITERATION, small_run
from sb3_roles.prove.training_runs import difference
from sb3_roles.zoo.models import make_env, make_model
from sb3_roles.zoo.stop_signals import StopSignals
from sb3_roles.zoo.training import train

_TRIALS, _QUICK_TRIALS = 1000, 60
_STOCK_TRIALS, _QUICK_STOCK_TRIALS = 1000, 28


def damaged(setting: Setting) -> Outcome:
    """Damage checkpoints of a small run in many ways, and read them.

    Whole checkpoints, weights alone, and weights of actors alone take turns. A trial is kept if the
    file is refused with one line, or gives exactly what was written.

    :param setting: how
    """
    files = sound_files(setting.folder / "sound")
    contents = {kind: read_checkpoint(paths[0]) for kind, paths in files.items()}
    raw = {kind: [path.read_bytes() for path in paths] for kind, paths in files.items()}
    n_trials = _QUICK_TRIALS if setting.quick else _TRIALS
    path = setting.folder / "damaged.ckpt"
    failures, refused = [], 0
    for trial in range(n_trials):
        kind = list(files)[trial % len(files)]
        name = list(CHECKPOINTS)[trial // len(files) % len(CHECKPOINTS)]
        rng = np.random.default_rng([setting.seed, 5, trial])
        path.write_bytes(damaged_bytes(CHECKPOINTS[name], rng, *raw[kind]))
        problem = _problem(path, contents[kind])
        if problem is None:
            refused += 1
        elif problem:
            failures.append(f"trial {trial}, {kind}, {name}: {problem}")
    held = n_trials - len(failures)
    return Outcome(
        held,
        n_trials,
        f"damaged files of {len(CHECKPOINTS)} kinds, {refused} refused with one line, "
        f"{held - refused} read as they were written",
        tuple(failures),
        stock=_stock(setting),
    )


def _problem(path: Path, written: Checkpoint) -> str | None:
    """Return None if a file is refused, "" if it is read as it was written, or what is wrong."""
    try:
        found = read_checkpoint(path)
    except CheckpointError as error:
        return "the message has several lines" if "\n" in str(error) else None
    except Exception as error:
        return f"{type(error).__name__} instead of one line"
    return "" if _same(found, written) else "other content was read without a word"


def _same(one: Checkpoint, other: Checkpoint) -> bool:
    """Whether two checkpoints are the same in every bit, with their times."""
    a, b = ([c.manifest, c.policy, c.optimizer, c.state] for c in (one, other))
    return difference(a, b, "checkpoint") is None


def sound_files(folder: Path) -> dict[str, list[Path]]:
    """Train a small run, and write two checkpoints of each kind.

    :param folder: where
    :return: kind -> a file, and one of another moment
    """
    config = small_run("hmappo", n_iterations=3)
    env = make_env(config)
    model = make_model(config, env, "cpu")
    model.set_logger(Logger(None, []))
    checkpoints = CheckpointFolder(folder)
    checkpoints.prepare()
    best: list[Path] = []
    actors: list[Path] = []
    for steps in (ITERATION, 2 * ITERATION):
        resume = checkpoints.newest()[1] if best else None
        train(
            model, 3 * ITERATION, checkpoints, StopSignals(), config=config, resume=resume,
            stop_at=steps,
        )  # fmt: skip
        place = folder / f"best_{steps}"
        EvaluationCallback(ITERATION, evaluate=lambda _: {}).save(
            model, place, {"env_steps": steps}
        )
        best.append(place / WEIGHTS_FILE)
        card = folder / f"actors_{steps}.ckpt"
        facts = {"env_steps": steps, "agent_steps": model.num_timesteps, HOLDS: ACTORS}
        write_checkpoint(card, facts, stored(actor_weights(model.policy), "float16"))
        actors.append(card)
    env.close()
    return {"whole": checkpoints.paths()[::-1], "weights": best[::-1], "actors": actors[::-1]}


def _stock(setting: Setting) -> str:
    """Damage what SB3 saves of a PPO in the same ways, and load it."""
    raw: list[bytes] = []
    weights: dict[str, th.Tensor] = {}
    for seed in (1, 2):
        model = PPO("MlpPolicy", "CartPole-v1", seed=seed, device="cpu", n_steps=8, batch_size=8)
        model.set_logger(Logger(None, []))
        model.learn(8)
        model.save(setting.folder / "stock.zip")
        raw.append((setting.folder / "stock.zip").read_bytes())
        weights = weights or {key: t.clone() for key, t in model.policy.state_dict().items()}
    n_trials = _QUICK_STOCK_TRIALS if setting.quick else _STOCK_TRIALS
    path = setting.folder / "damaged.zip"
    same, other, errors = 0, 0, Counter[str]()
    with warnings.catch_warnings(), redirect_stdout(StringIO()):
        warnings.simplefilter("ignore")
        for trial in range(n_trials):
            damage = list(BYTES.values())[trial % len(BYTES)]
            rng = np.random.default_rng([setting.seed, 55, trial])
            path.write_bytes(damaged_bytes(damage, rng, raw[0], raw[1]))
            try:
                found = PPO.load(path, device="cpu").policy.state_dict()
            except Exception as error:
                errors[type(error).__name__] += 1
            else:
                equal = all(th.equal(found[key], weights[key]) for key in weights)
                same, other = same + equal, other + (not equal)
    return (
        f"of {n_trials} damaged PPO zips {same + other} load without a word, {other} of them with "
        f"other weights; {sum(errors.values())} end in tracebacks of {len(errors)} kinds"
    )
