"""``sb3-roles bench train``: joint steps per second of whole training, and where the time goes.

Every case is an algorithm with its tuned configuration, trained in this process as ``train.py``
does: rollouts with the callbacks of a run, and updates; evaluations and checkpoints are left out.
The cases run in turn (A B A B ...), so that a busy machine slows all of them alike.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING, Any

from sb3_roles.zoo.algorithms import ALGORITHMS
from sb3_roles.zoo.bench_case import (
    PARTS,
    TUNED,
    configure,
    training_case,
)
from sb3_roles.zoo.bench_compare import RIVALS, Comparison, comparison_table
from sb3_roles.zoo.bench_memory import memory_cells, peak_memory
from sb3_roles.zoo.bench_report import Table, cells, machine_lines, rounds_line
from sb3_roles.zoo.bench_rounds import add_round_options, print_report
from sb3_roles.zoo.machine import start_torch
from sb3_roles.zoo.options import UsageError, int_text, several_of

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Subparsers

_BACKENDS = ("native", "supersuit")
# What is cloned from demonstrations has no rollouts to learn from, so no steps to be measured by.
_MEASURED = [name for name, one in ALGORITHMS.items() if not one.clones]


def add_parser(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "train",
        help="steps per second of training",
        description="Measure joint steps per second of training with the tuned configurations: "
        "rollouts with callbacks, and updates. Rates are per round; the shares of the time are "
        "those of all rounds.",
    )
    parser.add_argument(
        "--algo",
        type=several_of("algorithm", _MEASURED),
        default=("hmappo",),
        metavar="NAME,...",
        help=f"from {', '.join(_MEASURED)}; gnn clones demonstrations and learns from no rollouts, "
        "so there is nothing to measure",
    )
    parser.add_argument(
        "--vec-env",
        type=several_of("backend", _BACKENDS),
        default=("native",),
        metavar="NAME,...",
        help=f"from {', '.join(_BACKENDS)}",
    )
    parser.add_argument(
        "--compare",
        type=several_of("comparison", RIVALS),
        nargs="?",
        const=tuple(RIVALS),
        default=(),
        metavar="NAME,...",
        help=f"measure hmappo against these in the same rounds, by default all: {', '.join(RIVALS)}"
        "; fails if they do not do the same work",
    )
    parser.add_argument("--scene", default=None, metavar="NAME", help="scene of the area search")
    parser.add_argument("--n-agents", type=int_text, default=None, metavar="N", help="robots")
    add_round_options(parser, iterations=4, repeats=5)
    parser.set_defaults(run=run)


def run(args: Namespace) -> int:
    """Measure all cases and print the report.

    :param args: parsed arguments
    :return: exit code
    :raises UsageError: if an option does not fit the environment, or rivals do other work
    """
    if args.compare and (args.algo, args.vec_env) != (("hmappo",), ("native",)):
        raise UsageError(
            "--compare is for the tuned default: leave out --algo and --vec-env, or give hmappo "
            "and native"
        )
    options = {"scene": args.scene, "n_agents": args.n_agents}
    changes = {"env_kwargs": {key: one for key, one in options.items() if one is not None}}
    configs = {
        f"{algo} {backend}": configure(algo, backend, changes, args.n_envs)
        for algo in args.algo
        for backend in args.vec_env
    }
    machine = start_torch(args.num_threads)
    report = measure(configs, args.compare, args.iterations, args.repeats)
    report = {"machine": machine, **report}
    print_report(args, report, _head(report), _tables(report))
    return 0


def measure(
    configs: Mapping[str, Mapping[str, Any]],
    rivals: Sequence[str],
    iterations: int,
    repeats: int,
) -> dict[str, Any]:
    """Train all cases in turn.

    :param configs: by name, checked
    :param rivals: of the case :data:`~sb3_roles.zoo.bench_case.TUNED`, see ``bench_compare``
    :param iterations: rollouts and updates of a case in a round; rivals make one
    :param repeats: rounds
    :return: plain data
    :raises UsageError: if a rival does other work than the tuned default
    """
    with ExitStack() as stack:
        cases = {
            name: stack.enter_context(closing(training_case(name, config)))
            for name, config in configs.items()
        }
        comparison = None
        if rivals:
            comparison = Comparison(cases[TUNED], configs[TUNED], rivals)
            stack.enter_context(closing(comparison))
        for _ in range(repeats):
            for case in cases.values():
                case.measure(iterations)
            if comparison is not None:
                comparison.measure(iterations)
        return {
            "config": {"iterations": iterations, "repeats": repeats},
            "cases": [case.describe() for case in cases.values()],
            "comparisons": [] if comparison is None else comparison.describe(),
            "peak_resident_bytes": peak_memory(),
        }


def _head(report: Mapping[str, Any]) -> list[str]:
    peak = report["peak_resident_bytes"]
    head = [
        *machine_lines(report["machine"]),
        rounds_line(report["config"])
        + (", of slower rivals 1 iteration" if report["comparisons"] else ""),
    ]
    if peak is not None:
        head.append(f"peak resident memory of the process, with all cases: {peak / 1e6:,.0f} MB")
    return head


def _tables(report: Mapping[str, Any]) -> list[Table]:
    rates = Table(
        ("joint steps per second of training", "median", "range", "target", "aim", "CPU share",
         "parameters")
    )  # fmt: skip
    shares = Table(("share of the time, %", *PARTS, "rest"))
    buffers = Table(
        ("observations of a rollout", "MB", "bytes/joint step", "float32, SB3 before 2.7.1",
         "SB3 installed", "target")
    )  # fmt: skip
    work = Table(("work", "joint steps", "optimizer steps", "samples x epochs"))
    for case in report["cases"]:
        name = f"{case['name']}, {case['n_teams']} teams of {case['n_agents']}"
        rate = cells(case["joint_steps_per_second"], ",.0f")
        aim = "" if case["aim"] is None else cells(case["aim"], ",.0f")[2]
        rates.add(name, *rate, aim, f"{case['cpu_share']:.2f}", f"{case['parameters']:,}")
        part = case["share_of_time"]
        shares.add(case["name"], *(f"{100 * part[name]:.1f}" for name in (*PARTS, "rest")))
        buffers.add(
            case["name"],
            f"{case['memory']['observation_bytes'] / 1e6:.1f}",
            f"{case['observation_bytes_per_joint_step']:,.0f}",
            *memory_cells(case["memory"]),
        )
        done = case["work"]
        counts = ("joint_steps", "optimizer_steps", "samples_times_epochs")
        work.add(case["name"], *(f"{done[count]:,}" for count in counts))
    tables = [rates, shares, buffers, work]
    if report["comparisons"]:
        tables.append(comparison_table(report["comparisons"]))
    return tables
