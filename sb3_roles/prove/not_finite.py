"""R12: NaN and infinity in what is learned from; nothing may be learned then."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium as gym
import numpy as np
import safetensors
import torch as th

from sb3_roles.common import buffers
from sb3_roles.common.checkpoint import CheckpointError, CheckpointFolder
from sb3_roles.common.not_finite import NOT_FINITE_FILE
from sb3_roles.common.team_wrapper import find_team_env
from sb3_roles.mappo import mappo
from sb3_roles.prove.processes import run_here
from sb3_roles.prove.promises import Outcome, Setting
from sb3_roles.prove.small_runs import ITERATION, STEPS, TEAMS, small_settings
from sb3_roles.zoo import job
from sb3_roles.zoo.config import write_yaml
from sb3_roles.zoo.environments import AREA_SEARCH
from sb3_roles.zoo.run_folder import CHECKPOINTS

PARTS = ("observation", "reward", "advantage", "loss", "gradient")
ALGOS = ("hmappo", "mappo", "ppo")
_ITERATIONS = 4
_REPEATS = 4
# Of what an injected number is called: returns are where advantages come from, and of stock
# algorithms only the optimizer is looked at.
_CALLED = {
    "advantage": ("return", "advantage"),
    "loss": ("loss", "gradient"),
}
Weights = dict[str, th.Tensor]


def injections(setting: Setting) -> Outcome:
    """Inject a number into every part of every algorithm, once or several times.

    :param setting: see :class:`Setting`
    """
    failures, tried = [], 0
    pairs = list(itertools.product(ALGOS, PARTS))
    # The short form leaves out every other one.
    pairs = pairs[::2] if setting.quick else pairs * _REPEATS
    for k, (algo, part) in enumerate(pairs):
        rng = np.random.default_rng([setting.seed, 12, k])
        value = float(rng.choice([np.nan, np.inf]))
        found = trial(algo, part, value, setting.folder / f"{k}_{algo}_{part}", rng)
        tried += 1
        if found:
            failures.append(f"{algo}, {value} in the {part}: {'; '.join(found)}")
    said = (
        f"NaN or infinity in {', '.join(PARTS)} of {', '.join(ALGOS)}: exit code 3, one line that "
        "names it, weights and optimizer unchanged, what it was found in kept, the checkpoint loads"
    )
    return Outcome(tried - len(failures), tried, said, tuple(failures), _stock())


def trial(algo: str, part: str, value: float, folder: Path, rng: np.random.Generator) -> list[str]:
    """Train, inject one number after the first checkpoint, and look at what is left.

    :param algo: of :data:`ALGOS`
    :param part: of :data:`PARTS`
    :param value: NaN or infinity
    :param folder: for the logs
    :param rng: draws where and when
    :return: what is wrong, one text each
    """
    folder.mkdir(parents=True)
    settings = small_settings(algo, _ITERATIONS)
    write_yaml(folder / "config.yml", {AREA_SEARCH: settings})
    words = ["--algo", algo, "--conf-file", folder / "config.yml", "--log-folder", folder / "logs"]
    words += ["--device", "cpu", "--eval-freq", 0, "--save-freq", ITERATION, "--verbose", 0]
    seen: list[Any] = []

    def make(*arguments: Any) -> Any:
        model = make_model(*arguments)
        seen.extend([model, _Watch(model)])
        stack.enter_context(_injected(model, part, value, rng))
        return model

    make_model = job.make_model
    with ExitStack() as stack:
        stack.enter_context(mock.patch.object(job, "make_model", make))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            code, _, err = run_here(list(map(str, words)), "train", caught=(Exception,))
    if code in (130, 143):
        # The signal was for the experiment.
        raise KeyboardInterrupt
    if not seen:
        return [f"no training: {err[:200]!r}"]
    model, watch = seen
    lines = err.splitlines()
    found = [] if code == 3 else [f"exit code {code}"]
    if len(lines) != 1:
        found.append(f"{len(lines)} lines: {err[:200]!r}")
    # The folder's own name has the part in it.
    said = err.replace(str(folder), "")
    if not any(name in said for name in _CALLED.get(part, (part,))):
        found.append(f"not named: {err[:300]!r}")
    if not _same(watch.last, _state(model)):
        found.append("weights or optimizer changed")
    return found + _left(folder / "logs" / algo / f"{AREA_SEARCH}_1", err)


def _left(run: Path, said: str) -> list[str]:
    """Look at the run folder."""
    found = []
    path = run / NOT_FINITE_FILE
    if str(path) not in said or not path.is_file():
        found.append(f"{path.name} is not there, or not named")
    else:
        with safetensors.safe_open(path, "pt") as file:
            if not list(file.keys()):
                found.append(f"{path.name} is empty")
    try:
        _, checkpoint = CheckpointFolder(run / CHECKPOINTS).newest()
    except CheckpointError as error:
        return [*found, f"no checkpoint: {error}"]
    if not all(bool(th.isfinite(one.float()).all()) for one in checkpoint.policy.values()):
        found.append("the checkpoint holds weights that are not finite")
    return found


# What is watched: weights and optimizer after the last step that was taken


class _Watch:
    def __init__(self, model: Any) -> None:
        self.last = _state(model)

        def note(*_: Any) -> None:
            self.last = _state(model)

        model.policy.optimizer.register_step_post_hook(note)


def _state(model: Any) -> Weights:
    state = {f"policy.{key}": value for key, value in model.policy.state_dict().items()}
    for index, entries in model.policy.optimizer.state_dict()["state"].items():
        state |= {f"optimizer.{index}.{key}": th.as_tensor(one) for key, one in entries.items()}
    return {key: value.detach().clone() for key, value in state.items()}


def _same(first: Weights, second: Weights) -> bool:
    return first.keys() == second.keys() and all(th.equal(first[key], second[key]) for key in first)


# What is injected


@contextmanager
def _injected(model: Any, part: str, value: float, rng: np.random.Generator) -> Iterator[None]:
    """Put a number into a part, once, at a random time after the first iteration."""
    batched = find_team_env(model.env).batched  # type: ignore[attr-defined]
    team, robot = int(rng.integers(TEAMS)), int(rng.integers(batched.n_agents))
    iteration = int(rng.integers(1, _ITERATIONS))
    step = iteration * STEPS + int(rng.integers(STEPS))
    # Of two epochs of four minibatches; gradients are asked for as often.
    minibatch = 8 * iteration + int(rng.integers(8))
    with ExitStack() as stack:

        def replaced(owner: Any, name: str, new: Callable[..., Any]) -> None:
            stack.enter_context(mock.patch.object(owner, name, new))

        if part in ("observation", "reward"):
            whole = batched.step
            counted = itertools.count()

            def stepped(actions: np.ndarray) -> None:
                whole(actions)
                if next(counted) == step:
                    array = batched.rewards
                    if part == "observation":
                        array = batched.observations["position"]
                    array[team, robot] = value

            replaced(batched, "step", stepped)
        elif part == "advantage":
            returns, rollouts = buffers.lambda_returns, itertools.count()

            def poisoned(*arguments: Any) -> th.Tensor:
                found = returns(*arguments)
                if next(rollouts) == iteration:
                    found[step % STEPS, team * batched.n_agents + robot] = value
                return found

            replaced(buffers, "lambda_returns", poisoned)
        elif part == "loss":
            _poison_loss(model, replaced, minibatch, value)
        else:
            parameters = [one for one in model.policy.parameters() if one.requires_grad]
            order, asked = rng.permutation(len(parameters)).tolist(), [0] * len(parameters)

            def gradient(given: th.Tensor, k: int) -> th.Tensor:
                asked[k] += 1
                # Not of a parameter that this algorithm does not learn.
                chosen = next(one for one in order if asked[one])
                if k != chosen or asked[k] <= minibatch:
                    return given
                changed = given.clone()
                changed[(0,) * changed.ndim] = value
                return changed

            for k, parameter in enumerate(parameters):
                stack.callback(parameter.register_hook(partial(gradient, k=k)).remove)
        yield


def _poison_loss(
    model: Any, replaced: Callable[[Any, str, Any], None], minibatch: int, value: float
) -> None:
    counted = itertools.count()
    if hasattr(model, "kl_coefs"):
        whole = mappo.stream_loss

        def loss(*arguments: Any) -> Any:
            found = whole(*arguments)
            # Every stream asks once for each minibatch.
            due = next(counted) == minibatch * len(model.kl_coefs)
            return found._replace(loss=found.loss * value) if due else found

        replaced(mappo, "stream_loss", loss)
        return
    evaluate = model.policy.evaluate_actions

    def values(*arguments: Any) -> Any:
        first, *rest = evaluate(*arguments)
        return (first * value if next(counted) == minibatch else first, *rest)

    replaced(model.policy, "evaluate_actions", values)


# The stock stack


class _OneBadReward(gym.RewardWrapper[Any, Any]):
    """NaN once."""

    steps = 0

    def reward(self, reward: Any) -> float:
        self.steps += 1
        return float("nan") if self.steps == 40 else float(reward)


def _stock() -> str:
    from stable_baselines3 import PPO
    from stable_baselines3.common.logger import Logger

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = _OneBadReward(gym.make("CartPole-v1"))
        model = PPO("MlpPolicy", env, n_steps=16, batch_size=8, n_epochs=2, seed=0, device="cpu")
        model.set_logger(Logger(None, []))
        try:
            model.learn(160)
            end = "trained on"
        except ValueError:
            end = "stopped"
    weights = list(model.policy.parameters())
    bad = sum(not bool(th.isfinite(one).all()) for one in weights)
    return f"SB3's PPO {end} after one NaN reward with {bad} of {len(weights)} weights not finite"
