"""Run folders: ``<logs>/<algo>/<env>_<i>/``, which hold all that a run needs to be repeated."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from sb3_roles._version import __version__
from sb3_roles.common.files import append
from sb3_roles.common.versions import PACKAGES, version_of
from sb3_roles.zoo.config import CONFIG_FILE, write_yaml
from sb3_roles.zoo.environments import folder_name
from sb3_roles.zoo.launcher import process_settings
from sb3_roles.zoo.options import UsageError

ARGS_FILE, COMMAND_FILE, LOCK_FILE = "args.yml", "command.txt", "lock"
CHECKPOINTS, BEST = "checkpoints", "best"
SCORES_FILE = "evaluation.yml"


def _numbered(folder: Path, env: str) -> dict[int, Path]:
    pattern = re.compile(re.escape(folder_name(env)) + r"_([0-9]+)")
    found = {}
    for path in folder.iterdir() if folder.is_dir() else ():
        match = pattern.fullmatch(path.name)
        if match and path.is_dir():
            found[int(match[1])] = path
    return found


def find_run(logs: Path, algo: str, env: str, exp_id: int = 0) -> Path:
    """Find a run folder, ``<logs>/<algo>/<env>_<id>``.

    :param logs: folder of all runs
    :param algo: name of the algorithm
    :param env: name of the environment
    :param exp_id: number of the run; 0 for the latest
    :raises UsageError: if there is none
    """
    runs = _numbered(logs / algo, env)
    if runs and exp_id in (0, *runs):
        return runs[exp_id or max(runs)]
    wanted = f"run {exp_id}" if exp_id else "run"
    there = f"there are {', '.join(map(str, sorted(runs)))}" if runs else "there is none"
    raise UsageError(f"no {wanted} of {algo} on {env} in {str(logs)!r}: {there}")


def new_run(logs: Path, algo: str, env: str) -> Path:
    """Make the next run folder.

    :param logs: folder of all runs
    :param algo: name of the algorithm
    :param env: name of the environment
    :return: the folder, empty
    """
    folder = logs / algo
    folder.mkdir(parents=True, exist_ok=True)
    number = max(_numbered(folder, env), default=0) + 1
    while True:
        path = folder / f"{folder_name(env)}_{number}"
        try:
            path.mkdir()
            return path
        except FileExistsError:
            # Another trainer was faster.
            number += 1


def _refuse_link(path: Path) -> None:
    if path.is_symlink():
        raise UsageError(f"{path}: is a symbolic link, where a run has a file: remove it")


def _open_itself(path: Path) -> IO[str]:
    """Open a file to read and append, and never the one that a link stands for.

    A run folder may come from anybody, and must not choose what else is written to: a lock is
    emptied before its owner is written into it, a command line is added to those before it.

    :raises UsageError: if the file is a link, or can not be opened
    """
    _refuse_link(path)
    # The flag, where the system has it, for a link that is made in between.
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0)
    try:
        return open(os.open(path, flags, 0o666), "a+", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from None


class RunLock:
    """Keeps two trainers from writing to one run; released by the system when its owner dies.

    :param run: the run folder
    :raises UsageError: if another process has it, or the lock's file can not be opened
    """

    def __init__(self, run: Path) -> None:
        self._file: IO[str] = _open_itself(run / LOCK_FILE)
        try:
            import fcntl
        except ImportError:
            return  # No such locks on this system.
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.seek(0)
            owner = self._file.read(32).strip() or "unknown"
            self._file.close()
            raise UsageError(f"{run}: process {owner} is training this run") from None
        self._file.truncate(0)
        self._file.write(f"{os.getpid()}\n")
        self._file.flush()

    def release(self) -> None:
        """Let others train this run."""
        self._file.close()


def write_description(
    run: Path, config: Mapping[str, Any], args: Mapping[str, Any], command: Sequence[str]
) -> None:
    """Write what a run is: ``config.yml``, ``args.yml`` and ``command.txt``.

    :param run: the run folder
    :param config: the whole configuration
    :param args: the command line's options, as they were understood
    :param command: the command line
    """
    write_yaml(run / ARGS_FILE, args)
    note_command(run, command)
    # At last: a run that has it can be resumed.
    write_yaml(run / CONFIG_FILE, config)


def note_command(run: Path, command: Sequence[str]) -> None:
    """Add a command line to ``command.txt``, with the commit, versions and settings it ran with.

    The commit is null where the package is no file of a git work tree, as an installed one.

    :param run: the run folder
    :param command: the command line
    """
    _refuse_link(run / COMMAND_FILE)
    commit = source_commit(Path(__file__)) or "null"
    lines = [shlex.join(command), f"# sb3_roles {__version__}, commit {commit}"]
    versions = [f"{name} {version_of(name)}" for name in PACKAGES]
    lines.append(f"# python {sys.version.split()[0]}, " + ", ".join(versions))
    lines.append(f"# {process_settings()}")
    append(run / COMMAND_FILE, ("\n".join(lines) + "\n").encode())


def source_commit(file: Path) -> str | None:
    """Return the commit that a source file belongs to, with a mark if its work tree was changed.

    :param file: a file of the package
    :return: None if git does not track it: the repository around a virtual environment is another
        project's
    """
    # A hook of git names the repository that it runs for there.
    hidden = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE")
    variables = {key: value for key, value in os.environ.items() if key not in hidden}

    def git(*arguments: str) -> str:
        result = subprocess.run(
            ["git", "-C", str(file.resolve().parent), *arguments],
            env=variables,
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
        return result.stdout.strip()

    try:
        git("ls-files", "--error-unmatch", file.name)
        changed = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "HEAD") + (" with changes" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return None
