"""Folders of published weights: made beside their place, looked at, and then moved there whole."""

from __future__ import annotations

import os
import secrets
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_roles._version import __version__
from sb3_roles.common.checkpoint import SUFFIX
from sb3_roles.common.files import write_atomically
from sb3_roles.zoo.config import CONFIG_FILE, write_yaml
from sb3_roles.zoo.model_card import CARD, check_files, facts_of_file, read_card, render
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.run_facts import (
    EVALUATIONS,
    PROGRESS,
    curve_of,
    published_config,
    read_table,
    small_evaluations,
    small_progress,
    training_of,
    wall_time,
)
from sb3_roles.zoo.run_folder import BEST, CHECKPOINTS, source_commit

if TYPE_CHECKING:
    from sb3_roles.evaluation.grid.plan import Row
    from sb3_roles.zoo.row_runs import Run

_PARTIAL = ".partial"
# A folder is written in seconds; a partial one of that age has lost its writer.
_STALE_SECONDS = 600.0
# Numbers that it takes to save anything worth a rounding: 100 KB.
_SMALL = 50_000
_PLACE = "sb3_roles/pretrained"


@contextmanager
def staged(run: Run, row: Row, out: Path, dtype: str, best: bool) -> Iterator[tuple[Path, Path]]:
    """Write all that is published of a run into a partial folder, which is gone in the end.

    :param run: a run of the row
    :param row: of a plan
    :param out: where the folder of the row is, or shall be
    :param dtype: how weights are stored, see ``common.actor_weights``; or ``"auto"``
    :param best: the best evaluated weights instead of the latest ones
    :return: the partial folder, whose card has no scores, and the place that it is for
    :raises UsageError: if the run has no such weights, or a file of it is damaged
    :raises OSError: if something can not be written
    """
    target = out / row.name / f"seed_{run.seed}"
    target.parent.mkdir(parents=True, exist_ok=True)
    _remove_stale(target.parent)
    partial = target.with_name(f".{target.name}.{os.getpid()}-{secrets.token_hex(4)}{_PARTIAL}")
    partial.mkdir()
    try:
        _write(run, row, partial, dtype, best)
        yield partial, target
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        for folder in (target.parent, out):
            # Those that were made for nothing.
            with suppress(OSError):
                folder.rmdir()


def _remove_stale(folder: Path) -> None:
    latest = time.time() - _STALE_SECONDS
    for path in folder.glob(f".seed_*{_PARTIAL}"):
        with suppress(OSError):
            if path.stat().st_mtime < latest:
                shutil.rmtree(path)


def _write(run: Run, row: Row, folder: Path, dtype: str, best: bool) -> None:
    config = published_config(run.config)
    write_yaml(folder / CONFIG_FILE, config)
    progress = read_table(run.folder / PROGRESS)
    evaluations = read_table(run.folder / EVALUATIONS)
    try:
        curve, seconds = curve_of(evaluations), wall_time(progress)
        if progress:
            write_atomically(folder / PROGRESS, small_progress(progress))
        if evaluations:
            write_atomically(folder / EVALUATIONS, small_evaluations(evaluations))
    except (KeyError, ValueError) as error:
        raise UsageError(f"{run.folder}: damaged {PROGRESS} or {EVALUATIONS}: {error}") from None
    steps, weights = _write_weights(run, folder, dtype, best)
    names = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    facts = {
        "row": row.name,
        "label": row.label,
        "about": row.about,
        "algorithm": config["algo"],
        "environment": config["env"],
        "seed": run.seed,
        "drawn": row.drawn,
        "env_steps": steps["env_steps"],
        "planned_env_steps": config["n_timesteps"],
        "chosen": "best" if best else "latest",
        "wall_time_s": seconds,
        "training": training_of(run.folder, f"{_PLACE}/{row.name}/seed_{run.seed}/{CONFIG_FILE}"),
        "publishing": {"commit": source_commit(Path(__file__)), "versions": _versions()},
        "weights": weights,
        "curve": curve,
        "scores": None,
        "files": {path.relative_to(folder).as_posix(): facts_of_file(path) for path in names},
    }
    write_card(folder, facts)
    check_files(folder, read_card(folder))


