"""The training loop of a run: SB3's, with checkpoints between iterations, and stops by signal."""

from __future__ import annotations

import csv
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import KVWriter, filter_excluded_keys
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_roles.common import snapshot
from sb3_roles.common.checkpoint import Checkpoint, CheckpointError, CheckpointFolder
from sb3_roles.common.facts import machine_facts
from sb3_roles.common.files import csv_bytes, write_atomically
from sb3_roles.common.team_wrapper import find_team_env


class CsvLog(KVWriter):
    """``progress.csv``, whose rows and columns a resumed run takes up where the checkpoint was.

    SB3's writer empties the file when it is opened, and its columns change with the hash seed. Rows
    are kept in the file alone: a run may have any number of them.

    :param path: the file
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.columns: list[str] = []
        self.n_rows = 0

    def write(
        self,
        key_values: dict[str, Any],
        key_excluded: dict[str, tuple[str, ...]],
        step: int = 0,
    ) -> None:
        """Add a row; see ``KVWriter``."""
        values = filter_excluded_keys(key_values, key_excluded, "csv")
        new = [key for key in values if key not in self.columns]
        self.columns += new
        # A number that waited in a checkpoint is not numpy's any more, and shall look the same.
        plain = {k: v.item() if isinstance(v, np.generic) else v for k, v in values.items()}
        row = [str(plain.get(key, "")) for key in self.columns]
        if new:
            self._rewrite([*self._read(), row])
        else:
            with open(self.path, "ab") as file:
                file.write(csv_bytes(row, []))
        self.n_rows += 1

    def _read(self) -> list[list[str]]:
        """Return the rows of the run so far, without the header."""
        if not self.n_rows or not self.path.exists():
            return []
        try:
            with open(self.path, encoding="utf-8", newline="") as file:
                rows = list(csv.reader(file))
        except (UnicodeDecodeError, csv.Error) as error:
            raise CheckpointError(f"{self.path}: damaged log: {error}") from error
        return rows[1 : 1 + self.n_rows]

    def _rewrite(self, rows: list[list[str]]) -> None:
        width = len(self.columns)
        full = [row[:width] + [""] * (width - len(row)) for row in rows]
        write_atomically(self.path, csv_bytes(self.columns, full))

    def close(self) -> None:
        """Nothing is open."""

    def get_state(self) -> dict[str, Any]:
        """Return how much of the file belongs to the run so far."""
        return {"columns": list(self.columns), "rows": self.n_rows}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Drop what was written after :meth:`get_state`.

        :raises CheckpointError: if the file is no log
        """
        self.columns = [str(name) for name in state["columns"]]
        self.n_rows = int(state["rows"])
        rows = self._read()
        self._rewrite(rows)
        self.n_rows = len(rows)


class StopSignals:
    """Whether the user asked to stop."""

    def __init__(self) -> None:
        self.received: int | None = None

    @contextmanager
    def caught(self) -> Iterator[StopSignals]:
        """Note the first SIGINT or SIGTERM instead of dying; the second one ends the program."""
        numbers = (signal.SIGINT, signal.SIGTERM)
        earlier = [signal.signal(number, self._note) for number in numbers]
        try:
            yield self
        finally:
            for number, handler in zip(numbers, earlier, strict=True):
                signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.received is not None:
            raise SystemExit(128 + number)
        self.received = number
        print("stopping after this update; again to stop at once", file=sys.stderr, flush=True)

    @property
    def exit_code(self) -> int:
        """0, 130 after SIGINT, 143 after SIGTERM."""
        return 0 if self.received is None else 128 + self.received


def train(
    model: OnPolicyAlgorithm,
    n_timesteps: int,
    checkpoints: CheckpointFolder,
    stop: StopSignals,
    callbacks: Sequence[BaseCallback] = (),
    stateful: Sequence[Any] = (),
    config: Mapping[str, Any] | None = None,
    resume: Checkpoint | None = None,
    save_freq: int = 0,
    log_interval: int = 1,
    stop_at: int | None = None,
    begin: Callable[[], object] | None = None,
) -> None:
    """Train, and leave a checkpoint at the end, unless a callback has asked to stop.

    Checkpoints are written between iterations only: after ``train()``, before the next rollout.

    :param model: untrained, its logger set
    :param n_timesteps: joint steps of the whole run
    :param checkpoints: where to write them
    :param stop: looked at between iterations
    :param callbacks: SB3's
    :param stateful: what has ``get_state()`` and ``set_state()``
    :param config: noted in the checkpoints
    :param resume: continue from this
    :param save_freq: joint steps between checkpoints; 0 for the last one only
    :param log_interval: iterations between rows of the log
    :param stop_at: joint steps after which to stop early, as after a signal
    :param begin: called before the first step, when ``resume`` is known to fit
    :raises FloatingPointError: if the loss is not finite; nothing is saved then
    :raises CheckpointError: if ``resume`` does not fit
    """
    env: Any = model.env
    n_agents = find_team_env(env).n_agents
    total, callback = model._setup_learn(
        n_timesteps * n_agents, CallbackList(list(callbacks)), True, "run"
    )
    if resume is not None:
        snapshot.restore(model, resume)
    callback.on_training_start({"total_timesteps": total, "self": model}, {})
    if resume is not None:
        snapshot.restore_stateful(stateful, resume)
        snapshot.set_rng_state(resume.state["rng"])
    if begin is not None:
        begin()
    per_iteration = model.n_steps * env.num_envs
    saved = model.num_timesteps

    def save() -> None:
        env_steps = model.num_timesteps // n_agents
        manifest = {
            "config": dict(config or {}),
            "machine": machine_facts(model),
            "env_steps": env_steps,
            "agent_steps": model.num_timesteps,
        }
        checkpoints.save(env_steps, manifest=manifest, **snapshot.capture(model, stateful))

    limit = total if stop_at is None else min(total, stop_at * n_agents)
    # An algorithm may be finished before its time: early stopping.
    while not (
        model.num_timesteps >= limit
        or stop.received is not None
        or getattr(model, "finished", False)
    ):
        # Returns False when a callback asks to stop, in the middle of a rollout.
        if not model.collect_rollouts(env, callback, model.rollout_buffer, model.n_steps):
            break
        model._update_current_progress_remaining(model.num_timesteps, total)
        iteration = model.num_timesteps // per_iteration
        if iteration % log_interval == 0:
            model.dump_logs(iteration)
        model.train()
        if save_freq and (model.num_timesteps - saved) >= save_freq * n_agents:
            save()
            saved = model.num_timesteps
    else:
        if model.num_timesteps > saved or not checkpoints.paths():
            save()
    callback.on_training_end()
