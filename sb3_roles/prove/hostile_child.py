"""Loads hostile run folders in a process of its own, under a watch; prints a line of JSON each."""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import sysconfig
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from sb3_roles.prove.hostile_files import MODULE
from sb3_roles.prove.processes import run_here

MARGIN = 1 << 30
"""Bytes of address space that a load may take beyond what a sound one has taken."""
_SECONDS = 120
_EVENTS = (
    "os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.forkpty", "os.kill",
    "subprocess.Popen", "socket.connect", "socket.bind", "pickle.find_class", "ctypes.dlopen",
    "os.remove", "os.rename", "os.rmdir", "os.chmod", "shutil.rmtree", "shutil.move", "compile",
)  # fmt: skip
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_PATHS = ("os.remove", "os.rename", "os.rmdir", "os.chmod")


class Watch:
    """Notes what Python's audit hooks tell of code that runs, and of files that are written.

    :param folder: what may be written below
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        self.seen: list[str] = []
        self._on = False
        scheme = sysconfig.get_paths()
        names = {scheme["stdlib"], scheme["purelib"], scheme["platlib"]}
        packages = {str(Path(__file__).resolve().parents[2]), os.path.dirname(os.__file__)}
        import area_search

        packages.add(str(Path(str(area_search.__file__)).resolve().parents[1]))
        self._ours = tuple({*names, *packages})
        sys.addaudithook(self._hook)

    @contextmanager
    def on(self) -> Iterator[list[str]]:
        """Give the list of what is seen inside."""
        self.seen.clear()
        self._on = True
        try:
            yield self.seen
        finally:
            self._on = False

    def _hook(self, event: str, args: tuple[Any, ...]) -> None:
        if not self._on:
            return
        note = None
        if event == "open":
            path, _, flags = args
            writes = isinstance(flags, int) and flags & _WRITES
            if writes and not self._may_write(path):
                note = f"open {path!r} to write"
        elif event in _PATHS:
            note = None if self._may_write(args[0]) else f"{event} {args[0]!r}"
        elif event == "exec":
            file = str(getattr(args[0], "co_filename", "?"))
            if not file.startswith(("<frozen ", *self._ours)):
                note = f"exec of {file}"
        elif event == "import":
            note = f"import {args[0]}" if args[0] == MODULE else None
        elif event in _EVENTS:
            note = f"{event} {str(args)[:80]}"
        if note is not None:
            self.seen.append(note)

    def _may_write(self, path: Any) -> bool:
        if isinstance(path, int):
            return True
        # Where it is, not where a link says.
        return (
            Path(os.path.realpath(os.fsdecode(path))).is_relative_to(self.folder)
            or str(path) == os.devnull
        )


def bound_memory() -> None:
    """Let this process take no more than :data:`MARGIN` beyond what it has."""
    with open("/proc/self/statm", encoding="ascii") as file:
        pages = int(file.read().split()[0])
    limit = pages * resource.getpagesize() + MARGIN
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.getrlimit(resource.RLIMIT_AS)[1]))


def _too_long(number: int, frame: FrameType | None) -> None:
    raise TimeoutError(f"more than {_SECONDS} s")


def commands(run_folder: str, resume_only: bool) -> Iterator[list[str]]:
    """Return the command lines that load a run folder.

    :param run_folder: the folder
    :param resume_only: only those that read all of it
    """
    if not resume_only:
        yield ["enjoy", "-f", run_folder, "--no-render"]
    yield ["train", "--resume", run_folder, "--device", "cpu"]


def watch_all(
    sound: Path, folders: list[tuple[Path, bool]], tell: Callable[[dict[str, Any]], object]
) -> None:
    """Load a sound run folder, and then hostile ones.

    :param sound: the run folder
    :param folders: hostile ones, and whether only resumption reads what is hostile
    :param tell: takes what came out
    """
    for words in commands(str(sound), resume_only=False):
        ran = run_here(words, caught=(BaseException,))
        tell({"folder": sound.name, "command": words[0], "code": ran.code, "errors": ran.err})
    watch = Watch(sound.parent)
    bound_memory()
    signal.signal(signal.SIGALRM, _too_long)
    for folder, resume_only in folders:
        watch.folder = folder.resolve()
        for words in commands(str(folder), resume_only):
            start = time.monotonic()
            signal.alarm(_SECONDS)
            with watch.on() as seen:
                ran = run_here(words, caught=(BaseException,))
            signal.alarm(0)
            tell(
                {
                    "folder": folder.name,
                    "command": words[0],
                    "code": ran.code,
                    "errors": ran.err,
                    "seen": list(dict.fromkeys(seen)),
                    "seconds": time.monotonic() - start,
                }
            )


if __name__ == "__main__":
    asked = json.loads(sys.argv[1])
    out = os.fdopen(os.dup(1), "w")
    watch_all(
        Path(asked["sound"]),
        [(Path(folder), only) for folder, only in asked["folders"]],
        lambda told: print(json.dumps(told), file=out, flush=True),
    )
