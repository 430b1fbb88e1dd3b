"""Trained weights that come with the package, or lie in a folder like its own.

A published run is ``<row>/seed_<k>/``: a run folder with one checkpoint, which holds the actors
alone, and a card, see ``zoo.model_card``. So whatever takes a run folder takes it, too.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_roles.common.names import closest
from sb3_roles.zoo.model_card import CARD, check_files, read_card
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.plans import learned_rows, read_plan_file

if TYPE_CHECKING:
    from sb3_roles.evaluation.grid.plan import Row
    from sb3_roles.zoo.loaded_run import LoadedRun
    from sb3_roles.zoo.row_runs import Run

FOLDER = Path(__file__).resolve().parents[1] / "pretrained"
_SEED = re.compile(r"seed_(0|[1-9][0-9]*)")


@dataclass(frozen=True)
class Published:
    """The published weights of one training.

    :param row: of the tables
    :param seed: of the training
    :param folder: where they are
    """

    row: str
    seed: int
    folder: Path

    @property
    def name(self) -> str:
        """``<row>/seed_<k>``."""
        return f"{self.row}/{self.folder.name}"

    @cached_property
    def card(self) -> dict[str, Any]:
        """What its card says.

        :raises CardError: if it can not be read
        """
        return read_card(self.folder)

    def load(
        self, device: str = "cpu", env: str | None = None, algo: str | None = None
    ) -> LoadedRun:
        """Load the policy, after a look whether its files are those of the card.

        :param device: where it computes
        :param env: the run's environment, if the caller wants a certain one
        :param algo: the same of its algorithm
        :raises UsageError: naming a file that is missing or damaged, or if it is of another
            environment or algorithm
        """
        from sb3_roles.zoo.loaded_run import load_run

        check_files(self.folder, self.card)
        return load_run(self.folder, device=device, env=env, algo=algo)

    def is_drawn(self, deterministic: bool, stochastic: bool) -> bool:
        """Whether its actions are drawn: as in the tables, unless the user chooses.

        :param deterministic: the user asks for the likeliest ones
        :param stochastic: the user asks for drawn ones
        """
        return stochastic or (bool(self.card["drawn"]) and not deterministic)


def published(folder: Path | None = None) -> dict[str, list[Published]]:
    """Find published weights.

    :param folder: with a folder for each row; by default the package's own
    :return: row -> its weights, by seed; rows without any are missing
    """
    found: dict[str, list[Published]] = {}
    for path in sorted((FOLDER if folder is None else folder).glob(f"*/*/{CARD}")):
        match = _SEED.fullmatch(path.parent.name)
        if match:
            row = path.parent.parent.name
            found.setdefault(row, []).append(Published(row, int(match[1]), path.parent))
    return {row: sorted(ones, key=lambda one: one.seed) for row, ones in found.items()}


def is_published(name: str) -> bool:
    """Whether there are weights of this name in the package, see :func:`find_published`."""
    row, _, seed = name.partition("/")
    return any(seed in ("", one.folder.name) for one in published().get(row, ()))


def find_published(
    name: str, what: str = "row with trained weights", others: Iterable[str] = ()
) -> Published:
    """Find weights of the package by name.

    :param name: a row of the tables, which stands for the first of its seeds, or
        ``<row>/seed_<k>``
    :param what: is named, for the message
    :param others: names of the same kind, for the message
    :raises UsageError: with the closest match, or with the command that trains such weights, if
        there are none
    """
    there = published()
    row, _, seed = name.partition("/")
    if row in there:
        by_seed = {one.folder.name: one for one in there[row]}
        if name == row:
            return there[row][0]
        if seed not in by_seed:
            raise UsageError(closest(f"seed of {row}", seed, by_seed))
        return by_seed[seed]
    rows = learned_rows(read_plan_file())
    if row not in rows:
        raise UsageError(closest(what, name, [*others, *{**rows, **there}]))
    raise UsageError(f"no trained weights of {row} come with this package: {_how(rows[row])}")


def _how(row: Row) -> str:
    from sb3_roles.zoo.row_configs import training_command

    return f"train some with {training_command(row)}"


def published_runs(row: Row, report: Callable[[str], None] = print) -> list[Run]:
    """Return the package's runs of a learned row of a plan, found by their configuration.

    :param row: a learned one
    :param report: takes lines: what was taken, and what could not be read
    :return: by seed; empty if there are none
    :raises ConfigError: if the row's configuration is wrong
    """
    from sb3_roles.zoo.config import read_run_config
    from sb3_roles.zoo.row_runs import Run, describe_runs, fits

    # The row's own name first: another row may have its configuration.
    there = published()
    names = sorted(there, key=lambda name: name != row.name)
    for name in names:
        runs = []
        for one in there[name]:
            try:
                if one.card["algorithm"] != row.algo:
                    continue
                check_files(one.folder, one.card)
                run = Run(one.folder, read_run_config(one.folder))
                if fits(run, row):
                    _ = run.env_steps
                    runs.append(run)
            except UsageError as error:
                report(f"not taken: {error}")
        if runs:
            report(f"{row.name}: {describe_runs(runs)}, as they come with this package")
            return runs
    return []
