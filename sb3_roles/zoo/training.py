"""The training loop of a run: SB3's, with checkpoints between iterations, and stops by signal."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import KVWriter, filter_excluded_keys
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_roles.common import snapshot
from sb3_roles.common.checkpoint import Checkpoint, CheckpointError, CheckpointFolder
from sb3_roles.common.facts import machine_facts
from sb3_roles.common.files import append, csv_bytes, open_regular, write_atomically
from sb3_roles.common.group_play import RolloutsLost
from sb3_roles.common.team_wrapper import find_team_env
from sb3_roles.zoo.stop_signals import StopSignals

_STOPPING = "stopping, this iteration will be repeated by --resume; again to stop at once"

# A log may come with a run folder of anybody.
_MAX_LINE, _MAX_LOG = 1 << 20, 256 << 20


def _short_lines(file: TextIO) -> Iterator[str]:
    size = 0
    while line := file.readline(_MAX_LINE):
        size += len(line)
        if len(line) == _MAX_LINE or size > _MAX_LOG:
            raise csv.Error(f"a line of {_MAX_LINE} characters, or {_MAX_LOG} in all")
        yield line


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
            append(self.path, csv_bytes(row, []))
        self.n_rows += 1

    def _read(self) -> list[list[str]]:
        """Return the rows of the run so far, without the header."""
        if not self.n_rows or not self.path.exists():
            return []
        try:
            with io.TextIOWrapper(open_regular(self.path), "utf-8", newline="") as file:
                rows = list(islice(csv.reader(_short_lines(file)), 1 + self.n_rows))
        except (UnicodeDecodeError, csv.Error) as error:
            raise CheckpointError(f"{self.path}: damaged log: {error}") from error
        return rows[1:]

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
        """Drop what was written after :meth:`get_state`, and say so if rows of before are gone.

        :raises CheckpointError: if the file is no log
        """
        self.columns = [str(name) for name in state["columns"]]
        self.n_rows = int(state["rows"])
        rows = self._read()
        if len(rows) < self.n_rows:
            print(f"warning: {self.path}: {self.n_rows - len(rows)} rows of {self.n_rows} are gone")
        self._rewrite(rows)
        self.n_rows = len(rows)


class _Check(BaseCallback):
    """Lets a signal that waited, as for a file to be written, stop the rollout."""

    def __init__(self, stop: StopSignals) -> None:
        super().__init__()
        self._stop = stop

    def _on_step(self) -> bool:
        self._stop.check()
        return True


class _Boundary(NamedTuple):
    """A run between two iterations."""

    env_steps: int
    content: dict[str, Any]
    """of ``CheckpointFolder.save``"""


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
) -> int:
    """Train, and leave a checkpoint at the end, unless a callback has asked to stop.

    Checkpoints are of boundaries between iterations: after ``train()``, before the next rollout.
    At each the run is copied. A signal breaks the iteration off, and the copy becomes the
    checkpoint: who resumes it repeats the iteration, and ends in the same weights and logs.

    :param model: untrained, its logger set
    :param n_timesteps: joint steps of the whole run
    :param checkpoints: where to write them
    :param stop: whether there was a signal; the caller catches them
    :param callbacks: SB3's
    :param stateful: what has ``get_state()`` and ``set_state()``
    :param config: noted in the checkpoints
    :param resume: continue from this
    :param save_freq: joint steps between checkpoints; 0 for the last one only
    :param log_interval: iterations between rows of the log
    :param stop_at: joint steps after which to stop early, as after a signal
    :param begin: called before the first step, when ``resume`` is known to fit
    :return: joint steps of the run so far; after a signal those of the checkpoint
    :raises FloatingPointError: if the loss is not finite; nothing is saved then
    :raises CheckpointError: if ``resume`` does not fit
    :raises KeyboardInterrupt: after a signal before the first iteration could begin, or without one
    """
    env: Any = model.env
    n_agents = find_team_env(env).n_agents
    total, callback = model._setup_learn(
        n_timesteps * n_agents, CallbackList([*callbacks, _Check(stop)]), True, "run"
    )
    if resume is not None:
        snapshot.restore(model, resume)
    callback.on_training_start({"total_timesteps": total, "self": model}, {})
    if resume is not None:
        snapshot.restore_stateful(stateful, resume)
        with snapshot.fitting():
            snapshot.set_rng_state(resume.state["rng"])
    if begin is not None:
        begin()
    per_iteration = model.n_steps * env.num_envs
    limit = total if stop_at is None else min(total, stop_at * n_agents)
    begun = model.num_timesteps // n_agents
    saved = None if resume is None else begun
    boundary: _Boundary | None = None
    facts = machine_facts(model)

    def take() -> _Boundary:
        env_steps = model.num_timesteps // n_agents
        manifest = {
            "config": dict(config or {}),
            "machine": facts,
            "env_steps": env_steps,
            "agent_steps": model.num_timesteps,
        }
        return _Boundary(env_steps, {"manifest": manifest, **snapshot.capture(model, stateful)})

    def save(one: _Boundary) -> int:
        checkpoints.save(one.env_steps, **one.content)
        return one.env_steps

    stop.message = _STOPPING
    try:
        with stop.held():
            boundary = take()
        # An algorithm may be finished before its time: early stopping.
        while not (model.num_timesteps >= limit or getattr(model, "finished", False)):
            # Returns False when a callback asks to stop, in the middle of a rollout.
            if not model.collect_rollouts(env, callback, model.rollout_buffer, model.n_steps):
                break
            model._update_current_progress_remaining(model.num_timesteps, total)
            iteration = model.num_timesteps // per_iteration
            if iteration % log_interval == 0:
                model.dump_logs(iteration)
            # Of a signal that came while a file was written.
            stop.check()
            model.train()
            with stop.held():
                boundary = take()
                if save_freq and boundary.env_steps - (saved or begun) >= save_freq:
                    saved = save(boundary)
        else:
            if saved != boundary.env_steps:
                with stop.held():
                    saved = save(boundary)
    except KeyboardInterrupt:
        if stop.received is None or boundary is None:
            raise
        if saved != boundary.env_steps:
            save(boundary)
        env_steps = boundary.env_steps
    except RolloutsLost:
        # The cluster is gone, the run is not.
        if boundary is not None and saved != boundary.env_steps:
            save(boundary)
        raise
    else:
        env_steps = model.num_timesteps // n_agents
    stop.message = ""
    callback.on_training_end()
    return env_steps
