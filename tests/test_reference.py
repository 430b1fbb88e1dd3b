"""The kernels agree with the plain-Python reference, step by step and bit by bit."""

from __future__ import annotations

import numpy as np
import pytest

from area_search import BatchedAreaSearch, Scene
from area_search.reference import ReferenceAreaSearch


def assert_same(batch: BatchedAreaSearch, references: list[ReferenceAreaSearch]) -> None:
    """Compare everything that a user can see of each team."""
    for m, reference in enumerate(references):
        observations = reference.observe()
        for key, array in batch.observations.items():
            if key in batch.team_observation_keys:
                expected = observations[0][key]
            else:
                expected = np.stack([observation[key] for observation in observations])
            assert array.dtype == expected.dtype
            assert np.array_equal(array[m], expected), f"{key}: {array[m]} != {expected}"
        if reference.n_steps:
            assert np.array_equal(batch.reward_components[m], reference.reward_components())
            assert np.array_equal(batch.rewards[m], reference.rewards())
            metrics = batch.episode_metrics(m)
            assert {name: metrics[name] for name in batch.metric_names} == reference.metrics()
            assert metrics["t90_paper"] == reference.t90_paper
            assert metrics["t90_true"] == reference.t90_true
            assert metrics["length"] == reference.n_steps
            assert batch.terminated[m] == reference.terminated
            assert batch.truncated[m] == reference.truncated


def compare(scene: Scene, seed: int, sub_goal: str, n_teams: int, n_episodes: int) -> int:
    """Play random episodes on both; return the number of compared steps."""
    rng = np.random.default_rng(seed)
    time = bool(seed % 2)
    batch = BatchedAreaSearch(scene, n_teams, sub_goal, time=time)
    batch.reset(seed)
    episodes = np.arange(n_teams)
    references = [ReferenceAreaSearch(scene, seed, int(e), sub_goal, time=time) for e in episodes]
    compared = ended = 0
    assert_same(batch, references)
    while ended < n_episodes * n_teams:
        actions = rng.integers(0, 5, (n_teams, scene.n_agents))
        roles = rng.integers(0, 3, (n_teams, scene.n_agents))
        batch.set_roles(roles)
        batch.step(actions)
        for reference, moves, own in zip(references, actions, roles, strict=True):
            reference.roles = own.tolist()
            reference.step(moves.tolist())
        assert_same(batch, references)
        compared += n_teams
        done = batch.terminated | batch.truncated
        if done.any():
            ended += int(done.sum())
            batch.reset_teams(done)
            episodes[done] += n_teams
            for m in np.flatnonzero(done):
                episode = int(episodes[m])
                references[m] = ReferenceAreaSearch(scene, seed, episode, sub_goal, time=time)
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


# 8 x 3 x 40 random scenes on small maps; together with the paper's scenes more than 1e5 steps.
@pytest.mark.parametrize("sub_goal", ["none", "nearest", "assigned", "routes"])
@pytest.mark.parametrize("part", range(8))
def test_random_scenes(sub_goal: str, part: int) -> None:
    rng = np.random.default_rng([part, len(sub_goal)])
    # In plain Python, all routes of a step take as long as twenty other steps.
    least = 200 if sub_goal == "routes" else 4000
    compared = 0
    while compared < least:
        scene = random_scene(rng, 8)
        compared += compare(scene, int(rng.integers(1 << 40)), sub_goal, 3, 3)
    assert compared >= least
