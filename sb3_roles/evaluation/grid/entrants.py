"""Who fills a row of a plan, and what it played."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from sb3_roles.evaluation.grid.plan import Cell
from sb3_roles.evaluation.records import EpisodeRecords


@dataclass(frozen=True)
class Entrant:
    """One that plays for a row: its scripted controller, or the policy of one training run.

    :param row: name of the row
    :param source: name of the scripted controller, or path of the run folder
    :param learned: whether it was trained
    :param drawn: draw actions instead of taking the likeliest ones
    :param training_seed: of the run; None for a scripted controller
    :param env_steps: joint steps that it was trained for; None for a scripted controller
    :param shipped: its weights come with this package
    :param role_control: see ``Row``
    """

    row: str
    source: str
    learned: bool = False
    drawn: bool = False
    training_seed: int | None = None
    env_steps: int | None = None
    shipped: bool = False
    role_control: str | None = None


class Played(NamedTuple):
    """The episodes of one entrant in one column, from episode 0 on."""

    entrant: Entrant
    records: EpisodeRecords


Entrants = Mapping[str, Sequence[Entrant]]
"""Name of a row -> who plays for it: one for each training seed; empty for a row without a run."""
Results = Mapping[Cell, Sequence[Played]]
"""Cell -> what its entrants played, in their order; cells without an entrant are missing."""
