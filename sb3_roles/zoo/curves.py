"""``sb3-roles curves``: the evaluations of several runs over joint steps, seeds side by side."""

from __future__ import annotations

import csv
import json
import math
from argparse import Namespace
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from glob import glob
from io import BytesIO
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any

from sb3_roles.common.files import write_atomically
from sb3_roles.common.names import closest
from sb3_roles.zoo.config import CONFIG_FILE, read_yaml
from sb3_roles.zoo.options import UsageError, output_file, positive_number

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Subparsers

EVALUATIONS_FILE = "evaluations.csv"
# Fractions, which are printed as percent.
_FRACTIONS = ("explo_paper", "explo_true", "cover", "t90_share")
_STEPS = "env_steps"
_METRICS = ("explo_paper", "cover")
_EVERY = 100_000


@dataclass(frozen=True)
class Run:
    """The evaluations of one run.

    :param steps: joint steps at which it was evaluated, increasing
    :param values: metric -> one value for each of ``steps``, nan where it has none
    """

    steps: Sequence[int]
    values: Mapping[str, Sequence[float]]

    def reaches(self, step: int) -> bool:
        """Whether ``step`` lies between the first and the last evaluation."""
        return bool(self.steps) and self.steps[0] <= step <= self.steps[-1]

    def at(self, metric: str, step: int) -> float:
        """Return a metric at ``step``, on a straight line between the evaluations around it."""
        after = bisect_left(self.steps, step)
        values = self.values[metric]
        if self.steps[after] == step:
            return values[after]
        first, last = self.steps[after - 1], self.steps[after]
        share = (step - first) / (last - first)
        return (1.0 - share) * values[after - 1] + share * values[after]


# Label -> the runs of which the mean is taken.
Curves = dict[str, list[Run]]


def add_parser(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "curves",
        help="learning curves of several runs",
        description="Print the held-out evaluations of runs over joint steps as a Markdown table, "
        "mean [lowest .. highest] over the runs of each label. Between two evaluations of a run a "
        "straight line is taken: runs need not be evaluated at the same steps.",
    )
    parser.add_argument(
        "runs",
        nargs="+",
        metavar="[LABEL=]RUN",
        help="run folders, or patterns such as 'logs/hmappo/*'; runs of one label are averaged, by "
        "default those of one algorithm",
    )
    parser.add_argument(
        "--metrics",
        nargs="+",
        default=None,
        metavar="NAME",
        help="columns of evaluations.csv (default: explo_paper and cover, or else return)",
    )
    parser.add_argument(
        "--every",
        type=positive_number(1e12),
        default=None,
        metavar="N",
        help="print the first evaluation after each N joint steps (default: 100000, or all of them "
        "where no run is that long)",
    )
    parser.add_argument("--json", action="store_true", help="print all evaluations as JSON")
    parser.add_argument("--plot", type=output_file(".png"), metavar="FILE", help="draw them, too")
    parser.set_defaults(run=run)


def run(args: Namespace) -> int:
    """Print the curves.

    :param args: parsed arguments
    :return: exit code
    :raises UsageError: if a run has no evaluations, or no such metric
    """
    metrics = args.metrics or _default_metrics(args.runs)
    curves = read_curves(args.runs, metrics)
    if args.json:
        print(json.dumps(_report(curves, metrics), indent=2))
    else:
        print("\n".join(_table(curves, metrics, args.every or _default_every(curves))))
    if args.plot:
        _plot(curves, metrics, Path(args.plot))
    return 0


def _default_metrics(runs: Sequence[str]) -> list[str]:
    """Those of area search, or the return if a run is on an environment that has none of them."""
    for _, folders in map(_folders, runs):
        for folder in folders:
            path = folder / EVALUATIONS_FILE
            if path.is_file():
                with open(path, newline="", encoding="utf-8", errors="replace") as file:
                    if _METRICS[0] not in next(csv.reader(file), _METRICS):
                        return ["return"]
    return list(_METRICS)


def _default_every(curves: Curves) -> int:
    longest = max(run.steps[-1] for runs in curves.values() for run in runs)
    return _EVERY if longest >= _EVERY else 1


def read_curves(runs: Sequence[str], metrics: Sequence[str]) -> Curves:
    """Collect the evaluations of runs, by label.

    :param runs: ``LABEL=RUN`` or ``RUN``, where RUN is a run folder or a pattern of some; without a
        label, the algorithm is the label
    :param metrics: columns to read
    :return: see ``Curves``; a folder that is named twice is read once per label
    :raises UsageError: if a file is missing or damaged, or a metric is unknown
    """
    curves: Curves = {}
    seen = set()
    for label, folders in [_folders(text) for text in runs]:
        for folder in folders:
            config = folder / CONFIG_FILE
            if not config.is_file():
                raise UsageError(f"{folder}: no run folder, it has no {CONFIG_FILE}")
            if not (folder / EVALUATIONS_FILE).is_file():
                raise UsageError(
                    f"{folder}: no evaluation yet: train makes one after each --eval-freq joint "
                    f"steps, in {EVALUATIONS_FILE}"
                )
            name = label
            if name is None:
                content = read_yaml(config)
                name = str(content.get("algo")) if isinstance(content, dict) else "unknown"
            if (name, folder.resolve()) not in seen:
                seen.add((name, folder.resolve()))
                curves.setdefault(name, []).append(_read(folder / EVALUATIONS_FILE, metrics))
    return curves


