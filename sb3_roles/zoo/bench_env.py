"""``sb3-roles bench env``: joint steps per second of every way to run the environment.

All cases run in one process and in turn (A B C A B C ...), so that a busy machine slows all of them
alike, and ratios and exponents are taken within a round. A joint step moves a whole team.
"""

from __future__ import annotations

import json
import operator
import statistics
import tempfile
from argparse import Namespace
from typing import TYPE_CHECKING, Any

from sb3_roles.zoo.bench_report import (
    against,
    cells,
    log_log_slope,
    machine_lines,
    plural,
    ratios,
    row,
    spread,
)
from sb3_roles.zoo.env_cases import ROBOTS, SIDES, SUB_GOALS, Case, case_name, make_cases
from sb3_roles.zoo.machine import describe_machine, fresh_python
from sb3_roles.zoo.options import positive_number, whole_number

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Subparsers

# What the project aims at; reported as met or missed, never asserted.
RATE_TARGETS = {
    "native none 4 robots 25x25": 300_000,
    "native nearest 4 robots 25x25": 100_000,
    "native assigned 4 robots 25x25": 40_000,
    "pettingzoo none 4 robots 25x25": 40_000,
}
RATIO_TARGETS = {"reference": 500}
EXPONENT_TARGET = 1.0
COMPILE_TARGET, IMPORT_TARGET = 20.0, 1.0
IMPORTS = ("import area_search", "from area_search import AreaSearchEnv")

_COMPILE = """
import time
import numpy as np
from area_search import BatchedAreaSearch
for sub_goal in {sub_goals!r}:
    start = time.perf_counter()
    batch = BatchedAreaSearch("hard", 2, sub_goal)
    batch.reset(0)
    batch.step(np.zeros((2, batch.n_agents), np.int64))
    batch.reset_teams(np.ones(2, np.bool_))
    print(time.perf_counter() - start)
"""
_IMPORT = """
import time
start = time.perf_counter()
{statement}
print(time.perf_counter() - start)
"""


def add_parser(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "env",
        help="steps per second of the environment",
        description="Measure joint steps per second on one core: the native batch, both "
        "vectorized environments, the PettingZoo environment and the plain-Python reference; "
        "how the cost grows with robots and map; import and compile time.",
    )
    parser.add_argument(
        "--seconds-per-case",
        type=positive_number(600),
        default=0.3,
        metavar="S",
        help="shortest measuring time of a case in a round",
    )
    parser.add_argument(
        "--repeats", type=whole_number(1, 1000), default=5, metavar="N", help="number of rounds"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=run)


def run(args: Namespace) -> int:
    """Measure everything and print the report.

    :param args: parsed arguments
    :return: exit code
    """
    machine = describe_machine()
    startup = measure_startup()
    cases = measure(make_cases(), args.seconds_per_case, args.repeats)
    report = {
        "config": {"seconds_per_case": args.seconds_per_case, "repeats": args.repeats},
        "machine": machine,
        **describe(cases),
        "growth": _growth(cases),
        **startup,
    }
    print(json.dumps(report, indent=2, allow_nan=False) if args.json else _table(report))
    return 0


def measure(cases: dict[str, Case], seconds: float, repeats: int) -> dict[str, Case]:
    """Measure cases in turn.

    :param cases: by name
    :param seconds: shortest measuring time of a case in a round
    :param repeats: rounds
    :return: the same cases
    """
    for case in cases.values():
        case.work()
    for _ in range(repeats):
        for case in cases.values():
            case.measure(seconds)
    return cases


def describe(cases: dict[str, Case]) -> dict[str, Any]:
    """Return rates and their ratios, plain data.

    :param cases: measured, those of 4 robots on 25 x 25 cells among them
    """
    return {"cases": [_describe(case) for case in cases.values()], "ratios": _ratios(cases)}


