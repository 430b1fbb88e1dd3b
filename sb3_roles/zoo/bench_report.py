"""What the reports of the measuring commands share: spreads, targets, and lines of text."""

from __future__ import annotations

import operator
import statistics
from collections.abc import Callable, Sequence
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
    low, high = format(found["min"], style), format(found["max"], style)
    return format(found["median"], style), f"{low} .. {high}", target


def machine_lines(machine: dict[str, Any]) -> list[str]:
    """Describe the machine in two lines.

    :param machine: see ``zoo.machine.describe_machine``
    """
    load = machine["load_before"]
    packages = ("python", "numpy", "numba", "torch", "sb3_roles")
    versions = [f"{name} {machine[name]}" for name in packages if name in machine]
    return [
        f"{machine['cpu']}, {machine['cores']} cores ({machine['usable_cores']} usable), "
        f"load before {'?' if load is None else f'{load:.2f}'}",
        ", ".join(versions),
    ]