def _versions() -> dict[str, str]:
    import torch as th

    return {"sb3_roles": __version__, "torch": str(th.__version__)}


def _write_weights(
    run: Run, folder: Path, dtype: str, best: bool
) -> tuple[dict[str, int], dict[str, Any]]:
    """Write the weights of the actors, and read them back as those who use them will."""
    import torch as th

    from sb3_roles.common.actor_weights import ACTORS, HOLDS, actor_weights, stored
    from sb3_roles.common.checkpoint import CheckpointError, write_checkpoint
    from sb3_roles.zoo.loaded_run import load_run

    env, algo = run.config["env"], run.config["algo"]
    try:
        steps = _steps(run, best)
        model = load_run(run.folder, best, "cpu", env, algo).model
        if model.num_timesteps != steps["agent_steps"]:
            raise UsageError(f"{run.folder}: its training goes on: publish it when it has ended")
        weights = actor_weights(model.policy)
        n = sum(tensor.numel() for tensor in weights.values())
        dtype = ("float32" if n < _SMALL else "float16") if dtype == "auto" else dtype
        kept = stored(weights, dtype)
        path = folder / CHECKPOINTS / f"step_{steps['env_steps']:012d}{SUFFIX}"
        path.parent.mkdir()
        write_checkpoint(path, {**steps, HOLDS: ACTORS}, kept)
    except CheckpointError as error:
        raise UsageError(f"{run.folder}: {error}") from error
    again = actor_weights(load_run(folder, device="cpu", env=env, algo=algo).model.policy)
    if not all(th.equal(again[name], kept[name].to(again[name].dtype)) for name in kept):
        raise UsageError(f"{path}: reads back differently from what was written")
    return steps, {
        "file": path.relative_to(folder).as_posix(),
        "dtype": dtype,
        "parameters": n,
    }


def _steps(run: Run, best: bool) -> dict[str, int]:
    from sb3_roles.common.checkpoint import read_checkpoint
    from sb3_roles.evaluation.callback import WEIGHTS_FILE
    from sb3_roles.zoo.models import steps_of
    from sb3_roles.zoo.row_runs import newest_checkpoint

    if not best:
        checkpoint = newest_checkpoint(run.folder)[1]
        return {key: steps_of(checkpoint, key) for key in ("env_steps", "agent_steps")}
    checkpoint = read_checkpoint(run.folder / BEST / WEIGHTS_FILE)
    record = checkpoint.manifest.get("record")
    found = record.get("env_steps") if isinstance(record, Mapping) else None
    if not isinstance(found, int):
        raise UsageError(f"{run.folder}: its best weights do not say after how many steps they are")
    return {"env_steps": found, "agent_steps": steps_of(checkpoint, "agent_steps")}


def write_card(folder: Path, facts: Mapping[str, Any]) -> None:
    """Write the card of a folder, whole or not at all.

    :param folder: of published weights
    :param facts: see ``zoo.model_card``
    """
    write_atomically(folder / CARD, render(facts).encode())


def same_weights(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Say whether two cards are of the same weights, stored in the same way."""
    first, second = (facts["files"].get(facts["weights"]["file"]) for facts in (one, other))
    return first is not None and first == second


def put(partial: Path, target: Path) -> None:
    """Move a whole folder to its place; what was there is gone only then.

    :param partial: of :func:`staged`
    :param target: its place
    :raises OSError: if that fails; what was there is there then
    """
    old = partial.with_suffix(".old" + _PARTIAL)
    if target.exists():
        os.rename(target, old)
    try:
        os.rename(partial, target)
    except OSError:
        if old.exists():
            os.rename(old, target)
        raise
    shutil.rmtree(old, ignore_errors=True)
