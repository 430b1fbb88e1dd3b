"""Short texts for messages: unknown names, errors, spans of numbers."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def closest(what: str, name: object, allowed: Iterable[object]) -> str:
    """One line for an unknown name: what is allowed, and the closest match.

    :param what: the kind of thing that was named
    :param name: the unknown name
    :param allowed: the known names, or numbers
    """
    known = {str(one): one for one in allowed}
    close = difflib.get_close_matches(str(name), known, n=1)
    hint = f"; did you mean {known[close[0]]!r}?" if close else ""
    return f"unknown {what} {name!r}: allowed are {', '.join(known) or 'none'}{hint}"


def one_line(error: BaseException) -> str:
    """Return what an error says, for the end of a message of one line."""
    return " ".join(str(error).split())


def span_text(low: int, high: int) -> str:
    """Return a span of whole numbers, one number if it is one: ``1,000 to 5,000``."""
    return f"{low:,}" if low == high else f"{low:,} to {high:,}"
