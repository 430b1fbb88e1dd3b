"""Versions of installed packages; importing this imports none of them."""

from __future__ import annotations

from importlib import metadata

PACKAGES = ("torch", "stable-baselines3", "sb3-contrib", "numpy", "numba", "gymnasium")
"""Packages that a training is computed with."""


def version_of(package: str) -> str:
    """Return the version of an installed package, or ``"unknown"``.

    :param package: as it is installed
    """
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"
