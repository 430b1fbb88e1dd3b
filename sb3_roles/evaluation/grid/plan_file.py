"""Read a :class:`~sb3_roles.evaluation.grid.plan.Plan` from what a YAML file says, and check it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from area_search.scenes import SCENES, shown
from sb3_roles.baselines import CONTROLLER_NAMES
from sb3_roles.evaluation.grid.fields import (
    FLAG,
    MAPPING,
    NAMES,
    SEED,
    TEXT,
    Check,
    check_names,
    fields,
    line,
    list_of,
    named,
    note,
    whole,
)
from sb3_roles.evaluation.grid.plan import (
    FIGURE_METRICS,
    SCORES,
    Column,
    Figure,
    Plan,
    PlanError,
    Row,
    Table,
)

# Percentages and steps are far below.
_MAX_PRINTED = 1e6

_TOP: dict[str, Check] = {
    "episodes": whole(1),
    "quick_episodes": whole(1),
    "seed": SEED,
    "rows": MAPPING,
    "tables": MAPPING,
    "figures": MAPPING,
}
_ROW: dict[str, Check] = {
    "label": line,
    "controller": TEXT,
    "algo": TEXT,
    "conf": TEXT,
    "params": MAPPING,
    "drawn": FLAG,
    "bound": FLAG,
    "episodes": whole(1),
    "quick_episodes": whole(1),
    "block": whole(1),
    "about": note,
}
_PART: dict[str, Check] = {
    "caption": line,
    "n_agents": list_of(int, "numbers of robots"),
    "scenes": MAPPING,
    "metrics": NAMES,
    "rows": NAMES,
}
_TABLE = {**_PART, "paper": MAPPING}
_FIGURE = {**_PART, "paper": MAPPING, "kind": TEXT}


def parse_plan(content: object) -> Plan:
    """Check what a plan's file says.

    :param content: of ``tables.yml``, plain data
    :raises PlanError: naming the first thing that is wrong
    """
    top = fields("the plan", content, _TOP)
    rows = {name: _row(name, value) for name, value in named("rows", top["rows"]).items()}
    tables = {
        name: _table(name, value, rows) for name, value in named("tables", top["tables"]).items()
    }
    figures = {
        name: _figure(name, value, rows) for name, value in named("figures", top["figures"]).items()
    }
    return Plan(top["episodes"], top["quick_episodes"], top["seed"], rows, tables, figures)


def _row(name: str, content: object) -> Row:
    where = f"row {name}"
    given = fields(where, content, _ROW, ["label"])
    if ("controller" in given) == ("algo" in given):
        raise PlanError(f"{where}: give either controller or algo")
    if "controller" in given:
        for key in ("conf", "params", "drawn"):
            if key in given:
                raise PlanError(f"{where}: only learned rows have {key}")
        check_names(where, "controller", [given["controller"]], CONTROLLER_NAMES)
    return Row(name, **given)


def columns_of(where: str, given: Mapping[str, Any]) -> tuple[Column, ...]:
    """Check scenes and numbers of robots.

    :param where: they are, for the message
    :param given: ``scenes``, scene -> label, and ``n_agents``, a list
    :return: robots before scenes
    :raises PlanError: naming the first thing that is wrong
    """
    scenes = given["scenes"]
    if not scenes:
        raise PlanError(f"{where}: scenes must be at least one scene")
    check_names(where, "scene", scenes, SCENES)
    for scene, label in scenes.items():
        if line(label) is not None:
            raise PlanError(f"{where}: the label of {scene} must be {line(label)}, got {label!r}")
    for n_agents in given["n_agents"]:
        wanted = whole(1)(n_agents)
        if wanted is not None:
            raise PlanError(f"{where}: n_agents must be {wanted}, got {n_agents!r}")
    return tuple(Column(scene, n) for n in given["n_agents"] for scene in scenes)


def _table(name: str, content: object, rows: Mapping[str, Row]) -> Table:
    where = f"table {name}"
    given = fields(where, content, _TABLE, _PART)
    check_names(where, "row", given["rows"], rows)
    check_names(where, "metric", given["metrics"], SCORES)
    columns = columns_of(where, given)
    paper = _printed(f"{where}, paper", given.get("paper", {}), given)
    return Table(
        name,
        given["caption"],
        columns,
        given["scenes"],
        tuple(given["metrics"]),
        tuple(given["rows"]),
        paper,
    )


def _printed(
    where: str, content: Mapping[Any, Any], table: Mapping[str, Any]
) -> dict[tuple[str, Column, str], float | None]:
    values: dict[tuple[str, Column, str], float | None] = {}
    check_names(where, "row", content, table["rows"])
    for row, teams in content.items():
        teams = fields(f"{where}, {row}", teams, {n: MAPPING for n in table["n_agents"]}, ())
        for n_agents, metrics in teams.items():
            place = f"{where}, {row}, {n_agents}"
            check_names(place, "metric", metrics, table["metrics"])
            for metric, printed in metrics.items():
                if not isinstance(printed, list) or len(printed) != len(table["scenes"]):
                    raise PlanError(f"{place}: {metric} must have one value for each scene")
                for scene, value in zip(table["scenes"], printed, strict=True):
                    if not (value is None or _printable(value)):
                        raise PlanError(
                            f"{place}: {metric} must be null or numbers from 0 to "
                            f"{_MAX_PRINTED:.0f}, got {shown(value)}"
                        )
                    values[row, Column(scene, n_agents), metric] = value
    return values


def _printable(value: object) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and 0 <= value <= _MAX_PRINTED  # type: ignore[operator]


def _points(
    where: str, content: Mapping[Any, Any], figure: Mapping[str, Any]
) -> dict[tuple[str, str, str], tuple[tuple[int, float], ...]]:
    """Read what a figure of the paper shows: row -> scene -> metric -> step -> percentage."""
    points = {}
    check_names(where, "row", content, figure["rows"])
    for row, scenes in content.items():
        scenes = fields(f"{where}, {row}", scenes, dict.fromkeys(figure["scenes"], MAPPING), ())
        for scene, metrics in scenes.items():
            place = f"{where}, {row}, {scene}"
            known = dict.fromkeys(figure["metrics"], MAPPING)
            for metric, values in fields(place, metrics, known, ()).items():
                for step, value in values.items():
                    wanted = whole(1)(step)
                    if wanted is not None or not _printable(value):
                        raise PlanError(
                            f"{place}: {metric} must be steps from 1 on and numbers from 0 to "
                            f"{_MAX_PRINTED:.0f}, got {shown(step)}: {shown(value)}"
                        )
                points[row, scene, metric] = tuple(sorted(values.items()))
    return points


def _figure(name: str, content: object, rows: Mapping[str, Row]) -> Figure:
    where = f"figure {name}"
    given = fields(where, content, _FIGURE, ("caption", "kind", "metrics", "rows"))
    kind = given["kind"]
    check_names(where, "kind", [kind], FIGURE_METRICS)
    check_names(where, "row", given["rows"], rows)
    check_names(where, "metric", given["metrics"], FIGURE_METRICS[kind])
    of_training = kind == "training"
    for key in ("n_agents", "scenes"):
        if (key in given) == of_training:
            problem = "has none" if of_training else "needs it"
            raise PlanError(f"{where}: {key}: a figure of kind {kind} {problem}")
    if of_training:
        for row in given["rows"]:
            if not rows[row].learned:
                raise PlanError(f"{where}: {row} is not trained")
    if "paper" in given and kind not in ("episode", "roles"):
        raise PlanError(f"{where}: paper: only figures over the steps of an episode show points")
    columns = () if of_training else columns_of(where, given)
    return Figure(
        name,
        given["caption"],
        kind,
        columns,
        given.get("scenes", {}),
        tuple(given["metrics"]),
        tuple(given["rows"]),
        _points(f"{where}, paper", given.get("paper", {}), given),
    )
