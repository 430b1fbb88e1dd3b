"""``sb3-roles bench growth``: what a joint step costs with more robots, and on larger maps.

Rollouts and updates of the tuned HMAPPO are measured separately, and the environment by itself,
with random actions. Maps keep the density of targets. All cases run in turn, so that exponents are
taken within a round.
"""

from __future__ import annotations

import math
import time
from argparse import ArgumentTypeError, Namespace
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING, Any

from sb3_roles.zoo.bench_case import TrainingCase, configure, training_case
from sb3_roles.zoo.bench_memory import available_memory
from sb3_roles.zoo.bench_report import (
    Table,
    log_log_slope,
    machine_lines,
    plural,
    rounds_line,
    spread,
)
from sb3_roles.zoo.bench_rounds import add_round_options, print_report
from sb3_roles.zoo.env_cases import make_scene
from sb3_roles.zoo.machine import start_torch
from sb3_roles.zoo.options import UsageError, names_of, output_file, whole_number

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Subparsers

ROBOTS, SIDES = (4, 8, 15, 50), (25, 50, 100)
PARTS = ("update", "rollout", "environment")
# What a rollout may take of the free memory: all cases are alive, and minibatches are copies.
_SHARE = 0.25


def add_parser(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "growth",
        help="cost of a joint step with more robots and on larger maps",
        description="Measure what a joint step of training costs for several numbers of robots, "
        "and on several maps: update, rollout, and the environment by itself.",
    )
    parser.add_argument(
        "--robots",
        type=_several_numbers(1, 1024),
        default=ROBOTS,
        metavar="N,...",
        help="numbers of robots on the smallest map (default: 4,8,15,50)",
    )
    parser.add_argument(
        "--sides",
        type=_several_numbers(9, 1024),
        default=SIDES,
        metavar="N,...",
        help="sides of the maps for the smallest team, in cells (default: 25,50,100)",
    )
    parser.add_argument(
        "--plot", type=output_file(".png", ".svg", ".pdf"), metavar="FILE", help="draw it, too"
    )
    add_round_options(parser, iterations=1, repeats=3)
    parser.set_defaults(run=run)


def _several_numbers(low: int, high: int) -> Callable[[str], tuple[int, ...]]:
    number = whole_number(low, high)

    def numbers(text: str) -> tuple[int, ...]:
        found = tuple(sorted({number(name) for name in names_of(text)}))
        if len(found) < 2:
            raise ArgumentTypeError(f"growth needs two different numbers or more, got {text!r}")
        return found

    return numbers


def run(args: Namespace) -> int:
    """Measure the growth and print the report.

    :param args: parsed arguments
    :return: exit code
    :raises UsageError: if there is nothing to draw with
    """
    if args.plot:
        check_plots()
    sizes = [(n, args.sides[0]) for n in args.robots]
    sizes += [(args.robots[0], side) for side in args.sides[1:]]
    configs = {size: configure(changes=_changes(*size), n_envs=args.n_envs) for size in sizes}
    machine = start_torch(args.num_threads)
    with ExitStack() as stack:
        cases = {}
        for size, config in configs.items():
            fitting = _fitted(config, size, len(configs))
            cases[size] = stack.enter_context(closing(GrowthCase(size, fitting)))
        for _ in range(args.repeats):
            for case in cases.values():
                case.measure(args.iterations)
        report = {
            "config": {"iterations": args.iterations, "repeats": args.repeats},
            "machine": machine,
            "cases": [case.describe() for case in cases.values()],
            "growth": _exponents(cases, args.robots, args.sides),
        }
    print_report(args, report, _head(report), _tables(report))
    if args.plot:
        from sb3_roles.zoo.bench_growth_plot import draw

        draw(report, args.plot)
    return 0


def _changes(n_agents: int, side: int) -> dict[str, Any]:
    scene = make_scene(n_agents, side)
    fields = ("n_agents", "height", "width", "n_targets")
    return {"env_kwargs": {"scene": "hard", **{name: getattr(scene, name) for name in fields}}}


def _fitted(config: dict[str, Any], size: tuple[int, int], n_cases: int) -> dict[str, Any]:
    """Return the configuration with as many teams as fit the memory."""
    available = available_memory()
    teams: int = config["n_envs"]
    if available is None:
        return config
    limit = _SHARE * available / n_cases
    while teams > 1 and observation_bytes(config) * teams * config["n_steps"] > limit:
        teams //= 2
    if teams == config["n_envs"]:
        return config
    return configure(changes=_changes(*size), n_envs=teams)


def observation_bytes(config: Mapping[str, Any]) -> int:
    """Return the bytes of the observations of a joint step at most: a team's maps are stored once.

    :param config: checked
    """
    from sb3_roles.common.team_wrapper import find_team_env
    from sb3_roles.zoo.models import make_env

    env = make_env(config, n_envs=1)
    try:
        team = find_team_env(env)
        total = 0
        for key, space in env.observation_space.spaces.items():  # type: ignore[attr-defined]
            copies = 1 if key in team.team_keys else team.n_agents
            total += copies * math.prod(space.shape) * space.dtype.itemsize
        return total
    finally:
        env.close()


