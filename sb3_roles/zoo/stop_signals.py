"""Stops by signal: Ctrl-C and SIGTERM, from the first import to the last evaluation."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from sb3_roles.common.files import is_writing
from sb3_roles.common.interrupts import begin_stop, is_same_stop

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_STDERR = 2


class SecondSignal(SystemExit):
    """The end of the program: no exit that an environment of anybody's own has asked for."""


class StopSignals:
    """Whether, and how, the user asked to stop.

    Within :meth:`caught` the first SIGINT or SIGTERM raises KeyboardInterrupt, wherever the program
    is; where a file is being replaced, and within :meth:`waiting`, it is only noted, and raised by
    the next :meth:`check`. The second signal ends the program.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self.message = ""
        """to print when the first signal comes, for what may take a moment"""
        self._held = 0
        self._at_once = ""

    @contextmanager
    def caught(self) -> Iterator[StopSignals]:
        """Handle signals, in the main thread; again inside of what has set handlers of its own."""
        earlier = [signal.signal(number, self._note) for number in _SIGNALS]
        try:
            yield self
        finally:
            for number, handler in zip(_SIGNALS, earlier, strict=True):
                # None stands for one that was set by C.
                signal.signal(number, handler or signal.SIG_DFL)

    @contextmanager
    def at_once(self, message: str) -> Iterator[None]:
        """Let a signal end the process on the spot, while there is nothing to be cleaned up.

        For imports: some of them swallow whatever is raised, and go on.

        :param message: last line of the process
        """
        self._at_once = message
        try:
            yield
        finally:
            self._at_once = ""

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Let a signal wait for the next :meth:`check` behind this block."""
        self._held += 1
        try:
            yield
        finally:
            self._held -= 1

    @contextmanager
    def held(self) -> Iterator[None]:
        """Let a signal wait for the end of this block.

        :raises KeyboardInterrupt: at the end, if there was one
        """
        with self.waiting():
            yield
        self.check()

    def check(self) -> None:
        """Stop, if a signal was noted.

        :raises KeyboardInterrupt: if so
        """
        if self.received is not None:
            raise KeyboardInterrupt

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.received is not None:
            if is_same_stop():
                return
            raise SecondSignal(128 + number)
        begin_stop()
        self.received = number
        message = self._at_once or self.message
        if message:
            # Not print: this may have interrupted it.
            with suppress(OSError):
                os.write(_STDERR, f"{message}\n".encode())
        if self._at_once:
            os._exit(self.exit_code)
        if not self._held and not is_writing(frame):
            raise KeyboardInterrupt

    @property
    def exit_code(self) -> int:
        """130 after SIGINT, as after an interrupt without a signal; 143 after SIGTERM."""
        return 128 + (signal.SIGINT if self.received is None else self.received)
