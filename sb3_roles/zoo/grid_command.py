"""What the commands share that play a grid of episodes: ``tables``, ``report``, ``ablations``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_roles.zoo.options import UsageError, check_folder, whole_number
from sb3_roles.zoo.row_configs import LOGS

if TYPE_CHECKING:
    from sb3_roles.evaluation.grid.play import Outcome
    from sb3_roles.evaluation.grid.store import RecordStore

EXIT_ROWS_FAILED = 3
RECORDS = "records"


def add_jobs(parser: argparse._ActionsContainer) -> None:
    """Add ``--jobs``.

    :param parser: of the command, or a group of its options
    """
    parser.add_argument(
        "--jobs",
        type=whole_number(1, 1024),
        metavar="N",
        help="processes that play (default: one for each CPU)",
    )


def add_folders(parser: argparse.ArgumentParser, out: Path) -> None:
    """Add ``--out`` and ``--log-folder``.

    :param parser: of the command
    :param out: default of the one
    """
    parser.add_argument(
        "-o", "--out", type=Path, default=out, metavar="DIR", help="of all that is made"
    )
    parser.add_argument(
        "-f", "--log-folder", type=Path, default=LOGS, metavar="DIR", help="of the runs"
    )


def add_plan(parser: argparse.ArgumentParser, stem: str, dry_run: str) -> None:
    """Add ``--plan`` and ``--dry-run``.

    :param parser: of the command
    :param stem: of the file that is the plan otherwise
    :param dry_run: help of the other
    """
    parser.add_argument(
        "--plan", type=Path, metavar="FILE", help=f"instead of zoo_configs/{stem}.yml"
    )
    parser.add_argument("--dry-run", action="store_true", help=dry_run)


def check_logs(folder: Path, option: str = "--log-folder") -> None:
    """Find out whether a folder of runs is there; that of new runs may not be there yet.

    :param folder: of runs
    :param option: that named it
    :raises UsageError: if there is none
    """
    if folder != LOGS and not folder.is_dir():
        raise UsageError(f"argument {option}: {str(folder)!r} is no folder")


def check_out(folder: Path, write: bool) -> None:
    """Find out, before work that takes long, whether a folder can be written to.

    :param folder: of all that is made
    :param write: make it if it is not there; otherwise it is only looked at
    :raises UsageError: if it can not
    """
    check_folder("--out", folder)
    if write:
        folder.mkdir(parents=True, exist_ok=True)


def tell(line: str) -> None:
    """Print a line on stderr, above a progress bar if there is one."""
    from tqdm import tqdm  # type: ignore[import-untyped]

    tqdm.write(line, file=sys.stderr)
    sys.stderr.flush()


@contextmanager
def said_if_stopped(store: RecordStore) -> Iterator[None]:
    """Say, when Ctrl-C ends what is done within, that nothing is lost.

    :param store: of what is played
    """
    try:
        yield
    except KeyboardInterrupt:
        tell(f"stopped; {store.folder} keeps what was played, and the same command goes on")
        raise


def exit_code(outcome: Outcome) -> int:
    """Say which rows are left out, if there are any.

    :param outcome: of what was played
    :return: exit code of the command
    """
    if not outcome.failures:
        return 0
    tell(f"left out: {', '.join(outcome.failures)}")
    return EXIT_ROWS_FAILED
