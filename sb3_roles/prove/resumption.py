"""R2: training that was cut and resumed ends in what straight training ends in."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.logger import Logger

from sb3_roles.common.checkpoint import CheckpointError, CheckpointFolder
from sb3_roles.prove.promises import Outcome, Setting
from sb3_roles.prove.small_runs import (
    ITERATION,
    SMALL_POLICIES,
    SMALL_SCENE,
    STEPS,
    TEAMS,
    small_run,
)
from sb3_roles.prove.training_runs import (
    Trained,
    checkpoint_difference,
    log_difference,
    stir,
    torch_threads,
    train_here,
)
from sb3_roles.zoo.algorithms import ALGORITHMS, POLICY_ARGUMENTS
from sb3_roles.zoo.config import load_settings, merge
from sb3_roles.zoo.environments import AREA_SEARCH
from sb3_roles.zoo.models import make_env, make_model
from sb3_roles.zoo.run_folder import CHECKPOINTS

N_ITERATIONS = 8
CUTS = tuple(range(1, N_ITERATIONS))
"""Iterations after which a run is cut."""
_QUICK_CUTS = (1, 3)
_QUICK_ITERATIONS = 4
_QUICK = ("gnn", "recurrent_ppo")
_THREADS = (1, 2)
# Two updates an epoch: more of them cost time and resume no other way.
_BATCH = {"batch_size": ITERATION // 2}


@dataclass(frozen=True)
class Case:
    """One run that is cut.

    :param algo: of the registry
    :param threads: of torch
    :param precision: ``"fp32"``, ``"bf16"``, or empty for a policy that has but one
    :param backend: of ``make_team_vec_env``
    :param what: further words on it
    :param changes: keys of the configuration to replace
    """

    algo: str
    threads: int = 1
    precision: str = ""
    backend: str = "native"
    what: str = ""
    changes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """What messages call it."""
        words = (self.algo, self.what, self.backend, self.precision)
        return ", ".join([*filter(None, words), f"{self.threads} threads"])

    def config(self, n_iterations: int, seed: int) -> dict[str, Any]:
        """Return its checked configuration, of a run that is stopped before its last iteration.

        At the end of a run the learning rate is 0, and whatever was forgotten would not show.

        :param n_iterations: that are trained
        :param seed: of the run
        """
        batch = _BATCH if "batch_size" in ALGORITHMS[self.algo].parameters else {}
        changes = {**batch, **self.changes}
        if self.precision:
            own = SMALL_POLICIES[next(iter(ALGORITHMS[self.algo].policies))]
            given = changes.get("policy_kwargs", own)
            changes["policy_kwargs"] = {**given, "precision": self.precision}
        return small_run(self.algo, self.backend, n_iterations + 1, seed=seed, **changes)


def precisions(algo: str) -> tuple[str, ...]:
    """Return the precisions that an algorithm's policy offers; one empty text if none.

    :param algo: of the registry
    """
    policy = next(iter(ALGORITHMS[algo].policies))
    return ("fp32", "bf16") if "precision" in POLICY_ARGUMENTS[policy] else ("",)


def of_defaults() -> dict[str, Any]:
    """Return the keys of HMAPPO's own configuration, with sub-goals by routes, in small."""
    settings = load_settings("hmappo", AREA_SEARCH)
    small = {"n_envs": TEAMS, "n_steps": STEPS, **_BATCH}
    changed = merge(settings, {**small, "env_kwargs": SMALL_SCENE})
    # The length of the run is the experiment's.
    return {key: value for key, value in changed.items() if key not in ("n_timesteps", "policy")}


def all_cases() -> list[Case]:
    """Return the runs of the full form."""
    cases = [
        Case(algo, threads, precision)
        for algo in ALGORITHMS
        for threads in _THREADS
        for precision in precisions(algo)
    ]
    # What plays but does not learn from it is the same on any backend.
    cases += [Case(name, backend="supersuit") for name, one in ALGORITHMS.items() if not one.clones]
    mix = {**SMALL_SCENE, "scene": ["easy", "hard"], "sub_goal": "assigned"}
    sticky = {"role_every": 3, "role_control": "learned"}
    return [
        *cases,
        *(
            Case("hmappo", threads, what=what, changes=changes)
            for threads in _THREADS
            for what, changes in (
                ("groups and shards", {"rollout_groups": 2, "n_shards": 2}),
                ("roles of 3 steps", {"wrapper_kwargs": sticky}),
                ("its defaults with routes", of_defaults()),
                ("a mix of scenes", {"env_kwargs": mix}),
                ("a KL penalty", {"kl_coef": 0.5, "kl_target": 0.01}),
            )
        ),
    ]


def quick_cases() -> list[Case]:
    """Return the runs of the short form."""
    return [Case(algo, precision=precisions(algo)[-1]) for algo in _QUICK] + [
        Case("hmappo", 2, what="its defaults with routes", changes=of_defaults())
    ]


