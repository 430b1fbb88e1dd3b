"""A small plan with hand-made tables and short episodes, for the tests of the report."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from sb3_roles.baselines import controller_class
from sb3_roles.baselines.random import RandomController
from sb3_roles.evaluation.grid.entrants import Entrant
from sb3_roles.evaluation.grid.plan import Column, Plan, Table
from sb3_roles.evaluation.grid.plan_file import parse_plan
from sb3_roles.evaluation.tables.model import TableResult, TableRow, Value

EASY, HARD = Column("easy", 2), Column("hard", 2)
HOSTILE = "</script><img src=x onerror=alert(1)> & \"quoted\" 'text'"
SVG = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9"><path d="M0 0h9v9z"/></svg>'


class TakesTurns(RandomController):
    """Moves at random, and its robots take turns in two roles."""

    role_names = ("explore", "cover")

    def begin(self, batch: Any) -> None:
        super().begin(batch)
        self.roles = np.full((batch.n_teams, batch.n_agents), -1, np.int8)

    def act(self, batch: Any) -> np.ndarray:
        self.roles[:] = (batch.steps[:, None] + np.arange(batch.n_agents)) % 2
        return super().act(batch)


def small_plan() -> Plan:
    """Four rows, the last one a bound; a table of two scenes."""
    return parse_plan(
        {
            "episodes": 20,
            "quick_episodes": 2,
            "seed": 7,
            "rows": {
                "greedy": {"label": "Greedy", "controller": "greedy"},
                "greedy_assigned": {"label": HOSTILE, "controller": "greedy_assigned"},
                "hmappo": {"label": "Roles", "algo": "hmappo", "about": "ours"},
                "oracle": {"label": "Oracle", "controller": "random", "bound": True},
            },
            "tables": {
                "I": {
                    "caption": "Two robots",
                    "n_agents": [2],
                    "scenes": {"easy": "Easy", "hard": "Hard"},
                    "metrics": ["explo_paper", "explo_true", "cover"],
                    "rows": ["greedy", "greedy_assigned", "hmappo", "oracle"],
                    "paper": {
                        "greedy": {2: {"explo_paper": [70.0, 100.0], "cover": [30.0, 40.0]}},
                        "hmappo": {2: {"explo_paper": [90.0, 100.0], "cover": [None, 60.0]}},
                    },
                }
            },
            "figures": {},
        }
    )


def entrants() -> dict[str, list[Entrant]]:
    """One for each row, but two for the learned one."""
    scripted = {name: [Entrant(name, name)] for name in ("greedy", "greedy_assigned")}
    runs = [Entrant("hmappo", f"run{k}", True, False, k, 1000) for k in (0, 1)]
    return {**scripted, "hmappo": runs, "oracle": [Entrant("oracle", "random")]}


def make(entrant: Entrant) -> Any:
    """Return the controller of an entrant."""
    return TakesTurns() if entrant.learned else controller_class(entrant.source)()


def number(mean: float | None, **fields: Any) -> Value:
    """Return a value of 20 episodes with an interval of one up and down."""
    low, high = (None, None) if mean is None else (mean - 1, mean + 1)
    value = Value(mean, low, high, "%", False, None, False, 20, 0, None)
    return replace(value, **fields)


def row_of(
    plan: Plan, name: str, means: dict[tuple[Column, str], float], **fields: Any
) -> TableRow:
    """Return a row of a table with the plan's printed numbers beside the means."""
    spec, row = plan.tables["I"], plan.rows[name]
    values = {
        (column, metric): number(
            mean,
            printed=(name, column, metric) in spec.paper,
            paper=spec.paper.get((name, column, metric)),
            n_seeds=2 if row.learned else 0,
        )
        for (column, metric), mean in means.items()
    }
    made = TableRow(
        name, row.label, row.about, row.learned, row.drawn, row.bound, "", values, {}, {}, 0
    )
    return replace(made, **fields)


def table_of(plan: Plan, rows: list[TableRow], **spec: Any) -> dict[str, TableResult]:
    """Return table I of these rows."""
    table: Table = replace(plan.tables["I"], **spec)
    return {"I": TableResult(table, tuple(rows), ("A note.",), False)}


def small_tables(plan: Plan) -> dict[str, TableResult]:
    """Greedy below and above its printed row, an assigned one, ours, and a bound that beats all."""
    means = {
        "greedy": (60.0, 120.0, 55.0, 88.0, 31.0, 65.0),
        "greedy_assigned": (80.0, 104.0, 75.0, 92.0, 44.0, 72.0),
        "hmappo": (89.5, 97.0, 80.0, 84.0, 45.0, 48.0),
        "oracle": (110.0, 112.0, 94.0, 95.0, 98.0, 99.0),
    }
    keys = [(column, metric) for metric in plan.tables["I"].metrics for column in (EASY, HARD)]
    rows = [
        row_of(
            plan,
            name,
            dict(zip(keys, values, strict=True)),
            budget="2 runs of 1,000 joint steps" if name == "hmappo" else "",
            decision={EASY: 2e-6, HARD: 4e-6},
            batch=20,
        )
        for name, values in means.items()
    ]
    return table_of(plan, rows)


def tables_with_a_time(plan: Plan) -> dict[str, TableResult]:
    """Those of `small_tables`, and a printed time that ours never gets to, in the easy scene."""
    spec = plan.tables["I"]
    key = ("hmappo", EASY, "time_e_paper")
    never = number(None, unit="steps", printed=True, paper=39.0, n_seeds=2)
    rows = [
        replace(row, values={**row.values, (EASY, "time_e_paper"): never})
        if row.name == "hmappo"
        else row
        for row in small_tables(plan)["I"].rows
    ]
    return table_of(
        plan, rows, metrics=(*spec.metrics, "time_e_paper"), paper={**spec.paper, key: 39.0}
    )