class GrowthCase:
    """One size of the task: a training, and an environment that is stepped by itself.

    :param size: robots, and side of the map
    :param config: checked
    """

    def __init__(self, size: tuple[int, int], config: Mapping[str, Any]) -> None:
        from sb3_roles.zoo.models import make_env

        self.size = size
        self.training: TrainingCase = training_case(f"{size[0]} robots {size[1]}x{size[1]}", config)
        self.env: Any = make_env(config)
        self.env.seed(0)
        self.env.reset()
        self.env_costs: list[float] = []
        self._step_alone(1)

    def _step_alone(self, n_steps: int) -> float:
        """Return seconds; the actions are drawn before."""
        import numpy as np

        choices = self.env.action_space.nvec
        shape = (n_steps, self.env.num_envs, len(choices))
        actions = np.random.default_rng(0).integers(0, choices, shape)
        start = time.perf_counter()
        for chosen in actions:
            self.env.step(chosen)
        return time.perf_counter() - start

    def measure(self, iterations: int) -> None:
        """Train, and step the environment by itself as often."""
        self.training.measure(iterations)
        n_steps = iterations * self.training.model.n_steps
        self.env_costs.append(self._step_alone(n_steps) / (n_steps * self.training.n_teams))

    def costs(self, part: str) -> list[float]:
        """Return seconds per joint step by round.

        :param part: one of :data:`PARTS`
        """
        return {
            "update": self.training.update_costs,
            "rollout": self.training.rollout_costs,
            "environment": self.env_costs,
        }[part]

    def describe(self) -> dict[str, Any]:
        """Return what was measured, plain data."""
        found = self.training.describe()
        return {
            "n_agents": self.size[0],
            "side": self.size[1],
            "n_teams": self.training.n_teams,
            "joint_steps_per_second": spread(self.training.rates),
            "microseconds": {
                part: spread([1e6 * cost for cost in self.costs(part)]) for part in PARTS
            },
            "observation_bytes_per_joint_step": found["observation_bytes_per_joint_step"],
            "memory": found["memory"],
            "work": found["work"],
        }

    def close(self) -> None:
        """Close the environments."""
        self.training.close()
        self.env.close()


def _exponents(
    cases: Mapping[tuple[int, int], GrowthCase], robots: Sequence[int], sides: Sequence[int]
) -> list[dict[str, Any]]:
    found = []
    for along, sizes, some in (
        ("robots", list(robots), [cases[n, sides[0]] for n in robots]),
        ("cells", [side * side for side in sides], [cases[robots[0], side] for side in sides]),
    ):
        for part in PARTS:
            rounds = zip(*(case.costs(part) for case in some), strict=True)
            exponents = [log_log_slope(sizes, costs) for costs in rounds]
            found.append(
                {"along": along, "sizes": sizes, "part": part, "exponent": spread(exponents)}
            )
    return found


def _head(report: Mapping[str, Any]) -> list[str]:
    return [
        *machine_lines(report["machine"]),
        f"{rounds_line(report['config'])}; microseconds per joint step, median",
    ]


def _tables(report: Mapping[str, Any]) -> list[Table]:
    costs = Table(
        ("robots, map", "teams", *PARTS, "joint steps/s", "range", "bytes/joint step",
         "DictRolloutBuffer")
    )  # fmt: skip
    for case in report["cases"]:
        rate = case["joint_steps_per_second"]
        costs.add(
            f"{plural(case['n_agents'], 'robot')}, {case['side']} x {case['side']}",
            str(case["n_teams"]),
            *(f"{case['microseconds'][part]['median']:,.0f}" for part in PARTS),
            f"{rate['median']:,.0f}",
            f"{rate['min']:,.0f} .. {rate['max']:,.0f}",
            f"{case['observation_bytes_per_joint_step']:,.0f}",
            f"{case['memory']['dict_rollout_buffer_float32']['ratio']:.1f} times",
        )
    growth = Table(("exponent of the cost", *PARTS))
    for along in ("robots", "cells"):
        lines = [one for one in report["growth"] if one["along"] == along]
        label = f"{along} {' '.join(map(str, lines[0]['sizes']))}"
        growth.add(label, *(f"{one['exponent']['median']:.2f}" for one in lines))
    return [costs, growth]


def check_plots() -> None:
    """Refuse to begin what can not be drawn in the end.

    :raises UsageError: if matplotlib is not there
    """
    from sb3_roles.evaluation.figures.files import drawing_style

    try:
        with drawing_style("growth"):
            pass
    except ImportError as error:
        raise UsageError(f"argument --plot: {error}") from None
