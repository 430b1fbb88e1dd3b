"""``sb3-roles bench options``: what each option of speed costs or gains, one change at a time."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from sb3_roles.zoo.bench_case import TrainingCase, configure, training_case
from sb3_roles.zoo.bench_report import (
    Table,
    machine_lines,
    range_text,
    rounds_line,
    spread,
)
from sb3_roles.zoo.bench_rounds import add_round_options, print_report
from sb3_roles.zoo.machine import start_torch
from sb3_roles.zoo.options import several_of

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Subparsers

DEFAULT = "default"


@dataclass(frozen=True)
class Change:
    """One change of the tuned default.

    :param settings: of the configuration, see ``zoo.config.merge``
    :param against: what it is compared with: the default, or another change
    :param num_threads: threads of torch; None for those of the command
    """

    settings: Mapping[str, Any] = field(default_factory=dict)
    against: str = DEFAULT
    num_threads: int | None = None


def _policy(**options: Any) -> dict[str, Any]:
    return {"policy_kwargs": options}


_CONVOLUTIONS = "encoder convolutions"
CHANGES: dict[str, Change] = {
    "precision fp32": Change(_policy(precision="fp32")),
    "precision bf16": Change(_policy(precision="bf16")),
    _CONVOLUTIONS: Change(_policy(encoder="convolutions", norm_layer="none")),
    # Patches have no normalization.
    "norm_layer frozen_batch": Change(
        _policy(encoder="convolutions", norm_layer="frozen_batch"), _CONVOLUTIONS
    ),
    "share_encoders false": Change(_policy(share_encoders=False)),
    "n_shards 1": Change({"n_shards": 1}),
    "rollout_groups 1": Change({"rollout_groups": 1}),
    "n_epochs 1": Change({"n_epochs": 1}),
    "n_epochs 2": Change({"n_epochs": 2}),
    "n_epochs 4": Change({"n_epochs": 4}),
    "num_threads 1": Change(num_threads=1),
}


def add_parser(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "options",
        help="what each option of speed costs or gains",
        description="Measure training of the tuned HMAPPO with one option changed at a time, in "
        "the same rounds. What a change does to learning is another question.",
    )
    parser.add_argument(
        "--changes",
        type=several_of("change", CHANGES),
        default=tuple(CHANGES),
        metavar="NAME,...",
        help=f"by default all: {', '.join(CHANGES)}",
    )
    add_round_options(parser, iterations=1, repeats=5)
    parser.set_defaults(run=run)


def run(args: Namespace) -> int:
    """Measure default and changes, and print the report.

    :param args: parsed arguments
    :return: exit code
    """
    # What a change is compared with comes along, in the order of the list.
    needed = {DEFAULT, *args.changes, *(CHANGES[name].against for name in args.changes)}
    changes = {DEFAULT: Change()} | {key: one for key, one in CHANGES.items() if key in needed}
    configs = {
        name: configure(changes=change.settings, n_envs=args.n_envs)
        for name, change in changes.items()
    }
    machine = start_torch(args.num_threads)
    same = _same_as_default(changes, configs)
    configs = {name: config for name, config in configs.items() if name not in same}
    with ExitStack() as stack:
        cases = {
            name: stack.enter_context(closing(training_case(name, config)))
            for name, config in configs.items()
        }
        found: dict[str, list[float]] = {name: [] for name in cases if name != DEFAULT}
        for _ in range(args.repeats):
            for name, measured in found.items():
                # Right behind what it is compared with.
                other = cases[changes[name].against]
                other.measure(args.iterations)
                cases[name].measure(args.iterations, changes[name].num_threads)
                measured.append(cases[name].rates[-1] / other.rates[-1])
        report = {
            "config": {"iterations": args.iterations, "repeats": args.repeats},
            "machine": machine,
            "default": {**cases[DEFAULT].describe(), "config": configs[DEFAULT]},
            "changes": [
                _describe(name, changes[name], cases[name], measured)
                for name, measured in found.items()
            ],
            "same_as_default": same,
        }
    print_report(args, report, _head(report), [_table(report)])
    return 0


def _same_as_default(
    changes: Mapping[str, Change], configs: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    """Name the changes that change nothing."""
    from sb3_roles.zoo.models import complete

    default = complete(configs[DEFAULT])
    return [
        name
        for name, change in changes.items()
        if name != DEFAULT and change.num_threads is None and complete(configs[name]) == default
    ]


def _describe(
    name: str, change: Change, case: TrainingCase, measured: Sequence[float]
) -> dict[str, Any]:
    return {
        "change": name,
        "against": change.against,
        "joint_steps_per_second": spread(case.rates),
        "ratio": spread(measured),
        "work": case.describe()["work"],
    }


def _head(report: Mapping[str, Any]) -> list[str]:
    same = report["same_as_default"]
    head = [
        *machine_lines(report["machine"]),
        rounds_line(report["config"]),
    ]
    return head + ([f"the default already: {', '.join(same)}"] if same else [])


def _table(report: Mapping[str, Any]) -> Table:
    table = Table(("changed", "joint steps/s", "range", "times as fast", "range", "as"))
    rate = report["default"]["joint_steps_per_second"]
    table.add(DEFAULT, f"{rate['median']:,.0f}", range_text(rate, ",.0f"), "", "", "")
    for one in report["changes"]:
        rate, ratio = one["joint_steps_per_second"], one["ratio"]
        table.add(
            one["change"],
            f"{rate['median']:,.0f}",
            range_text(rate, ",.0f"),
            f"{ratio['median']:.2f}",
            range_text(ratio, ".2f"),
            one["against"],
        )
    return table
