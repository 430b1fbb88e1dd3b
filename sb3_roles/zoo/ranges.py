"""What a value of a configuration may be, checked without importing torch."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from sb3_roles.common.names import closest, shown

_TEXT_NUMBER = re.compile(r"([+-]?[0-9_]*\.?[0-9]*)[eE]([+-]?)([0-9]+)")
LINEAR = "lin_"


class Range(Protocol):
    """What one value may be."""

    def problem(self, value: Any) -> str | None:
        """Return what is wrong with a value, ``"must be ..., got ..."``; None if nothing is."""


def yaml_number(text: str) -> str | None:
    """Return how YAML 1.1 wants a number to be written that it reads as text; None for a text.

    :param text: such as ``"5e-4"``, which then is ``"5.0e-4"``
    """
    match = _TEXT_NUMBER.fullmatch(text.strip())
    if match is None or not any(digit.isdigit() for digit in match[1]):
        return None
    whole, _, decimals = match[1].partition(".")
    return f"{whole or '0'}.{decimals or '0'}e{match[2] or '+'}{match[3]}"


def schedule_start(value: str) -> float | None:
    """Return the first value of a schedule such as ``lin_5.0e-4``; None for other text."""
    if not value.startswith(LINEAR):
        return None
    try:
        return float(value[len(LINEAR) :])
    except ValueError:
        return None


@dataclass(frozen=True)
class Number:
    """A number between two bounds.

    :param low: smallest value
    :param high: largest value
    :param above: ``low`` itself is not allowed
    :param optional: null is allowed, too
    :param schedule: a linear schedule such as ``lin_5.0e-4`` is allowed, too
    """

    low: float = 0.0
    high: float = math.inf
    above: bool = False
    optional: bool = False
    schedule: bool = False
    whole = False

    def problem(self, value: Any) -> str | None:
        """See :class:`Range`."""
        if value is None and self.optional:
            return None
        number = value
        if isinstance(value, str):
            number = schedule_start(value) if self.schedule else None
            written = yaml_number(value)
            if written is not None:
                return f"is {shown(value)}, which YAML reads as text: write {written}"
        if self._fits(number):
            return None
        return f"must be {self._describe()}, got {shown(value)}"

    def _fits(self, number: Any) -> bool:
        kinds = int if self.whole else (int, float)
        if isinstance(number, bool) or not isinstance(number, kinds):
            return False
        bottom = self.low < number if self.above else self.low <= number
        return bottom and number <= self.high and math.isfinite(number)

    def _describe(self) -> str:
        kind = "whole number" if self.whole else "number"
        # 1e12 is clear, 4.29497e+09 is not.
        low, high = (
            f"{bound:.0f}" if self.whole and 1e6 < bound < 1e12 else f"{bound:g}"
            for bound in (self.low, self.high)
        )
        if math.isinf(self.high):
            text = f"a finite {kind} {'above' if self.above else 'from'} {low}"
        else:
            text = f"a {kind} in {'(' if self.above else '['}{low}, {high}]"
        text += ", a schedule such as lin_5.0e-4" if self.schedule else ""
        return text + (", or null" if self.optional else "")


@dataclass(frozen=True)
class Whole(Number):
    """A whole number between two bounds, see :class:`Number`."""

    low: float = 1
    high: float = 1e12
    whole = True


@dataclass(frozen=True)
class Flag:
    """True or false."""

    optional: bool = False

    def problem(self, value: Any) -> str | None:
        """See :class:`Range`."""
        if isinstance(value, bool) or (value is None and self.optional):
            return None
        return f"must be true or false, got {shown(value)}"


@dataclass(frozen=True)
class Text:
    """Any text.

    :param optional: None is allowed, too
    """

    optional: bool = False

    def problem(self, value: Any) -> str | None:
        """See :class:`Range`."""
        if isinstance(value, str) or (self.optional and value is None):
            return None
        return f"must be a text{' or null' if self.optional else ''}, got {shown(value)}"


@dataclass(frozen=True)
class Choice:
    """One of some names.

    :param names: what is allowed
    :param matrix: weights by role and component are allowed, too
    """

    names: tuple[str, ...]
    matrix: bool = False

    def problem(self, value: Any) -> str | None:
        """See :class:`Range`."""
        if self.matrix and isinstance(value, Mapping):
            for role, weights in value.items():
                problem = Weights().problem(weights)
                if problem is not None:
                    return f"of {shown(role)} {problem}"
            return None
        return None if value in self.names else f"is {closest('value', value, self.names)}"


@dataclass(frozen=True)
class Weights:
    """Names and their weights."""

    optional: bool = False

    def problem(self, value: Any) -> str | None:
        """See :class:`Range`."""
        if value is None and self.optional:
            return None
        if not isinstance(value, Mapping) or not all(isinstance(name, str) for name in value):
            form = "weights by name, such as {explore: 0.4, cover: 0.6}"
            return f"must be {form}, got {shown(value)}"
        for name, weight in value.items():
            problem = Number(low=-1e6, high=1e6).problem(weight)
            if problem is not None:
                return f"{name} {problem}"
        return None


@dataclass(frozen=True)
class Items:
    """A list.

    :param item: what each of its entries may be; None for texts
    :param optional: null is allowed, too
    :param least: shortest length
    :param most: longest length; None for any
    """

    item: Range | None = None
    optional: bool = False
    least: int = 0
    most: int | None = None

    def problem(self, value: Any) -> str | None:
        """See :class:`Range`."""
        if value is None and self.optional:
            return None
        is_list = isinstance(value, Sequence) and not isinstance(value, str)
        if not is_list or not self.least <= len(value) <= (self.most or len(value)):
            length = "" if self.most == self.least else "at least "
            return f"must be a list of {length}{self.least}, got {shown(value)}"
        for entry in value:
            problem = (self.item or Text()).problem(entry)
            if problem is not None:
                return f"entry {problem}"
        return None


@dataclass(frozen=True)
class OneOrMany:
    """One value, or a list of them.

    :param item: what each of them may be
    """

    item: Range

    def problem(self, value: Any) -> str | None:
        """See :class:`Range`."""
        if isinstance(value, Sequence) and not isinstance(value, str):
            return Items(self.item, least=1).problem(value)
        return self.item.problem(value)


@dataclass(frozen=True)
class Options:
    """A mapping with known keys.

    :param keys: what each of them may be
    """

    keys: Mapping[str, Range]

    def problem(self, value: Any) -> str | None:
        """See :class:`Range`."""
        if not isinstance(value, Mapping):
            return f"must be keys and values, got {shown(value)}"
        found = problems("", value, self.keys)
        return "; ".join(found) if found else None


def problems(where: str, values: Any, allowed: Mapping[str, Range]) -> list[str]:
    """Check a mapping, and find all that is wrong.

    :param where: the mapping's name, before each message; empty for the top level
    :param values: what was given
    :param allowed: known keys, and what their values may be
    :return: one line per problem
    """
    prefix = f"{where}." if where else ""
    if not isinstance(values, Mapping):
        return [f"{where or 'the configuration'} must be a mapping of keys, got {shown(values)}"]
    found = []
    for key, value in values.items():
        if key not in allowed:
            found.append(closest(f"key in {where}" if where else "key", key, allowed))
            continue
        problem = allowed[key].problem(value)
        if problem is not None:
            found.append(f"{prefix}{key} {problem}")
    return found
