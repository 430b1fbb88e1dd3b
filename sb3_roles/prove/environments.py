"""R9 and R10: the area search in random play, against invariants and against a slow reference."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from area_search import SCENES, BatchedAreaSearch, Scene, get_scene
from area_search.paths import ROUTE_SUB_GOALS
from sb3_roles.prove.promises import Outcome, Setting
from sb3_roles.prove.reference_play import SideBySide
from sb3_roles.prove.search_rules import RULES
from sb3_roles.prove.search_watch import Watch, boards

ROBOTS = (1, 4, 8, 15)
_MOST_LINES = 20
# Two episodes and a part of a third.
_STEPS = 120
# What is played of each scene and team size: sub-goals, their share of the joint steps, options.
# Routes cost as much as a hundred other steps.
_VARIANTS: tuple[tuple[str, float, dict[str, Any]], ...] = (
    ("none", 0.5, {}),
    ("nearest", 0.3, {"early_stop_patience": 10, "reward_sharing": "same_role"}),
    ("assigned", 0.19, {"team_share": 0.3}),
    ("routes", 0.006, {}),
    ("role_routes", 0.004, {}),
)
_JOINT_STEPS, _QUICK_JOINT_STEPS = 1_000_000, 20_000
_REFERENCE_STEPS, _QUICK_REFERENCE_STEPS = 20_000, 300
# In plain Python, large teams and routes are slow: shares of the joint steps by ROBOTS, and by
# sub-goals.
_ROBOT_SHARES = (0.4, 0.3, 0.2, 0.1)
_COMPARED = {"none": 0.4, "nearest": 0.32, "assigned": 0.26, "routes": 0.012, "role_routes": 0.008}
_SHORT = 8


@dataclass
class _Part:
    """Some play of one scene."""

    scene: Scene
    sub_goal: str
    n_teams: int
    n_steps: int
    index: int


def _scenes() -> list[Scene]:
    return [get_scene(name, n_agents=n) for name in SCENES for n in ROBOTS]


def _watched_parts(quick: bool) -> Iterator[_Part]:
    scenes = _scenes()
    if quick:
        # One variant each, in turn, the next team size of a scene another one.
        teams = -(-_QUICK_JOINT_STEPS // (len(scenes) * _STEPS))
        for i, scene in enumerate(scenes):
            sub_goal, _, options = _VARIANTS[i % len(_VARIANTS)]
            size = (1, _STEPS // 8) if sub_goal in ROUTE_SUB_GOALS else (5 * teams + 7, _STEPS // 4)
            # Short episodes, so that some of them end.
            short = scene.with_options(horizon=_STEPS // 5, **options)
            yield _Part(short, sub_goal, *size, i)
        return
    for i, scene in enumerate(scenes):
        for k, (sub_goal, share, options) in enumerate(_VARIANTS):
            teams = -(-int(_JOINT_STEPS * share) // (len(scenes) * _STEPS))
            index = i * len(_VARIANTS) + k
            yield _Part(scene.with_options(**options), sub_goal, teams, _STEPS, index)


def _forgets(batch: BatchedAreaSearch, which: np.ndarray, seed: int) -> list[str]:
    """Compare teams that were reset with a batch that has played nothing before."""
    options = {"known_map": batch.known_map, "time": batch.time}
    fresh = BatchedAreaSearch(batch.scene, batch.n_teams, batch.sub_goal, **options)
    fresh.reset(seed, batch.episodes)
    shown = {key: (fresh.observations[key], value) for key, value in batch.observations.items()}
    shown["map"] = boards(fresh), boards(batch)
    return [
        f"reset_forgets: {name} of a reset is not that of a new batch, {batch.scene.name}, "
        f"{batch.n_agents} robots"
        for name, (one, other) in shown.items()
        if not np.array_equal(one[which], other[which])
    ]


def watched(part: _Part, seed: int) -> tuple[int, int, list[str]]:
    """Play at random and check all invariants at every step.

    :param part: what to play
    :param seed: of play
    :return: joint steps, those that break an invariant, and a line for each that was broken
    """
    rng = np.random.default_rng([seed, part.index])
    batch = BatchedAreaSearch(
        part.scene, part.n_teams, part.sub_goal, known_map=part.index % 2 == 0, time=True
    )
    stream = int(rng.integers(1 << 40))
    batch.reset(stream)
    watch = Watch(batch)
    lines = watch.begin()
    for _ in range(part.n_steps):
        shape = (batch.n_teams, batch.n_agents)
        batch.set_roles(rng.integers(0, 3, shape))
        lines += watch.step(rng.integers(0, 5, shape))
        done = batch.terminated | batch.truncated
        if done.any():
            batch.reset_teams(done)
            lines += watch.begin(done)
            forgotten = _forgets(batch, done, stream)
            lines += forgotten
            watch.broken += bool(forgotten)
    steps = part.n_steps * batch.n_teams
    return steps, min(watch.broken, steps), lines


def invariants(setting: Setting) -> Outcome:
    """R9: what always holds holds in random play.

    :param setting: how
    """
    steps = broken = 0
    lines: list[str] = []
    for part in _watched_parts(setting.quick):
        played, wrong, said = watched(part, setting.seed)
        steps, broken, lines = steps + played, broken + wrong, lines + said
        if not setting.quick and part.index % len(_VARIANTS) == 0:
            where = f"{part.scene.name}, {part.scene.n_agents} robots"
            setting.note(f"{where}; {steps:,} joint steps, {broken:,} with a violation")
    return Outcome(
        steps - broken,
        steps,
        f"joint steps without a violation of {len(RULES) + 1} invariants; {len(SCENES)} scenes, "
        f"{', '.join(map(str, ROBOTS))} robots",
        tuple(lines[:_MOST_LINES]),
    )


def _compared_parts(quick: bool) -> Iterator[_Part]:
    scenes = _scenes()
    for i, scene in enumerate(scenes):
        robots, number = ROBOTS.index(scene.n_agents), i * len(_COMPARED)
        if quick:
            sub_goal = list(_COMPARED)[i % len(_COMPARED)]
            steps = -(-_QUICK_REFERENCE_STEPS * 5 // 3 // len(scenes))
            if sub_goal in ROUTE_SUB_GOALS:
                steps = 1
            yield _Part(scene.with_options(horizon=_SHORT), sub_goal, 1, steps, number)
            continue
        for k, (sub_goal, share) in enumerate(_COMPARED.items()):
            most = _REFERENCE_STEPS * _ROBOT_SHARES[robots] * share / len(SCENES)
            # Of routes there are few steps: short episodes, so that some of them end.
            options = {"horizon": _SHORT} if sub_goal in ROUTE_SUB_GOALS else {}
            yield _Part(scene.with_options(**options), sub_goal, 1, int(np.ceil(most)), number + k)


def reference(setting: Setting) -> Outcome:
    """R10: the kernels agree with the slow reference in every byte that a user can see.

    :param setting: how
    """
    steps = differing = 0
    lines: list[str] = []
    for part in _compared_parts(setting.quick):
        scene = part.scene
        seed = int(np.random.default_rng([setting.seed, part.index]).integers(1 << 40))
        played = SideBySide(
            scene, seed, part.sub_goal, part.n_teams, known_map=seed % 3 == 0, time=seed % 2 == 0
        )
        where = f"{scene.name}, {scene.n_agents} robots, sub-goals {part.sub_goal}"
        lines += [f"{where}, reset: {text}" for found in played.differences() for text in found]
        for number in range(1, part.n_steps + 1):
            for found in played.step():
                steps += 1
                differing += bool(found)
                lines += [f"{where}, step {number}: {text}" for text in found]
        if not setting.quick:
            setting.note(f"{where}; {steps:,} joint steps, {differing:,} differ")
    return Outcome(
        steps - differing,
        steps,
        f"joint steps equal in every byte of observations, rewards, flags and metrics; "
        f"{len(SCENES)} scenes, {', '.join(map(str, ROBOTS))} robots, all sub-goals",
        tuple(lines[:_MOST_LINES]),
    )
