"""What the tests of grids share: small plans, controllers that fail, and equality of records."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from sb3_roles.baselines import controller_class
from sb3_roles.baselines.random import RandomController
from sb3_roles.evaluation.grid.entrants import Entrant, Results
from sb3_roles.evaluation.grid.plan import Plan
from sb3_roles.evaluation.grid.plan_file import parse_plan
from sb3_roles.evaluation.records import TIMINGS, EpisodeRecords

# A training of a moment, beside its own defaults.
TINY = {
    "n_timesteps": 8,
    "n_envs": 2,
    "n_steps": 2,
    "batch_size": 2,
    "n_epochs": 1,
    "env_kwargs": {"horizon": 4, "n_agents": 2},
}


def plan_data(names: Sequence[str] = ("random", "greedy"), **changes: Any) -> dict[str, Any]:
    """Return what the file of a plan of small blocks says."""
    table = {
        "caption": "Two scenes",
        "n_agents": [2],
        "scenes": {"easy": "Easy", "hard": "Hard"},
        "metrics": ["explo_true", "cover"],
        "rows": list(names),
    }
    return {
        "episodes": 8,
        "quick_episodes": 2,
        "seed": 1000,
        "rows": {
            name: {
                "label": name.title(),
                "controller": name if name in ("random", "greedy", "vrpc") else "random",
                "block": 3,
            }
            for name in names
        },
        "tables": {"I": table},
        "figures": {},
    } | changes


def small_plan(names: Sequence[str] = ("random", "greedy"), **changes: Any) -> Plan:
    """Return such a plan."""
    return parse_plan(plan_data(names, **changes))


def scripted(plan: Plan) -> dict[str, list[Entrant]]:
    """Return an entrant for every row, which is called like it."""
    return {name: [Entrant(name, name)] for name in plan.rows}


def make_run(logs: Path, row: Any, number: int, steps: int, seed: int, **changes: Any) -> Path:
    """Write what the finder reads of a run; its weights fit nothing."""
    # Processes that play import this module, too, and need none of these.
    from sb3_roles.common.checkpoint import CheckpointFolder
    from sb3_roles.zoo.config import write_yaml
    from sb3_roles.zoo.models import complete
    from sb3_roles.zoo.row_configs import config_of_row

    run = logs / row.algo / f"area-search-v0_{number}"
    config = {**complete(config_of_row(row)), "seed": seed, "n_timesteps": 500, **changes}
    run.mkdir(parents=True)
    write_yaml(run / "config.yml", config)
    folder = CheckpointFolder(run / "checkpoints")
    folder.prepare()
    folder.save(steps, manifest={"env_steps": steps}, policy={})
    return run


class Deadly(RandomController):
    """Random, and kills its process when it begins to play, unless a file says that it did."""

    def __init__(self, marker: Path | None) -> None:
        self._marker = marker

    def begin(self, batch: Any) -> None:
        if self._marker is None or not self._marker.exists():
            if self._marker is not None:
                self._marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        super().begin(batch)


class Failing(RandomController):
    """Random, and fails after some steps."""

    def act(self, batch: Any) -> np.ndarray:
        if batch.steps[0] > 3:
            raise ZeroDivisionError("three steps\nare enough")
        return super().act(batch)


def make(entrant: Entrant) -> Any:
    """Make a controller: a scripted one, or one that fails in the way that its source names."""
    kind, _, argument = entrant.source.partition(":")
    if kind == "deadly":
        return Deadly(Path(argument) if argument else None)
    if kind == "failing":
        return Failing()
    if kind == "missing":
        raise ImportError("install something")
    return controller_class(kind)()


def assert_same(first: EpisodeRecords, second: EpisodeRecords) -> None:
    """Records must be equal bit for bit, but for the times that were measured."""
    for one in fields(EpisodeRecords):
        if one.name in TIMINGS:
            continue
        a, b = getattr(first, one.name), getattr(second, one.name)
        pairs = [(a[key], b[key]) for key in a] if one.name == "counts" else [(a, b)]
        for left, right in pairs:
            if isinstance(left, np.ndarray):
                assert left.dtype == right.dtype, one.name
                assert left.shape == right.shape, one.name
                assert left.tobytes() == right.tobytes(), one.name
            else:
                assert left == right, one.name


def assert_same_results(first: Results, second: Results) -> None:
    """The same cells, entrants and records."""
    assert list(first) == list(second)
    for cell in first:
        assert [one.entrant for one in first[cell]] == [one.entrant for one in second[cell]]
        for one, other in zip(first[cell], second[cell], strict=True):
            assert_same(one.records, other.records)
