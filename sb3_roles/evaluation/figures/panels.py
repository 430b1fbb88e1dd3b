"""How the figures of a plan are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_roles.common.thresholds import THRESHOLD
from sb3_roles.evaluation.figures.bars import draw_bars
from sb3_roles.evaluation.figures.data import Bar, Curve, Drawn
from sb3_roles.evaluation.figures.looks import (
    AXES,
    MARKERS,
    WIDTH,
    Look,
    legend,
    line_handle,
    looks,
    marked,
    rows_of,
    star,
    team,
)
from sb3_roles.evaluation.grid.plan import Figure, Plan

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

PAPER = "the paper"
_MARKS = 8  # markers on a line
_MANY = 5  # lines in a panel
_BAND = 0.18  # opacity
_ROLE_DASHES = {"cover": "-", "explore": (0, (4, 1.5)), "switched": "-"}
_SCENE_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#56B4E9", "#E69F00")


def draw(plan: Plan, figure: Figure, drawn: Drawn, note: str) -> Canvas:
    """Draw a figure; within ``figures.files.drawing_style``.

    :param plan: of the figure
    :param figure: of the plan
    :param drawn: its numbers, at least one curve or bar
    :param note: small, above the panels; may be empty
    """
    from matplotlib.figure import Figure as Canvas

    canvas = Canvas(layout="constrained")
    curves = [one for one in drawn if isinstance(one, Curve)]
    if figure.kind == "training":
        _draw_training(canvas, plan, figure, curves)
    elif figure.kind in ("roles", "switching"):
        _draw_roles(canvas, plan, figure, curves)
    elif figure.kind == "episode":
        _draw_episodes(canvas, plan, figure, curves)
    else:
        draw_bars(canvas, plan, figure, [one for one in drawn if isinstance(one, Bar)])
    if note:
        canvas.suptitle(note, x=0.995, ha="right", fontsize=6.5, style="italic")
    return canvas


def _line(axes: Axes, x: np.ndarray, curve: Curve, look: Look, place: float, band: float) -> None:
    """Draw a curve; ``place``, in [0, 1), tells where its markers begin."""
    every = max(1, len(x) // _MARKS)
    # Markers of different lines are at different steps: where lines meet, all of them are seen.
    first = int(place * every)
    axes.plot(x, curve.mean, linestyle=look.dashes, markevery=(first, every), **marked(look))
    axes.fill_between(x, curve.low, curve.high, color=look.color, alpha=band, linewidth=0)


def _draw_training(canvas: Canvas, plan: Plan, figure: Figure, curves: Sequence[Curve]) -> None:
    styles, rows = looks(plan), rows_of(figure, curves)
    canvas.set_size_inches(WIDTH, 3.2)
    for axes, metric in zip(
        canvas.subplots(1, len(figure.metrics), squeeze=False)[0], figure.metrics, strict=True
    ):
        for curve in curves:
            if curve.metric == metric:
                place = rows.index(curve.row) / len(rows)
                _line(axes, curve.x / 1000.0, curve, styles[curve.row], place, _BAND)
        axes.set_ylabel(AXES[metric])
        axes.set_xlabel("joint steps of the training (thousands)")
        axes.set_ylim(bottom=0.0)
        axes.margins(x=0.02)
    legend(canvas, [line_handle(styles[row], plan.rows[row].label) for row in rows])


def _draw_episodes(canvas: Canvas, plan: Plan, figure: Figure, curves: Sequence[Curve]) -> None:
    """Draw a line of panels for each place, a column for each metric.

    Beside each panel stands what the curves end with, row by row: curves of many rows overlap.
    """
    styles, rows = looks(plan), rows_of(figure, curves)
    places = [place for place in figure.columns if any(one.column == place for one in curves)]
    n_metrics = len(figure.metrics)
    canvas.set_size_inches(WIDTH, 2.6 * len(places) + 0.7)
    grid = canvas.subplots(
        len(places), 2 * n_metrics, squeeze=False, width_ratios=[3.2, 1.0] * n_metrics
    )
    # Many bands on top of each other would hide the lines.
    band = _BAND if len(rows) <= _MANY else 0.4 * _BAND
    for line, place in enumerate(places):
        for k, metric in enumerate(figure.metrics):
            axes, side = grid[line, 2 * k : 2 * k + 2]
            for curve in curves:
                if (curve.column, curve.metric) == (place, metric):
                    look, index = styles[curve.row], rows.index(curve.row)
                    _line(axes, curve.x, curve, look, index / len(rows), band)
                    ends = curve.mean[-1], curve.low[-1], curve.high[-1]
                    _end(side, index, ends, look)
                    _stars(axes, figure, curve, look.color)
            axes.set_ylabel(AXES[metric])
            axes.set_title(f"{figure.scenes[place.scene]}, {team(place.n_agents)}")
            axes.set_xlabel("step" if line == len(places) - 1 else "")
            axes.margins(x=0.02)
            axes.set_ylim(bottom=0.0)
            side.sharey(axes)
            side.set_title("at the end", fontsize=7)
            side.set_xlim(-0.7, len(rows) - 0.3)
            side.set_xticks([])
            side.tick_params(axis="y", labelleft=False, length=0)
            side.spines["left"].set_visible(False)
            if metric in ("explo_paper", "explo_true"):
                for each in (axes, side):
                    each.axhline(100.0 * THRESHOLD, color="#666666", lw=0.8, ls=":", zorder=1)
    handles = [line_handle(styles[row], plan.rows[row].label) for row in rows]
    legend(canvas, [*handles, *_star_handles(figure, curves)])


def _stars(axes: Axes, figure: Figure, curve: Curve, color: str) -> None:
    """Draw what the paper shows of a row."""
    for step, value in _points_of(figure, curve):
        # At the last step, half of it is beyond the panel.
        axes.plot([step], [value], clip_on=False, **star(color))


def _points_of(figure: Figure, curve: Curve) -> Sequence[tuple[int, float]]:
    scene = "" if curve.column is None else curve.column.scene
    return figure.paper.get((curve.row, scene, curve.metric), ())


def _star_handles(figure: Figure, curves: Sequence[Curve]) -> list[Any]:
    from matplotlib.lines import Line2D

    shown = any(_points_of(figure, curve) for curve in curves)
    return [Line2D([], [], label=PAPER, **star("#444444"))] if shown else []


def _end(axes: Axes, place: float, ends: tuple[float, float, float], look: Look) -> None:
    mean, low, high = ends
    axes.plot([place, place], [low, high], color=look.color, linewidth=1.0)
    axes.plot([place], [mean], linestyle="", **marked(look))


def _draw_roles(canvas: Canvas, plan: Plan, figure: Figure, curves: Sequence[Curve]) -> None:
    """Draw one panel for each row and number of robots, a line for each scene and metric."""
    switching = figure.kind == "switching"
    panels: dict[tuple[str, int], list[tuple[str, Curve]]] = {}
    for curve in curves:
        if curve.column is not None:
            scene, n_agents = curve.column
            panels.setdefault((curve.row, n_agents), []).append((scene, curve))
    many_teams = len({n_agents for _, n_agents in panels}) > 1
    shown = {scene for panel in panels.values() for scene, _ in panel}
    scenes = [scene for scene in figure.scenes if scene in shown]
    parts = zip(_SCENE_COLORS, MARKERS, strict=False)
    styles = {
        scene: Look(color, "-", marker, True, "")
        for scene, (color, marker) in zip(scenes, cycle(parts), strict=False)
    }
    n_columns = min(2, len(panels))
    n_lines = -(-len(panels) // n_columns)
    canvas.set_size_inches(WIDTH * n_columns / 2, 2.2 * n_lines + 0.5)
    grid = canvas.subplots(n_lines, n_columns, squeeze=False, sharex=True, sharey=True).ravel()
    for k, (axes, ((row, n_agents), drawn)) in enumerate(zip(grid, panels.items(), strict=False)):
        for scene, curve in drawn:
            look = styles[scene]._replace(dashes=_ROLE_DASHES[curve.metric])
            _line(axes, curve.x, curve, look, scenes.index(scene) / len(scenes), _BAND)
            _stars(axes, figure, curve, look.color)
        axes.set_title(plan.rows[row].label + (f", {team(n_agents)}" if many_teams else ""))
        if not switching:
            axes.set_ylim(0.0, 100.0)
        axes.margins(x=0.02)
        axes.xaxis.set_tick_params(labelbottom=True)
        axes.set_xlabel("step" if k + n_columns >= len(panels) else "")
        if k % n_columns == 0:
            one_role = f" {figure.metrics[0]}" if len(figure.metrics) == 1 else ""
            in_role = f"robots in the role{one_role} (%)"
            axes.set_ylabel("robots that change their role (%)" if switching else in_role)
    if switching:
        # Of all panels, which share it: it depends on the curves how far up it goes.
        grid[0].set_ylim(bottom=0.0)
    for axes in grid[len(panels) :]:
        axes.remove()
    handles = [line_handle(look, figure.scenes[scene]) for scene, look in styles.items()]
    if len(figure.metrics) > 1:
        bare = Look("#444444", "-", "", True, "")
        handles += [
            line_handle(bare._replace(dashes=_ROLE_DASHES[role]), f"role {role}")
            for role in figure.metrics
        ]
    legend(canvas, [*handles, *_star_handles(figure, curves)])
