"""What the header of a file of records must hold; a file may come from anybody."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import fields
from typing import Any

from area_search.scenes import LATER, Scene, shown

_Check = Callable[[Any], bool]


def _texts(values: Iterable[Any]) -> bool:
    return all(isinstance(value, str) for value in values)


def _text(value: Any) -> bool:
    return isinstance(value, str)


def _choice(value: Any) -> bool:
    return value is None or isinstance(value, bool)


def _whole(value: Any, low: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and low <= value < 2**64


_METADATA: dict[str, _Check] = {
    "name": _text,
    "controller": _text,
    "controller_options": lambda value: isinstance(value, dict),
    "scene": lambda value: isinstance(value, dict),
    "deterministic": _choice,
    "communication": _choice,
    "version": _text,
    "config_hash": _text,
    "seed": lambda value: _whole(value, 0),
    "role_names": lambda value: isinstance(value, list) and _texts(value),
    "versions": lambda value: isinstance(value, dict) and _texts(value.values()),
}
_TIMING: dict[str, _Check] = {
    "seconds": lambda value: isinstance(value, float) and 0 < value < float("inf"),
    "batch_size": lambda value: _whole(value, 1),
}


def checked_scene(metadata: dict[str, Any], timing: dict[str, Any]) -> Scene:
    """Check what a file says beside its pages: the hash only tells that somebody wrote it so.

    :param metadata: JSON values, see ``EpisodeRecords``
    :param timing: the same
    :return: the scene, whose ranges bound what the file can ask for
    :raises ValueError: if an entry is missing, or is none that could have been written
    """
    for entries, checks in ((metadata, _METADATA), (timing, _TIMING)):
        for key, is_sound in checks.items():
            if key not in entries:
                raise ValueError(f"the entry {key!r} of the metadata is missing")
            if not is_sound(entries[key]):
                raise ValueError(f"the entry {key!r} of the metadata is {shown(entries[key])}")
    given = metadata["scene"]
    names = {field.name for field in fields(Scene)}
    unknown = (set(given) - names) | (names - set(LATER) - set(given))
    if unknown:
        raise ValueError(f"the scene of the metadata has not the fields of one: {min(unknown)!r}")
    return Scene(**given)
