"""Who plays for the rows of a plan: scripted controllers, and the runs of ``train``."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_roles.common.names import closest
from sb3_roles.evaluation.grid.entrants import Entrant
from sb3_roles.zoo.config import CONFIG_FILE
from sb3_roles.zoo.environments import AREA_SEARCH
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.published import published, published_runs
from sb3_roles.zoo.row_configs import training_command
from sb3_roles.zoo.row_runs import (
    Report,
    RunFinder,
    describe_runs,
    fits,
    named_runs,
    newest_checkpoint,
)
from sb3_roles.zoo.run_folder import CHECKPOINTS

if TYPE_CHECKING:
    from sb3_roles.baselines.base import Controller
    from sb3_roles.evaluation.grid.crews import Parcel
    from sb3_roles.evaluation.grid.plan import Figure, Plan, Table


def make_controller(entrant: Entrant) -> Controller:
    """Make who plays for an entrant; of a run, the latest weights, on the CPU.

    :param entrant: see ``Entrant``
    :raises ImportError: if a scripted controller needs a package that is missing
    :raises UsageError: if the folder is no run on area search, or damaged
    """
    if not entrant.learned:
        from sb3_roles.baselines import controller_class

        return controller_class(entrant.source)()
    from sb3_roles.zoo.loaded_run import load_run

    loaded = load_run(Path(entrant.source), device="cpu", env=AREA_SEARCH)
    return loaded.controller(not entrant.drawn, True, entrant.role_control)


def pack(entrant: Entrant) -> Parcel:
    """Read what :func:`make_controller` needs of a run folder.

    :param entrant: see ``Entrant``
    :return: of a learned entrant with its configuration and its newest weights, without the rest of
        the checkpoint. The training may have gone on since the run was found: ``env_steps`` are
        those of the weights
    :raises UsageError: if there is no sound checkpoint
    :raises CheckpointError: if it states wrong numbers of steps
    :raises OSError: if a file can not be read
    """
    from sb3_roles.common.actor_weights import HOLDS
    from sb3_roles.common.checkpoint import write_checkpoint
    from sb3_roles.evaluation.grid.crews import Parcel
    from sb3_roles.evaluation.grid.store import named
    from sb3_roles.zoo.models import steps_of

    if not entrant.learned:
        return Parcel(entrant)
    run = Path(entrant.source)
    path, checkpoint = newest_checkpoint(run)
    steps = {key: steps_of(checkpoint, key) for key in ("env_steps", "agent_steps")}
    holds = {key: checkpoint.manifest[key] for key in (HOLDS,) if key in checkpoint.manifest}
    with tempfile.TemporaryDirectory(prefix="sb3_roles-") as folder:
        weights = Path(folder, path.name)
        with named(weights):
            write_checkpoint(weights, {**steps, **holds}, checkpoint.policy)
        content = weights.read_bytes()
    files = {
        CONFIG_FILE: (run / CONFIG_FILE).read_bytes(),
        f"{CHECKPOINTS}/{path.name}": content,
    }
    return Parcel(replace(entrant, env_steps=steps["env_steps"]), files)


def find_entrants(
    plan: Plan, logs: Path, runs: Sequence[str] = (), report: Report = print
) -> dict[str, list[Entrant]]:
    """Find who plays for the rows that tables and figures need.

    For a learned row these are its runs, or else the weights that come with this package.

    :param plan: the part of it that is wanted
    :param logs: folder of the runs
    :param runs: see :func:`named_runs`
    :param report: takes lines: the runs of each learned row, or how to train some
    :return: row -> one entrant for each run, one for a scripted row; empty for a row without a run
    :raises UsageError: if ``runs`` or the configuration of a row is wrong
    """
    named = named_runs(runs, plan)
    finder = RunFinder(logs, report)
    parts: list[Table | Figure] = [*plan.tables.values(), *plan.figures.values()]
    entrants: dict[str, list[Entrant]] = {}
    for name in dict.fromkeys(row for part in parts for row in part.rows):
        row = plan.rows[name]
        if row.controller is not None:
            entrants[name] = [Entrant(name, row.controller)]
            continue
        if name in named:
            report(f"{name}: {describe_runs(named[name])}")
            if not all(fits(run, row) for run in named[name]):
                report(f"{name}: named by hand, its configuration is not the row's")
        chosen = named[name] if name in named else finder.find(row)
        shipped = [] if chosen else published_runs(row, report)
        if chosen and name not in named and name in published():
            report(f"{name}: not the weights that come with this package, for these runs are there")
        if not (chosen or shipped):
            report(f"{name} has no run in {logs}: {training_command(row, logs)}")
        entrants[name] = [run.entrant(row) for run in chosen]
        entrants[name] += [replace(run.entrant(row), shipped=True) for run in shipped]
    unneeded = [name for name in named if name not in entrants]
    if unneeded:
        raise UsageError(f"argument --runs: {closest('row', unneeded[0], entrants)}")
    return entrants
