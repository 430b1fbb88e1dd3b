"""``sb3-roles bench train``: joint steps per second of whole training, and where the time goes.

Every case is an algorithm with its tuned configuration, trained in this process as ``train.py``
does: rollouts with the callbacks of a run, and updates; evaluations and checkpoints are left out.
The cases run in turn (A B A B ...), so that a busy machine slows all of them alike.
"""

from __future__ import annotations

import json
import os
import time
from argparse import Namespace
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from sb3_roles.zoo.algorithms import ALGORITHMS
from sb3_roles.zoo.bench_report import against, cells, machine_lines, row, spread
from sb3_roles.zoo.config import load_settings, merge, resolve
from sb3_roles.zoo.environments import AREA_SEARCH
from sb3_roles.zoo.machine import describe_machine
from sb3_roles.zoo.options import int_text, several_of, whole_number

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Subparsers

# What the project aims at with its tuned default; reported as met or missed, never asserted.
RATE_TARGETS = {"hmappo native": 1_500}
PARTS = ("environment", "inference", "buffer", "update")
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
    parser.add_argument("--scene", default=None, metavar="NAME", help="scene of the area search")
    parser.add_argument("--n-agents", type=int_text, default=None, metavar="N", help="robots")
    parser.add_argument(
        "--iterations",
        type=whole_number(1, 10_000),
        default=4,
        metavar="N",
        help="rollouts and updates of a case in a round",
    )
    parser.add_argument(
        "--repeats", type=whole_number(1, 1000), default=5, metavar="N", help="number of rounds"
    )
    parser.add_argument(
        "--num-threads",
        type=whole_number(1, 1024),
        default=None,
        metavar="T",
        help="threads of torch",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=run)


def run(args: Namespace) -> int:
    """Measure all cases and print the report.

    :param args: parsed arguments
    :return: exit code
    :raises UsageError: if an option does not fit the environment
    """
    configs = {
        f"{algo} {backend}": _configure(args, algo, backend)
        for algo in args.algo
        for backend in args.vec_env
    }
    machine = describe_machine()
    # Read when torch is imported, as in train.py.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    import torch as th

    if args.num_threads is not None:
        th.set_num_threads(args.num_threads)
    machine |= {"torch": th.__version__, "torch_threads": th.get_num_threads()}
    cases = [TrainingCase(name, config) for name, config in configs.items()]
    try:
        for _ in range(args.repeats):
            for case in cases:
                case.measure(args.iterations)
        report = {
            "config": {"iterations": args.iterations, "repeats": args.repeats},
            "machine": machine,
            "cases": [case.describe() for case in cases],
        }
    finally:
        for case in cases:
            case.close()
    print(json.dumps(report, indent=2, allow_nan=False) if args.json else _table(report))
    return 0


def _configure(args: Namespace, algo: str, backend: str) -> dict[str, Any]:
    options = {"scene": args.scene, "n_agents": args.n_agents}
    given = {key: value for key, value in options.items() if value is not None}
    settings = load_settings(algo, AREA_SEARCH)
    return resolve(algo, AREA_SEARCH, merge(settings, {"env_kwargs": given}), 0, backend)


