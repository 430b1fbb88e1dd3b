"""A plan: which rows are played where, for which tables and figures; see ``plan_file``.

A *row* is who plays, a *column* where: a scene and a number of robots. A *cell* is a row in a
column; tables and figures are made of cells, and two that need the same cell share its records.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeVar

from sb3_roles.common.names import closest

SCORES = ("explo_paper", "explo_true", "cover", "time_e_paper", "t90_true")
"""Metrics of tables, see ``evaluation.metrics``."""
FIGURE_METRICS = {
    "training": ("explore_reward", "cover_reward"),
    "episode": ("explo_paper", "explo_true", "cover"),
    "roles": ("explore", "cover"),
    "switching": ("switched",),
    "time_e": ("time_e_paper", "t90_true"),
}
"""Kind of figure -> what it can show."""


class PlanError(ValueError):
    """A plan that can not be carried out; one line."""


class Column(NamedTuple):
    """Where a row plays.

    :param scene: name of the scene
    :param n_agents: robots in the team
    """

    scene: str
    n_agents: int


Cell = tuple[str, Column]
"""Name of a row, and where it plays."""


@dataclass(frozen=True)
class Row:
    """Who plays: a scripted controller, or the policies that an algorithm trained.

    :param name: key of the row
    :param label: what readers see
    :param controller: name of a scripted controller, None for a learned row
    :param algo: name of the algorithm of a learned row, None for a scripted one
    :param conf: stem of its configuration file; the algorithm's own by default
    :param params: replaces some of the configuration
    :param drawn: draw actions instead of taking the likeliest ones; learned rows only
    :param bound: it knows what a team can not know, and is no rival
    :param episodes: at most so many; None for no limit
    :param quick_episodes: the same in the quick form
    :param block: episodes that are played and kept at once
    :param about: half a sentence for readers
    :param role_control: who chooses the roles while it plays, see ``RoleWrapper``; None for what it
        was trained with
    """

    name: str
    label: str
    controller: str | None = None
    algo: str | None = None
    conf: str | None = None
    params: Mapping[str, Any] = field(default_factory=dict)
    drawn: bool = False
    bound: bool = False
    episodes: int | None = None
    quick_episodes: int | None = None
    block: int = 100
    about: str = ""
    role_control: str | None = None

    @property
    def learned(self) -> bool:
        """Whether it has to be trained."""
        return self.controller is None


@dataclass(frozen=True)
class Table:
    """One table.

    :param name: ``"I"`` .. ``"V"``
    :param caption: without a full stop
    :param columns: in the order of print, robots before scenes
    :param scenes: scene -> what readers see
    :param metrics: of ``SCORES``, in the order of print
    :param rows: names, in the order of print
    :param paper: (row, column, metric) -> printed value, None for a printed dash; what is not in
        print is missing
    """

    name: str
    caption: str
    columns: tuple[Column, ...]
    scenes: Mapping[str, str]
    metrics: tuple[str, ...]
    rows: tuple[str, ...]
    paper: Mapping[tuple[str, Column, str], float | None]


@dataclass(frozen=True)
class Figure:
    """One figure.

    :param name: stem of its files
    :param caption: without a full stop
    :param kind: of ``FIGURE_METRICS``
    :param columns: where its rows play; empty for training curves
    :param scenes: scene -> what readers see
    :param metrics: of ``FIGURE_METRICS[kind]``
    :param rows: names
    :param paper: (row, scene, metric) -> what the paper's figure shows, pairs of a step from 1 on
        and a percentage
    """

    name: str
    caption: str
    kind: str
    columns: tuple[Column, ...]
    scenes: Mapping[str, str]
    metrics: tuple[str, ...]
    rows: tuple[str, ...]
    paper: Mapping[tuple[str, str, str], tuple[tuple[int, float], ...]] = field(
        default_factory=dict
    )


@dataclass(frozen=True)
class Plan:
    """All of it.

    :param episodes: of a cell
    :param quick_episodes: of a cell, in the quick form
    :param seed: of the held-out stream
    :param rows: by name
    :param tables: by name
    :param figures: by name
    """

    episodes: int
    quick_episodes: int
    seed: int
    rows: Mapping[str, Row]
    tables: Mapping[str, Table]
    figures: Mapping[str, Figure]

    def cells(self) -> list[Cell]:
        """Return the cells that tables and figures need, each once, in their order."""
        parts: list[Table | Figure] = [*self.tables.values(), *self.figures.values()]
        found = {
            (row, column): None for part in parts for column in part.columns for row in part.rows
        }
        return list(found)

    def episodes_of(self, row: str, quick: bool = False, episodes: int | None = None) -> int:
        """Return how many episodes a row plays in each column.

        :param row: its name
        :param quick: in the quick form
        :param episodes: instead of the plan's; a row's own limit holds all the same
        """
        one = self.rows[row]
        wanted = episodes or (self.quick_episodes if quick else self.episodes)
        limit = one.quick_episodes if quick else one.episodes
        return min(wanted, limit or wanted)

    def select(
        self,
        tables: Collection[str] | None = None,
        rows: Collection[str] | None = None,
        scenes: Collection[str] | None = None,
        figures: Collection[str] | None = None,
    ) -> Plan:
        """Return a part of the plan.

        :param tables: names of those to keep; None for all, and the same below. Where figures are
            named, no table is kept that is not named, too
        :param rows: of tables and figures
        :param scenes: of tables and figures; what has none of them is left out
        :param figures: names; where tables, rows or scenes are named, no figure is kept that is not
            named, too
        :raises PlanError: for a name that is not there, or if nothing is left
        """
        scene_names = dict.fromkeys(column.scene for _, column in self.cells())
        for what, chosen, known in (
            ("table", tables, self.tables),
            ("row", rows, self.rows),
            ("scene", scenes, scene_names),
            ("figure", figures, self.figures),
        ):
            for name in chosen or ():
                if name not in known:
                    raise PlanError(closest(what, name, known))
        if figures is not None and tables is None:
            tables = ()
        if figures is None and any(part is not None for part in (tables, rows, scenes)):
            figures = ()
        kept_tables = _restrict(self.tables, tables, rows, scenes)
        kept_figures = _restrict(self.figures, figures, rows, scenes)
        if not kept_tables and not kept_figures:
            raise PlanError("no table or figure has any of the named rows and scenes")
        return replace(self, tables=kept_tables, figures=kept_figures)


_Part = TypeVar("_Part", Table, Figure)


def _restrict(
    parts: Mapping[str, _Part],
    names: Collection[str] | None,
    rows: Collection[str] | None,
    scenes: Collection[str] | None,
) -> dict[str, _Part]:
    kept = {}
    for name, part in parts.items():
        columns = tuple(one for one in part.columns if scenes is None or one.scene in scenes)
        own = tuple(row for row in part.rows if rows is None or row in rows)
        empty = not own or (bool(part.columns) and not columns)
        if (names is None or name in names) and not empty:
            kept[name] = replace(part, columns=columns, rows=own)
    return kept
