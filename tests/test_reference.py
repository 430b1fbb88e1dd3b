"""The kernels agree with the plain-Python reference, step by step and bit by bit."""

from __future__ import annotations

import numpy as np
import pytest

from area_search import Scene
from sb3_roles.prove.reference_play import SideBySide


def compare(scene: Scene, seed: int, sub_goal: str, n_teams: int, n_episodes: int) -> int:
    """Play random episodes on both; return the number of compared steps."""
    played = SideBySide(scene, seed, sub_goal, n_teams, time=bool(seed % 2))
    assert not any(played.differences())
    compared = 0
    while played.ended < n_episodes * n_teams:
        assert not any(found := played.step()), found
        compared += n_teams
    return compared


def random_scene(rng: np.random.Generator, largest: int) -> Scene:
    """Draw any valid scene up to a size."""
    height, width = (int(n) for n in rng.integers(5, largest + 1, 2))
    scene = Scene(
        name="random",
        height=height,
        width=width,
        free_fraction=float(rng.choice([0.3, 0.49, 0.6, 0.84, 1.0])),
        n_targets=1,
        n_agents=int(rng.integers(1, 7)),
        spawn_sigma=float(rng.choice([0.0, 1.0, 5.0])),
        sensor_radius=float(rng.choice([0.0, 1.0, 1.5, 2.0, 3.2])),
        view_radius=int(rng.integers(1, 6)),
        communication_radius=float(rng.choice([0.0, 2.0, 3.5, 10.0])),
        horizon=int(rng.integers(1, 40)),
        early_stop_patience=[None, 10, 3][rng.integers(3)],
        explore_normalizer=float(rng.choice([3.0, 5.0, 16.52])),
        reward_sharing=(sharing := str(rng.choice(["own", "same_role"]))),
        team_share=float(rng.choice([0.0, 0.3, 1.0])) if sharing == "own" else 0.0,
        alpha=float(rng.choice([0.4, 0.1, 0.0])),
        beta=float(rng.choice([0.6, 0.9, 1.0])),
    )
    return scene.with_options(n_targets=int(rng.integers(1, scene.n_free + 1)))


# Random scenes on small maps, 8 parts for each kind of sub-goal; with the paper's scenes more
# than 1e5 steps in all.
@pytest.mark.parametrize("sub_goal", ["none", "nearest", "assigned", "routes", "role_routes"])
@pytest.mark.parametrize("part", range(8))
def test_random_scenes(sub_goal: str, part: int) -> None:
    rng = np.random.default_rng([part, len(sub_goal)])
    # In plain Python, all routes of a step take as long as twenty other steps.
    least = 200 if "routes" in sub_goal else 4000
    compared = 0
    while compared < least:
        scene = random_scene(rng, 8)
        compared += compare(scene, int(rng.integers(1 << 40)), sub_goal, 3, 3)
    assert compared >= least
