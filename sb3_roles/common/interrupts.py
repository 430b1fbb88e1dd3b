"""Ctrl-C, heard once however often it comes."""

from __future__ import annotations

import signal
import time
from types import FrameType

SAME_STOP = 0.3
"""Seconds within which a second signal is the first one's.

timeout, srun and some terminals signal a process and its group; a hasty hand presses twice.
"""
_last = float("-inf")


def interrupt(number: int, frame: FrameType | None) -> None:
    """Handle SIGINT: raise KeyboardInterrupt, but not while that of the last one is on its way.

    A second one would interrupt what handles the first, and end in a traceback.
    """
    global _last
    now = time.monotonic()
    if now - _last >= SAME_STOP:
        _last = now
        raise KeyboardInterrupt


def interrupt_once() -> None:
    """Handle SIGINT by :func:`interrupt` from now on, where Python would raise each time.

    A process that was started to ignore it goes on to do so.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)