def measure_startup(repeats: int = 3) -> dict[str, Any]:
    """Measure import and compile time, each in fresh processes.

    :param repeats: number of processes for each import statement
    :return: ``imports``, seconds and target by statement; ``compile``, seconds until the first use
        has compiled everything, with an empty cache: each sub-goal's is what it adds to those
        before it, because they share kernels
    """
    times: dict[str, list[float]] = {statement: [] for statement in IMPORTS}
    for _ in range(repeats):
        for statement in IMPORTS:
            times[statement] += fresh_python(_IMPORT.format(statement=statement))
    with tempfile.TemporaryDirectory() as cache:
        added = fresh_python(_COMPILE.format(sub_goals=SUB_GOALS), NUMBA_CACHE_DIR=cache)
    total = sum(added)
    return {
        "imports": {
            statement: against(spread(seconds), IMPORT_TARGET, operator.lt)
            for statement, seconds in times.items()
        },
        "compile": {
            "added": dict(zip(SUB_GOALS, added, strict=True)),
            "total": {"seconds": total, "target": COMPILE_TARGET, "met": total < COMPILE_TARGET},
        },
    }


def _describe(case: Case) -> dict[str, Any]:
    return {
        "name": case.name,
        "api": case.api,
        "sub_goal": case.sub_goal,
        "n_agents": case.scene.n_agents,
        "side": case.scene.width,
        "n_teams": case.n_teams,
        "joint_steps": case.joint_steps,
        "joint_steps_per_second": against(spread(case.rates), RATE_TARGETS.get(case.name)),
        # Above 1 would mean more than one core; far below it, that others had the core.
        "cpu_share": statistics.median(case.cpu_shares),
    }


def _ratios(cases: dict[str, Case]) -> dict[str, dict[str, Any]]:
    fast = cases[case_name("native", "none", 4, 25)]
    found = {}
    for api in ("native_vec_env", "pettingzoo", "supersuit_vec_env", "reference"):
        slow = cases[case_name(api, "none", 4, 25)]
        values = spread(ratios(fast.rates, slow.rates))
        found[f"native / {api}"] = against(values, RATIO_TARGETS.get(api))
    return found


def _growth(cases: dict[str, Case]) -> list[dict[str, Any]]:
    growth = []
    for sub_goal in SUB_GOALS:
        by_robots = [cases[case_name("native", sub_goal, n, SIDES[0])] for n in ROBOTS]
        by_side = [cases[case_name("native", sub_goal, 4, side)] for side in SIDES]
        areas = tuple(side * side for side in SIDES)
        for along, sizes, some in (("robots", ROBOTS, by_robots), ("cells", areas, by_side)):
            costs = zip(*([1.0 / rate for rate in case.rates] for case in some), strict=True)
            exponents = [log_log_slope(sizes, cost) for cost in costs]
            growth.append(
                {
                    "sub_goal": sub_goal,
                    "along": along,
                    "sizes": list(sizes),
                    "microseconds": [1e6 / statistics.median(case.rates) for case in some],
                    "exponent": against(spread(exponents), EXPONENT_TARGET, operator.le),
                }
            )
    return growth


def _table(report: dict[str, Any]) -> str:
    config = report["config"]
    lines = [
        *machine_lines(report["machine"]),
        f"{config['repeats']} interleaved rounds, at least {config['seconds_per_case']:g} s a case",
        "",
        row("joint steps per second, one core", "median", "range", "target", "CPU share"),
    ]
    for case in report["cases"]:
        rate = case["joint_steps_per_second"]
        label = f"{case['name']}, {plural(case['n_teams'], 'team')}"
        lines.append(row(label, *cells(rate, ",.0f"), f"{case['cpu_share']:.2f}"))
    lines += ["", row("speed ratio, 4 robots 25x25", "median", "range", "target")]
    lines += [row(name, *cells(ratio, ",.1f")) for name, ratio in report["ratios"].items()]
    lines += ["", row("growth exponent of the cost", "median", "range", "target", "us/step")]
    for line in report["growth"]:
        costs = " ".join(f"{cost:.3g}" for cost in line["microseconds"])
        label = f"{line['sub_goal']}, {line['along']} {' '.join(map(str, line['sizes']))}"
        lines.append(row(label, *cells(line["exponent"], ".2f", "<="), costs))
    lines += ["", row("start-up, fresh process", "seconds", "range", "target")]
    lines += [row(name, *cells(found, ".2f", "<")) for name, found in report["imports"].items()]
    compiled = report["compile"]
    for sub_goal, seconds in compiled["added"].items():
        lines.append(row(f"first use, empty cache: {sub_goal} adds", f"{seconds:.1f}"))
    total = compiled["total"]
    seconds, _, target = cells({**total, **spread([total["seconds"]])}, ".1f", "<")
    lines.append(row("first use, empty cache: total", seconds, "", target))
    return "\n".join(lines)
