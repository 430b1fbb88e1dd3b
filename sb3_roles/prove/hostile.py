"""R6: hostile checkpoints and run folders run no code, take no memory, and give one line."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import warnings
from contextlib import redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from typing import Any

from stable_baselines3 import PPO

from sb3_roles.prove.hostile_files import LOADED, MODULE, RESUMED, Spoil, marker_of, sb3_zip
from sb3_roles.prove.processes import environment
from sb3_roles.prove.promises import Outcome, Setting
from sb3_roles.prove.small_runs import ITERATION, small_run
from sb3_roles.zoo.config import write_yaml
from sb3_roles.zoo.job import run_job
from sb3_roles.zoo.train_jobs import DEFAULTS

_TIMEOUT = 1800.0
# Of each sort one, those that are soon made and read.
_QUICK = (
    "a pickle in the place of the checkpoint",
    "a pickle in the place of the weights",
    "a member ../x.py",
    "a zip bomb",
    "members that overlap",
    "a tensor of 2^62 bytes",
    "a pipe in the place of the checkpoint",
    "a link to an endless device",
    "YAML that calls os.system",
    "YAML of 2^60 values by aliases",
    "an environment os:system",
    "an environment of a module beside it",
    "a policy of 20 GB",
    "a state nested 100,000 deep",
    "generators that are none",
    "options that write elsewhere",
    "a log without end",
    "a command that is a link",
)


def hostile(setting: Setting) -> Outcome:
    """Give hostile run folders to ``enjoy`` and ``train --resume``.

    Both run in a child process, under an audit hook and with little memory to spare. A trial is a
    kind; it is kept if each command ends with exit code 2 and one line, nothing ran and nothing was
    written outside of the folder.

    :param setting: how
    """
    if not Path("/proc/self/statm").exists():
        return Outcome(0, 0, "", skipped="memory is bounded as Linux counts it, in /proc")
    if not setting.quick:
        return try_kinds(setting, LOADED, RESUMED)
    loaded = {name: LOADED[name] for name in _QUICK if name in LOADED}
    return try_kinds(setting, loaded, {name: RESUMED[name] for name in _QUICK if name in RESUMED})


def try_kinds(setting: Setting, loaded: dict[str, Spoil], resumed: dict[str, Spoil]) -> Outcome:
    """Try some kinds of hostile run folders.

    :param setting: how
    :param loaded: kinds that every way to load refuses
    :param resumed: kinds that only resumption reads
    """
    sound = _sound_run(setting.folder / "logs")
    (setting.folder / f"{MODULE}.py").write_text("def make():\n    raise SystemExit(7)\n")
    kinds = {**loaded, **resumed}
    folders: dict[str, Path] = {}
    for i, (name, spoil) in enumerate(kinds.items()):
        folders[name] = setting.folder / f"run_{i}"
        shutil.copytree(sound, folders[name])
        spoil(folders[name])
    told = _watched(setting, sound, [(f, n in resumed) for n, f in folders.items()])
    for one in told[:2]:
        if one["code"] != 0:
            return Outcome(0, len(kinds), "the sound run does not load", (str(one["errors"]),))
    failures = []
    for name, folder in folders.items():
        mine = [one for one in told[2:] if one["folder"] == folder.name]
        found = [f"{one['command']}: {text}" for one in mine for text in _problems(one)]
        if len(mine) < (1 if name in resumed else 2):
            found.append("the process died")
        if marker_of(folder).exists() or (setting.folder / "hostile_tag_ran").exists():
            found.append("its code ran")
        if found:
            failures.append(f"{name}: {'; '.join(found)}")
    return Outcome(
        len(kinds) - len(failures),
        len(kinds),
        "kinds of hostile run folders: nothing ran, memory bounded, exit code 2 with one line",
        tuple(failures),
        stock=_stock(setting.folder),
    )


def _problems(told: dict[str, Any]) -> list[str]:
    found = [] if told["code"] == 2 else [f"exit code {str(told['code'])[:200]}"]
    lines = told["errors"].splitlines()
    if len(lines) != 1:
        found.append(f"{len(lines)} lines: {' | '.join(lines)[:200]}")
    elif "out of memory" in lines[0] or "allocate" in lines[0]:
        found.append(f"memory is not bounded: {lines[0][:200]}")
    elif len(lines[0]) > 2000:
        found.append(f"a line of {len(lines[0])} characters")
    return found + [f"{one}, which it must not" for one in told["seen"][:3]]


def _sound_run(logs: Path) -> Path:
    """Train a run whose resumption has nothing left to do."""
    config = small_run("hmappo", n_iterations=1)
    options = {
        **DEFAULTS,
        "algo": ("hmappo",),
        "log_folder": str(logs),
        "device": "cpu",
        "eval_freq": 0,
        "eval_episodes": 1,
        "save_freq": ITERATION,
        "verbose": 0,
    }
    with redirect_stdout(StringIO()):
        run_job({"config": config, "options": options, "resume": None, "command": ["train.py"]})
    (run,) = (logs / "hmappo").iterdir()
    write_yaml(run / "args.yml", {**options, "algo": "hmappo", "num_threads": 1})
    return run


def _watched(
    setting: Setting, sound: Path, folders: list[tuple[Path, bool]]
) -> list[dict[str, Any]]:
    asked = {"sound": str(sound), "folders": [(str(one), only) for one, only in folders]}
    command = [sys.executable, "-m", "sb3_roles.prove.hostile_child", json.dumps(asked)]
    done = subprocess.run(
        command,
        cwd=setting.folder,
        env=environment(),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=_TIMEOUT,
    )
    told = [json.loads(line) for line in done.stdout.splitlines()]
    if len(told) < 2:
        raise RuntimeError(f"the child process failed: {done.stderr[-2000:]}")
    return told


def _stock(folder: Path) -> str:
    """Load a crafted zip as SB3 does; its payload makes a file in the experiment's folder."""
    run = folder / "stock"
    path = folder / "stock.zip"
    path.write_bytes(sb3_zip(run))
    with warnings.catch_warnings(), redirect_stdout(StringIO()), suppress(Exception):
        warnings.simplefilter("ignore")
        PPO.load(path, device="cpu")
    ran = "runs" if marker_of(run).exists() else "does not run"
    return f"PPO.load {ran} the payload of a crafted zip"
