"""A disk that is full while a run writes (R4)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from sb3_roles.prove import processes
from sb3_roles.prove.promises import Outcome, Setting
from sb3_roles.prove.small_runs import ITERATION, small_settings
from sb3_roles.zoo.config import write_yaml
from sb3_roles.zoo.environments import AREA_SEARCH

DISK_TRIALS = "sb3_roles.prove.disk_trials"
_TIMEOUT = 3600.0
ALGO = "hmappo"
FILES = (
    "lock",
    "args.yml",
    "command.txt",
    "config.yml",
    "progress.csv",
    "roles.csv",
    "evaluations.csv",
    "model.ckpt",
    "evaluation.yml",
)
"""What a run writes beside its checkpoints."""


def offsets(setting: Setting) -> Outcome:
    """Fill the disk at chosen bytes of checkpoints, and of every other file of a run (R4).

    :param setting: the short form has four of the former and two of the latter
    """
    try:
        import resource  # noqa: F401
    except ImportError:
        return Outcome(0, 0, "", skipped="this system has no RLIMIT_FSIZE")
    rng = np.random.default_rng([setting.seed, 4])
    n_offsets, files = (4, ("progress.csv", "evaluation.yml")) if setting.quick else (20, FILES)
    shares = [0.0, 0.999, *rng.uniform(0, 1, n_offsets - 2).round(4).tolist()]
    task = {
        "folder": str(setting.folder),
        "begin": _begin(setting.folder),
        "offsets": shares,
        "files": [(name, int(rng.integers(0, 4 if name == "lock" else 40))) for name in files],
    }
    done = processes.finish(
        json.dumps(task), cwd=setting.folder, timeout=_TIMEOUT, module=DISK_TRIALS
    )
    tried = n_offsets + len(files)
    if done.returncode:
        return Outcome(0, tried, "the trials broke", (processes.last_line(done.stderr),))
    found = json.loads(done.stdout)
    said = f"refusals ({n_offsets} in checkpoints, {len(files)} in other files), exit 2, one line"
    return Outcome(
        tried - len(found["failures"]),
        tried,
        said,
        tuple(found["failures"]),
        f"{found['destroyed']} of {n_offsets} earlier files destroyed",
    )


def _begin(folder: Path) -> list[str]:
    """Return the arguments of a run of two iterations that writes each of its files."""
    config = folder / "given.yml"
    write_yaml(config, {AREA_SEARCH: small_settings(ALGO, 2)})
    words = ["--algo", ALGO, "-conf", str(config), "--seed", "3", "--num-threads", "1"]
    words += ["--save-freq", str(ITERATION), "--eval-freq", str(ITERATION)]
    return [*words, "--eval-episodes", "2", "--device", "cpu"]
