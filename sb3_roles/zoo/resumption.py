"""Where a run goes on: its newest checkpoint, and what may keep it from going on bit for bit."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_roles.common.checkpoint import Checkpoint, CheckpointError, CheckpointFolder
from sb3_roles.common.checkpoint_fit import check_outline
from sb3_roles.common.env_state import env_gap
from sb3_roles.common.facts import differences, machine_facts
from sb3_roles.zoo.config import plain
from sb3_roles.zoo.environments import ENVIRONMENTS
from sb3_roles.zoo.models import steps_of, told
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.run_facts import PROGRESS
from sb3_roles.zoo.run_folder import CHECKPOINTS, SCORES_FILE


def has_checkpoint(run: Path) -> bool:
    """Return whether a run has one, or has lost it: who resumes it is not to begin anew then.

    What was evaluated at the end had one. The folder of checkpoints is made before anything is
    logged: where there is a log and no such folder, somebody has removed it, with what was in it.

    :param run: the run folder
    """
    checkpoints = CheckpointFolder(run / CHECKPOINTS)
    lost = (run / PROGRESS).exists() and not checkpoints.folder.exists()
    return bool(checkpoints.paths()) or lost or (run / SCORES_FILE).exists()


def note_anew(job: Mapping[str, Any]) -> None:
    """Say, or refuse, that a run which was killed before its first checkpoint begins anew.

    :param job: see ``job.run_job``
    :raises UsageError: with ``--strict-resume``
    """
    run = Path(job["resume"])
    if job["options"].get("strict_resume"):
        raise UsageError(f"--strict-resume: {run} has no checkpoint to go on from")
    dropped = f"; the rows of {PROGRESS} are dropped" if (run / PROGRESS).exists() else ""
    print(f"{run} has no checkpoint yet: it begins anew{dropped}", flush=True)


def read_newest(
    checkpoints: CheckpointFolder,
    model: OnPolicyAlgorithm,
    config: Mapping[str, Any],
    again: bool = False,
) -> tuple[Checkpoint, int, list[str]]:
    """Read where a run was; nothing is written.

    :param checkpoints: of the run
    :param model: made of its configuration, with its environment
    :param config: complete
    :param again: it has been read before, and what there was to warn of is known
    :return: the checkpoint, its joint steps, and what may keep it from going on bit for bit
    :raises UsageError: if there is none, or none that is sound and fits
    """
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            own = config["env"] not in ENVIRONMENTS
            # The state of anybody's own environment, whose code the user named, may have any size.
            check = None if own else partial(check_outline, model)
            _, checkpoint = checkpoints.newest(check)
        begun = steps_of(checkpoint, "env_steps")
    except CheckpointError as error:
        raise UsageError(told(checkpoints.folder.parent, error)) from error
    for warning in caught[: 0 if again else None]:
        print(f"warning: {warning.message}", flush=True)
    assert model.env is not None
    machine, trained = (checkpoint.manifest.get(name) for name in ("machine", "config"))
    reasons = differences(machine if isinstance(machine, dict) else {}, machine_facts(model))
    gap = env_gap(model.env)
    reasons += [] if gap is None else [gap]
    reasons += differences(trained if isinstance(trained, dict) else {}, plain(config))
    return checkpoint, begun, [" ".join(reason.split()) for reason in reasons]


def note_inexact(reasons: Sequence[str], job: Mapping[str, Any]) -> None:
    """Say, or refuse, what may keep a run from going on bit for bit.

    :param reasons: of :func:`read_newest`
    :param job: see ``job.run_job``
    :raises UsageError: if there are any, with ``--strict-resume``
    """
    if not reasons:
        return
    text = f"not bit-exact: {'; '.join(reasons)}"
    if job["options"].get("strict_resume"):
        raise UsageError(f"--strict-resume: {job['resume']}: {text}")
    print(text, flush=True)
