"""Checks of numbers that several classes take; each error is one line with the name and value."""

from __future__ import annotations

import os
from typing import Any

import numpy as np


def check_whole(low: int, /, **values: int | np.integer[Any]) -> None:
    """Refuse what is no whole number, Python's or numpy's, of at least ``low``.

    :param low: the least that is allowed
    :param values: name -> value
    :raises ValueError: naming the first wrong one
    """
    for name, value in values.items():
        whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
        if not whole or value < low:
            raise ValueError(f"{name} must be a whole number of at least {low}, got {value!r}")


def check_positive(**values: int | np.integer[Any]) -> None:
    """Refuse what is no whole number of at least 1, see :func:`check_whole`.

    :param values: name -> value
    :raises ValueError: naming the first wrong one
    """
    check_whole(1, **values)


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


def check_trusted(what: str, path: object, trust: bool) -> None:
    """Refuse to unpickle a file that the caller does not vouch for.

    :param what: what was called, for the message
    :param path: the file
    :param trust: whether the caller does
    :raises ValueError: if not
    """
    if trust is not True:
        where = path if isinstance(path, (str, os.PathLike)) else "the file"
        raise ValueError(
            f"{what} unpickles, and so runs whatever code {where} names: give trust=True if you "
            "know who wrote it; run folders load without that: sb3_roles.zoo.models.load_model"
        )
