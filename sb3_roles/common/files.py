"""Small files that are always whole."""

from __future__ import annotations

import csv
import errno
import io
import os
import secrets
import stat
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import IO, Any, BinaryIO

# What a folder answers where the file system keeps no order between it and its files.
_UNSYNCED = (errno.EINVAL, errno.ENOTSUP)
# Files are written in milliseconds; a partial one of that age has lost its writer.
_STALE_SECONDS = 600.0
_PARTIAL = ".partial"
_PARTIALS = f"*.[0-9]*{_PARTIAL}"


def write_atomically(path: Path, content: bytes) -> None:
    """Write a small file, see :func:`replace_file`.

    :param path: its folder is made if it does not exist
    :param content: all of it
    :raises OSError: if it can not be written; an earlier file of that name is whole then
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, lambda file: file.write(content))


def replace_file(
    path: Path,
    write: Callable[[IO[bytes]], object],
    check: Callable[[Path], object] | None = None,
) -> None:
    """Write a file so that a reader, or a crash of program or machine, never meets half of it.

    It is written under another name, forced to the disk, and then takes the place of an earlier
    file. When this returns, the new file is on the disk, under its name.

    :param path: the file, in a folder that exists
    :param write: writes the content
    :param check: looks at what was written, and raises if it is not sound
    :raises OSError: if it can not be written; an earlier file of that name is whole then
    """
    # Of this call: another process, or machine, may be writing the same file.
    partial = path.with_name(f"{path.name}.{os.getpid()}-{secrets.token_hex(4)}{_PARTIAL}")
    try:
        with open(partial, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        if check is not None:
            check(partial)
        os.replace(partial, path)
        _sync_folder(path.parent)
    except OSError as error:
        if error.filename is None:
            # A full disk is not said to be that of any file.
            error.filename = str(path)
        raise
    finally:
        with suppress(FileNotFoundError):
            partial.unlink()


def is_writing(frame: FrameType | None) -> bool:
    """Return whether a file is being replaced, which an exception of a signal would break off.

    :param frame: where the thread is
    """
    while frame is not None:
        if frame.f_code is replace_file.__code__:
            return True
        frame = frame.f_back
    return False


def append(path: Path, content: bytes) -> None:
    """Add to the end of a file; it is on the disk when this returns.

    :param path: made if it does not exist
    :param content: what to add
    :raises OSError: if it can not be written; part of it may be there then
    """
    try:
        with open(path, "ab") as file:
            file.write(content)
            file.flush()
            # A checkpoint counts on the rows of the logs before it.
            os.fsync(file.fileno())
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


def _sync_folder(folder: Path) -> None:
    if not hasattr(os, "O_DIRECTORY"):
        return  # Folders can not be opened on this system.
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _UNSYNCED:
            raise
    finally:
        os.close(descriptor)


def remove_partial(folder: Path) -> None:
    """Remove what killed writers of :func:`replace_file` left in a folder that nobody writes to.

    :param folder: of the files
    """
    for path in folder.glob(_PARTIALS):
        path.unlink(missing_ok=True)


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
    """Remove what killed writers of :func:`replace_file` left, if it is some minutes old.

    :param folder: of the files
    :param below: also in all folders below it
    """
    latest = time.time() - _STALE_SECONDS
    for path in folder.glob(f"{'**/' if below else ''}{_PARTIALS}"):
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
