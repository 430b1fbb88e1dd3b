"""``sb3-roles bench env``: joint steps per second of every way to run the environment.

All cases run in one process and in turn (A B C A B C ...), so that a busy machine slows all of them
alike, and ratios and exponents are taken within a round. A joint step moves a whole team.
"""

from __future__ import annotations

import json
import operator
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from area_search.scenes import Scene, get_scene
from sb3_roles._version import __version__
from sb3_roles.zoo.options import UsageError, positive_number, whole_number

if TYPE_CHECKING:
    import numpy as np

    from sb3_roles.zoo.options import Subparsers

SUB_GOALS = ("none", "nearest", "assigned")
N_TEAMS, N_TEAMS_SUPERSUIT = 128, 8
ROBOTS, SIDES = (1, 4, 15, 50), (25, 50, 100, 200)
TARGET_DENSITY = 0.16

# What DESIGN and PERFORMANCE ask for; reported as met or missed, never asserted.
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


@dataclass
class Case:
    """One thing to measure.

    :param api: how the environment is run
    :param scene: the task
    :param sub_goal: path features in the observation
    :param n_teams: teams that are stepped together
    :param work: does some whole number of joint steps and returns it
    """

    api: str
    scene: Scene
    sub_goal: str
    n_teams: int
    work: Callable[[], int]
    rates: list[float] = field(default_factory=list)
    cpu_shares: list[float] = field(default_factory=list)
    joint_steps: int = 0

    @property
    def name(self) -> str:
        """What the case is called in reports."""
        return case_name(self.api, self.sub_goal, self.scene.n_agents, self.scene.width)

    def measure(self, seconds: float) -> None:
        """Work for at least some time, and add the rate to ``rates``."""
        done, elapsed = 0, 0.0
        cpu, start = time.process_time(), time.perf_counter()
        while elapsed < seconds:
            done += self.work()
            elapsed = time.perf_counter() - start
        self.rates.append(done / elapsed)
        self.cpu_shares.append((time.process_time() - cpu) / elapsed)
        self.joint_steps += done


def case_name(api: str, sub_goal: str, n_agents: int, side: int) -> str:
    """Name a case."""
    plural = "" if n_agents == 1 else "s"
    return f"{api} {sub_goal} {n_agents} robot{plural} {side}x{side}"


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
    cases = make_cases()
    for case in cases.values():
        case.work()
    for _ in range(args.repeats):
        for case in cases.values():
            case.measure(args.seconds_per_case)
    report = {
        "config": {"seconds_per_case": args.seconds_per_case, "repeats": args.repeats},
        "machine": machine,
        "cases": [_describe(case) for case in cases.values()],
        "ratios": _ratios(cases),
        "growth": _growth(cases),
        **startup,
    }
    print(json.dumps(report, indent=2, allow_nan=False) if args.json else _table(report))
    return 0


def describe_machine() -> dict[str, Any]:
    """Describe what the measurement runs on; call it before the work, for the load average.

    :return: CPU, cores, load average of the last minute, versions
    """
    cpu = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            names = [
                line.split(":", 1)[1].strip() for line in file if line.startswith("model name")
            ]
        cpu = names[0] if names else cpu
    except OSError:
        pass  # not Linux
    affinity = getattr(os, "sched_getaffinity", None)
    return {
        "cpu": cpu,
        "cores": os.cpu_count(),
        "usable_cores": len(affinity(0)) if affinity else os.cpu_count(),
        "load_before": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "numba": version("numba"),
        "sb3_roles": __version__,
    }


def make_cases() -> dict[str, Case]:
    """Make every case, ready to run.

    :return: by name
    """
    cases: list[Case] = []
    sizes = {(n, side) for n in (4, 15) for side in (25, 100)}
    sizes |= {(n, SIDES[0]) for n in ROBOTS} | {(4, side) for side in SIDES}
    for sub_goal in SUB_GOALS:
        for n_agents, side in sorted(sizes, key=lambda size: (size[1], size[0])):
            cases.append(_native(make_scene(n_agents, side), sub_goal))
    scene = make_scene(4, 25)
    cases.append(_vec_env(scene, "native", N_TEAMS))
    cases.append(_vec_env(scene, "supersuit", N_TEAMS_SUPERSUIT))
    cases.append(_pettingzoo(scene))
    cases.append(_reference(scene))
    return {case.name: case for case in cases}


def make_scene(n_agents: int, side: int) -> Scene:
    """Make the hard scene with another team and map, at the same densities and horizon."""
    n_targets = round(TARGET_DENSITY * side * side)
    return get_scene("hard", n_agents=n_agents, height=side, width=side, n_targets=n_targets)