class Stopwatch:
    """Adds up the time inside some methods of objects; what they call belongs to the outermost."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._inside = False

    def watch(self, part: str, owner: Any, method: str) -> None:
        """Count the time inside ``owner.method`` as that of a part.

        :param part: key in ``seconds``
        :param owner: any object; gets an attribute that shadows its method
        :param method: the method's name
        """
        original: Callable[..., Any] = getattr(owner, method)
        self.seconds.setdefault(part, 0.0)

        def timed(*args: Any, **options: Any) -> Any:
            if self._inside:
                return original(*args, **options)
            self._inside = True
            start = time.perf_counter()
            try:
                return original(*args, **options)
            finally:
                self.seconds[part] += time.perf_counter() - start
                self._inside = False

        setattr(owner, method, timed)


class TrainingCase:
    """One algorithm on one backend, warmed up by an iteration.

    :param name: what reports call it
    :param config: checked, see ``zoo.config``
    :raises UsageError: if algorithm and environment do not fit
    """

    def __init__(self, name: str, config: dict[str, Any]) -> None:
        from stable_baselines3.common.logger import Logger

        from sb3_roles.common.team_wrapper import find_team_env
        from sb3_roles.zoo.models import make_env, make_model

        self.name, self.config = name, config
        self.env = make_env(config)
        self.model: Any = make_model(config, self.env, "cpu")
        self.model.set_logger(Logger(None, []))
        team_env = find_team_env(self.env)
        self.n_agents, self.n_teams = team_env.n_agents, team_env.n_teams
        self.rates: list[float] = []
        self.joint_steps, self.optimizer_steps, self.seconds = 0, 0, 0.0
        self._train(1)
        self.watch = Stopwatch()
        self.watch.watch("update", self.model, "train")
        self.watch.watch("environment", self.model.env, "step")
        if hasattr(self.model, "rollout_groups"):
            # The policy itself runs on other threads.
            for method in ("_act", "_bootstrap", "_last_values"):
                self.watch.watch("inference", self.model, method)
        else:
            self.watch.watch("inference", self.model.policy, "forward")
        for method in ("add_streams", "add", "compute_stream_returns",
                       "compute_returns_and_advantage"):  # fmt: skip
            if hasattr(self.model.rollout_buffer, method):
                self.watch.watch("buffer", self.model.rollout_buffer, method)
        self._count_steps(self.model.policy.optimizer)

    def _count_steps(self, optimizer: Any) -> None:
        def count(*_: Any) -> None:
            self.optimizer_steps += 1

        optimizer.register_step_post_hook(count)

    def _train(self, iterations: int) -> None:
        from sb3_roles.common.callbacks import TeamMetricsCallback

        rows = iterations * self.model.n_steps * self.env.num_envs
        self.model.learn(rows, TeamMetricsCallback(), reset_num_timesteps=False)

    def measure(self, iterations: int) -> None:
        """Train for some iterations, and add the rate to ``rates``."""
        start = time.perf_counter()
        self._train(iterations)
        seconds = time.perf_counter() - start
        done = iterations * self.model.n_steps * self.n_teams
        self.rates.append(done / seconds)
        self.joint_steps += done
        self.seconds += seconds

    def describe(self) -> dict[str, Any]:
        """Return what was measured, plain data."""
        parts = {part: self.watch.seconds.get(part, 0.0) / self.seconds for part in PARTS}
        parts["rest"] = max(0.0, 1.0 - sum(parts.values()))
        epochs = getattr(self.model, "n_epochs", 1)
        return {
            "name": self.name,
            "n_agents": self.n_agents,
            "n_teams": self.n_teams,
            "joint_steps_per_second": against(spread(self.rates), RATE_TARGETS.get(self.name)),
            "share_of_time": parts,
            "observation_bytes_per_joint_step": self._buffer_bytes()
            / (self.model.n_steps * self.n_teams),
            "work": {
                "joint_steps": self.joint_steps,
                "robot_steps": self.joint_steps * self.n_agents,
                "samples_times_epochs": self.joint_steps * self.n_agents * epochs,
                "optimizer_steps": self.optimizer_steps,
            },
        }

    def _buffer_bytes(self) -> int:
        buffer = self.model.rollout_buffer
        if hasattr(buffer, "nbytes"):
            return int(buffer.nbytes)
        stored = buffer.observations
        return sum(array.nbytes for array in stored.values())

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


def _table(report: dict[str, Any]) -> str:
    config = report["config"]
    threads = report["machine"]["torch_threads"]
    lines = [
        *machine_lines(report["machine"]),
        f"{config['repeats']} interleaved rounds of {config['iterations']} iterations, "
        f"{threads} thread{'' if threads == 1 else 's'} of torch",
        "",
        row("joint steps per second of training", "median", "range", "target", "bytes/step"),
    ]
    for case in report["cases"]:
        label = f"{case['name']}, {case['n_teams']} teams of {case['n_agents']}"
        rate = cells(case["joint_steps_per_second"], ",.0f")
        lines.append(row(label, *rate, f"{case['observation_bytes_per_joint_step']:,.0f}"))
    lines += ["", f"{'share of the time, %':32}" + "".join(f"{p:>13}" for p in (*PARTS, "rest"))]
    for case in report["cases"]:
        shares = case["share_of_time"]
        values = "".join(f"{100 * shares[part]:13.1f}" for part in (*PARTS, "rest"))
        lines.append(f"{case['name']:32}{values}")
    lines += ["", f"{'work':32}{'joint steps':>13}{'optimizer steps':>17}{'samples x epochs':>18}"]
    for case in report["cases"]:
        work = case["work"]
        lines.append(
            f"{case['name']:32}{work['joint_steps']:13,}{work['optimizer_steps']:17,}"
            f"{work['samples_times_epochs']:18,}"
        )
    return "\n".join(lines)