def _folders(text: str) -> tuple[str | None, list[Path]]:
    """Return the label and the folders of one argument."""
    label, equals, pattern = text.partition("=")
    # A folder's name may hold an equals sign, too.
    if not equals or Path(text).exists():
        label, pattern = "", text
    elif not label.strip() or not pattern:
        raise UsageError(f"argument RUN: must be RUN or LABEL=RUN, got {text!r}")
    if Path(pattern).exists():
        return label.strip() or None, [Path(pattern)]
    found = sorted(path for path in map(Path, glob(pattern)) if path.is_dir())
    if not found:
        raise UsageError(f"{pattern}: no such run folder")
    # Runs are numbered: _10 comes after _9.
    found.sort(key=lambda path: (len(path.name), path.name))
    return label.strip() or None, found


def _read(path: Path, metrics: Sequence[str]) -> Run:
    with open(path, newline="", encoding="utf-8", errors="replace") as file:
        try:
            rows = list(csv.DictReader(file))
        except csv.Error as error:
            raise UsageError(f"{path}: {error}") from None
    by_step: dict[int, list[float]] = {}
    for row in rows:
        for metric in (_STEPS, *metrics):
            if metric not in row:
                raise UsageError(f"{path}: {closest('metric', metric, map(str, row))}")
        try:
            by_step[int(row[_STEPS])] = [float(row[metric] or "nan") for metric in metrics]
        except (TypeError, ValueError):
            raise UsageError(f"{path}: a row is damaged: {dict(row)}") from None
    if not by_step:
        raise UsageError(f"{path}: no evaluation yet")
    steps = sorted(by_step)
    return Run(
        steps, {name: [by_step[step][k] for step in steps] for k, name in enumerate(metrics)}
    )


def _values(runs: Sequence[Run], metric: str, step: int) -> list[float]:
    """Return a metric of all runs; empty before the first evaluation of one and after the last."""
    if not all(run.reaches(step) for run in runs):
        return []
    return [run.at(metric, step) for run in runs]


def _common_steps(runs: Sequence[Run]) -> list[int]:
    """All steps at which one of the runs was evaluated, while all of them were trained."""
    steps = sorted({step for run in runs for step in run.steps})
    return [step for step in steps if all(run.reaches(step) for run in runs)]


def _report(curves: Curves, metrics: Sequence[str]) -> dict[str, Any]:
    """Return label -> joint steps -> metric -> one value per run, null where it has none."""
    return {
        label: {
            step: {
                metric: [
                    None if math.isnan(value) else value for value in _values(runs, metric, step)
                ]
                for metric in metrics
            }
            for step in _common_steps(runs)
        }
        for label, runs in curves.items()
    }


def _cell(metric: str, values: Sequence[float]) -> str:
    scale, suffix = (100.0, " %") if metric in _FRACTIONS else (1.0, "")
    known = [scale * value for value in values if not math.isnan(value)]
    if not known:
        return "-"
    return f"{mean(known):.1f}{suffix} [{min(known):.1f} .. {max(known):.1f}]"


def _table(curves: Curves, metrics: Sequence[str], every: float) -> list[str]:
    columns = [(label, metric) for label in curves for metric in metrics]
    # A label is the user's own text.
    names = [f"{label} {metric}".replace("|", "\\|") for label, metric in columns]
    lines = [
        "| joint steps | " + " | ".join(names) + " |",
        "|---" * (len(columns) + 1) + "|",
    ]
    for step in _table_steps(curves, every):
        cells = [_cell(metric, _values(curves[label], metric, step)) for label, metric in columns]
        lines.append(f"| {step:,} | " + " | ".join(cells) + " |")
    return lines


def _table_steps(curves: Curves, every: float) -> list[int]:
    """For each ``every`` joint steps, the first evaluation at which most labels have a value.

    Of runs that are shorter, it is the last one.
    """
    chosen: dict[int, tuple[int, int]] = {}
    steps = sorted({step for runs in curves.values() for step in _common_steps(runs)})
    for step in steps:
        known = sum(all(run.reaches(step) for run in runs) for runs in curves.values())
        row = int(step // every)
        if row and known > chosen.get(row, (0, 0))[0]:
            chosen[row] = (known, step)
    return [step for _, step in chosen.values()] or steps[-1:]


def _plot(curves: Curves, metrics: Sequence[str], file: Path) -> None:
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise UsageError("argument --plot: install sb3_roles[plots] to draw curves") from None
    figure = Figure(figsize=(5.0 * len(metrics), 3.6), layout="constrained")
    styles = ("-", "--", ":", "-.")
    for axes, metric in zip(
        figure.subplots(1, len(metrics), squeeze=False)[0], metrics, strict=True
    ):
        scale = 100.0 if metric in _FRACTIONS else 1.0
        for style, (label, runs) in zip(styles * len(curves), curves.items(), strict=False):
            points = [(step, _values(runs, metric, step)) for step in _common_steps(runs)]
            known = [
                (step / 1000.0, [scale * value for value in values if not math.isnan(value)])
                for step, values in points
                if not all(map(math.isnan, values))
            ]
            steps, values = [step for step, _ in known], [values for _, values in known]
            axes.plot(steps, [mean(v) for v in values], style, label=label)
            axes.fill_between(steps, [min(v) for v in values], [max(v) for v in values], alpha=0.2)
        axes.set_xlabel("joint steps (thousands)")
        axes.set_ylabel(f"{metric} (%)" if metric in _FRACTIONS else metric)
        axes.grid(alpha=0.3)
        axes.legend()
    image = BytesIO()
    figure.savefig(image, format="png", dpi=120)
    write_atomically(file, image.getvalue())