def _actions(shape: tuple[int, ...]) -> Iterator[np.ndarray]:
    import numpy as np

    # A prime number of them, which no horizon is a multiple of.
    drawn = np.random.default_rng(0).integers(0, 5, (101, *shape))
    while True:
        yield from drawn


def _native(scene: Scene, sub_goal: str) -> Case:
    import numpy as np

    from area_search import BatchedAreaSearch

    batch = BatchedAreaSearch(scene, N_TEAMS, sub_goal)
    batch.reset(0)
    actions = _actions((N_TEAMS, scene.n_agents))
    # One horizon in which every team is reset once, each share of them at another step: from then
    # on the resets, which cost many times a step, are spread evenly.
    for step in range(scene.horizon):
        batch.step(next(actions))
        batch.reset_teams(np.arange(N_TEAMS) % scene.horizon == step)

    def work() -> int:
        batch.step(next(actions))
        ended = batch.terminated | batch.truncated
        if ended.any():
            batch.reset_teams(ended)
        return N_TEAMS

    return Case("native", scene, sub_goal, N_TEAMS, work)


def _vec_env(scene: Scene, backend: str, n_teams: int) -> Case:
    from area_search import AreaSearchEnv
    from sb3_roles.common.team_vec_env import make_team_vec_env

    vec_env = make_team_vec_env(lambda: AreaSearchEnv(scene), n_teams, 0, backend)
    vec_env.reset()
    actions = _actions((n_teams * scene.n_agents,))

    # Whole episodes, here and below: the teams are all reset at the same step.
    def work() -> int:
        for _ in range(scene.horizon):
            vec_env.step(next(actions))
        return scene.horizon * n_teams

    return Case(f"{backend}_vec_env", scene, "none", n_teams, work)


def _pettingzoo(scene: Scene) -> Case:
    from area_search import AreaSearchEnv

    env = AreaSearchEnv(scene)
    env.reset(seed=0)
    moves = _actions((scene.n_agents,))
    actions = [
        dict(zip(env.possible_agents, next(moves).tolist(), strict=True)) for _ in range(101)
    ]

    def work() -> int:
        env.reset()
        done = 0
        while env.agents:
            env.step(actions[done % len(actions)])
            done += 1
        return done

    return Case("pettingzoo", scene, "none", 1, work)


def _reference(scene: Scene) -> Case:
    from area_search.reference import ReferenceAreaSearch

    moves = _actions((scene.n_agents,))
    actions = [next(moves).tolist() for _ in range(101)]
    episode = 0

    def work() -> int:
        nonlocal episode
        team = ReferenceAreaSearch(scene, 0, episode)
        episode += 1
        team.observe()
        while not team.truncated:
            team.step(actions[team.n_steps % len(actions)])
            team.rewards()
            team.observe()
        return team.n_steps

    return Case("reference", scene, "none", 1, work)


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
            times[statement] += _fresh_python(_IMPORT.format(statement=statement))
    with tempfile.TemporaryDirectory() as cache:
        added = _fresh_python(_COMPILE.format(sub_goals=SUB_GOALS), NUMBA_CACHE_DIR=cache)
    total = sum(added)
    return {
        "imports": {
            statement: _against(_spread(seconds), IMPORT_TARGET, operator.lt)
            for statement, seconds in times.items()
        },
        "compile": {
            "added": dict(zip(SUB_GOALS, added, strict=True)),
            "total": {"seconds": total, "target": COMPILE_TARGET, "met": total < COMPILE_TARGET},
        },
    }


def _fresh_python(code: str, **variables: str) -> list[float]:
    # The same packages as here, however this process was told where they are.
    path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    result = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": path, **variables},
        capture_output=True,
        text=True,
    )
    if result.returncode != 0:
        reason = result.stderr.strip().splitlines() or [f"exit code {result.returncode}"]
        raise UsageError(f"a fresh interpreter could not run the environment: {reason[-1]}")
    return [float(line) for line in result.stdout.split()]


def _spread(values: Sequence[float]) -> dict[str, Any]:
    return {"median": statistics.median(values), "min": min(values), "max": max(values)}


def _against(
    spread: dict[str, Any],
    target: float | None,
    meets: Callable[[float, float], bool] = operator.ge,
) -> dict[str, Any]:
    """Add a target, and whether the median meets it, to a spread."""
    met = None if target is None else bool(meets(spread["median"], target))
    return {**spread, "target": target, "met": met}


def _describe(case: Case) -> dict[str, Any]:
    return {
        "name": case.name,
        "api": case.api,
        "sub_goal": case.sub_goal,
        "n_agents": case.scene.n_agents,
        "side": case.scene.width,
        "n_teams": case.n_teams,
        "joint_steps": case.joint_steps,
        "joint_steps_per_second": _against(_spread(case.rates), RATE_TARGETS.get(case.name)),
        # Above 1 would mean more than one core; far below it, that others had the core.
        "cpu_share": statistics.median(case.cpu_shares),
    }


