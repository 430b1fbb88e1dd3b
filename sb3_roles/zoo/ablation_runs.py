"""The runs of the variants of ablations: which are there, which are missing, and their training."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_roles.zoo.ablation_file import Ablations, Variant
from sb3_roles.zoo.config import config_file
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.row_configs import method_of_row, training_command
from sb3_roles.zoo.row_runs import Report, Run, RunFinder

_NESTED = "_kwargs"


@dataclass(frozen=True)
class Found:
    """The runs of one variant.

    :param runs: seed -> the run that was trained for all of the budget
    :param begun: seed -> a run of the first folder that has not got there, if there is no other
    :param missing: seeds of which there is neither
    """

    runs: Mapping[int, Run]
    begun: Mapping[int, Run]
    missing: tuple[int, ...]


def find_runs(
    ablations: Ablations, folders: Sequence[Path], report: Report = print
) -> dict[str, Found]:
    """Find the runs of all variants by configuration, budget and seed.

    Of several runs of a seed it is the newest of the first folder that has one.

    :param ablations: whose variants
    :param folders: of runs, ``<folder>/<algo>/<run>``; runs of the first one may be gone on with
    :param report: takes lines about runs that can not be read
    :return: variant -> its runs; those that only play otherwise have those of their reference
    :raises ConfigError: if the configuration of a variant is wrong
    """
    finders = [RunFinder(folder, report) for folder in folders]
    found: dict[str, Found] = {}
    for variant in ablations.variants.values():
        if variant.runs_of not in found:
            found[variant.runs_of] = _find(variant, finders, report)
    return {name: found[variant.runs_of] for name, variant in ablations.variants.items()}


def _find(variant: Variant, finders: Sequence[RunFinder], report: Report) -> Found:
    from sb3_roles.zoo.algorithms import get_algorithm

    assert variant.row.algo is not None
    ends_itself = get_algorithm(variant.row.algo).clones
    runs: dict[int, Run] = {}
    begun: dict[int, Run] = {}
    for finder in finders:
        planned = [
            run
            for run in finder.fitting(variant.row)
            if run.seed in variant.seeds and run.config["n_timesteps"] == variant.n_timesteps
        ]
        here: dict[int, Run] = {}
        for run in finder.trained(planned):
            if ends_itself or run.env_steps >= variant.n_timesteps:
                # A newer run of a seed takes the place of an older one.
                here[run.seed] = run
            elif finder is finders[0]:
                begun[run.seed] = run
            else:
                report(f"not taken: {run.folder} is at {run.env_steps:,} joint steps")
        runs = {**here, **runs}
    begun = {seed: run for seed, run in begun.items() if seed not in runs}
    missing = tuple(seed for seed in variant.seeds if seed not in runs and seed not in begun)
    return Found(dict(sorted(runs.items())), dict(sorted(begun.items())), missing)


def _spans(seeds: Sequence[int]) -> Iterator[range]:
    """Join seeds that follow each other."""
    first = 0
    for k in range(1, len(seeds) + 1):
        if k == len(seeds) or seeds[k] != seeds[k - 1] + 1:
            yield range(seeds[first], seeds[k - 1] + 1)
            first = k


def commands_of(variant: Variant, logs: Path, seeds: Sequence[int] | None = None) -> list[str]:
    """Return the command lines that train the runs of a variant.

    :param variant: the variant
    :param logs: folder of the runs
    :param seeds: ascending; by default all of the variant
    """
    chosen = variant.seeds if seeds is None else seeds
    return [
        training_command(variant.row, logs, part, variant.n_timesteps) for part in _spans(chosen)
    ]


def missing_lines(variant: Variant, found: Found, logs: Path) -> list[str]:
    """Say which runs of a variant are missing, and how to train them.

    :param variant: the variant, of which the runs are
    :param found: what there is
    :param logs: folder of new runs
    """
    lines = []
    for seed, run in found.begun.items():
        lines.append(
            f"{variant.row.name}, seed {seed}, is at {run.env_steps:,} of "
            f"{variant.n_timesteps:,} joint steps: {_resume_command(run)}"
        )
    for part in _spans(found.missing):
        s = f"s {part[0]} to {part[-1]}" if len(part) > 1 else f" {part[0]}"
        (command,) = commands_of(variant, logs, part)
        lines.append(f"{variant.row.name}, seed{s}: no run: {command}")
    return lines


def _resume_command(run: Run) -> str:
    return shlex.join(["sb3-roles", "train", "--resume", str(run.folder)])


def train_missing(
    variant: Variant, found: Found, logs: Path, options: Mapping[str, Any], report: Report
) -> tuple[int, bool]:
    """Train what is missing of a variant, one run after the other.

    :param variant: of which the runs are
    :param found: what there is; runs that were begun go on
    :param logs: folder of new runs
    :param options: further options of ``sb3-roles train``
    :param report: takes lines: what is trained, and what failed
    :return: the exit code of a run that a signal stopped, after which nothing more is trained, or
        0; and whether a run failed
    """
    from sb3_roles.zoo.job import TrainingFailed, run_job

    failed = False
    for command, job in _jobs(variant, found, logs, options):
        report(command)
        try:
            code = run_job({**job, "command": shlex.split(command)})
        except (TrainingFailed, UsageError) as error:
            # Such as one that another process is training: the others can be trained all the same.
            report(f"{variant.row.name}: {error}")
            failed = True
            continue
        if code:
            return code, failed
    return 0, failed


def _jobs(
    variant: Variant, found: Found, logs: Path, options: Mapping[str, Any]
) -> Iterator[tuple[str, dict[str, Any]]]:
    from sb3_roles.zoo.train_jobs import new_jobs, resumed_job

    row = variant.row
    for run in found.begun.values():
        yield _resume_command(run), resumed_job({"resume": run.folder, **options})
    given = {
        "algo": (row.algo,),
        "n_timesteps": variant.n_timesteps,
        "hyperparams": dict(row.params),
        "log_folder": str(logs),
        **({} if row.conf is None else {"conf_file": config_file(row.conf)}),
        **options,
    }
    for seed in found.missing:
        (command,) = commands_of(variant, logs, [seed])
        (job,) = new_jobs({**given, "seed": seed})[1]
        yield command, job


def changes_of(variant: Variant, reference: Variant) -> str:
    """Say what differs between two variants, from their whole configurations.

    :param variant: the one
    :param reference: the other
    :return: ``"gamma 0.95 -> 0.9, n_epochs 3 -> 2"``; of another algorithm only what both have;
        empty for the same configuration
    """
    ours, theirs = _flat(variant), _flat(reference)
    same_algo = variant.row.algo == reference.row.algo
    keys = [key for key in {**theirs, **ours} if same_algo or (key in ours and key in theirs)]
    changed = [
        f"{key.rpartition('.')[2]} {_shown(theirs, key)} -> {_shown(ours, key)}"
        for key in keys
        if _shown(ours, key) != _shown(theirs, key) and key != "policy"
    ]
    if variant.row.role_control is not None:
        changed.append(f"roles while playing: {variant.row.role_control}")
    return ", ".join(changed)


def _flat(variant: Variant) -> dict[str, Any]:
    found: dict[str, Any] = {"algo": variant.row.algo}
    method = {**method_of_row(variant.row), "n_timesteps": variant.n_timesteps}
    for key, value in method.items():
        if key.endswith(_NESTED) and isinstance(value, Mapping):
            found.update({f"{key}.{name}": one for name, one in value.items()})
        else:
            found[key] = value
    return {**found, "drawn": variant.row.drawn}


def _shown(values: Mapping[str, Any], key: str) -> str:
    import yaml

    if key not in values:
        return "-"
    text = yaml.safe_dump(values[key], default_flow_style=True, width=10**6, sort_keys=True)
    return str(text).removesuffix("\n").removesuffix("...").strip()
