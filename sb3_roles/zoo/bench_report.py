"""What the reports of the measuring commands share: spreads, targets, tables and lines of text."""

from __future__ import annotations

import operator
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


def spread(values: Sequence[float]) -> dict[str, Any]:
    """Return ``median``, ``min`` and ``max`` of at least one value."""
    return {"median": statistics.median(values), "min": min(values), "max": max(values)}


def against(
    found: dict[str, Any],
    target: float | None,
    meets: Callable[[float, float], bool] = operator.ge,
) -> dict[str, Any]:
    """Add a target, and whether the median meets it, to a spread.

    :param found: see :func:`spread`
    :param target: None for none
    :param meets: compares the median with the target
    """
    met = None if target is None else bool(meets(found["median"], target))
    return {**found, "target": target, "met": met}


def ratios(over: Sequence[float], under: Sequence[float]) -> list[float]:
    """Divide what was measured in the same rounds.

    :param over: one value per round
    :param under: as many, not 0
    """
    return [a / b for a, b in zip(over, under, strict=True)]


def log_log_slope(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Exponent b of the power law cost = a size^b that fits best in logarithms.

    :param sizes: at least two different positive numbers
    :param costs: as many positive numbers
    :return: the exponent
    """
    import numpy as np

    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def row(label: str, median: str, spread: str = "", target: str = "", last: str = "") -> str:
    """Set one line of a report in columns."""
    return f"{label:49}{median:>11}  {spread:22}{target:19}{last}".rstrip()


def cells(found: dict[str, Any], style: str, relation: str = ">=") -> tuple[str, str, str]:
    """Write median, range and target as text.

    :param found: see :func:`against`
    :param style: format of a number
    :param relation: how the median shall compare with the target
    """
    target = ""
    if found["target"] is not None:
        verdict = "met" if found["met"] else "MISSED"
        target = f"{relation} {found['target']:,.0f} {verdict}"
    return format(found["median"], style), range_text(found, style), target


def range_text(found: dict[str, Any], style: str) -> str:
    """Write the range of a spread as text."""
    return f"{found['min']:{style}} .. {found['max']:{style}}"


@dataclass
class Table:
    """A table for people: the first columns are text, the others are set to the right.

    :param columns: headings
    :param rows: as many cells each
    :param n_texts: number of the columns of text
    """

    columns: Sequence[str]
    rows: list[Sequence[str]] = field(default_factory=list)
    n_texts: int = 1

    def add(self, *row: str) -> None:
        """Add a row."""
        if len(row) != len(self.columns):
            raise ValueError(f"{len(self.columns)} columns, got {len(row)} cells: {row}")
        self.rows.append(row)

    def lines(self, markdown: bool = False) -> list[str]:
        """Set the table.

        :param markdown: with bars between the cells
        """
        if markdown:
            rule = ["---" if k < self.n_texts else "---:" for k in range(len(self.columns))]
            # "..." stays text, a bar would end the cell.
            rows = [[cell.replace("|", "\\|") for cell in row] for row in self.rows]
            return [f"| {' | '.join(row)} |" for row in (self.columns, rule, *rows)]
        widths = [max(map(len, column)) for column in zip(self.columns, *self.rows, strict=True)]
        return [
            "  ".join(
                cell.ljust(width) if k < self.n_texts else cell.rjust(width)
                for k, (cell, width) in enumerate(zip(row, widths, strict=True))
            ).rstrip()
            for row in (self.columns, *self.rows)
        ]


def page(head: Sequence[str], tables: Sequence[Table], markdown: bool = False) -> str:
    """Set lines and tables, each of them behind an empty line.

    :param head: what was measured, and on what
    :param tables: see :class:`Table`
    :param markdown: for documents
    """
    # Two spaces end a line in Markdown.
    lines = [f"{line}  " for line in head] if markdown else list(head)
    for table in tables:
        lines += ["", *table.lines(markdown)]
    return "\n".join(lines)


def rounds_line(config: Mapping[str, Any]) -> str:
    """Say how often was measured.

    :param config: ``repeats`` and ``iterations``
    """
    rounds = plural(config["repeats"], "interleaved round")
    return f"{rounds} of {plural(config['iterations'], 'iteration')}"


def machine_lines(machine: dict[str, Any]) -> list[str]:
    """Describe the machine in two lines, and the settings of its threads in a third if known.

    :param machine: see ``zoo.machine.describe_machine``
    """
    load = machine["load_before"]
    packages = ("python", "numpy", "numba", "torch", "stable_baselines3", "sb3_roles")
    versions = [f"{name} {machine[name]}" for name in packages if name in machine]
    lines = [
        f"{machine['cpu']}, {machine['cores']} cores ({machine['usable_cores']} usable), "
        f"load before {'?' if load is None else f'{load:.2f}'}",
        ", ".join(versions),
    ]
    if "torch_threads" in machine:
        threads = plural(machine["torch_threads"], "thread") + " of torch"
        lines.append(f"{threads}, {machine['process']}")
    return lines


def plural(number: int, what: str) -> str:
    """Write a number of things."""
    return f"{number:,} {what}{'' if number == 1 else 's'}"
