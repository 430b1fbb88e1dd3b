"""Area search through both backends of ``make_team_vec_env``: one trajectory."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from area_search import AreaSearchEnv, BatchedAreaSearch
from sb3_roles.common.team_vec_env import make_team_vec_env, team_seeds

OPTIONS: dict[str, Any] = {"height": 9, "width": 11, "n_targets": 20, "n_agents": 3, "horizon": 12}


def same(a: Any, b: Any) -> bool:
    """Compare arrays, numbers and dicts of them exactly."""
    if isinstance(a, dict):
        return set(a) == set(b) and all(same(a[key], b[key]) for key in a)
    return bool(np.array_equal(np.asarray(a), np.asarray(b)))


@pytest.mark.parametrize("sub_goal", ["none", "nearest", "assigned", "routes", "role_routes"])
@pytest.mark.parametrize("early_stop_patience", [None, 4])
@pytest.mark.parametrize("instance", [True, False])
def test_native_and_supersuit_play_the_same_episodes(
    sub_goal: str, early_stop_patience: int | None, instance: bool
) -> None:
    def make() -> AreaSearchEnv:
        return AreaSearchEnv("hard", sub_goal, early_stop_patience=early_stop_patience, **OPTIONS)

    native = make_team_vec_env(make, 4, seed=3, backend="native")
    supersuit = make_team_vec_env(make() if instance else make, 4, seed=3, backend="supersuit")
    rng = np.random.default_rng(0)
    assert same(native.reset(), supersuit.reset())
    finished = terminated = 0
    for _ in range(40):
        actions = rng.integers(0, 5, native.num_envs)
        outcomes = [env.step(actions) for env in (native, supersuit)]
        for part in range(3):
            assert same(outcomes[0][part], outcomes[1][part])
        for one, other in zip(outcomes[0][3], outcomes[1][3], strict=True):
            assert same(one, other)
            finished += "episode_metrics" in one
            terminated += one.get("TimeLimit.truncated") is False
        assert same(native.reward_components, supersuit.reward_components)
        assert same(native.metrics, supersuit.metrics)
    assert finished > 0
    assert (terminated > 0) == (early_stop_patience is not None)
    supersuit.close()


def test_a_team_plays_the_episodes_of_its_seed() -> None:
    env = make_team_vec_env(lambda: AreaSearchEnv("hard", **OPTIONS), 5, seed=8)
    observations = env.reset()
    for team, seed in enumerate(team_seeds(8, 5)):
        alone = BatchedAreaSearch("hard", **OPTIONS)
        alone.reset([seed])
        row = team * env.n_agents
        assert np.array_equal(observations["state"][row], alone.observations["state"][0])
