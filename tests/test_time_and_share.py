"""The share of the horizon that is left as an observation, and rewards shared with the team."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers import small_search
from numpy.testing import assert_array_equal

from area_search import AreaSearchEnv, BatchedAreaSearch, Scene, SceneError
from sb3_roles import HMAPPO
from sb3_roles.evaluation.episodes import describe, run_episodes
from sb3_roles.evaluation.header import checked_scene
from sb3_roles.evaluation.policies import PolicyController
from sb3_roles.zoo.config import ConfigError, resolve

SMALL: dict[str, Any] = {"height": 9, "width": 9, "n_targets": 20, "n_agents": 3, "horizon": 4}
SCENE = Scene(name="small", **SMALL)


def test_time_is_what_is_left_of_the_horizon() -> None:
    plain = BatchedAreaSearch(SCENE, 2)
    timed = BatchedAreaSearch(SCENE, 2, time=True)
    assert set(timed.observations) - set(plain.observations) == {"time"}
    assert timed.observation_space["time"].contains(np.ones(1, np.float32))
    for batch in (plain, timed):
        batch.reset(3)
    left = timed.observations["time"]
    assert left.dtype == np.float32
    assert_array_equal(left, [[1.0], [1.0]])
    for expected in (0.75, 0.5, 0.25, 0.0):
        moves = np.random.default_rng(0).integers(0, 5, (2, 3))
        for batch in (plain, timed):
            batch.step(moves)
        assert_array_equal(left, [[expected], [expected]])
        for key, value in plain.observations.items():
            assert_array_equal(value, timed.observations[key])
        assert_array_equal(plain.rewards, timed.rewards)
    timed.reset_teams(np.array([True, False]))
    assert_array_equal(left, [[1.0], [0.0]])
    # Asked for in the middle of an episode.
    plain.show_time()
    plain.show_time()
    assert_array_equal(plain.observations["time"], [[0.0], [0.0]])


@pytest.mark.parametrize("backend", ["native", "supersuit"])
@pytest.mark.parametrize("expand", [True, False])
def test_time_reaches_the_rows(backend: str, expand: bool) -> None:
    env = small_search(backend=backend, expand=expand, time=True, horizon=2)
    observations: Any = env.reset()
    rows = 6 if expand else 2
    assert "time" in env.team_keys  # type: ignore[attr-defined]
    assert_array_equal(observations["time"], np.ones((rows, 1)))
    observations, _, _, _ = env.step(np.zeros(6, np.int64))
    assert_array_equal(observations["time"], np.full((rows, 1), 0.5))
    observations, _, dones, infos = env.step(np.zeros(6, np.int64))
    assert dones.all()
    assert all(info["terminal_observation"]["time"] == 0.0 for info in infos)
    assert_array_equal(observations["time"], np.ones((rows, 1)))
    assert "time" not in AreaSearchEnv().observation_space("robot_0").spaces


def test_policies_read_the_time_and_play_with_it() -> None:
    env = small_search(2, roles={}, time=True, horizon=4)
    model = HMAPPO("RolePolicy", env, n_steps=4, batch_size=8, device="cpu", seed=0)
    policy = model.policy
    assert "time" in policy.actor_keys and "time" in policy.critic_keys
    model.learn(2 * 4 * env.num_envs)
    records = run_episodes(PolicyController(model), SCENE, 3, 0)
    assert records.length.tolist() == [4, 4, 4]
    # What it plays is a function of the time.
    controller = PolicyController(model)
    batch = BatchedAreaSearch(SCENE, 1)
    batch.reset(0)
    controller.begin(batch)
    assert batch.observations["time"].tolist() == [[1.0]]


def test_a_share_of_the_teams_mean() -> None:
    own, shared, whole = (
        BatchedAreaSearch(SCENE.with_options(team_share=share), 4) for share in (0.0, 0.25, 1.0)
    )
    for batch in (own, shared, whole):
        batch.reset(0)
    rng = np.random.default_rng(1)
    differ = 0
    for _ in range(4):
        moves = rng.integers(0, 5, (4, 3))
        for batch in (own, shared, whole):
            batch.step(moves)
        mean = own.reward_components.mean(axis=1, keepdims=True)
        expected = 0.75 * own.reward_components + 0.25 * mean
        np.testing.assert_allclose(shared.reward_components, expected, rtol=1e-6)
        np.testing.assert_allclose(
            whole.reward_components, np.broadcast_to(mean, (4, 3, 2)), rtol=1e-6
        )
        np.testing.assert_allclose(shared.rewards, expected @ [0.4, 0.6], rtol=1e-6)
        # What the team is paid does not change.
        np.testing.assert_allclose(shared.rewards.sum(1), own.rewards.sum(1), rtol=1e-5)
        differ += int((shared.rewards != own.rewards).sum())
    assert differ > 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"team_share": 1.5}, "team_share must be a number in [0, 1], got 1.5"),
        ({"team_share": 0.5, "reward_sharing": "same_role"}, "must be 0 with reward_sharing"),
    ],
)
def test_shares_that_can_not_be(options: dict[str, Any], said: str) -> None:
    with pytest.raises(SceneError) as error:
        Scene(**options)
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("env_kwargs", "wrapper_kwargs", "said"),
    [
        ({"time": 1}, {}, "time must be true or false, got 1"),
        ({"tme": True}, {}, "did you mean 'time'?"),
        ({"team_share": -1}, {}, "team_share must be a number in [0, 1]"),
        ({"team_share": 0.5}, {"reward_sharing": "team"}, "wrapper_kwargs.reward_sharing team"),
    ],
)
def test_configurations(
    env_kwargs: dict[str, Any], wrapper_kwargs: dict[str, Any], said: str
) -> None:
    settings = {"n_timesteps": 9, "env_kwargs": env_kwargs, "wrapper_kwargs": wrapper_kwargs}
    with pytest.raises(ConfigError) as error:
        resolve("hmappo", "area-search-v0", settings)
    assert len(error.value.lines) == 1
    assert said in error.value.lines[0]


def test_records_are_of_the_same_scene_as_before() -> None:
    """Scenes did not always have team_share: without it, neither facts nor hash change."""

    class Idle:
        """Does nothing."""

    plain = describe(Idle(), SCENE)  # type: ignore[arg-type]
    assert "team_share" not in plain["scene"]
    assert Scene(**plain["scene"]) == SCENE
    shared = describe(Idle(), SCENE.with_options(team_share=0.5))  # type: ignore[arg-type]
    assert shared["scene"]["team_share"] == 0.5
    assert shared["config_hash"] != plain["config_hash"]
    header = {"seed": 0, "role_names": [], "versions": {}}
    timing = {"seconds": 1.0, "batch_size": 1}
    for one in (plain, shared):
        scene = checked_scene({**one, **header}, timing)
        assert scene.team_share == one["scene"].get("team_share", 0.0)
    del plain["scene"]["alpha"]
    with pytest.raises(ValueError, match="not the fields of one: 'alpha'"):
        checked_scene({**plain, **header}, timing)
