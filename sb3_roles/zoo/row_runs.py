"""The runs of ``train`` that play for a learned row of a plan, found in folders."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from glob import glob
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_roles.common.names import closest, span_text
from sb3_roles.zoo.config import CONFIG_FILE, read_run_config
from sb3_roles.zoo.environments import AREA_SEARCH
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.row_configs import config_of_row, method_of, method_of_row
from sb3_roles.zoo.run_folder import CHECKPOINTS

if TYPE_CHECKING:
    from sb3_roles.common.checkpoint import Checkpoint
    from sb3_roles.evaluation.grid.entrants import Entrant
    from sb3_roles.evaluation.grid.plan import Plan, Row

Report = Callable[[str], None]


def newest_checkpoint(run: Path) -> tuple[Path, Checkpoint]:
    """Read the newest sound checkpoint of a run folder.

    :param run: the folder
    :return: its file, and what it holds
    :raises UsageError: if there is none
    """
    from sb3_roles.common.checkpoint import CheckpointError, CheckpointFolder

    try:
        with warnings.catch_warnings():
            # That it goes back to an older one shows in the steps of the row.
            warnings.simplefilter("ignore")
            return CheckpointFolder(run / CHECKPOINTS).newest()
    except CheckpointError as error:
        raise UsageError(f"{run}: {error}") from error


@dataclass(frozen=True)
class Run:
    """A run folder on area search.

    :param folder: the folder
    :param config: checked
    """

    folder: Path
    config: Mapping[str, Any]

    @property
    def seed(self) -> int:
        """Seed of the training."""
        return int(self.config["seed"])

    @cached_property
    def method(self) -> dict[str, Any]:
        """What it has in common with other runs of its configuration."""
        return method_of(self.config)

    @cached_property
    def env_steps(self) -> int:
        """Joint steps that its latest weights were trained for.

        :raises UsageError: if there is no sound checkpoint
        """
        from sb3_roles.common.checkpoint import CheckpointError
        from sb3_roles.zoo.models import steps_of

        try:
            return steps_of(newest_checkpoint(self.folder)[1], "env_steps")
        except CheckpointError as error:
            raise UsageError(f"{self.folder}: {error}") from error

    def entrant(self, row: Row) -> Entrant:
        """Return who plays for a row with its weights."""
        from sb3_roles.evaluation.grid.entrants import Entrant

        place, steps, control = str(self.folder), self.env_steps, row.role_control
        return Entrant(row.name, place, True, row.drawn, self.seed, steps, role_control=control)


def fits(run: Run, row: Row) -> bool:
    """Whether a run has the configuration of a row.

    :param run: of the row's algorithm
    :param row: a learned one
    :raises ConfigError: if the row's configuration is wrong
    """
    return run.method == method_of_row(row)


class RunFinder:
    """Finds the runs of learned rows by their configuration.

    :param logs: folder of the runs, ``<logs>/<algo>/<run>``
    :param report: takes lines: what was taken, and what could not be read
    """

    def __init__(self, logs: Path, report: Report = print) -> None:
        self.logs, self._report = logs, report
        self._runs: dict[str, list[Run]] = {}

    def find(self, row: Row) -> list[Run]:
        """Return the runs of a row, one for each seed, by seed.

        Runs of different length are no sample of one method: of those that the configuration fits,
        the number of joint steps (trained, and planned, which schedules depend on) is taken that
        most seeds have, and the larger one of two such. Of several runs of one seed it is the
        newest. Where a training ends by itself, as behavior cloning does, the steps do not matter.

        :param row: a learned one
        :return: empty if there is none
        :raises ConfigError: if the row's configuration is wrong
        """
        assert row.algo is not None
        fitting = self.fitting(row)
        if not fitting:
            return []
        from sb3_roles.zoo.algorithms import get_algorithm

        alike = get_algorithm(row.algo).clones
        groups: dict[tuple[int, int], dict[int, Run]] = {}
        for run in self.trained(fitting):
            steps = (0, 0) if alike else (run.env_steps, run.config["n_timesteps"])
            # A newer run of a seed takes the place of an older one.
            groups.setdefault(steps, {})[run.seed] = run
        if not groups:
            return []
        largest = max(groups, key=lambda steps: (len(groups[steps]), steps))
        chosen = [run for _, run in sorted(groups[largest].items())]
        self._report(f"{row.name}: {describe_runs(chosen)}{self._rest(fitting, chosen)}")
        return chosen

    def fitting(self, row: Row) -> list[Run]:
        """Return all runs of a row's configuration, trained or not, the oldest first.

        :param row: a learned one
        :raises ConfigError: if the row's configuration is wrong
        """
        assert row.algo is not None
        if row.algo not in self._runs:
            self._runs[row.algo] = self._read(row.algo)
        config = config_of_row(row)
        if not self._runs[row.algo]:
            return []
        wanted = method_of(config)
        return [run for run in self._runs[row.algo] if run.method == wanted]

    def _rest(self, fitting: Iterable[Run], chosen: Sequence[Run]) -> str:
        names = [run.folder.name for run in fitting if run not in chosen]
        return f"; not {', '.join(names)}: of another length, or not the newest" if names else ""

    def _read(self, algo: str) -> list[Run]:
        runs = []
        folders = [path.parent for path in (self.logs / algo).glob(f"*/{CONFIG_FILE}")]
        # Runs are numbered: _10 is newer than _9.
        for folder in sorted(folders, key=lambda path: (len(path.name), path.name)):
            try:
                config = read_run_config(folder)
            except UsageError as error:
                self._report(f"not taken: {error}")
                continue
            if config["env"] == AREA_SEARCH and config["algo"] == algo:
                runs.append(Run(folder, config))
        return runs

    def trained(self, runs: Iterable[Run]) -> list[Run]:
        """Return those of some runs that have weights, and report the others."""
        found = []
        for run in runs:
            try:
                _ = run.env_steps
                found.append(run)
            except UsageError as error:
                self._report(f"not taken: {error}")
        return found


def describe_runs(runs: Sequence[Run]) -> str:
    """Return half a sentence about the runs of a row.

    :param runs: at least one
    """
    steps = sorted({run.env_steps for run in runs})
    lengths = span_text(steps[0], steps[-1])
    planned = max(run.config["n_timesteps"] for run in runs)
    of = f" of {planned:,}" if steps[-1] < planned else ""
    seeds = ", ".join(str(run.seed) for run in runs)
    s = "" if len(runs) == 1 else "s"
    return f"{len(runs)} run{s} of {lengths}{of} joint steps, seed{s} {seeds}"


def named_runs(texts: Sequence[str], plan: Plan) -> dict[str, list[Run]]:
    """Read ``--runs ROW=RUN``: runs that play for a row, whatever else their configuration says.

    :param texts: RUN is a run folder, or a pattern of some
    :param plan: whose rows may be named
    :return: row -> its runs, each once
    :raises UsageError: if there is no such row or run, it is not of area search or of the row's
        algorithm, or there are two of one training seed, which are no two samples
    """
    learned = [name for name, row in plan.rows.items() if row.learned]
    found: dict[str, dict[Path, Run]] = {}
    for text in texts:
        name, equals, pattern = text.partition("=")
        if not (equals and pattern):
            raise UsageError(f"argument --runs: must be ROW=RUN, got {text!r}")
        if name not in learned:
            raise UsageError(f"argument --runs: {closest('learned row', name, learned)}")
        folders = [pattern] if Path(pattern).is_dir() else glob(pattern)
        if not folders:
            raise UsageError(f"argument --runs: {pattern}: no such run folder")
        for folder in sorted(map(Path, folders), key=lambda path: (len(path.name), path.name)):
            config = read_run_config(folder)
            if config["env"] != AREA_SEARCH:
                raise UsageError(f"argument --runs: {folder} is not of {AREA_SEARCH}")
            algo = plan.rows[name].algo
            if config["algo"] != algo:
                raise UsageError(
                    f"argument --runs: {folder} is a run of {config['algo']}, the row {name} is of "
                    f"{algo}"
                )
            run = Run(folder, config)
            _ = run.env_steps  # There are weights.
            own = found.setdefault(name, {})
            if folder.resolve() in own:
                continue
            if run.seed in [other.seed for other in own.values()]:
                raise UsageError(
                    f"argument --runs: {folder}: training seed {run.seed} is there already"
                )
            own[folder.resolve()] = run
    return {name: list(runs.values()) for name, runs in found.items()}
