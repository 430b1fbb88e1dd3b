"""What a run folder tells of its training, for the card of its weights."""

from __future__ import annotations

import csv
import io
import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_roles.common.files import csv_bytes
from sb3_roles.common.names import one_line
from sb3_roles.zoo.config import read_yaml
from sb3_roles.zoo.model_card import CURVE_COLUMNS
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.run_folder import ARGS_FILE, COMMAND_FILE

EVALUATIONS, PROGRESS = "evaluations.csv", "progress.csv"
DEMONSTRATIONS = "demonstrations.yml"
MAX_LINES, _MAX_POINTS = 100, 12
# Of progress.csv: what a reader compares, and the figure of the training needs.
_COLUMNS = (
    "time/env_steps",
    "time/time_elapsed",
    "rollout/length",
    "rollout/explo_paper",
    "rollout/explo_true",
    "rollout/cover",
    "rollout/return",
    "train/entropy",
    "train/loss",
    "validation/loss",
    "validation/accuracy",
)
# Options of a training that decide about its weights or its curve.
_OPTIONS = {"num_threads": None, "eval_freq": 50_000, "eval_episodes": 100, "device": "auto"}
_VERSION = re.compile(r"# sb3_roles ([\w.+-]+), commit (.+)")
_PACKAGE = re.compile(r"([\w.-]+) ([\w.+-]+)")
_NO_COMMIT = ("null", "unknown")

Table = list[dict[str, str]]


def read_table(path: Path) -> Table:
    """Read a csv file of a run.

    :param path: the file; a last line without its end is left out
    :return: a dict for each line; empty without a file
    :raises UsageError: if it is damaged
    """
    if not path.is_file():
        return []
    try:
        content = path.read_bytes()
        text = content[: content.rfind(b"\n") + 1].decode()
        lines = list(csv.DictReader(io.StringIO(text, newline=""), strict=True))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from None
    except (csv.Error, ValueError) as error:
        raise UsageError(f"{path}: damaged: {one_line(error)}") from None
    if any(None in line or None in line.values() for line in lines):
        raise UsageError(f"{path}: damaged: a row has not as many entries as the first line")
    return lines


def thinned(table: Table, n: int) -> Table:
    """Return at most ``n`` lines, evenly spread, the last one among them."""
    if len(table) <= n:
        return table
    return [table[(k + 1) * len(table) // n - 1] for k in range(n)]


def small_progress(table: Table) -> bytes:
    """Return the log of a training as a small csv file.

    :param table: of ``progress.csv``, with at least one line
    :return: some columns of some lines, six digits of each number
    """
    columns = [name for name in _COLUMNS if name in table[0]]
    # A step is a whole number of many digits.
    return csv_bytes(
        columns,
        [
            [line[name] if name == "time/env_steps" else _short(line[name]) for name in columns]
            for line in thinned(table, MAX_LINES)
        ],
    )


def _short(text: str) -> str:
    return text and format(float(text), ".6g")


def small_evaluations(table: Table) -> bytes:
    """Return the evaluations of a training, at most ``MAX_LINES`` of them.

    :param table: of ``evaluations.csv``, with at least one line
    """
    return csv_bytes(table[0], [line.values() for line in thinned(table, MAX_LINES)])


def curve_of(table: Table) -> dict[str, Any]:
    """Return some points of the learning curve.

    :param table: of ``evaluations.csv``
    :return: ``columns``, and one list for each of the ``points``; None for what was not measured
    """
    points = [
        [int(line["env_steps"]), *(_number(line.get(name)) for name in CURVE_COLUMNS[1:])]
        for line in thinned(table, _MAX_POINTS)
    ]
    return {"columns": list(CURVE_COLUMNS), "points": points}


def _number(text: str | None) -> float | None:
    return round(float(text), 4) if text else None


def wall_time(table: Table) -> int | None:
    """Return the seconds that a training took.

    :param table: of ``progress.csv``
    :return: None if it does not say
    """
    times = [line["time/time_elapsed"] for line in table if line.get("time/time_elapsed")]
    return round(float(times[-1])) if times else None


def training_of(run: Path, config_path: str) -> dict[str, Any]:
    """Return how a run was trained, and the command that repeats it.

    :param run: the folder
    :param config_path: of the published configuration, as the command names it
    :return: ``command``, ``commit`` (None: unknown), ``versions``, ``commands`` (1, and
        one more for each time that it was resumed), and ``demonstrations``, if it learned from any
    :raises UsageError: if a file of it is damaged
    """
    try:
        lines = (run / COMMAND_FILE).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        lines = []
    versions: dict[str, str] = {}
    commit = None
    # The first command began the training.
    for line in lines:
        match = _VERSION.fullmatch(line)
        if match and "sb3_roles" not in versions:
            versions["sb3_roles"] = match[1]
            commit = None if match[2] in _NO_COMMIT else match[2]
        elif line.startswith("# python ") and "python" not in versions:
            pairs = map(_PACKAGE.fullmatch, line.removeprefix("# ").split(", "))
            versions.update({pair[1]: pair[2] for pair in pairs if pair})
    n_commands = sum(bool(line) and not line.startswith("#") for line in lines)
    return {
        "command": _command(run, config_path),
        "commit": commit,
        "versions": versions,
        "commands": max(1, n_commands),
        **_demonstrations(run),
    }


def _command(run: Path, config_path: str) -> str:
    words = ["sb3-roles", "train", "--conf-file", config_path]
    options = _mapping(run / ARGS_FILE)
    for name, default in _OPTIONS.items():
        value = options.get(name, default)
        if value != default and isinstance(value, (int, str)):
            words += [f"--{name.replace('_', '-')}", str(value)]
    return shlex.join(words)


def _demonstrations(run: Path) -> dict[str, Any]:
    found = {}
    for name, value in _mapping(run / DEMONSTRATIONS).items():
        if isinstance(value, (int, float, str)):
            # Of a file, the name: where it lay is of no use to others.
            found[str(name)] = Path(value).name if isinstance(value, str) else value
    return {"demonstrations": found} if found else {}


def _mapping(path: Path) -> Mapping[Any, Any]:
    content = read_yaml(path) if path.is_file() else {}
    return content if isinstance(content, Mapping) else {}


def published_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the configuration of a run without the place of a file of demonstrations.

    :param config: checked
    """
    kept = dict(config)
    if isinstance(kept.get("demonstrations"), str):
        kept["demonstrations"] = Path(kept["demonstrations"]).name
    return kept
