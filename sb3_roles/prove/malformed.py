"""R8: malformed configurations and command lines, and nonsense that stock PPO is given."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from sb3_roles.prove.malformed_cases import CASES, Case
from sb3_roles.prove.processes import environment, run_here
from sb3_roles.prove.promises import Outcome, Setting

_LIMIT = 1.0
"""Seconds of the processor until the error is said."""
_QUICK_PROCESSES = 3
_HEAVY = ("torch", "stable_baselines3")
_CHILD = """
import json, sys, time
from sb3_roles.zoo.cli import main
words = sys.argv[1:]
script = words.pop(0)[:-3] if words[0].endswith(".py") else None
try:
    code = main(words, script)
except SystemExit as end:
    code = end.code
heavy = [name for name in {heavy!r} if name in sys.modules]
print(json.dumps([code, time.process_time(), heavy]))
"""
_BAD_NUMBER = float("nan")
NONSENSE: dict[str, Any] = {
    "learning_rate": -1e-3,
    "n_steps": 0,
    "batch_size": 0,
    "n_epochs": 0,
    "gamma": 1.5,
    "gae_lambda": -1.0,
    "clip_range": -0.2,
    "clip_range_vf": -1.0,
    "ent_coef": _BAD_NUMBER,
    "vf_coef": -0.5,
    "max_grad_norm": -1.0,
    "target_kl": -0.1,
    "stats_window_size": 0,
}
"""Settings of PPO that mean nothing."""


class Seen(NamedTuple):
    """What a command did.

    :param code: exit code
    :param out: what it printed on stdout
    :param err: the same of stderr
    :param seconds: of the processor
    :param heavy: slow packages that it has imported
    """

    code: object
    out: str
    err: str
    seconds: float
    heavy: tuple[str, ...] = ()


def commands(setting: Setting) -> Outcome:
    """Try all cases: in processes of their own, or with ``quick`` in this one, and three not.

    :param setting: see :class:`Setting`
    """
    failures, slowest, tried = [], 0.0, 0
    apart = range(0, len(CASES), len(CASES) // _QUICK_PROCESSES) if setting.quick else None
    for k, case in enumerate(CASES):
        ways: list[Callable[[Case, Path], Seen]] = [in_this_process] if setting.quick else []
        if apart is None or k in apart:
            ways.append(in_a_process)
        for way in ways:
            folder = setting.folder / str(tried)
            found, seconds = attempt(case, folder, way)
            slowest = max(slowest, seconds)
            tried += 1
            if found:
                failures.append(f"{case.name}: {'; '.join(found)}")
    stock, trusted = _stock(), _ours(NONSENSE)
    failures += [f"{name}: nonsense that ppo of this package takes" for name in trusted]
    total = tried + len(NONSENSE)
    said = (
        f"malformed configurations and command lines and {len(NONSENSE)} nonsense settings: exit "
        f"code 2, a line for each problem, nothing left behind; at most {slowest:.2f} s of CPU"
    )
    return Outcome(total - len(failures), total, said, tuple(failures), stock)


def attempt(case: Case, folder: Path, way: Callable[[Case, Path], Seen]) -> tuple[list[str], float]:
    """Run a case in a new folder.

    :param case: to try
    :param folder: not there yet
    :param way: :func:`in_this_process` or :func:`in_a_process`
    :return: what is wrong with how it ended, and the seconds of the processor that it took
    """
    folder.mkdir(parents=True)
    for name, content in case.files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if name.endswith("/"):
            path.mkdir()
        else:
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
    before = _tree(folder)
    seen = way(case, folder)
    return problems(case, seen, before, _tree(folder)), seen.seconds


def problems(
    case: Case, seen: Seen, before: dict[str, bytes | None], after: dict[str, bytes | None]
) -> list[str]:
    """Compare what a command did with what is promised.

    :param case: what was tried
    :param seen: what it did
    :param before: files of its folder
    :param after: the same, afterwards
    """
    found = []
    lines = seen.err.splitlines()
    if seen.code != 2:
        found.append(f"exit code {seen.code}")
    if len(lines) != case.lines:
        found.append(f"{len(lines)} lines instead of {case.lines}: {seen.err[:200]!r}")
    if not all(" error: " in line and line.isprintable() and len(line) < 2000 for line in lines):
        found.append(f"not all lines are short, printable errors: {seen.err[:200]!r}")
    missing = [name for name in case.named if name not in seen.err]
    if missing:
        found.append(f"{', '.join(map(repr, missing))} not named: {seen.err[:300]!r}")
    if seen.out:
        found.append(f"printed {seen.out[:80]!r}")
    if seen.heavy:
        found.append(f"imported {', '.join(seen.heavy)}")
    if seen.seconds >= _LIMIT:
        found.append(f"{seen.seconds:.2f} s of CPU")
    if before != after:
        found.append(f"left {sorted(set(after) ^ set(before)) or 'a changed file'}")
    return found


def _tree(folder: Path) -> dict[str, bytes | None]:
    """Return the content of all files, None for folders."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


