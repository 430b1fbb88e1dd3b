"""R13 and R14: the same results in any process, and with any workers of a Ray cluster."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sb3_roles.prove.processes import environment, last_line
from sb3_roles.prove.promises import Outcome, Setting
from sb3_roles.prove.remains import first_odd, remains_of_run, remains_of_tables
from sb3_roles.prove.small_runs import small_settings
from sb3_roles.zoo.config import write_yaml
from sb3_roles.zoo.environments import AREA_SEARCH
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.ray_options import import_ray
from sb3_roles.zoo.run_folder import find_run

N_PROCESSES, _QUICK_PROCESSES = 5, 2
_ALGOS, _QUICK_ALGOS = ("hmappo", "gnn", "recurrent_ppo"), ("hmappo",)
_LOGS, _TABLES, _PLAN = "logs", "out", "plan.yml"
# One interpreter runs all commands of a trial: starting it takes longer than they do.
_CODE = """
import json, sys
from pathlib import Path
{before}
from sb3_roles.prove.determinism import commands

commands(json.loads(sys.argv[1]))
"""


def processes(setting: Setting, before: str = "") -> Outcome:
    """Train, evaluate and make tables in fresh processes, and compare what is left.

    Each process has another hash seed, number, current folder and names of folders.

    :param setting: see :class:`Setting`
    :param before: Python code that each process runs first
    """
    n = _QUICK_PROCESSES if setting.quick else N_PROCESSES
    algos = _QUICK_ALGOS if setting.quick else _ALGOS
    rng = np.random.default_rng([setting.seed, 13])
    found: list[dict[str, str]] = []
    failures = []
    for i in range(n):
        setting.note(f"process {i + 1} of {n}")
        # Of another length each: what depends on a path shall show.
        folder = setting.folder / ("p" * (1 + 3 * i) + str(int(rng.integers(10**6))))
        folder.mkdir()
        hash_seed = str(int(rng.integers(1, 2**32)))
        result = subprocess.run(
            [sys.executable, "-c", _CODE.format(before=before), json.dumps(algos)],
            cwd=folder,
            env=environment(PYTHONHASHSEED=hash_seed),
            capture_output=True,
            text=True,
        )
        if result.returncode:
            failures.append(f"process {i + 1}: {last_line(result.stderr)}")
            continue
        found.append(json.loads((folder / "remains.json").read_text()))
        odd = first_odd(found[0], found[-1])
        if odd:
            failures.append(f"process {i + 1}, hash seed {hash_seed}: {odd} differ from the first")
    said = (
        f"fresh processes with other hash seeds, current folders and names: {len(found[0])} digests"
        f" of {', '.join(algos)}, held-out evaluations, tables and records each, identical"
        if found
        else "fresh processes"
    )
    return Outcome(n - len(failures), n, said, tuple(failures))


def commands(algos: list[str]) -> None:
    """Train, evaluate and make tables in the current folder, and write digests of what is left.

    :param algos: of the registry
    """
    from sb3_roles.zoo.cli import main

    here = Path()
    digests: dict[str, str] = {}
    for algo in algos:
        conf = here / f"{algo}.yml"
        write_yaml(conf, {AREA_SEARCH: small_settings(algo, 3)})
        words = ["--algo", algo, "--conf-file", str(conf), "--seed", "5", "-f", _LOGS]
        words += ["--eval-freq", "40", "--eval-episodes", "4", "--save-freq", "32"]
        words += ["--num-threads", "1", "--device", "cpu", "--verbose", "0"]
        _call(main, "train", *words)
        digests |= {
            f"{algo}: {name}": one for name, one in remains_of_run(_run_of(here, algo)).items()
        }
    digests |= evaluated(here)
    (here / "remains.json").write_text(json.dumps(digests))


def evaluated(here: Path) -> dict[str, str]:
    """Make tables of a run in a folder, and return digests of them.

    :param here: with a run of HMAPPO
    """
    from sb3_roles.zoo.cli import main

    write_yaml(here / _PLAN, tiny_plan())
    out, learned = here / _TABLES, f"learned={_run_of(here, 'hmappo')}"
    _call(main, "tables", "--plan", _PLAN, "-o", str(out), "--jobs", "1", "--runs", learned)
    return remains_of_tables(out)


def _run_of(folder: Path, algo: str) -> Path:
    return find_run(folder / _LOGS, algo, AREA_SEARCH)


def _call(main: Any, *words: str) -> None:
    code = main(list(words))
    if code:
        raise RuntimeError(f"{words[0]} ended with exit code {code}")


def tiny_plan() -> dict[str, Any]:
    """Return what the file of a plan of two scripted rows and a learned one says."""
    metrics = ["explo_true", "cover", "explo_paper"]
    table = {
        "caption": "Two scenes",
        "n_agents": [2],
        "scenes": {"easy": "Easy", "hard": "Hard"},
        "metrics": metrics,
        "rows": ["random", "greedy", "learned"],
    }
    rows: Mapping[str, Any] = {
        "random": {"label": "Random", "controller": "random", "block": 3},
        "greedy": {"label": "Greedy", "controller": "greedy", "block": 3},
        "learned": {"label": "Learned", "algo": "hmappo", "block": 3},
    }
    return {
        "episodes": 4,
        "quick_episodes": 2,
        "seed": 1000,
        "rows": dict(rows),
        "tables": {"I": table},
        "figures": {},
    }


def ray(setting: Setting) -> Outcome:
    """Train and evaluate on a Ray cluster that loses a worker in each round, and without Ray.

    :param setting: see :class:`Setting`
    """
    try:
        import_ray()
    except UsageError as error:
        return Outcome(0, 0, "", skipped=str(error))
    from sb3_roles.prove.ray_deaths import grid_trial, training_trials

    before = os.environ.get("PYTHONPATH")
    # Workers find the packages of this process.
    os.environ["PYTHONPATH"] = environment()["PYTHONPATH"]
    try:
        trials = training_trials(setting)
        if not setting.quick:
            trials.append(grid_trial(setting))
    finally:
        if before is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = before
    failures = [f"{trial.name}: {trial.odd}" for trial in trials if trial.odd]
    said = "; ".join(f"{trial.name}, {trial.deaths} killed" for trial in trials)
    held = len(trials) - len(failures)
    return Outcome(held, len(trials), f"as without Ray: {said}", tuple(failures))
