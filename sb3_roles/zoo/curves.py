"""``sb3-roles curves``: the evaluations of several runs over joint steps, seeds side by side."""

from __future__ import annotations

import csv
import json
import math
from argparse import Namespace
from collections import defaultdict
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any

from sb3_roles.common.names import closest
from sb3_roles.zoo.config import CONFIG_FILE, read_yaml
from sb3_roles.zoo.options import UsageError, output_file, positive_number

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Subparsers

EVALUATIONS_FILE = "evaluations.csv"
# Fractions, which are printed as percent.
_FRACTIONS = ("explo_paper", "explo_true", "cover", "t90_share")
_STEPS = "env_steps"

# Algorithm -> joint steps -> metric -> one value per run.
Curves = dict[str, dict[int, dict[str, list[float]]]]


def add_parser(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "curves",
        help="learning curves of several runs",
        description="Print the held-out evaluations of runs over joint steps as a Markdown table, "
        "mean [lowest .. highest] over the runs of each algorithm.",
    )
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run folders")
    parser.add_argument(
        "--metrics",
        nargs="+",
        default=["explo_paper", "cover"],
        metavar="NAME",
        help="columns of evaluations.csv",
    )
    parser.add_argument(
        "--every",
        type=positive_number(1e12),
        default=100_000,
        metavar="N",
        help="print the first evaluation after each N joint steps",
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
    curves = read_curves([Path(one) for one in args.runs], args.metrics)
    if args.json:
        print(json.dumps(curves, indent=2))
    else:
        print("\n".join(_table(curves, args.metrics, args.every)))
    if args.plot:
        _plot(curves, args.metrics, Path(args.plot))
    return 0


def read_curves(runs: list[Path], metrics: list[str]) -> Curves:
    """Collect the evaluations of runs, by algorithm.

    :param runs: run folders
    :param metrics: columns to read
    :return: see ``Curves``; steps that not all runs of an algorithm have got to are left out
    :raises UsageError: if a file is missing or damaged, or a metric is unknown
    """
    curves: Curves = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    n_runs: dict[str, int] = defaultdict(int)
    for folder in runs:
        path = folder / EVALUATIONS_FILE
        if not path.is_file() or not (folder / CONFIG_FILE).is_file():
            raise UsageError(f"{folder}: no run folder with {EVALUATIONS_FILE} and {CONFIG_FILE}")
        algo = str(read_yaml(folder / CONFIG_FILE).get("algo"))
        n_runs[algo] += 1
        with open(path, newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        for row in rows:
            for metric in metrics:
                if metric not in row:
                    raise UsageError(f"{path}: {closest('metric', metric, row)}")
                try:
                    value = float(row[metric] or "nan")
                    curves[algo][int(row[_STEPS])][metric].append(value)
                except (TypeError, ValueError):
                    raise UsageError(f"{path}: a row is damaged: {dict(row)}") from None
    return {
        algo: {
            steps: dict(values)
            for steps, values in sorted(by_step.items())
            if all(len(values[metric]) == n_runs[algo] for metric in metrics)
        }
        for algo, by_step in curves.items()
    }


def _cell(metric: str, values: list[float]) -> str:
    scale, suffix = (100.0, " %") if metric in _FRACTIONS else (1.0, "")
    known = [scale * value for value in values if not math.isnan(value)]
    if not known:
        return "-"
    return f"{mean(known):.1f}{suffix} [{min(known):.1f} .. {max(known):.1f}]"


def _table(curves: Curves, metrics: list[str], every: float) -> list[str]:
    columns = [(algo, metric) for algo in curves for metric in metrics]
    lines = [
        "| joint steps | " + " | ".join(f"{algo} {metric}" for algo, metric in columns) + " |",
        "|---" * (len(columns) + 1) + "|",
    ]
    printed = 0
    for steps in sorted({steps for by_step in curves.values() for steps in by_step}):
        if steps < printed + every:
            continue
        printed = int(steps // every * every)
        cells = [
            _cell(metric, curves[algo].get(steps, {}).get(metric, [])) for algo, metric in columns
        ]
        lines.append(f"| {steps:,} | " + " | ".join(cells) + " |")
    return lines


def _plot(curves: Curves, metrics: list[str], file: Path) -> None:
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
        for style, (algo, by_step) in zip(styles * len(curves), curves.items(), strict=False):
            steps = [n / 1000.0 for n in by_step]
            values: list[Any] = [[scale * v for v in one[metric]] for one in by_step.values()]
            axes.plot(steps, [mean(v) for v in values], style, label=algo)
            axes.fill_between(steps, [min(v) for v in values], [max(v) for v in values], alpha=0.2)
        axes.set_xlabel("joint steps (thousands)")
        axes.set_ylabel(f"{metric} (%)" if metric in _FRACTIONS else metric)
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(file, dpi=120)
