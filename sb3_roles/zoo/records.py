"""``sb3-roles records``: what a file of records is, and the metrics of its episodes."""

from __future__ import annotations

import json
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_roles.common.files import open_regular
from sb3_roles.zoo.options import UsageError

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Subparsers

_PARQUET = b"PAR1"


def add_parser(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "records",
        help="summarize a file of recorded episodes",
        description="Print what was recorded in a file that evaluate or simulate wrote with --out, "
        "and its metrics; pandas.read_parquet reads its steps.",
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="the records")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=run)


def run(args: Namespace) -> int:
    """Print the summary.

    :param args: parsed arguments
    :return: exit code
    :raises UsageError: if the file holds no sound records
    """
    _look_at(args.file)
    from sb3_roles.evaluation.records import RecordsError, read_records
    from sb3_roles.zoo.summaries import report_of, table_of

    try:
        report = report_of(read_records(args.file))
    except RecordsError as error:
        raise UsageError(str(error)) from None
    if args.json:
        print(json.dumps(report, indent=2, allow_nan=False))
        return 0
    print(table_of(report))
    config = report["config"]
    options = "".join(f", {key} {value}" for key, value in config["controller_options"].items())
    versions = ", ".join(f"{name} {version}" for name, version in config["versions"].items())
    print(f"\n{config['controller_class']}{options}")
    print(f"config {config['config_hash'][:16]}, sb3_roles {config['version']}, {versions}")
    return 0


def _look_at(path: Path) -> None:
    """Refuse what is no Parquet file, before what reads one is imported."""
    try:
        with open_regular(path) as file:
            begins = file.read(len(_PARQUET))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from None
    if begins != _PARQUET:
        raise UsageError(f"{path}: damaged, or no Parquet file: it begins with {begins!r}")
