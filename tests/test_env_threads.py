"""Teams of a batch on several threads: every array is the one of a single thread."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from area_search import BatchedAreaSearch
from area_search.team_slices import even_slices
from sb3_roles.zoo.config import load_settings, merge, resolve
from sb3_roles.zoo.environments import AREA_SEARCH

N_TEAMS, N_AGENTS = 7, 3
SMALL: dict[str, Any] = {"height": 11, "width": 12, "n_targets": 12, "horizon": 9}


def make(n_threads: int, sub_goal: str = "assigned") -> BatchedAreaSearch:
    return BatchedAreaSearch("hard", N_TEAMS, sub_goal, True, n_threads, n_agents=N_AGENTS, **SMALL)


def play(batch: BatchedAreaSearch, steps: int = 25) -> list[dict[str, np.ndarray]]:
    """Play with resets; return observations and state after every step."""
    rng = np.random.default_rng(0)
    if not batch._started:
        batch.reset(range(N_TEAMS))
    found = []
    for _ in range(steps):
        batch.step(rng.integers(0, 5, (N_TEAMS, N_AGENTS)))
        done = batch.terminated | batch.truncated
        outcome = {**batch.observations, **batch.get_state()}
        found.append({name: value.copy() for name, value in outcome.items()})
        batch.reset_teams(done)
    return found


def assert_same(first: list[dict[str, np.ndarray]], second: list[dict[str, np.ndarray]]) -> None:
    for one, other in zip(first, second, strict=True):
        assert one.keys() == other.keys()
        for name, value in one.items():
            np.testing.assert_array_equal(value, other[name])


@pytest.mark.parametrize("sub_goal", ["none", "nearest", "assigned", "routes", "role_routes"])
def test_threads_change_nothing(sub_goal: str) -> None:
    expected = play(make(1, sub_goal))
    assert any(step["truncated"].any() for step in expected)
    for n_threads in (2, 3, 20):
        assert_same(play(make(n_threads, sub_goal)), expected)


def test_threads_may_change_in_the_middle_and_travel_with_copies() -> None:
    whole = play(make(1), 6)
    batch = make(1)
    found = play(batch, 3)
    batch.n_threads = 2
    copied = pickle.loads(pickle.dumps(batch))
    assert copied.n_threads == 2
    for one in (batch, copied):
        one.reset(range(N_TEAMS))
        one.n_threads = 4
        assert_same(play(one, 6), whole)
    assert_same(found, whole[:3])


def test_a_batch_without_threads_is_refused() -> None:
    for wrong in (0, True, 1.5):
        with pytest.raises(ValueError, match="n_threads must be a whole number of at least 1"):
            make(wrong)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="n_threads"):
            make(2).n_threads = wrong  # type: ignore[assignment]


def test_slices_cover_every_team_once() -> None:
    assert even_slices(7, 3) == [slice(0, 3), slice(3, 5), slice(5, 7)]
    assert even_slices(2, 5) == [slice(0, 1), slice(1, 2)]


def test_training_steps_on_as_many_threads_as_torch() -> None:
    import torch as th

    from sb3_roles.zoo.models import make_env

    settings = merge(load_settings("mappo", AREA_SEARCH), {"n_envs": 2, "batch_size": 10})
    before = th.get_num_threads()
    th.set_num_threads(2)
    try:
        env = make_env(resolve("mappo", AREA_SEARCH, settings, 0, "native"))
    finally:
        th.set_num_threads(before)
    assert env.get_attr("n_threads", 0) == [2]
