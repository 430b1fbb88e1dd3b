"""Short texts for messages: unknown names, errors, spans of numbers."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

_LONGEST = 120


def closest(what: str, name: object, allowed: Iterable[object]) -> str:
    """One line for an unknown name: what is allowed, and the closest match.

    :param what: the kind of thing that was named
    :param name: the unknown name
    :param allowed: the known names, or numbers
    """
    known = {str(one): one for one in allowed}
    folded = {one.lower(): known[one] for one in known}
    # Not of a long text: that search takes minutes.
    close = difflib.get_close_matches(str(name)[:_LONGEST].lower(), folded, n=1)
    hint = f"; did you mean {folded[close[0]]!r}?" if close else ""
    return f"unknown {what} {shown(name)}: allowed are {', '.join(known) or 'none'}{hint}"


def shown(value: object) -> str:
    """Return a value as a message shows it: on one line, printable, and not too long.

    :param value: anything that a user gave
    """
    text = printable(repr(value))
    if len(text) <= _LONGEST:
        return text
    return f"{text[: _LONGEST - 20]}... ({len(text):,} characters)"


def printable(text: str) -> str:
    """Return a text on one line, with what a terminal could not show, or would obey, escaped.

    :param text: such as a message with the name of a file, which may hold anything
    """
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode()
        for c in " ".join(text.split())
    )


def one_line(error: BaseException) -> str:
    """Return what an error says, for the end of a message of one line."""
    return printable(str(error))


def span_text(low: int, high: int) -> str:
    """Return a span of whole numbers, one number if it is one: ``1,000 to 5,000``."""
    return f"{low:,}" if low == high else f"{low:,} to {high:,}"
