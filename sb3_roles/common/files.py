"""Small files that are always whole."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that a reader, or an interruption, never meets half of it.

    :param path: its folder is made if it does not exist
    :param content: all of it
    :raises OSError: if it can not be written; an earlier file of that name is whole then
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # Of this process: another one may be writing the same file.
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        partial.write_bytes(content)
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        if error.filename is None:
            # A full disk is not said to be that of any file.
            error.filename = str(path)
        raise


def csv_bytes(header: Iterable[str], rows: Iterable[Iterable[Any]]) -> bytes:
    """Return a table as the bytes of a csv file."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue().encode()
