"""Durations as people read them."""

from __future__ import annotations


def short_duration(seconds: float) -> str:
    """Return what one decision takes, with three digits and its unit: ``2.6 ms``.

    :param seconds: at least 0
    """
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-6:.3g} µs"


def long_duration(seconds: float) -> str:
    """Return what a command takes: ``40 s``, ``12 min``, ``3 h 20 min``.

    :param seconds: at least 0; less than one is called one
    """
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
