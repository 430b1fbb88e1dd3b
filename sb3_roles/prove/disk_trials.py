"""Saves that the system refuses in the middle of a file, in a process of their own.

``TASK`` is JSON, see :func:`main`. The refusal is the kernel's: while the chosen file is open for
writing, the process may write no file beyond a number of bytes (RLIMIT_FSIZE). What was written
before stays, as on a full disk, and no rights or file systems are needed.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import shutil
import sys
from pathlib import Path
from typing import Any

from sb3_roles.common.checkpoint import CheckpointFolder
from sb3_roles.prove.processes import run_here
from sb3_roles.prove.save_loops import stock_model
from sb3_roles.prove.small_runs import ITERATION
from sb3_roles.zoo.models import load_model
from sb3_roles.zoo.run_folder import CHECKPOINTS

_WRITES = os.O_WRONLY | os.O_RDWR


class FullDisk:
    """Refuses bytes of files whose name begins with a word; one per process."""

    def __init__(self) -> None:
        self._name, self._offset, self._there = "", 0, 0
        _, self._hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        sys.addaudithook(self._hear)

    def fill(self, name: str, offset: int) -> None:
        """Refuse what goes beyond an offset from now on.

        :param name: of the file, or how it begins; nothing to refuse nothing
        :param offset: in bytes
        """
        self._name, self._offset = name, offset
        self._limit(None)

    def _hear(self, event: str, details: tuple[Any, ...]) -> None:
        if event != "open" or not self._name or not isinstance(details[0], (str, os.PathLike)):
            return
        if isinstance(details[2], int) and details[2] & _WRITES:
            chosen = Path(details[0]).name.startswith(self._name)
            self._limit(self._offset if chosen else None)

    def _limit(self, size: int | None) -> None:
        soft = self._hard if size is None else size
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, self._hard))


def train(*arguments: str | Path) -> tuple[object, list[str]]:
    """Run ``train`` in this process, and return its exit code and what it said on stderr."""
    ran = run_here([*map(str, arguments), "--verbose", "0"], "train")
    return ran.code, ran.err.splitlines()


def refused(outcome: tuple[object, list[str]], folder: Path) -> str:
    """Return what is wrong with a command that met a full disk; empty if nothing is."""
    code, lines = outcome
    if code != 2:
        return f"exit code {code}: {(lines or ['no message'])[-1]}"
    if len(lines) != 1:
        return f"{len(lines)} lines"
    left = [path.name for path in folder.rglob("*.partial")]
    return f"left {left[0]}" if left else ""


def resume_trial(disk: FullDisk, run: Path, offset: float) -> str:
    """Go on with a run, whose next checkpoint finds no place.

    :param run: a folder with one checkpoint, after one iteration
    :param offset: share of the checkpoint's bytes that find a place
    :return: what went wrong; empty if nothing did
    """
    (earlier,) = CheckpointFolder(run / CHECKPOINTS).paths()
    before = earlier.read_bytes()
    disk.fill(f"step_{2 * ITERATION:012d}", int(offset * len(before)))
    problem = refused(train("--resume", run), run)
    disk.fill("", 0)
    if problem:
        return problem
    if [path.read_bytes() for path in CheckpointFolder(run / CHECKPOINTS).paths()] != [before]:
        return "the earlier checkpoint is not what it was"
    load_model(run, device="cpu")
    code, lines = train("--resume", run)
    return "" if code == 0 else f"it does not go on afterwards: {lines}"


def file_trial(disk: FullDisk, begin: list[str], logs: Path, name: str, offset: int) -> str:
    """Begin a run, one of whose files finds no place.

    :param begin: arguments of the command
    :param logs: folder of the run
    :param name: of the file
    :param offset: bytes that find a place
    :return: what went wrong; empty if nothing did
    """
    disk.fill(name, offset)
    problem = refused(train(*begin, "-f", logs), logs)
    disk.fill("", 0)
    for run in (path.parent for path in logs.glob("*/*/config.yml")):
        if not problem and CheckpointFolder(run / CHECKPOINTS).paths():
            load_model(run, device="cpu")
        code, lines = (0, []) if problem else train("--resume", run)
        problem = problem or ("" if code == 0 else f"it does not go on afterwards: {lines}")
    return problem


def stock_trial(disk: FullDisk, model: Any, path: Path, offset: float) -> bool:
    """Save a model over an earlier file, and return whether there is one to load afterwards."""
    disk.fill("", 0)
    model.save(path)
    disk.fill(path.name, int(offset * path.stat().st_size))
    with contextlib.suppress(OSError):
        model.save(path)
    disk.fill("", 0)
    try:
        type(model).load(path, device="cpu")
    except Exception:
        # Whatever it is: the zip, a member, or what is pickled in it.
        return False
    return True


def main(task: dict[str, Any]) -> None:
    """Run the trials, and print what went wrong as JSON.

    :param task: ``folder``; ``begin``: arguments of a run of two iterations; ``offsets``: shares of
        a checkpoint; ``files``: names and numbers of bytes
    """
    folder, begin = Path(task["folder"]), task["begin"]
    disk, failures = FullDisk(), []
    # A run that was stopped after its first iteration, to begin each trial with.
    train(*begin, "-n", str(ITERATION), "-f", folder / "first")
    (first,) = (path.parent for path in folder.glob("first/*/*/config.yml"))
    text = (first / "config.yml").read_text()
    steps = f"n_timesteps: {ITERATION}\n"
    (first / "config.yml").write_text(text.replace(steps, f"n_timesteps: {2 * ITERATION}\n"))
    for i, offset in enumerate(task["offsets"]):
        run = folder / f"run_{i}"
        shutil.copytree(first, run)
        problem = resume_trial(disk, run, offset)
        failures += [f"checkpoint, {offset:.3f} of it: {problem}"] if problem else []
        shutil.rmtree(run)
    for i, (name, size) in enumerate(task["files"]):
        problem = file_trial(disk, begin, folder / f"logs_{i}", name, size)
        failures += [f"{name}, byte {size}: {problem}"] if problem else []
    model, destroyed = stock_model(), 0
    for offset in task["offsets"]:
        destroyed += not stock_trial(disk, model, folder / "stock.zip", offset)
    print(json.dumps({"failures": failures, "destroyed": destroyed}))


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
