"""Commands of this package in processes of their own, to be watched, killed and compared."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

_TIMEOUT = 600.0


def environment(**variables: str) -> dict[str, str]:
    """Return the environment variables of a child: this process's packages, one thread.

    :param variables: to set besides
    """
    path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    return {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", **variables}


def words(*arguments: str | Path) -> list[str]:
    """Return the words that run a command of ``sb3-roles`` in a fresh interpreter.

    :param arguments: its name and options
    """
    return [sys.executable, "-m", "sb3_roles", *map(str, arguments)]


def start(*arguments: str | Path, cwd: Path, **variables: str) -> subprocess.Popen[str]:
    """Start a command, in a session of its own, its output in pipes.

    :param arguments: see :func:`words`
    :param cwd: folder to run it in
    :param variables: environment variables
    """
    return subprocess.Popen(
        words(*arguments),
        cwd=cwd,
        env=environment(**variables),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def finish(
    *arguments: str | Path, cwd: Path, timeout: float = _TIMEOUT, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end.

    :param arguments: see :func:`words`
    :param cwd: folder to run it in
    :param timeout: seconds
    :param variables: environment variables
    :raises subprocess.TimeoutExpired: if it takes longer
    """
    options: dict[str, Any] = {"cwd": cwd, "env": environment(**variables), "timeout": timeout}
    return subprocess.run(
        words(*arguments), stdin=subprocess.DEVNULL, capture_output=True, text=True, **options
    )
