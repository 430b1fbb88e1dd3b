"""Bars of the time to 90 % exploration, with their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from sb3_roles.evaluation.figures.data import Bar
from sb3_roles.evaluation.figures.looks import AXES, WIDTH, Look, legend, looks, rows_of, team
from sb3_roles.evaluation.grid.plan import Figure, Plan

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

_CARET = 6  # matplotlib's marker that points up, its tip at the place


def draw_bars(canvas: Canvas, plan: Plan, figure: Figure, bars: Sequence[Bar]) -> None:
    """Draw a line of panels for each number of robots, a column for each metric.

    :param canvas: empty
    :param plan: of the figure
    :param figure: of the plan
    :param bars: at least one
    """
    from matplotlib.patches import Patch

    styles, rows = looks(plan), rows_of(figure, bars)
    scenes = [scene for scene in figure.scenes if any(bar.column.scene == scene for bar in bars)]
    teams = sorted({bar.column.n_agents for bar in bars})
    width = 1.0 / (len(rows) + 1)
    canvas.set_size_inches(WIDTH, 1.7 * len(teams) + 0.7)
    grid = canvas.subplots(len(teams), len(figure.metrics), squeeze=False, sharex=True, sharey=True)
    for line, n_agents in enumerate(teams):
        for axes, metric in zip(grid[line], figure.metrics, strict=True):
            for bar in bars:
                if (bar.metric, bar.column.n_agents) == (metric, n_agents):
                    offset = rows.index(bar.row) - (len(rows) - 1) / 2
                    place = scenes.index(bar.column.scene) + width * offset
                    _bar(axes, bar, styles[bar.row], place, width)
            axes.set_title(AXES[metric] if line == 0 else "")
            axes.grid(visible=False, axis="x")
            axes.set_xticks(range(len(scenes)), [figure.scenes[scene] for scene in scenes])
            axes.tick_params(axis="x", length=0, labelbottom=True)
        grid[line, 0].set_ylabel(f"{team(n_agents)}: step")
    # Room for what is written above the highest bar.
    top = max(bar.score.high or bar.score.mean or 0.0 for bar in bars)
    grid[0, 0].set_ylim(0.0, 1.25 * max(top, 1.0))
    patches = [Patch(label=plan.rows[row].label, **_filling(styles[row])) for row in rows]
    legend(canvas, patches)


def _filling(look: Look) -> dict[str, Any]:
    # Pale: a hatch is seen on it.
    color = f"{look.color}66"
    return {"facecolor": color, "edgecolor": "black", "linewidth": 0.5, "hatch": look.hatch}


def _bar(axes: Axes, bar: Bar, look: Look, place: float, width: float) -> None:
    mean, low, high, share = bar.score.mean, bar.score.low, bar.score.high, bar.score.share
    if mean is None:
        axes.text(place, 0.0, "\N{EN DASH}", ha="center", va="bottom", fontsize=9)
        return
    axes.bar(place, mean, 0.9 * width, **_filling(look))
    top = mean
    if low is not None and high is not None:
        top = high
        axes.plot([place, place], [low, high], color="black", linewidth=0.9)
        if bar.open_ended:
            axes.plot([place], [high], color="black", marker=_CARET, markersize=4)
    if share is not None:
        axes.annotate(
            f"{100 * share:.0f}",
            (place, top),
            (0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=5.5,
            rotation=90,
        )
