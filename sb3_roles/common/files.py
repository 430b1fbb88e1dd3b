"""Small files that are always whole."""

from __future__ import annotations

import csv
import errno
import io
import os
import secrets
import stat
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

# Files are written in milliseconds; a partial one of that age has lost its writer.
_STALE_SECONDS = 600.0


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that a reader, or an interruption, never meets half of it.

    :param path: its folder is made if it does not exist
    :param content: all of it
    :raises OSError: if it can not be written; an earlier file of that name is whole then
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # Of this call: another process, or machine, may be writing the same file.
    partial = path.with_name(f"{path.name}.{os.getpid()}-{secrets.token_hex(4)}.partial")
    try:
        partial.write_bytes(content)
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        if error.filename is None:
            # A full disk is not said to be that of any file.
            error.filename = str(path)
        raise


def open_regular(path: str | Path) -> BinaryIO:
    """Open a file to read, if it is one: no pipe that waits for a writer, no device without end.

    :param path: the file, or a link to one
    :raises OSError: if it is something else, or can not be opened
    """
    mode = os.stat(path).st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    # The flag, where the system has it, for what is put in its place in between.
    file = os.fdopen(os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)), "rb")
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return file


def remove_stale(folder: Path, below: bool = False) -> None:
    """Remove what killed writers of :func:`write_atomically` left, if it is some minutes old.

    :param folder: of the files
    :param below: also in all folders below it
    """
    latest = time.time() - _STALE_SECONDS
    for path in folder.glob(f"{'**/' if below else ''}*.[0-9]*.partial"):
        # Another process may clean as well, or the folder be read-only.
        with suppress(OSError):
            if path.stat().st_mtime < latest:
                path.unlink()


def csv_bytes(header: Iterable[str], rows: Iterable[Iterable[Any]]) -> bytes:
    """Return a table as the bytes of a csv file."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue().encode()
