"""Commands of this package, here or in processes of their own, to be watched and compared."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from sb3_roles.common.names import one_line

_TIMEOUT = 600.0


def environment(**variables: str) -> dict[str, str]:
    """Return the environment variables of a child: this process's packages, one thread.

    :param variables: to set besides
    """
    path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    return {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", **variables}


def words(*arguments: str | Path, module: str = "sb3_roles") -> list[str]:
    """Return the words that run a command of ``sb3-roles`` in a fresh interpreter.

    :param arguments: its name and options
    :param module: to run instead of the package
    """
    return [sys.executable, "-m", module, *map(str, arguments)]


def start(
    *arguments: str | Path, cwd: Path, module: str = "sb3_roles", **variables: str
) -> subprocess.Popen[str]:
    """Start a command, in a session of its own, its output in pipes.

    :param arguments: see :func:`words`
    :param cwd: folder to run it in
    :param module: see :func:`words`
    :param variables: environment variables
    """
    return subprocess.Popen(
        words(*arguments, module=module),
        cwd=cwd,
        env=environment(**variables),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def kill_session(process: subprocess.Popen[str]) -> None:
    """Kill a process of :func:`start` and all that it has started, as ``kill -9`` would.

    :param process: may have ended
    """
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def left_behind(process: subprocess.Popen[str]) -> list[int]:
    """Return processes of the session of one that has ended, where the system tells (Linux).

    :param process: of :func:`start`
    """
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        # One may end meanwhile.
        with suppress(OSError):
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            # State, parent, group, session; a zombie has ended.
            if int(fields[3]) == process.pid and fields[0] != "Z":
                found.append(int(folder.name))
    return found


def finish(
    *arguments: str | Path,
    cwd: Path,
    timeout: float = _TIMEOUT,
    module: str = "sb3_roles",
    **variables: str,
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end.

    :param arguments: see :func:`words`
    :param cwd: folder to run it in
    :param timeout: seconds
    :param module: see :func:`words`
    :param variables: environment variables
    :raises subprocess.TimeoutExpired: if it takes longer; nothing of it is left then
    """
    process = start(*arguments, cwd=cwd, module=module, **variables)
    try:
        out, error = process.communicate(timeout=timeout)
    finally:
        kill_session(process)
    return subprocess.CompletedProcess(process.args, process.returncode, out, error)


class Ran(NamedTuple):
    """What a command of :func:`run_here` left.

    :param code: exit code, or the name and text of an exception that came instead
    :param out: what it wrote to stdout
    :param err: what it wrote to stderr
    """

    code: object
    out: str
    err: str


def run_here(
    words: Sequence[str],
    script: str | None = None,
    caught: tuple[type[BaseException], ...] = (),
) -> Ran:
    """Run a command in this process.

    :param words: see ``zoo.cli.main``
    :param script: see ``zoo.cli.main``
    :param caught: exceptions that are an outcome, too; others are passed on
    """
    from sb3_roles.zoo.cli import main

    code: object
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(list(words), script)
        except SystemExit as end:
            code = end.code
        except caught as error:
            code = f"{type(error).__name__}: {one_line(error)}"
    return Ran(code, out.getvalue(), err.getvalue())


def last_line(text: str) -> str:
    """Return the last line of what a process said, which of a traceback is the error.

    :param text: of stderr
    """
    return (text.strip().splitlines() or ["no message"])[-1]
