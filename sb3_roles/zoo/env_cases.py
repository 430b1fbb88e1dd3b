"""The ways to run the area-search environment that ``sb3-roles bench env`` measures."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from area_search.scenes import Scene, get_scene
from sb3_roles.zoo import environments

if TYPE_CHECKING:
    import numpy as np

# Routes in roles are a few more of the searches that routes are made of, and grow as these do.
SUB_GOALS = tuple(name for name in environments.SUB_GOALS if name != "role_routes")
# Fewer with routes, of which the horizon before the measurement would take minutes.
N_TEAMS, N_TEAMS_ROUTES, N_TEAMS_SUPERSUIT = 128, 16, 8
ROBOTS, SIDES = (1, 4, 15, 50), (25, 50, 100, 200)
TARGET_DENSITY = 0.16


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


def make_cases(grown: bool = True) -> dict[str, Case]:
    """Make every case, ready to run.

    :param grown: with larger teams and maps; else 4 robots on 25 x 25 cells only
    :return: by name
    """
    cases: list[Case] = []
    sizes = {(4, SIDES[0])}
    if grown:
        sizes |= {(n, side) for n in (4, 15) for side in (25, 100)}
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

    n_teams = N_TEAMS_ROUTES if sub_goal == "routes" else N_TEAMS
    batch = BatchedAreaSearch(scene, n_teams, sub_goal)
    batch.reset(0)
    actions = _actions((n_teams, scene.n_agents))
    # One horizon in which every team is reset once, each share of them at another step: from then
    # on the resets, which cost many times a step, are spread evenly.
    for step in range(scene.horizon):
        batch.step(next(actions))
        batch.reset_teams(np.arange(n_teams) * scene.horizon // n_teams == step)

    def work() -> int:
        batch.step(next(actions))
        ended = batch.terminated | batch.truncated
        if ended.any():
            batch.reset_teams(ended)
        return n_teams

    return Case("native", scene, sub_goal, n_teams, work)


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
