"""How rows look in figures: lines, markers and bars that differ in grey, too."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any, NamedTuple

from sb3_roles.evaluation.figures.data import Bar, Curve
from sb3_roles.evaluation.grid.plan import Figure, Plan

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

WIDTH = 7.2  # inches: two columns of a paper
# Okabe and Ito's colors and some of Tol's, which the color-blind can tell apart, none too light for
# lines. Trained rows take them from the front, scripted ones from the back.
_COLORS = (
    *("#56B4E9", "#999933", "#882255", "#332288", "#000000", "#44AA99"),
    *("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#8C564B"),
)
_BOUND = "#7F7F7F"
_DASHES = ("-", (0, (5, 1.5)), (0, (5, 1.2, 1, 1.2)), (0, (2, 1)), (0, (7, 1.2, 1, 1.2, 1, 1.2)))
MARKERS = ("o", "s", "^", "D", "v", "P", "<", "X", ">", "p", "*")
# In points, of those that are small for their size.
_SIZES = {"P": 5.5, "X": 5.5, "p": 5.0, "*": 7.0}
# No dots: as vectors, they take a hundred times as much room as lines.
_HATCHES = (
    *("\\\\", "////", "\\\\\\\\", "xxxx", "----", "||||", "++++", "//", ""),
    *("xx", "++", "--", "||"),
)

AXES = {
    "explore_reward": "sum of R_e per episode (cells / B_e)",
    "cover_reward": "sum of R_c per episode (targets)",
    "explo_paper": "newly seen / free cells (%)",
    "explo_true": "explored free cells (%)",
    "cover": "covered targets (%)",
    "time_e_paper": "Time_E: mean of newly seen / free cells at 90 %",
    "t90_true": "90 % of the free cells explored",
}
"""Metric -> what an axis, or a column of panels, says."""


class Look(NamedTuple):
    """How a row looks, in all figures of a plan.

    :param color: of lines and bars
    :param dashes: of lines
    :param marker: on lines
    :param filled: whether the marker is
    :param hatch: of bars
    """

    color: str
    dashes: Any
    marker: str
    filled: bool
    hatch: str


def looks(plan: Plan) -> dict[str, Look]:
    """Return how the rows of a plan look: markers are filled for those that were trained.

    Dashes and markers together repeat after 55 rows only.
    """
    colors = {True: iter(cycle(_COLORS)), False: iter(cycle(reversed(_COLORS)))}
    styles = zip(cycle(_DASHES), cycle(MARKERS), cycle(_HATCHES), strict=False)
    return {
        name: Look(
            _BOUND if row.bound else next(colors[row.learned]), dashes, marker, row.learned, hatch
        )
        for (name, row), (dashes, marker, hatch) in zip(plan.rows.items(), styles, strict=False)
    }


def rows_of(figure: Figure, drawn: Sequence[Curve] | Sequence[Bar]) -> list[str]:
    """Return the rows that are drawn, in the figure's order."""
    there = {one.row for one in drawn}
    return [row for row in figure.rows if row in there]


def team(n_agents: int) -> str:
    """Say how many robots there are."""
    return f"{n_agents} robot{'s' * (n_agents != 1)}"


def marked(look: Look) -> dict[str, Any]:
    """Return the arguments of ``Axes.plot`` for color and marker."""
    return {
        "color": look.color,
        "marker": look.marker,
        "markersize": _SIZES.get(look.marker, 4.2),
        "markerfacecolor": look.color if look.filled else "white",
        "markeredgecolor": "white" if look.filled else look.color,
        "markeredgewidth": 0.4 if look.filled else 0.9,
    }


def line_handle(look: Look, label: str) -> Any:
    """Return the entry of a line in a legend."""
    from matplotlib.lines import Line2D

    return Line2D([], [], linestyle=look.dashes, label=label, **marked(look))


def star(color: str, **options: Any) -> dict[str, Any]:
    """Return the arguments of ``Axes.plot`` for what the paper's figure shows."""
    looks_like = {"marker": "*", "markersize": 9.0, "markerfacecolor": "white", "linestyle": ""}
    return {**looks_like, "color": color, "markeredgewidth": 1.0, "zorder": 5, **options}


def legend(canvas: Canvas, handles: Sequence[Any]) -> None:
    """Put a legend below all panels, where it hides nothing."""
    # At most so many labels side by side, in lines of about the same length.
    n_lines = -(-len(handles) // (4 if canvas.get_figwidth() == WIDTH else 2))
    canvas.legend(
        handles=handles,
        loc="outside lower center",
        ncols=-(-len(handles) // n_lines),
        handlelength=3.6,
    )
