"""Ctrl-C, heard once however often it comes."""

from __future__ import annotations

import atexit
import os
import signal
import time
from types import FrameType

SAME_STOP = 0.3
"""Seconds within which a second signal is the first one's.

timeout, srun and some terminals signal a process and its group; a hasty hand presses twice.
"""
_last = float("-inf")


def begin_stop() -> None:
    """Note that a signal came that stops what is done."""
    global _last
    _last = time.monotonic()


def is_same_stop() -> bool:
    """Return whether a signal that comes now is that of the last stop once more."""
    return time.monotonic() - _last < SAME_STOP


def interrupt(number: int, frame: FrameType | None) -> None:
    """Handle SIGINT: raise KeyboardInterrupt, but not within ``SAME_STOP`` seconds of the last.

    A second one would interrupt what handles the first, and end in a traceback.
    """
    if not is_same_stop():
        begin_stop()
        raise KeyboardInterrupt


def interrupt_once() -> None:
    """Handle SIGINT by :func:`interrupt` from now on, where Python would raise each time."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)


def leave_at_interrupt() -> None:
    """Let SIGINT end a process on the spot that is about to end anyway, without a traceback."""
    if signal.getsignal(signal.SIGINT) is interrupt:
        signal.signal(signal.SIGINT, _leave)
        # For the very last, when Python has put the system's handler back, which kills.
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)


def _leave(number: int, frame: FrameType | None) -> None:
    if not is_same_stop():
        os._exit(128 + number)
