"""Ray's workers killed in the middle of their work; only with the extra ``ray``."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_roles.baselines import controller_class
from sb3_roles.baselines.random import RandomController
from sb3_roles.common.group_play import GroupRecord, GroupTask
from sb3_roles.common.ray_cluster import LOCAL, connect, disconnect
from sb3_roles.common.ray_cluster import ray as the_ray
from sb3_roles.common.rollout_steps import Learner
from sb3_roles.evaluation.grid.entrants import Entrant
from sb3_roles.evaluation.grid.plan_file import parse_plan
from sb3_roles.evaluation.grid.play import play
from sb3_roles.evaluation.grid.ray_crew import RayCrew
from sb3_roles.evaluation.grid.store import RecordStore
from sb3_roles.prove.promises import Setting
from sb3_roles.prove.remains import first_odd, remains_of_records, remains_of_run
from sb3_roles.prove.small_runs import ITERATION, small_run
from sb3_roles.prove.training_runs import torch_threads, train_here
from sb3_roles.zoo.ray_rollouts import MAX_RETRIES, RayPlayer, play_task

_GROUPS = 2
_ROUNDS, _QUICK_ROUNDS = 4, 2


class Trial(NamedTuple):
    """One comparison.

    :param name: what was done
    :param deaths: workers that were killed
    :param odd: what differs; empty if nothing does
    """

    name: str
    deaths: int
    odd: str


def die_once(marker: Path) -> None:
    """End this process as a failing machine would, unless another one has died of the same marker.

    :param marker: a file that is made before
    """
    try:
        marker.touch(exist_ok=False)
    except FileExistsError:
        return
    os.kill(os.getpid(), signal.SIGKILL)


def play_and_die(
    config: str,
    folder: str,
    task: GroupTask,
    weights: Mapping[str, th.Tensor],
    n_threads: int,
    marker: Path,
) -> GroupRecord:
    """Play, and die with what was played, once for each marker; see ``ray_rollouts.play_task``."""
    record = play_task(config, folder, task, weights, n_threads)
    die_once(marker)
    return record


class DeadlyPlayer(RayPlayer):
    """Loses a worker in each round.

    :param learner: see :class:`RayPlayer`
    :param config: see :class:`RayPlayer`
    :param n_workers: see :class:`RayPlayer`
    :param markers: folder of a file for each death
    """

    def __init__(
        self, learner: Learner, config: Mapping[str, Any], n_workers: int, markers: Path
    ) -> None:
        super().__init__(learner, config, n_workers)
        self._play_and_die = the_ray.remote(num_cpus=1, max_retries=MAX_RETRIES)(play_and_die)
        self._markers, self._round = markers, 0

    def run(
        self, tasks: Sequence[GroupTask], weights: Mapping[str, th.Tensor]
    ) -> list[GroupRecord]:
        """Play some tasks, which are a round."""
        self._round += 1
        return super().run(tasks, weights)

    def submit(self, task: GroupTask, weights: Any, n_threads: int) -> Any:
        """Send one task."""
        marker = self._markers / f"round_{self._round}"
        return self._play_and_die.remote(
            self._config, os.getcwd(), task, weights, n_threads, marker
        )


def training_trials(setting: Setting) -> list[Trial]:
    """Train with one and two workers, of which one dies in each round, and without Ray.

    :param setting: see :class:`Setting`
    """
    rounds = _QUICK_ROUNDS if setting.quick else _ROUNDS
    config = small_run("hmappo", n_iterations=rounds, seed=setting.seed, rollout_groups=_GROUPS)
    trials = []
    with torch_threads(1):
        alone = setting.folder / "alone"
        train_here(alone, config, save_freq=ITERATION)
        expected = remains_of_run(alone)
        for n_workers in (1,) if setting.quick else (1, 2):
            name = f"{rounds} rounds of training with {n_workers} worker{'s'[: n_workers - 1]}"
            setting.note(name)
            run, markers = (setting.folder / f"{one}_{n_workers}" for one in ("run", "markers"))
            markers.mkdir()
            _train(run, config, n_workers, markers)
            deaths = len(list(markers.iterdir()))
            odd = first_odd(expected, remains_of_run(run))
            if deaths != rounds:
                odd = odd or f"{deaths} of {rounds} workers died, nothing was tried"
            trials.append(Trial(name, deaths, odd))
    return trials


def _train(run: Path, config: Mapping[str, Any], n_workers: int, markers: Path) -> None:
    connect(LOCAL, n_workers)
    try:

        def use_ray(model: OnPolicyAlgorithm) -> None:
            learner: Any = model
            learner.player = DeadlyPlayer(learner, config, n_workers, markers)

        train_here(run, config, save_freq=ITERATION, prepare=use_ray)
    finally:
        disconnect()


# The grid of evaluations


class Deadly(RandomController):
    """Random, and kills its process when it begins to play, once for each marker."""

    def __init__(self, marker: Path) -> None:
        self._marker = marker

    def begin(self, batch: Any) -> None:
        """Die, or begin."""
        die_once(self._marker)
        super().begin(batch)


def make_deadly(entrant: Entrant) -> Any:
    """Make a scripted controller, or one that kills its worker: ``deadly:<marker>``.

    :param entrant: who
    """
    kind, _, marker = entrant.source.partition(":")
    return Deadly(Path(marker)) if kind == "deadly" else controller_class(kind)()


def grid_trial(setting: Setting) -> Trial:
    """Play a grid on two workers, of which one is killed, and in this process.

    :param setting: see :class:`Setting`
    """
    table: dict[str, Any] = {
        "caption": "Two scenes",
        "n_agents": [2],
        "scenes": {"easy": "Easy", "hard": "Hard"},
        "metrics": ["cover"],
        "rows": ["random", "greedy", "deadly"],
    }
    labels = {"random": "random", "greedy": "greedy", "deadly": "random"}
    plan = parse_plan(
        {
            "episodes": 6,
            "quick_episodes": 2,
            "seed": 1000,
            "rows": {
                name: {"label": name.title(), "controller": controller, "block": 3}
                for name, controller in labels.items()
            },
            "tables": {"I": table},
            "figures": {},
        }
    )
    marker = setting.folder / "grid_death"
    sources = {**dict.fromkeys(labels), "deadly": f"deadly:{marker}"}
    entrants = {name: [Entrant(name, source or name)] for name, source in sources.items()}
    stores = {name: RecordStore(setting.folder / name) for name in ("grid", "own")}
    crew = RayCrew(LOCAL, make_deadly, stores["grid"], 2)
    try:
        played = play(plan, entrants, stores["grid"], make_deadly, report=setting.note, crew=crew)
    finally:
        crew.close()
    deaths = int(marker.exists())
    own = play(plan, entrants, stores["own"], make_deadly, report=setting.note)
    found, expected = ({str(key): remains_of_records(one.records)
                        for key, ones in outcome.results.items() for one in ones}
                       for outcome in (played, own))  # fmt: skip
    odd = first_odd(expected, found) or ", ".join([*played.failures, *own.failures])
    if not deaths:
        odd = odd or "no worker died, nothing was tried"
    return Trial("a grid of evaluations with 2 workers", deaths, odd)
