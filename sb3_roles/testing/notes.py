"""Notes of what a play returned, small enough to be kept until another play is compared with it."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_roles.common.env_failures import STEP_PARTS
from sb3_roles.testing.episodes import MakeEnv, Moment, play

_LARGE = 256
"""Bytes above which an array is not kept."""


@dataclass(frozen=True)
class ArrayNote:
    """Stands for a large array.

    :param dtype: of the array
    :param shape: of the array
    :param digest: of its content
    """

    dtype: str
    shape: tuple[int, ...]
    digest: str

    def __repr__(self) -> str:
        return f"{self.dtype} {self.shape} with the digest {self.digest}"


def noted(moment: Moment) -> Moment:
    """Copy a moment, with notes in place of its large arrays.

    Equal moments have equal notes, as :func:`~sb3_roles.testing.episodes.compare` sees them.

    :param moment: to copy
    """
    return moment._replace(**{name: _small(getattr(moment, name)) for name in STEP_PARTS})


def noted_play(make_env: MakeEnv, n_steps: int, seed: int) -> list[Moment]:
    """Play an instance to the end, and return notes of what it returned.

    :param make_env: makes a new environment
    :param n_steps: steps to play
    :param seed: of play
    """
    return [noted(moment) for moment in play(make_env(), n_steps, seed)]


def _small(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        if value.nbytes <= _LARGE or value.dtype.hasobject:
            return copy.deepcopy(value)
        plain = value
        if value.dtype.kind in "fc":
            # What compares as equal gets the same bits: one NaN, and no zero with a sign.
            plain = np.where(np.isnan(value), np.nan, value) + 0.0
        return ArrayNote(str(value.dtype), value.shape, _sum([np.ascontiguousarray(plain)]))
    if isinstance(value, dict):
        return {key: _small(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_small(part) for part in value]
    copied = copy.deepcopy(value)
    # An object that differs from its copy can be compared only as itself.
    return copied if copied == value else value


def _sum(parts: Any) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest.hexdigest()[:16]


def digests(make_env: MakeEnv, n_steps: int, seed: int, action_seed: int) -> list[str]:
    """Return a digest of each moment of a play.

    :param make_env: makes a new environment
    :param n_steps: steps to play
    :param seed: of the first reset
    :param action_seed: of the actions
    """
    return [_digest(moment) for moment in play(make_env(), n_steps, seed, action_seed)]


def _digest(moment: Moment) -> str:
    return _sum(_flat(moment.parts()))


def _flat(value: Any) -> Iterator[bytes]:
    if isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, dict):
        for key, part in value.items():
            yield repr(key).encode()
            yield from _flat(part)
    elif isinstance(value, (list, tuple)):
        for part in value:
            yield from _flat(part)
    else:
        yield repr(value).encode()
