"""What the values of a plan's file may be, and errors of one line about those that are not."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from sb3_roles.common.names import closest, shown
from sb3_roles.evaluation.grid.plan import PlanError

# Of the stream of episodes; see ``held_out_seed``.
_MAX_SEED = 2**63 - 1

Check = Callable[[object], str | None]
"""Returns what a value should have been; None: it is that."""


def whole(low: int, high: int | None = None) -> Check:
    """Make the check of a whole number from ``low`` to ``high``."""

    def check(value: Any) -> str | None:
        whole = isinstance(value, int) and not isinstance(value, bool)
        if whole and low <= value <= (value if high is None else high):
            return None
        return f"a whole number of at least {low}" + ("" if high is None else f", at most {high}")

    return check


def _is(kind: type, what: str) -> Check:
    return lambda value: None if isinstance(value, kind) else what


def list_of(kind: type, what: str) -> Check:
    """Make the check of a list, not empty, in which nothing is twice.

    :param kind: of its entries
    :param what: they are called in the message
    """

    def check(value: Any) -> str | None:
        sound = isinstance(value, list) and value and all(isinstance(one, kind) for one in value)
        # What is there twice would be printed, and counted, twice.
        once = sound and len(set(value)) == len(value)
        return None if once else f"a list of {what}, each once"

    return check


def line(value: object, may_be_empty: bool = False) -> str | None:
    """Check a text of one line."""
    sound = isinstance(value, str) and value.isprintable() and (may_be_empty or value.strip())
    return None if sound else "a text of one line" + ("" if may_be_empty else ", not empty")


def note(value: object) -> str | None:
    """Check a text of one line, which may be empty."""
    return line(value, may_be_empty=True)


TEXT, FLAG = _is(str, "a text"), _is(bool, "true or false")
MAPPING, NAMES = _is(dict, "keys and values"), list_of(str, "names")
SEED = whole(0, _MAX_SEED)


def named(what: str, content: Mapping[Any, Any]) -> dict[str, Any]:
    """Check names that become names of files.

    :param what: is named
    :param content: by name
    :raises PlanError: for a name with anything but letters, digits and ``_``
    """
    for key in content:
        if not isinstance(key, str) or not key.replace("_", "").isalnum() or not key.isascii():
            raise PlanError(f"{what}: names have letters, digits and _ only, got {shown(key)}")
    return dict(content)


def fields(
    where: str, content: object, checks: Mapping[Any, Check], required: Iterable[Any] | None = None
) -> dict[Any, Any]:
    """Check keys and values.

    :param where: they are, for the message
    :param content: should be keys and values
    :param checks: known keys, and what their values may be
    :param required: keys that must be there; by default all
    :return: the content
    :raises PlanError: naming the first thing that is wrong
    """
    if not isinstance(content, dict):
        raise PlanError(f"{where} must be keys and values, got {type(content).__name__}")
    for key, value in content.items():
        if key not in checks:
            raise PlanError(f"{where}: {closest('key', key, checks)}")
        wanted = checks[key](value)
        if wanted is not None:
            raise PlanError(f"{where}: {key} must be {wanted}, got {shown(value)}")
    for key in checks if required is None else required:
        if key not in content:
            raise PlanError(f"{where}: {key} is missing")
    return dict(content)


def check_names(where: str, what: str, names: Iterable[object], known: Iterable[str]) -> None:
    """Refuse names that are not known.

    :param where: they are, for the message
    :param what: is named
    :param names: to check
    :param known: the names that exist
    :raises PlanError: for the first one that does not
    """
    known = list(known)
    for name in names:
        if name not in known:
            raise PlanError(f"{where}: {closest(what, name, known)}")
