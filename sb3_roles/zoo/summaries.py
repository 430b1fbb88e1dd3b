"""What the commands print of records of episodes: one JSON object, or tables for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from sb3_roles.common.durations import short_duration

if TYPE_CHECKING:
    from sb3_roles.evaluation.records import EpisodeRecords

_NOTES = {
    "explo_paper": "the paper's: newly seen cells / free cells, can exceed 100 %",
    "explo_true": "explored share of the free cells",
    "cover": "share of the targets covered",
    "cover_bound": "share of the targets that no team can exceed",
    "time_e_paper": "first step with a mean explo_paper above 90 %",
    "t90_true": "first step with explo_true at 90 %",
    "t90_paper": "first step with explo_paper above 90 %",
    "path_length": "cells that a robot moved, mean over the team",
    "length": "steps of an episode",
}
_COLUMNS = ("explo_paper", "explo_true", "cover", "cover_bound", "time_e_paper", "path_length")
_INTERVALS = (
    "[95 % confidence interval]: Student's t over the episodes; time_e_paper: bootstrap percentiles"
)
_DECISION = "decision time for one team's step"


def report_of(records: EpisodeRecords) -> dict[str, Any]:
    """Summarize the records of one controller.

    :param records: what ``run_episodes`` returned
    :return: JSON values: ``config``, in which ``seed`` is that of the command line and ``stream``
        the seed that it stands for; ``metrics``, see ``evaluation.metrics.summarize``;
        ``joint_steps``; and ``timing``, the only part that is not the same in every run
    """
    from sb3_roles.evaluation.episodes import stream_of
    from sb3_roles.evaluation.metrics import decision_time, summarize

    about, seed = records.metadata, records.metadata["seed"]
    kind, number = stream_of(seed)
    joint_steps = int(records.length.sum())
    return {
        "config": {
            "controller": about["name"],
            "controller_class": about["controller"],
            "controller_options": about["controller_options"],
            "deterministic": about["deterministic"],
            "communication": about["communication"],
            "config_hash": about["config_hash"],
            "episodes": len(records.episode),
            "first_episode": int(records.episode[0]),
            "scene": about["scene"],
            "seed": number,
            "stream": {"kind": kind, "seed": seed},
            "version": about["version"],
            "versions": about["versions"],
        },
        "metrics": summarize(records),
        "joint_steps": joint_steps,
        "timing": {
            "decision": decision_time(records),
            "batch_size": records.timing["batch_size"],
            "seconds": records.seconds,
            "episodes_per_second": len(records.episode) / records.seconds,
            "joint_steps_per_second": joint_steps / records.seconds,
        },
    }


def table_of(report: Mapping[str, Any]) -> str:
    """Print the report of one controller as a table.

    :param report: see :func:`report_of`
    """
    config, timing = report["config"], report["timing"]
    lines = [f"{config['controller']} on {_episodes(config)}", *_choices(config)]
    lines += [f"mean ± standard error {_INTERVALS}", ""]
    for name, metric in report["metrics"].items():
        note = _NOTES[name]
        if "share" in metric:
            note += f"; {100 * metric['share']:.1f} % of the episodes get there"
        lines.append(f"{name:13}{_value(metric):>38}   {note}")
    lines += [
        "",
        f"{_DECISION}: {_decision(timing['decision'])}, in batches of {timing['batch_size']}",
        f"{timing['episodes_per_second']:,.0f} episodes/s, "
        f"{timing['joint_steps_per_second']:,.0f} joint steps/s",
    ]
    return "\n".join(lines)


def comparison_of(
    reports: Sequence[Mapping[str, Any]], differences: Sequence[Mapping[str, Any]]
) -> str:
    """Print the reports of several controllers, a line each, and their paired differences.

    :param reports: see :func:`report_of`, of the same episodes
    :param differences: of the second and later ones to the first: ``controller``, ``against`` and
        ``metrics``, see ``evaluation.metrics.paired_differences``
    """
    first = reports[0]["config"]["controller"]
    rows = [(report["config"]["controller"], report["metrics"]) for report in reports]
    paired = [(each["controller"], each["metrics"]) for each in differences]
    decisions = [
        [report["config"]["controller"], _decision(report["timing"]["decision"])]
        for report in reports
    ]
    return "\n".join(
        [
            _episodes(reports[0]["config"]),
            f"mean {_INTERVALS}",
            "",
            *_lines_of(rows),
            "",
            f"differences to {first} on the same episodes",
            *_lines_of(paired),
            "",
            f"{_DECISION}, in batches of {reports[0]['timing']['batch_size']}",
            *_aligned(decisions),
        ]
    )


def _episodes(config: Mapping[str, Any]) -> str:
    scene, kind = config["scene"], config["stream"]["kind"].replace("_", "-")
    return (
        f"{scene['name']}: {scene['n_agents']} robots, {config['episodes']} episodes, "
        f"{kind} seed {config['seed']}\n"
        f"{scene['height']} x {scene['width']} cells, {100 * scene['free_fraction']:g} % free, "
        f"{scene['n_targets']} targets, horizon {scene['horizon']}"
    )


def _choices(config: Mapping[str, Any]) -> list[str]:
    parts = []
    if config["deterministic"] is not None:
        parts.append("likeliest actions" if config["deterministic"] else "drawn actions")
    if config["communication"] is not None:
        parts.append("communication " + ("on" if config["communication"] else "off"))
    return [", ".join(parts)] if parts else []


def _lines_of(rows: Sequence[tuple[str, Mapping[str, Any]]]) -> list[str]:
    # Not every controller knows a bound, and differences have none.
    units = {name: each[name]["unit"] for name in _COLUMNS for _, each in rows if name in each}
    header = ["", *(f"{name}, {unit}" for name, unit in units.items())]
    return _aligned(
        [header, *([name, *(_cell(each.get(c)) for c in units)] for name, each in rows)]
    )


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    columns = list(zip(*rows, strict=True))
    # Names to the left, numbers to the right.
    aligned = [[cell.ljust(max(map(len, columns[0]))) for cell in columns[0]]]
    aligned += [[cell.rjust(max(map(len, column))) for cell in column] for column in columns[1:]]
    return ["  ".join(row) for row in zip(*aligned, strict=True)]


def _value(metric: Mapping[str, Any]) -> str:
    if metric["mean"] is None:
        return "-"
    error = "" if metric["se"] is None else f" ± {metric['se']:.2f}"
    return f"{metric['mean']:.2f}{error}{_interval(metric)} {metric['unit']}"


def _cell(metric: Mapping[str, Any] | None) -> str:
    if metric is None or metric["mean"] is None:
        return "-"
    return f"{metric['mean']:.2f}{_interval(metric)}"


def _interval(metric: Mapping[str, Any]) -> str:
    return "" if metric["ci95"] is None else " [{:.2f}, {:.2f}]".format(*metric["ci95"])


def _decision(times: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {short_duration(times[name])}" for name in ("median", "mean", "p95"))
