"""Write the report: one HTML file that needs nothing else, neither files nor a network."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from sb3_roles.common.files import write_atomically
from sb3_roles.evaluation.grid.plan import Column, Figure, Plan, Table
from sb3_roles.evaluation.metrics import MEANINGS
from sb3_roles.evaluation.report.printed import is_reached, printed_cells
from sb3_roles.evaluation.report.summary import summarize_tables
from sb3_roles.evaluation.report.traces import Trace, encode_traces

if TYPE_CHECKING:
    from sb3_roles.evaluation.tables.model import TableResult, TableRow, Value

TITLE = "Multi-robot area search: tables, figures and episodes"
SCRIPTS = ("page.js", "tables.js", "honesty.js", "map.js", "pane.js", "player.js")
"""In the order in which they are put together."""
_FIELDS = ("area", "what", "paper", "ours", "source", "switch")


def write_report(
    path: Path,
    plan: Plan,
    tables: Mapping[str, TableResult],
    figures: Mapping[str, str],
    captions: Mapping[str, str],
    traces: Sequence[Trace],
    facts: Mapping[str, Any],
    quick: bool,
) -> None:
    """Write the report, atomically.

    Its policy forbids every connection, and every script and style but its own. Figures are shown
    as images, so that nothing in them can run.

    :param path: of the file; its folder is made if it does not exist
    :param plan: what was played
    :param tables: name -> table
    :param figures: name -> SVG, the text of a whole file
    :param captions: name of a figure -> caption; the plan's for those that have none
    :param traces: episodes for the player, see
        :func:`~sb3_roles.evaluation.report.traces.record_traces`
    :param facts: what readers must know of the making: name -> a text, a number, or a list or
        mapping of them
    :param quick: the tables are of the quick form
    :raises OSError: if the disk refuses
    """
    content = report_content(plan, tables, figures, captions, traces, facts, quick)
    write_atomically(path, render_page(content).encode())


def report_content(
    plan: Plan,
    tables: Mapping[str, TableResult],
    figures: Mapping[str, str],
    captions: Mapping[str, str],
    traces: Sequence[Trace],
    facts: Mapping[str, Any],
    quick: bool,
) -> dict[str, Any]:
    """Return all that the page shows, as JSON values; parameters are those of `write_report`."""
    parts: list[Table | Figure] = [*plan.tables.values(), *plan.figures.values()]
    scenes = {scene: label for part in parts for scene, label in part.scenes.items()}
    return {
        "title": TITLE,
        "quick": quick,
        "facts": [{"name": name, "value": _fact(value)} for name, value in facts.items()],
        "summary": [point._asdict() for point in summarize_tables(plan, tables)],
        "rows": {
            name: {"label": row.label, "about": row.about, "drawn": row.drawn, "bound": row.bound}
            for name, row in plan.rows.items()
        },
        "scenes": scenes,
        "metrics": {name: meaning._asdict() for name, meaning in MEANINGS.items()},
        "tables": [_table(name, table) for name, table in tables.items()],
        "figures": [
            {"caption": captions.get(name) or _caption(plan, name), "source": _image(svg)}
            for name, svg in figures.items()
        ],
        "traces": encode_traces(traces),
        "printed": [cell._asdict() for cell in printed_cells(tables)],
        "deviations": deviations(),
    }


def _fact(value: Any) -> Any:
    if isinstance(value, Mapping):
        return [f"{name}: {one}" for name, one in value.items()]
    if isinstance(value, (list, tuple)):
        return [str(one) for one in value]
    return str(value)


def _caption(plan: Plan, name: str) -> str:
    return plan.figures[name].caption if name in plan.figures else name


def _image(svg: str) -> str:
    return "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode("ascii")


def _table(name: str, table: TableResult) -> dict[str, Any]:
    spec = table.spec
    return {
        "name": name,
        "caption": table.caption,
        "notes": list(table.notes),
        "scenes": [{"name": scene, "label": label} for scene, label in spec.scenes.items()],
        "teams": list(dict.fromkeys(column.n_agents for column in spec.columns)),
        "metrics": list(spec.metrics),
        "rows": [_row(row, table) for row in table.rows],
    }


def _row(row: TableRow, table: TableResult) -> dict[str, Any]:
    spec = table.spec
    teams = dict.fromkeys(column.n_agents for column in spec.columns)
    return {
        "name": row.name,
        "label": row.label,
        "about": row.about,
        "learned": row.learned,
        "drawn": row.drawn,
        "bound": row.bound,
        "budget": row.budget,
        # Team size, then scene, then metric.
        "values": [
            [
                [_cell(row, Column(scene, n), metric, spec.paper) for metric in spec.metrics]
                for scene in spec.scenes
            ]
            for n in teams
        ],
        "overall": [
            [_number_of(row.overall.get((n, metric))) for metric in spec.metrics] for n in teams
        ],
        "batch": row.batch,
        "decision": [
            _number(row.decision_over(Column(scene, n) for scene in spec.scenes)) for n in teams
        ],
        "seconds": [
            [_number(row.decision.get(Column(scene, n))) for scene in spec.scenes] for n in teams
        ],
    }


def _cell(
    row: TableRow,
    column: Column,
    metric: str,
    paper: Mapping[tuple[str, Column, str], float | None],
) -> dict[str, Any] | None:
    value = row.values.get((column, metric))
    key = row.name, column, metric
    if value is None and key in paper:
        # Not played: what the paper prints is shown all the same.
        return {"printed": True, "paper": paper[key]}
    return _number_of(value)


def _number_of(value: Value | None) -> dict[str, Any] | None:
    if value is None:
        return None
    return {
        "played": True,
        "mean": _number(value.mean),
        "low": _number(value.low),
        "high": _number(value.high),
        "unit": value.unit,
        "printed": value.printed,
        "paper": _number(value.paper),
        "capped": value.capped,
        "difference": _number(value.difference),
        "reached": is_reached(value),
        "best": value.best,
        "episodes": value.n_episodes,
        "seeds": value.n_seeds,
        "share": _number(value.share),
    }


def _number(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else round(float(value), 9)


def deviations() -> list[dict[str, str]]:
    """Return where this project differs from the paper, in the order of the file."""
    entries = yaml.safe_load(_resource("deviations.yml"))
    return [{field: entry[field] for field in _FIELDS} for entry in entries]


def _resource(name: str) -> str:
    return files("sb3_roles.evaluation.report").joinpath(name).read_text(encoding="utf-8")


def render_page(content: Mapping[str, Any]) -> str:
    """Put the page together.

    :param content: see :func:`report_content`
    :return: HTML
    """
    style = "\n" + _resource("page.css")
    # One scope for all files, and none of their names in the page's.
    script = '\n(() => {\n"use strict";\n' + "\n".join(map(_resource, SCRIPTS)) + "\n})();\n"
    policy = (
        f"default-src 'none'; script-src '{_hash(script)}'; style-src '{_hash(style)}'; "
        "img-src data:; connect-src 'none'; base-uri 'none'; form-action 'none'"
    )
    # Without "<" no text can end the element that it stands in.
    data = json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    parts = {
        "title": html.escape(content["title"]),
        "policy": policy,
        "style": style,
        "script": script,
        "data": data,
    }
    # In one pass: what a part holds is not looked at again.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _resource("page.html"))


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