def _ratios(cases: dict[str, Case]) -> dict[str, dict[str, Any]]:
    fast = cases[case_name("native", "none", 4, 25)]
    ratios = {}
    for api in ("native_vec_env", "pettingzoo", "supersuit_vec_env", "reference"):
        slow = cases[case_name(api, "none", 4, 25)]
        values = [a / b for a, b in zip(fast.rates, slow.rates, strict=True)]
        ratios[f"native / {api}"] = _against(_spread(values), RATIO_TARGETS.get(api))
    return ratios


def _growth(cases: dict[str, Case]) -> list[dict[str, Any]]:
    growth = []
    for sub_goal in SUB_GOALS:
        by_robots = [cases[case_name("native", sub_goal, n, SIDES[0])] for n in ROBOTS]
        by_side = [cases[case_name("native", sub_goal, 4, side)] for side in SIDES]
        for along, sizes, some in (("robots", ROBOTS, by_robots), ("side", SIDES, by_side)):
            costs = zip(*([1.0 / rate for rate in case.rates] for case in some), strict=True)
            exponents = [log_log_slope(sizes, cost) for cost in costs]
            growth.append(
                {
                    "sub_goal": sub_goal,
                    "along": along,
                    "sizes": list(sizes),
                    "microseconds": [1e6 / statistics.median(case.rates) for case in some],
                    "exponent": _against(_spread(exponents), EXPONENT_TARGET, operator.le),
                }
            )
    return growth


def log_log_slope(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Exponent b of the power law cost = a size^b that fits best in logarithms.

    :param sizes: at least two different positive numbers
    :param costs: as many positive numbers
    :return: the exponent
    """
    import numpy as np

    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def _table(report: dict[str, Any]) -> str:
    machine, config = report["machine"], report["config"]
    load = machine["load_before"]
    lines = [
        f"{machine['cpu']}, {machine['cores']} cores ({machine['usable_cores']} usable), "
        f"load before {'?' if load is None else f'{load:.2f}'}",
        f"python {machine['python']}, numpy {machine['numpy']}, numba {machine['numba']}, "
        f"sb3_roles {machine['sb3_roles']}",
        f"{config['repeats']} interleaved rounds, at least {config['seconds_per_case']:g} s a case",
        "",
        _row("joint steps per second, one core", "median", "range", "target", "CPU share"),
    ]
    for case in report["cases"]:
        rate = case["joint_steps_per_second"]
        teams = f"{case['n_teams']} team{'' if case['n_teams'] == 1 else 's'}"
        label = f"{case['name']}, {teams}"
        lines.append(_row(label, *_cells(rate, ",.0f"), f"{case['cpu_share']:.2f}"))
    lines += ["", _row("speed ratio, 4 robots 25x25", "median", "range", "target")]
    lines += [_row(name, *_cells(ratio, ",.1f")) for name, ratio in report["ratios"].items()]
    lines += ["", _row("growth exponent of the cost", "median", "range", "target", "us/step")]
    for line in report["growth"]:
        costs = " ".join(f"{cost:.3g}" for cost in line["microseconds"])
        label = f"{line['sub_goal']}, {line['along']} {' '.join(map(str, line['sizes']))}"
        lines.append(_row(label, *_cells(line["exponent"], ".2f", "<="), costs))
    lines += ["", _row("start-up, fresh process", "seconds", "range", "target")]
    lines += [_row(name, *_cells(spread, ".2f", "<")) for name, spread in report["imports"].items()]
    compiled = report["compile"]
    for sub_goal, seconds in compiled["added"].items():
        lines.append(_row(f"first use, empty cache: {sub_goal} adds", f"{seconds:.1f}"))
    total = compiled["total"]
    seconds, _, target = _cells({**total, **_spread([total["seconds"]])}, ".1f", "<")
    lines.append(_row("first use, empty cache: total", seconds, "", target))
    return "\n".join(lines)


def _row(label: str, median: str, spread: str = "", target: str = "", last: str = "") -> str:
    return f"{label:49}{median:>11}  {spread:22}{target:19}{last}".rstrip()


def _cells(spread: dict[str, Any], style: str, relation: str = ">=") -> tuple[str, str, str]:
    target = ""
    if spread["target"] is not None:
        verdict = "met" if spread["met"] else "MISSED"
        target = f"{relation} {spread['target']:,.0f} {verdict}"
    low, high = format(spread["min"], style), format(spread["max"], style)
    return format(spread["median"], style), f"{low} .. {high}", target
