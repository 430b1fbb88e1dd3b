"""``EvaluationCallback``: evaluation on episodes of its own, and the best policy's weights."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_roles.common.base_callback import Evaluate, TeamCallback
from sb3_roles.common.checkpoint import write_checkpoint
from sb3_roles.common.checks import check_positive
from sb3_roles.common.files import csv_bytes, write_atomically
from sb3_roles.common.names import closest
from sb3_roles.evaluation.evaluators import make_evaluator

WEIGHTS_FILE = "model.ckpt"
Save = Callable[[BaseAlgorithm, Path, Mapping[str, Any]], None]


@contextmanager
def random_state_kept() -> Iterator[None]:
    """Leave the global generators of Python, numpy and torch as they were."""
    python, legacy, cpu = random.getstate(), np.random.get_state(), th.get_rng_state()  # noqa: NPY002
    cuda = th.cuda.get_rng_state_all() if th.cuda.is_initialized() else None
    try:
        yield
    finally:
        random.setstate(python)
        np.random.set_state(legacy)  # noqa: NPY002
        th.set_rng_state(cpu)
        if cuda is not None:
            th.cuda.set_rng_state_all(cuda)


def save_policy(model: BaseAlgorithm, folder: Path, record: Mapping[str, Any]) -> None:
    """Write the weights of a model's policy to ``model.ckpt``, a checkpoint of weights only.

    ``common.checkpoint.read_checkpoint`` reads it, and ``common.snapshot.load_weights`` puts the
    weights into a model; in a run folder, ``load_model(run, best=True)`` does both.

    :param model: any SB3 model
    :param folder: where to write; made if it does not exist
    :param record: what is known of the weights, numbers and texts; the manifest's ``record``
    """
    folder.mkdir(parents=True, exist_ok=True)
    manifest = {"record": dict(record), "agent_steps": int(model.num_timesteps)}
    write_checkpoint(folder / WEIGHTS_FILE, manifest, model.policy.state_dict())


class EvaluationCallback(TeamCallback):
    """Evaluates every ``eval_freq`` joint steps, on the same episodes each time.

    By default they are those of a selection stream, see ``evaluation.episodes.selection_seed``: no
    training plays them, and no results are measured on them, because the best policy was chosen
    for its luck there, too.

    Training goes on as if there were no evaluation: the generators of Python, numpy and torch are
    put back, and the environment of the training is not used. The scores go to the logger as
    ``eval/<name>`` and to ``evaluations.csv``; the weights of the best policy to ``best/``.

    :param eval_freq: joint steps (steps of a team, summed over the teams) between evaluations
    :param n_episodes: team episodes of an evaluation, for the default ``evaluate``
    :param seed: of the selection stream, for the default ``evaluate``
    :param deterministic: take the likeliest actions, for the default ``evaluate``
    :param evaluate: returns the scores of a model by name; by default area search is evaluated by
        ``evaluation.evaluators.make_evaluator``; ``VecEnvEvaluator`` serves other environments,
        with ``stream="selection"``
    :param metric: the score that the best policy maximizes; by default ``cover``, or ``return``
        where that is no score
    :param folder: of ``evaluations.csv`` and ``best/``; None to write nothing
    :param save: ``save(model, folder, record)`` writes the best policy, see :func:`save_policy`
    :param verbose: 1 prints each evaluation
    :raises ValueError: if ``eval_freq`` or ``n_episodes`` is below 1
    """

    def __init__(
        self,
        eval_freq: int,
        n_episodes: int = 100,
        seed: int = 0,
        deterministic: bool = True,
        evaluate: Evaluate | None = None,
        metric: str | None = None,
        folder: str | Path | None = None,
        save: Save = save_policy,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        check_positive(eval_freq=eval_freq, n_episodes=n_episodes)
        self.eval_freq = eval_freq
        self.n_episodes = n_episodes
        self.seed = seed
        self.deterministic = deterministic
        self.evaluate = evaluate
        self.metric = metric
        self.folder = None if folder is None else Path(folder)
        self.save = save
        self.history: list[dict[str, float]] = []
        self.best: float | None = None
        self._due: int | None = None

    def _init_callback(self) -> None:
        super()._init_callback()
        if self.evaluate is None:
            self.evaluate = make_evaluator(
                self.model, self.n_episodes, self.seed, self.deterministic, "selection"
            )
        if self._due is None or self._due > self.joint_steps + self.eval_freq:
            self._due = self.joint_steps + self.eval_freq

    def _on_step(self) -> bool:
        assert self._due is not None
        if self.joint_steps >= self._due:
            self._due += self.eval_freq * (1 + (self.joint_steps - self._due) // self.eval_freq)
            self.run()
        return True

    def run(self) -> dict[str, float]:
        """Evaluate the policy as it is now, and record the outcome.

        :return: the scores
        :raises ValueError: if ``metric`` is none of the scores, or the best one is not finite
        """
        assert self.evaluate is not None
        with random_state_kept():
            scores = {name: float(value) for name, value in self.evaluate(self.model).items()}
        if self.metric is None:
            self.metric = "cover" if "cover" in scores else "return"
        if self.metric not in scores:
            raise ValueError(closest("metric", self.metric, scores))
        for name, value in scores.items():
            self.logger.record(f"eval/{name}", value)
        steps = {
            "env_steps": self.joint_steps,
            "agent_steps": int(self.model.num_timesteps),
        }
        self.history.append({**steps, **scores})
        value = scores[self.metric]
        if self.verbose > 0:
            note = getattr(self.evaluate, "note", "")
            note = f" ({note})" if note else ""
            print(f"evaluation at {self.joint_steps} joint steps: {self.metric} {value:.4g}{note}")
        # Not ">=": of equal ones the first. A NaN is never the best.
        if np.isfinite(value) and (self.best is None or value > self.best):
            self.best = value
            if self.folder is not None:
                record = {"metric": self.metric, "value": value, **steps, "scores": scores}
                self.save(self.model, self.folder / "best", record)
        self.logger.record(f"eval/best_{self.metric}", self.best)
        if self.folder is not None:
            names = list(dict.fromkeys(name for row in self.history for name in row))
            rows = [[row.get(name, "") for name in names] for row in self.history]
            write_atomically(self.folder / "evaluations.csv", csv_bytes(names, rows))
        return scores

    def close(self) -> None:
        """Release what the evaluation has open, such as its environment; nothing follows it."""
        close = getattr(self.evaluate, "close", None)
        if close is not None:
            close()

    def get_state(self) -> dict[str, Any]:
        """Return what the coming evaluations and records depend on."""
        return {
            "due": self._due,
            "best": self.best,
            "metric": self.metric,
            "history": [dict(row) for row in self.history],
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from what :meth:`get_state` returned; before the training begins."""
        self._due = state["due"]
        self.best = state["best"]
        self.metric = state["metric"]
        self.history = [dict(row) for row in state["history"]]
