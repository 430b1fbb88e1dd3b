"""The plot of ``sb3-roles bench growth``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_roles.common.files import write_atomically
from sb3_roles.evaluation.figures.files import drawing_style, render
from sb3_roles.evaluation.figures.looks import WIDTH, Look, legend, line_handle, marked

_LOOKS = {
    "update": Look("#D55E00", "-", "o", True, ""),
    "rollout": Look("#0072B2", (0, (5, 1.5)), "s", True, ""),
    "environment": Look("#000000", (0, (2, 1)), "^", False, ""),
}
_LABELS = {"environment": "environment by itself"}


def draw(report: Mapping[str, Any], file: Path) -> None:
    """Draw costs over robots and over cells, both axes in powers; bars are the range of the rounds.

    :param report: of ``bench_growth``
    :param file: ends in .png, .svg or .pdf
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    cases = report["cases"]
    side, n_agents = min(one["side"] for one in cases), min(one["n_agents"] for one in cases)
    with drawing_style("growth"):
        canvas = Figure(figsize=(WIDTH, 3.0), layout="constrained")
        panels = canvas.subplots(1, 2, sharey=True)
        for axes, label, title, some in (
            (
                panels[0],
                "robots",
                f"{side} x {side} cells",
                [(one["n_agents"], one) for one in cases if one["side"] == side],
            ),
            (
                panels[1],
                "cells",
                f"{n_agents} robots",
                [(one["side"] ** 2, one) for one in cases if one["n_agents"] == n_agents],
            ),
        ):
            sizes = [size for size, _ in some]
            for part, look in _LOOKS.items():
                costs = [one["microseconds"][part] for _, one in some]
                middle = [cost["median"] for cost in costs]
                reach = [
                    [cost["median"] - cost["min"] for cost in costs],
                    [cost["max"] - cost["median"] for cost in costs],
                ]
                axes.errorbar(
                    sizes, middle, reach, linestyle=look.dashes, capsize=2.0, **marked(look)
                )
            axes.set(xscale="log", yscale="log", xlabel=label, title=title)
            axes.set_xticks(sizes, [f"{size:,}" for size in sizes])
            axes.minorticks_off()
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter("{x:,.0f}")
        panels[0].set_ylabel("microseconds per joint step")
        legend(
            canvas, [line_handle(look, _LABELS.get(part, part)) for part, look in _LOOKS.items()]
        )
        about = "What a joint step costs, over robots and over cells of the map."
        content = render(canvas, "growth", about)[file.suffix.lower().removeprefix(".")]
    write_atomically(file, content)
