"""Checks of numbers that several classes take; each error is one line with the name and value."""

from __future__ import annotations

from typing import Any


def check_positive(**values: int) -> None:
    """Refuse what is no whole number of at least 1.

    :param values: name -> value
    :raises ValueError: naming the first wrong one
    """
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise ValueError(f"{name} must be a whole number of at least 1, got {value!r}")


def check_unit(**values: float) -> None:
    """Refuse what is no number in [0, 1].

    :param values: name -> value
    :raises ValueError: naming the first wrong one
    """
    for name, value in values.items():
        if not isinstance(value, (int, float)) or not 0.0 <= value <= 1.0:
            raise ValueError(f"{name} must be a number in [0, 1], got {value!r}")


def check_not_negative(**values: Any) -> None:
    """Refuse what is no finite number of at least 0.

    :param values: name -> value
    :raises ValueError: naming the first wrong one
    """
    for name, value in values.items():
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not number or not 0.0 <= value < float("inf"):
            raise ValueError(f"{name} must be a finite number of at least 0, got {value!r}")