def in_a_process(case: Case, folder: Path) -> Seen:
    """Run a case in a fresh interpreter; see :class:`Seen`."""
    done = subprocess.run(
        [sys.executable, "-c", _CHILD.format(heavy=_HEAVY), *case.words],
        cwd=folder,
        env=environment(),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="backslashreplace",
        timeout=600,
    )
    *printed, last = done.stdout.splitlines() or [""]
    try:
        code, seconds, heavy = json.loads(last)
    except ValueError:
        return Seen(done.returncode, done.stdout, done.stderr, 0.0)
    return Seen(code, "\n".join(printed), done.stderr, seconds, tuple(heavy))


def in_this_process(case: Case, folder: Path) -> Seen:
    """Run a case here; what it imports is not seen."""
    first, *words = case.words
    script = first.removesuffix(".py") if first.endswith(".py") else None
    start = time.process_time()
    with _inside(folder):
        ran = run_here(words if script else case.words, script)
    return Seen(*ran, time.process_time() - start)


@contextlib.contextmanager
def _inside(folder: Path) -> Iterator[None]:
    here = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(here)


def _ours(nonsense: dict[str, Any]) -> list[str]:
    """Return the settings that a configuration of ppo may have."""
    from sb3_roles.zoo.config import ConfigError, load_settings, resolve
    from sb3_roles.zoo.environments import AREA_SEARCH

    settings, taken = load_settings("ppo", AREA_SEARCH), []
    for name, value in nonsense.items():
        try:
            resolve("ppo", AREA_SEARCH, {**settings, name: value})
            taken.append(name)
        except ConfigError as error:
            if len(error.lines) != 1 or name not in error.lines[0]:
                taken.append(f"{name} ({'; '.join(error.lines)})")
    return taken


def _stock() -> str:
    """Give the same settings to SB3's PPO, and count how it takes them."""
    ends = Counter(stock_end(name, value) for name, value in NONSENSE.items())
    return (
        f"SB3's PPO trained with {ends['trained']} of {len(NONSENSE)} nonsense settings without a "
        f"word, crashed far from the cause with {ends['crashed']}, and named it with "
        f"{ends['named']}"
    )


def stock_end(name: str, value: Any) -> str:
    """Train SB3's PPO with one setting.

    :param name: of the constructor's argument
    :param value: of it
    :return: ``trained``, ``named`` (the constructor's error names the setting), or ``crashed``
    """
    from stable_baselines3 import PPO
    from stable_baselines3.common.logger import Logger

    small: dict[str, Any] = {"n_steps": 16, "batch_size": 8, "n_epochs": 2, "device": "cpu"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            model = PPO("MlpPolicy", "CartPole-v1", seed=0, **{**small, name: value})
        except Exception as error:
            return "named" if name in str(error) else "crashed"
        model.set_logger(Logger(None, []))  # Without one, SB3 makes a folder for its log.
        try:
            model.learn(64)
        except Exception:
            return "crashed"
    return "trained"
