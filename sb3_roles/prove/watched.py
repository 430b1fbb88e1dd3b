"""Training that notes what it is doing, so that it can be stopped in the middle of it.

``python -m sb3_roles.prove.watched BOARD train ...`` is ``sb3-roles train ...``, and the file BOARD
says at any moment which phase it is in.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

IMPORT, START, BETWEEN = "import", "start", "between"
ROLLOUT, UPDATE, SAVE, EVALUATION, FINAL = "rollout", "update", "save", "evaluation", "final"
_WIDTH = 32


class Moment(NamedTuple):
    """Where a training is."""

    phase: str
    """``import`` before signals are handled, ``start`` before the first rollout, then others"""
    entered: int
    """of phases that were entered"""


class Board:
    """A file with the phase of a training.

    :param path: made if it does not exist
    """

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_RDWR | os.O_CREAT)
        self._count = 0

    def write(self, phase: str) -> None:
        """Say that a phase is entered."""
        self._count += 1
        os.pwrite(self._file, f"{phase} {self._count}".ljust(_WIDTH).encode(), 0)

    def watch(self, owner: Any, name: str, phase: str) -> None:
        """Note when a function runs.

        :param owner: class, object or module
        :param name: of the function
        :param phase: to note
        """
        own: Callable[..., Any] = getattr(owner, name)

        def watched(*args: Any, **kwargs: Any) -> Any:
            before = self.read().phase
            self.write(phase)
            try:
                return own(*args, **kwargs)
            finally:
                self.write(BETWEEN if before == START else before)

        setattr(owner, name, watched)

    def read(self) -> Moment:
        """Return where the training is."""
        words = os.pread(self._file, _WIDTH, 0).split()
        return Moment(words[0].decode(), int(words[1])) if len(words) == 2 else Moment(IMPORT, 0)

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)


def _watch_training(board: Board) -> None:
    """Note the phases from here on; imports torch."""
    board.write(START)
    from sb3_roles.common.checkpoint import CheckpointFolder
    from sb3_roles.evaluation.callback import EvaluationCallback
    from sb3_roles.zoo import job

    make_model = job.make_model

    def make_watched(*args: Any, **kwargs: Any) -> Any:
        model = make_model(*args, **kwargs)
        board.watch(model, "collect_rollouts", ROLLOUT)
        board.watch(model, "train", UPDATE)
        return model

    vars(job)["make_model"] = make_watched
    board.watch(CheckpointFolder, "save", SAVE)
    board.watch(EvaluationCallback, "run", EVALUATION)
    board.watch(job, "_evaluate", FINAL)


def main() -> int:
    """Run the command."""
    board = Board(Path(sys.argv[1]))
    from sb3_roles.zoo import cli, train

    prepare_process = train.prepare_process

    def prepare() -> None:
        # Signals are handled by now, and torch is not imported yet.
        prepare_process()
        _watch_training(board)

    vars(train)["prepare_process"] = prepare
    return cli.main(sys.argv[2:])


if __name__ == "__main__":
    sys.exit(main())