class _Photographer(CheckpointFolder):
    """Keeps what the run folder is when a checkpoint has just been written."""

    def __init__(self, run: Path, photographs: Path) -> None:
        super().__init__(run / CHECKPOINTS)
        self._run, self._photographs = run, photographs

    def save(self, env_steps: int, **content: Any) -> Path:
        path = super().save(env_steps, **content)
        shutil.copytree(self._run, self._photographs / str(env_steps // ITERATION))
        return path


def cuts(setting: Setting) -> Outcome:
    """Cut and resume runs of every algorithm, and compare what they end in.

    :param setting: see :class:`Setting`
    """
    cases = quick_cases() if setting.quick else all_cases()
    n_iterations = _QUICK_ITERATIONS if setting.quick else N_ITERATIONS
    after = _QUICK_CUTS if setting.quick else CUTS
    held, failures = 0, []
    for i, case in enumerate(cases):
        setting.note(f"{i + 1} of {len(cases)}: {case.name}")
        broken = try_case(case, setting.folder / str(i), n_iterations, after, setting.seed)
        held += len(after) - len(broken)
        for cut, why in broken.items():
            failures.append(f"{case.name}, cut after {cut}: {why} is not that of the straight run")
            setting.note(failures[-1])
    algos = len({case.algo for case in cases})
    alone = ", ".join(name for name in ALGORITHMS if not precisions(name)[0])
    said = (
        f"cuts of {len(cases)} runs of {n_iterations} iterations, {algos} algorithms: weights, "
        f"optimizer, whole state and logs those of straight runs; {alone} have one precision"
    )
    of_stock = after[:1] if setting.quick else after
    stock = stock_cuts(setting.seed, setting.folder / "stock", n_iterations, of_stock)
    return Outcome(held, len(cases) * len(after), said, tuple(failures), stock)


def try_case(
    case: Case, folder: Path, n_iterations: int, after: Sequence[int], seed: int
) -> dict[int, str]:
    """Train straight, train with a checkpoint after each iteration, and resume from those.

    :param case: the run
    :param folder: of its own
    :param n_iterations: of the whole run
    :param after: iterations after which it is cut
    :param seed: of the run
    :return: what differs by the cut that it was found at
    """
    config, end = case.config(n_iterations, seed), n_iterations * ITERATION
    photographs = folder / "cut"
    with torch_threads(case.threads):
        straight = train_here(folder / "straight", config, stop_at=end)
        saving = folder / "saving"
        train_here(
            saving,
            config,
            stop_at=end,
            save_freq=ITERATION,
            checkpoints=_Photographer(saving, photographs),
            process=seed + 100,
        )
        broken = {}
        for cut in after:
            run = photographs / str(cut)
            why = _resume(run, config, end, 200 + cut, straight) or log_difference(
                folder / "straight", run
            )
            if why is not None:
                broken[cut] = why
    shutil.rmtree(folder)
    return broken


def _resume(
    run: Path, config: Mapping[str, Any], end: int, process: int, straight: Trained
) -> str | None:
    """Go on as another process would; return what is not as in the straight run."""
    with open(run / "progress.csv", "a", encoding="utf-8") as file:
        # Of an iteration that was begun before the process died.
        file.write("1,2,3\n1,")
    try:
        resumed = train_here(run, config, resume=True, stop_at=end, process=process)
    except CheckpointError as error:
        return str(error)
    return checkpoint_difference(straight.newest, resumed.newest)


# The stock stack


def stock_cuts(seed: int, folder: Path, n_iterations: int, after: Sequence[int]) -> str:
    """Do the same with SB3's own save, load and learn, and say how far the weights are off.

    :param seed: of the run
    :param folder: of its own
    :param n_iterations: of the whole run
    :param after: iterations after which it is saved
    """
    # A constant rate: of two calls of learn() each would let a schedule fall to its end.
    config = small_run("ppo", n_iterations=n_iterations, seed=seed, learning_rate=1e-3)
    folder.mkdir(parents=True)
    with torch_threads(1):
        straight = _learn(config, n_iterations, folder, None)
        again = _learn(config, n_iterations, folder, None)
        gaps = [_gap(straight, _learn(config, n_iterations, folder, cut)) for cut in after]
    twice = "" if _gap(straight, again) == 0.0 else " (two straight runs differ, too)"
    different = np.count_nonzero(gaps)
    return (
        f"SB3's PPO after save, load, learn: other weights at {different} of {len(gaps)} cuts, "
        f"by up to {max(gaps):.1e}{twice}"
    )


def _learn(
    config: Mapping[str, Any], n_iterations: int, folder: Path, cut: int | None
) -> dict[str, th.Tensor]:
    """Learn straight, or with a save and load in between; return the weights."""
    stir(99)
    env = make_env(config)
    rows = ITERATION * env.num_envs // TEAMS
    model: Any = make_model(config, env, "cpu")
    model.set_logger(Logger(None, []))
    model.learn((cut or n_iterations) * rows)
    if cut is not None:
        model.save(folder / "model")
        env.close()
        stir(100)
        env = make_env(config)
        model = type(model).load(folder / "model", env=env, device="cpu")
        model.set_logger(Logger(None, []))
        model.learn((n_iterations - cut) * rows, reset_num_timesteps=False)
    env.close()
    return {name: one.clone() for name, one in model.policy.state_dict().items()}


def _gap(one: Mapping[str, th.Tensor], other: Mapping[str, th.Tensor]) -> float:
    return max(float((one[name] - other[name]).abs().max()) for name in one)
