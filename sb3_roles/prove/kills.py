"""Kills and signals: what a run, and a folder of checkpoints, is after them (R1, R3, R15)."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from sb3_roles.common.checkpoint import CheckpointFolder
from sb3_roles.prove import processes, watched
from sb3_roles.prove.promises import Outcome, Setting
from sb3_roles.prove.small_runs import ITERATION, small_settings
from sb3_roles.prove.training_runs import WHOLE, checkpoint_difference, log_difference
from sb3_roles.prove.watched import BETWEEN, IMPORT, START, Board
from sb3_roles.zoo.config import CONFIG_FILE, write_yaml
from sb3_roles.zoo.environments import AREA_SEARCH
from sb3_roles.zoo.models import load_model
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.run_folder import CHECKPOINTS, SCORES_FILE

WATCHED = "sb3_roles.prove.watched"
SAVE_LOOPS = "sb3_roles.prove.save_loops"
ALGO = "hmappo"
_DEADLINE, _TIMEOUT = 300.0, 3600.0
_ATTEMPTS, _ALLOWED = 3, 10.0
"""Seconds from a signal to the end."""
# How long after a phase was entered a signal comes, at most, in seconds: about as long as it takes.
_WITHIN = {
    IMPORT: 0.3,
    START: 3.0,
    watched.ROLLOUT: 0.03,
    watched.UPDATE: 0.06,
    watched.SAVE: 0.004,
    watched.EVALUATION: 0.05,
    watched.FINAL: 0.05,
}


class Trainee:
    """A run in processes of its own.

    :param folder: of its own
    :param settings: of a configuration file
    :param options: of the command
    """

    def __init__(self, folder: Path, settings: dict[str, Any], *options: str) -> None:
        folder.mkdir(parents=True)
        self.folder, self._options = folder, options
        self._config = folder / "given.yml"
        write_yaml(self._config, {AREA_SEARCH: settings})
        self.board = Board(folder / "board")

    @property
    def run(self) -> Path | None:
        """The run folder that can be resumed; None before there is one."""
        made = sorted(self.folder.glob(f"logs/{ALGO}/*/{CONFIG_FILE}"))
        return made[-1].parent if made else None

    def start(self) -> subprocess.Popen[str]:
        """Begin the run, or go on with it."""
        words: list[str | Path] = ["train", "-conf", self._config, "--algo", ALGO, "--seed", "3"]
        words += ["-f", self.folder / "logs", "--device", "cpu", "--num-threads", "1"]
        words += self._options
        if self.run is not None:
            words = ["train", "--resume", self.run]
        self.board.write(IMPORT)
        return processes.start(
            self.folder / "board", *words, "--verbose", "0", cwd=self.folder, module=WATCHED
        )

    def wait_for(
        self, process: subprocess.Popen[str], phase: str, visits: int, within: float
    ) -> str | None:
        """Wait until a process is in a phase, and a while longer.

        :param phase: ``import`` begins at once
        :param visits: how often it must have been entered
        :param within: seconds to wait further
        :return: what the process is doing then; None if it has ended
        """
        deadline, seen, last = time.monotonic() + _DEADLINE, 0, -1
        while phase != IMPORT and seen < visits and process.poll() is None:
            now = self.board.read()
            if now.phase == phase and now.entered != last:
                seen, last = seen + 1, now.entered
            if time.monotonic() > deadline:
                raise TimeoutError(f"no {phase} in {_DEADLINE:.0f} s")
            time.sleep(0.0005)
        until = time.monotonic() + within
        while time.monotonic() < until and process.poll() is None:
            time.sleep(0.0005)
        return self.board.read().phase if process.poll() is None else None


def _counted(names: list[str]) -> str:
    return ", ".join(f"{n} in {name}" for name, n in sorted(Counter(names).items()))


# R1


def restarts(setting: Setting) -> Outcome:
    """Kill a run again and again, restart it each time, and compare it with one left alone (R1).

    :param setting: the short form kills twice
    """
    rng = np.random.default_rng([setting.seed, 1])
    kinds = [START, watched.ROLLOUT, watched.UPDATE, watched.SAVE, watched.EVALUATION]
    phases = [watched.UPDATE, watched.SAVE]
    if not setting.quick:
        phases = [*rng.permutation([*kinds * 3, IMPORT, *kinds[1:4]]), watched.FINAL]
    settings = small_settings(ALGO, 5 * len(phases), learning_rate=1e-3)
    options = ["--save-freq", str(ITERATION), "--eval-freq", str(2 * ITERATION)]
    options += ["--eval-episodes", "4"]
    alone, killed = (
        Trainee(setting.folder / name, settings, *options) for name in ("alone", "killed")
    )
    hit: list[str] = []
    failures: list[str] = []
    with ExitStack() as stack:

        def end(process: subprocess.Popen[str]) -> None:
            # Of one that has ended long ago the number may be that of another by now.
            if process.poll() is None:
                processes.kill_session(process)

        def started(trainee: Trainee) -> subprocess.Popen[str]:
            process = trainee.start()
            stack.callback(end, process)
            return process

        undisturbed = started(alone)
        for phase in phases:
            process = started(killed)
            visits = int(rng.integers(1, 4)) if phase in kinds[1:] else 1
            killed.wait_for(process, phase, visits, float(rng.uniform(0, _WITHIN[phase])))
            ended = process.poll() is not None
            processes.kill_session(process)
            if ended:
                failures.append(
                    f"restart {len(hit) + 1} ended by itself, code {process.returncode}"
                )
                break
            # Now that it is dead it can not go on to another one.
            hit.append(killed.board.read().phase)
            setting.note(f"killed in {hit[-1]}")
        for one, process in ((killed, started(killed)), (alone, undisturbed)):
            _, error = process.communicate(timeout=_TIMEOUT)
            if process.returncode:
                said = processes.last_line(error)
                failures.append(f"{one.folder.name}: code {process.returncode}: {said}")
    if not failures:
        found = run_difference(alone.run, killed.run)
        failures += [] if found is None else [f"the runs differ in {found}"]
    held = 0 if failures else len(hit)
    said = f"kills survived, identical ({_counted(hit)})"
    return Outcome(held, len(phases), said, tuple(failures), "no resume: begins anew")


def run_difference(a: Path | None, b: Path | None) -> str | None:
    """Return what differs between two finished runs, but for times; None for nothing.

    :param a: a run folder
    :param b: the other one
    """
    if a is None or b is None:
        return "their being there"
    newest = [CheckpointFolder(run / CHECKPOINTS).newest()[1] for run in (a, b)]
    found = checkpoint_difference(*newest) or log_difference(a, b)
    if found is None:
        return next((n for n in WHOLE if (a / n).read_bytes() != (b / n).read_bytes()), None)
    return found


# R15


def terminations(setting: Setting) -> Outcome:
    """Send SIGTERM, and now and then SIGINT, to training processes (R15).

    :param setting: the short form sends two
    """
    rng = np.random.default_rng([setting.seed, 15])
    long = [IMPORT] + [START] * 4 + [watched.ROLLOUT] * 4 + [watched.UPDATE] * 5
    short = [watched.SAVE, watched.EVALUATION, watched.FINAL] * 2
    phases = list(rng.permutation([*long, *short]))
    numbers = [signal.SIGINT if i % 4 == 3 else signal.SIGTERM for i in range(len(phases))]
    if setting.quick:
        phases, numbers = [watched.UPDATE, watched.FINAL], [signal.SIGTERM, signal.SIGINT]
    hit, times, failures = [], [], []
    held = 0
    for i, (phase, number) in enumerate(zip(phases, numbers, strict=True)):
        for attempt in range(_ATTEMPTS):
            trainee = _terminee(setting.folder / f"trial_{i}_{attempt}", phase, phase in long)
            where, seconds, problems = _terminated(trainee, phase, number, rng, phase in long)
            trainee.board.close()
            shutil.rmtree(trainee.folder)
            if where is not None:
                break
            # Of a phase of milliseconds; that it was missed says nothing about the program.
            problems = ["it ended before the signal"]
        times.append(seconds)
        hit.append(where or "nothing")
        setting.note(f"{signal.Signals(number).name} in {where}: out in {seconds:.1f} s")
        held += not problems
        failures += [f"{signal.Signals(number).name} in {where}: {one}" for one in problems]
    said = f"signals, out in at most {max(times):.1f} s ({_counted(hit)})"
    return Outcome(held, len(phases), said, tuple(failures))


def _terminated(
    trainee: Trainee, phase: str, number: int, rng: np.random.Generator, long: bool
) -> tuple[str | None, float, list[str]]:
    """Send one signal; return where it came, None if too late, seconds to the end, problems."""
    process = trainee.start()
    try:
        visits = int(rng.integers(1, 3)) if phase == watched.SAVE else 1
        within = 2.0 if long else _WITHIN[phase]
        where = trainee.wait_for(process, phase, visits, float(rng.uniform(0, within)))
        begun = time.monotonic()
        process.send_signal(number)
        _, error = process.communicate(timeout=_DEADLINE)
        seconds = time.monotonic() - begun
        orphans = processes.left_behind(process)
    finally:
        processes.kill_session(process)
    problems = _stopped_badly(trainee, process, number, error)
    if seconds > _ALLOWED:
        problems.append(f"took {seconds:.1f} s")
    if orphans:
        problems.append(f"left processes {orphans}")
    return where, seconds, problems


def _terminee(folder: Path, phase: str, long: bool) -> Trainee:
    """Make a run whose first iteration takes much longer than is allowed, or one of short ones."""
    if long:
        settings = small_settings(ALGO, 500, n_steps=400, n_epochs=50)
        return Trainee(folder, settings, "--eval-freq", "0")
    eval_freq = ITERATION if phase == watched.EVALUATION else 0
    options = ["--save-freq", str(ITERATION), "--eval-freq", str(eval_freq)]
    return Trainee(folder, small_settings(ALGO, 3), *options, "--eval-episodes", "60")


def _stopped_badly(
    trainee: Trainee, process: subprocess.Popen[str], number: int, error: str
) -> list[str]:
    """Return what is wrong with a process that was stopped, and what it left."""
    found = []
    run = trainee.run
    if process.returncode == -number:
        # Before the program could handle signals, when nothing may be there, or when it was done.
        phase = trainee.board.read().phase
        done = phase == BETWEEN and run is not None and (run / SCORES_FILE).exists()
        if phase != IMPORT and not done:
            found.append("died of the signal")
    elif process.returncode != 128 + number:
        found.append(f"exit code {process.returncode}: {processes.last_line(error)}")
    elif len(error.splitlines()) > 1:
        found.append(f"{len(error.splitlines())} lines: {processes.last_line(error)}")
    partial = [path.name for path in trainee.folder.rglob("*.partial")]
    found += [f"left {name}" for name in partial]
    made = list(trainee.folder.glob(f"logs/{ALGO}/*"))
    if run is None and made:
        found.append(f"left half a run folder, {made[0].name}")
    if run is not None:
        try:
            load_model(run, device="cpu")
        except UsageError as problem:
            if CheckpointFolder(run / CHECKPOINTS).paths() or "\n" in str(problem):
                found.append(f"does not load: {problem}")
    return found


# R3


def saves(setting: Setting) -> Outcome:
    """Kill loops of saves, and read what they have left (R3).

    :param setting: the short form kills ten
    """
    n_trials = 10 if setting.quick else 200
    arguments = (setting.folder, str(setting.seed), str(n_trials))
    done = processes.finish(*arguments, cwd=setting.folder, timeout=_TIMEOUT, module=SAVE_LOOPS)
    if done.returncode:
        return Outcome(0, n_trials, "the loops broke", (processes.last_line(done.stderr),))
    found = json.loads(done.stdout)
    said = f"kills survived, {found['inside']} of them with a file half written"
    return Outcome(
        n_trials - len(found["failures"]),
        n_trials,
        said,
        tuple(found["failures"]),
        f"{found['unreadable']} of {n_trials} files unreadable",
    )
