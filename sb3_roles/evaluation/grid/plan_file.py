"""Read a :class:`~sb3_roles.evaluation.grid.plan.Plan` from what a YAML file says, and check it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from area_search.scenes import SCENES, shown
from sb3_roles.baselines import CONTROLLER_NAMES
from sb3_roles.common.names import closest
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

# Of the stream of episodes; see ``held_out_seed``.
_MAX_SEED = 2**63 - 1
# Percentages and steps are far below.
_MAX_PRINTED = 1e6

# What a check returns is what the value should have been; None: it is that.
Check = Callable[[object], str | None]


def parse_plan(content: object) -> Plan:
    """Check what a plan's file says.

    :param content: of ``tables.yml``, plain data
    :raises PlanError: naming the first thing that is wrong
    """
    top = _fields("the plan", content, _TOP)
    rows = {name: _row(name, value) for name, value in _named("rows", top["rows"]).items()}
    tables = {
        name: _table(name, value, rows) for name, value in _named("tables", top["tables"]).items()
    }
    figures = {
        name: _figure(name, value, rows)
        for name, value in _named("figures", top["figures"]).items()
    }
    return Plan(top["episodes"], top["quick_episodes"], top["seed"], rows, tables, figures)


def _whole(low: int, high: int | None = None) -> Check:
    def check(value: Any) -> str | None:
        whole = isinstance(value, int) and not isinstance(value, bool)
        if whole and low <= value <= (value if high is None else high):
            return None
        return f"a whole number of at least {low}" + ("" if high is None else f", at most {high}")

    return check


def _is(kind: type, what: str) -> Check:
    return lambda value: None if isinstance(value, kind) else what


def _list_of(kind: type, what: str) -> Check:
    def check(value: Any) -> str | None:
        sound = isinstance(value, list) and value and all(isinstance(one, kind) for one in value)
        # What is there twice would be printed, and counted, twice.
        once = sound and len(set(value)) == len(value)
        return None if once else f"a list of {what}, each once"

    return check


_NAMES = _list_of(str, "names")


def _line(value: object, may_be_empty: bool = False) -> str | None:
    sound = isinstance(value, str) and value.isprintable() and (may_be_empty or value.strip())
    return None if sound else "a text of one line" + ("" if may_be_empty else ", not empty")


def _about(value: object) -> str | None:
    return _line(value, may_be_empty=True)


_TEXT, _FLAG = _is(str, "a text"), _is(bool, "true or false")
_MAPPING = _is(dict, "keys and values")
_TOP: dict[str, Check] = {
    "episodes": _whole(1),
    "quick_episodes": _whole(1),
    "seed": _whole(0, _MAX_SEED),
    "rows": _MAPPING,
    "tables": _MAPPING,
    "figures": _MAPPING,
}
_ROW: dict[str, Check] = {
    "label": _line,
    "controller": _TEXT,
    "algo": _TEXT,
    "conf": _TEXT,
    "params": _MAPPING,
    "drawn": _FLAG,
    "bound": _FLAG,
    "episodes": _whole(1),
    "quick_episodes": _whole(1),
    "block": _whole(1),
    "about": _about,
}
_PART: dict[str, Check] = {
    "caption": _line,
    "n_agents": _list_of(int, "numbers of robots"),
    "scenes": _MAPPING,
    "metrics": _NAMES,
    "rows": _NAMES,
}
_TABLE = {**_PART, "paper": _MAPPING}
_FIGURE = {**_PART, "paper": _MAPPING, "kind": _TEXT}


def _named(what: str, content: Mapping[Any, Any]) -> dict[str, Any]:
    for key in content:
        # Names become names of files.
        if not isinstance(key, str) or not key.replace("_", "").isalnum() or not key.isascii():
            raise PlanError(f"{what}: names have letters, digits and _ only, got {key!r}")
    return dict(content)


def _fields(
    where: str, content: object, checks: Mapping[Any, Check], required: Iterable[Any] | None = None
) -> dict[Any, Any]:
    if not isinstance(content, dict):
        raise PlanError(f"{where} must be keys and values, got {type(content).__name__}")
    for key, value in content.items():
        if key not in checks:
            raise PlanError(f"{where}: {closest('key', key, checks)}")
        wanted = checks[key](value)
        if wanted is not None:
            raise PlanError(f"{where}: {key} must be {wanted}, got {value!r}")
    for key in checks if required is None else required:
        if key not in content:
            raise PlanError(f"{where}: {key} is missing")
    return dict(content)


def _row(name: str, content: object) -> Row:
    where = f"row {name}"
    given = _fields(where, content, _ROW, ["label"])
    if ("controller" in given) == ("algo" in given):
        raise PlanError(f"{where}: give either controller or algo")
    if "controller" in given:
        for key in ("conf", "params", "drawn"):
            if key in given:
                raise PlanError(f"{where}: only learned rows have {key}")
        _check_names(where, "controller", [given["controller"]], CONTROLLER_NAMES)
    return Row(name, **given)


def _check_names(where: str, what: str, names: Iterable[object], known: Iterable[str]) -> None:
    known = list(known)
    for name in names:
        if name not in known:
            raise PlanError(f"{where}: {closest(what, name, known)}")


def _columns(where: str, given: Mapping[str, Any]) -> tuple[Column, ...]:
    scenes = given["scenes"]
    if not scenes:
        raise PlanError(f"{where}: scenes must be at least one scene")
    _check_names(where, "scene", scenes, SCENES)
    for scene, label in scenes.items():
        if _line(label) is not None:
            raise PlanError(f"{where}: the label of {scene} must be {_line(label)}, got {label!r}")
    for n_agents in given["n_agents"]:
        wanted = _whole(1)(n_agents)
        if wanted is not None:
            raise PlanError(f"{where}: n_agents must be {wanted}, got {n_agents!r}")
    return tuple(Column(scene, n) for n in given["n_agents"] for scene in scenes)


def _table(name: str, content: object, rows: Mapping[str, Row]) -> Table:
    where = f"table {name}"
    given = _fields(where, content, _TABLE, _PART)
    _check_names(where, "row", given["rows"], rows)
    _check_names(where, "metric", given["metrics"], SCORES)
    columns = _columns(where, given)
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
    _check_names(where, "row", content, table["rows"])
    for row, teams in content.items():
        teams = _fields(f"{where}, {row}", teams, {n: _MAPPING for n in table["n_agents"]}, ())
        for n_agents, metrics in teams.items():
            place = f"{where}, {row}, {n_agents}"
            _check_names(place, "metric", metrics, table["metrics"])
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
    _check_names(where, "row", content, figure["rows"])
    for row, scenes in content.items():
        scenes = _fields(f"{where}, {row}", scenes, dict.fromkeys(figure["scenes"], _MAPPING), ())
        for scene, metrics in scenes.items():
            place = f"{where}, {row}, {scene}"
            known = dict.fromkeys(figure["metrics"], _MAPPING)
            for metric, values in _fields(place, metrics, known, ()).items():
                for step, value in values.items():
                    wanted = _whole(1)(step)
                    if wanted is not None or not _printable(value):
                        raise PlanError(
                            f"{place}: {metric} must be steps from 1 on and numbers from 0 to "
                            f"{_MAX_PRINTED:.0f}, got {shown(step)}: {shown(value)}"
                        )
                points[row, scene, metric] = tuple(sorted(values.items()))
    return points


def _figure(name: str, content: object, rows: Mapping[str, Row]) -> Figure:
    where = f"figure {name}"
    given = _fields(where, content, _FIGURE, ("caption", "kind", "metrics", "rows"))
    kind = given["kind"]
    _check_names(where, "kind", [kind], FIGURE_METRICS)
    _check_names(where, "row", given["rows"], rows)
    _check_names(where, "metric", given["metrics"], FIGURE_METRICS[kind])
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
    columns = () if of_training else _columns(where, given)
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
