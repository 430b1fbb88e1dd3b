"""The PettingZoo face: the libraries' own checks, no shared memory, and clear errors."""

from __future__ import annotations

import copy
import functools
import pickle
import warnings
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from helpers import RIGHT, STOP, UP, one_line
from pettingzoo.test import parallel_api_test, parallel_seed_test
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.preprocessing import is_image_space

from area_search import AreaSearchEnv, SceneError
from area_search.arrays import observation_space
from sb3_roles.testing import check_parallel_env

VARIANTS: dict[str, dict[str, Any]] = {
    "hard": {},
    "hard, nearest": {"sub_goal": "nearest"},
    "easy, assigned, 8 robots": {"scene": "easy", "sub_goal": "assigned", "n_agents": 8},
    "routes": {"sub_goal": "routes"},
    "role_routes": {"sub_goal": "role_routes"},
    "early stop": {"early_stop_patience": 5, "reward_sharing": "same_role"},
    "one robot, one step": {"n_agents": 1, "horizon": 1},
    "small and wide": {"height": 5, "width": 40, "n_targets": 20, "view_radius": 6},
}


class OneRobot(gymnasium.Env):
    """A team of one robot as a Gymnasium environment."""

    metadata: ClassVar[dict[str, Any]] = AreaSearchEnv.metadata

    def __init__(self, **options: Any) -> None:
        self.env = AreaSearchEnv(n_agents=1, **options)
        self.observation_space = self.env.observation_space("robot_0")
        self.action_space = self.env.action_space("robot_0")
        self.render_mode = self.env.render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        observations, infos = self.env.reset(seed, options)
        return observations["robot_0"], infos["robot_0"]

    def step(self, action):
        return tuple(part["robot_0"] for part in self.env.step({"robot_0": action}))

    def render(self):
        return self.env.render()

    def close(self):
        self.env.close()


def random_actions(env: AreaSearchEnv, rng: np.random.Generator) -> dict[str, int]:
    """Draw an action for each robot."""
    return {agent: int(rng.integers(5)) for agent in env.agents}


def play(env: AreaSearchEnv, n_steps: int, seed: int) -> list[Any]:
    """Play on with autoresets and copy everything that comes out."""
    rng, record = np.random.default_rng(seed), []
    for _ in range(n_steps):
        if env.agents:
            record.append(copy.deepcopy(env.step(random_actions(env, rng))))
        else:
            record.append(copy.deepcopy(env.reset()))
        record.append(env.state())
    return record


# The libraries' own checks.


@pytest.mark.parametrize("variant", VARIANTS)
def test_pettingzoo_api(variant: str) -> None:
    env = AreaSearchEnv(**VARIANTS[variant])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(env, num_cycles=200)


@pytest.mark.parametrize("variant", VARIANTS)
def test_pettingzoo_seeds(variant: str) -> None:
    parallel_seed_test(lambda: AreaSearchEnv(**VARIANTS[variant]), num_cycles=120)


@pytest.mark.parametrize("variant", VARIANTS)
def test_our_own_conformance_checks(variant: str) -> None:
    options = VARIANTS[variant]
    most = options.get("horizon", 50)
    check_parallel_env(
        functools.partial(AreaSearchEnv, **options),
        n_steps=13 if "routes" in options.get("sub_goal", "") else 60,
        max_episode_steps=most,
        horizon=None if "early_stop_patience" in options else most,
    )


def test_states_of_the_environment_are_copies_too() -> None:
    env = AreaSearchEnv()
    env.reset(seed=0)
    before = env.state()
    env.state()[...] = 1
    np.testing.assert_equal(env.state(), before)


@pytest.mark.parametrize("sub_goal", ["none", "nearest", "assigned", "routes", "role_routes"])
def test_gymnasium_and_sb3_accept_a_robot_on_its_own(sub_goal: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Advice for who wants SB3's CNN for pictures; SB3 flattens these maps instead, see below.
        warnings.filterwarnings("ignore", message=".*is an image but the upper and lower bounds")
        warnings.filterwarnings("ignore", message=".*minimal resolution for an image is 36x36")
        warnings.filterwarnings("ignore", message=".*sub_goal has an unconventional shape")
        sb3_check_env(OneRobot(sub_goal=sub_goal, render_mode="rgb_array"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Territory sums have no upper bound that is worth declaring; the check only warns of it.
        warnings.filterwarnings("ignore", message=".*maximum value is infinity")
        # A class that is not registered has no spec to make other render modes from.
        warnings.filterwarnings("ignore", message=".*not having a spec")
        gymnasium_check_env(OneRobot(sub_goal=sub_goal, render_mode="rgb_array"))


def test_sb3_does_not_take_the_maps_for_pictures() -> None:
    for space in AreaSearchEnv().observation_space("robot_0").spaces.values():
        assert not is_image_space(space, check_channels=True)


# Observations.


def test_shapes_do_not_depend_on_the_number_of_robots() -> None:
    spaces = [
        AreaSearchEnv(n_agents=n, sub_goal="assigned").observation_space("robot_0")
        for n in (1, 4, 15)
    ]
    assert spaces[0] == spaces[1] == spaces[2]
    env = AreaSearchEnv(n_agents=4, sub_goal="assigned")
    assert spaces[0] == observation_space(env.scene, "assigned")
    # PettingZoo asks for the same object every time, so that seeding a space lasts.
    assert env.observation_space("robot_0") is env.observation_space("robot_0")
    assert env.action_space("robot_3") is env.action_space("robot_3")


def test_state_is_the_state_that_each_robot_gets() -> None:
    env = AreaSearchEnv()
    observations, _ = env.reset(seed=0)
    for _ in range(5):
        state = env.state()
        assert env.state_space.contains(state)
        for observation in observations.values():
            assert np.array_equal(observation["state"], state)
        observations = env.step(dict.fromkeys(env.agents, RIGHT))[0]


# Infos.


@pytest.mark.parametrize("variant", VARIANTS)
def test_keys_of_infos(variant: str) -> None:
    env = AreaSearchEnv(**VARIANTS[variant])
    rng = np.random.default_rng(0)
    for _ in range(3):
        _, infos = env.reset(seed=1)
        # A reset's infos would overwrite those of the last step on some paths.
        assert infos == {agent: {} for agent in env.possible_agents}
        while env.agents:
            _, rewards, _, _, infos = env.step(random_actions(env, rng))
            usual = {"reward_components", "metrics"}
            assert list(infos) == env.possible_agents
            for agent, info in infos.items():
                assert set(info) == usual | (set() if env.agents else {"episode_metrics"})
                assert tuple(info["reward_components"]) == env.reward_component_names
                assert tuple(info["metrics"]) == env.metric_names
                assert all(type(value) is float for value in info["metrics"].values())
                assert type(rewards[agent]) is float
        for info in infos.values():
            final = info["episode_metrics"]
            assert set(final) == {*env.metric_names, "t90_paper", "t90_true", "length"}
            assert {name: final[name] for name in env.metric_names} == info["metrics"]
            assert 1 <= final["length"] <= env.scene.horizon


def test_infos_of_robots_are_separate_objects() -> None:
    env = AreaSearchEnv(horizon=1)
    env.reset(seed=0)
    *_, infos = env.step(dict.fromkeys(env.agents, STOP))
    for part in ("reward_components", "metrics", "episode_metrics"):
        assert infos["robot_0"][part] is not infos["robot_1"][part]


# Errors.


def ended_env() -> AreaSearchEnv:
    """Return an environment whose episode is over."""
    env = AreaSearchEnv(horizon=1)
    env.reset(seed=0)
    env.step(dict.fromkeys(env.agents, STOP))
    return env


@pytest.mark.parametrize("make", [AreaSearchEnv, ended_env])
def test_a_step_needs_a_reset(make: Any) -> None:
    env = make()
    with pytest.raises(ValueError, match=r"reset\(\)") as raised:
        env.step(dict.fromkeys(env.possible_agents, STOP))
    one_line(raised.value)
    env.reset(seed=0)
    env.step(dict.fromkeys(env.agents, STOP))


@pytest.mark.parametrize(
    "action", [5, -1, 1.5, 1.0, None, "up", [1], np.float32(2), np.array([1]), 10**30, 2**63]
)
def test_wrong_actions_are_refused_and_change_nothing(action: Any) -> None:
    env = AreaSearchEnv()
    env.reset(seed=0)
    before = env.get_state()
    with pytest.raises(ValueError, match="action") as raised:
        env.step(dict.fromkeys(env.agents, 0) | {"robot_2": action})
    one_line(raised.value)
    np.testing.assert_equal(env.get_state(), before)
    env.step(dict.fromkeys(env.agents, RIGHT))


@pytest.mark.parametrize("actions", [{}, {"robot_0": 1, "robot_1": 2, "robot_3": 0}])
def test_a_missing_robot_is_named(actions: dict[str, int]) -> None:
    env = AreaSearchEnv()
    env.reset(seed=0)
    before = env.get_state()
    with pytest.raises(ValueError, match="robot_0" if not actions else "robot_2") as raised:
        env.step(actions)
    one_line(raised.value)
    np.testing.assert_equal(env.get_state(), before)


@pytest.mark.parametrize(
    "kind", [int, np.int8, np.uint8, np.int64, np.uint64, np.array, lambda a: np.array(a)[()]]
)
def test_actions_may_be_any_kind_of_integer(kind: Any) -> None:
    envs = [AreaSearchEnv() for _ in range(2)]
    for env in envs:
        env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(5):
        actions = random_actions(envs[0], rng)
        np.testing.assert_equal(
            envs[0].step(actions), envs[1].step({a: kind(move) for a, move in actions.items()})
        )


@pytest.mark.parametrize(
    ("mode", "hint"), [("rgb_aray", "rgb_array"), ("humn", "human"), ("", None), (3, None)]
)
def test_a_wrong_render_mode_gives_the_closest_match(mode: Any, hint: str | None) -> None:
    with pytest.raises(ValueError, match="render_mode") as raised:
        AreaSearchEnv(render_mode=mode)
    message = one_line(raised.value)
    assert "rgb_array, human" in message
    if hint:
        assert f"did you mean {hint!r}" in message


@pytest.mark.parametrize(
    ("seed", "options", "message"),
    [
        (0, {"epsiode": 3}, "did you mean 'episode'"),
        (0, {"episode": 3, "map": 1}, "'map'"),
        (-1, None, "seed .* got -1"),
        (1.5, None, "seed .* got 1.5"),
        ("1", None, "seed .* got '1'"),
        (0, {"episode": -2}, "episode .* got -2"),
        (0, {"episode": 1.5}, "episode .* got 1.5"),
        (0, {"episode": True}, "episode .* got True"),
        (None, {"episode": 3}, "needs a seed"),
    ],
)
def test_wrong_resets_are_refused_and_change_nothing(
    seed: Any, options: dict[str, Any] | None, message: str
) -> None:
    env = AreaSearchEnv()
    env.reset(seed=0)
    env.step(dict.fromkeys(env.agents, UP))
    before = env.get_state()
    with pytest.raises(ValueError, match=message) as raised:
        env.reset(seed=seed, options=options)
    one_line(raised.value)
    np.testing.assert_equal(env.get_state(), before)
    env.step(dict.fromkeys(env.agents, UP))


def test_wrong_constructor_options_are_scene_errors() -> None:
    for options in ({"scene": "hrd"}, {"n_agent": 3}, {"horizon": 0}):
        with pytest.raises(SceneError) as raised:
            AreaSearchEnv(**options)
        one_line(raised.value)


@pytest.mark.parametrize("roles", [[0, 1], [0, 1, 2, 0], [-1, 0, 0, 0], [0.0] * 4, "0101"])
def test_wrong_roles_are_refused(roles: Any) -> None:
    env = AreaSearchEnv(render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="roles") as raised:
        env.set_roles(roles)
    one_line(raised.value)
    env.render()


def test_without_a_seed_environments_differ_and_with_one_they_do_not() -> None:
    states = []
    for seed in (None, None, 3, 3):
        env = AreaSearchEnv()
        env.reset(seed=seed)
        states.append(env.state())
    assert not np.array_equal(states[0], states[1])
    assert np.array_equal(states[2], states[3])


# Copies.


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("n_steps", [0, 13, 50, 51])
def test_copies_continue_identically_and_on_their_own(copied: Any, n_steps: int) -> None:
    env = AreaSearchEnv(sub_goal="assigned", reward_sharing="same_role", render_mode="rgb_array")
    env.reset(seed=5)
    play(env, n_steps, seed=0)
    if env.agents:
        env.set_roles([0, 1, 1, 0])
    other = copied(env)
    assert other.agents == env.agents
    assert np.array_equal(other.render(), env.render())
    straight = play(env, 70, seed=1)
    np.testing.assert_equal(play(other, 70, seed=1), straight)
    assert np.array_equal(other.render(), env.render())


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_made_before_the_first_reset_can_be_used(copied: Any) -> None:
    env = AreaSearchEnv(sub_goal="nearest")
    other = copied(env)
    results = [one.reset(seed=5) for one in (env, other)]
    np.testing.assert_equal(*results)
    np.testing.assert_equal(*(play(one, 20, seed=0) for one in (env, other)))
    # Without a seed, copies must not all play the same episodes.
    fresh = [copied(AreaSearchEnv()) for _ in range(2)]
    for one in fresh:
        one.reset()
    assert not np.array_equal(fresh[0].state(), fresh[1].state())


# Frames.


def test_no_frames_without_a_render_mode() -> None:
    env = AreaSearchEnv()
    env.reset(seed=0)
    assert env.render() is None


@pytest.mark.parametrize("variant", VARIANTS)
def test_frames_show_the_state(variant: str) -> None:
    envs = [AreaSearchEnv(render_mode="rgb_array", **VARIANTS[variant]) for _ in range(2)]
    for env in envs:
        env.reset(seed=2)
    first = envs[0].render()
    assert first.dtype == np.uint8
    assert first.ndim == 3
    assert first.shape[2] == 3
    assert first.shape[0] % 2 == first.shape[1] % 2 == 0
    assert np.array_equal(first, envs[0].render())
    assert np.array_equal(first, envs[1].render())
    moved = False
    for action in range(1, 5):
        if not envs[0].agents:
            break
        for env in envs:
            env.step(dict.fromkeys(env.agents, action))
        frame = envs[0].render()
        assert frame.shape == first.shape
        assert np.array_equal(frame, envs[1].render())
        moved |= not np.array_equal(frame, first)
    assert moved


def test_a_frame_does_not_depend_on_how_the_episode_was_reached() -> None:
    played, fresh = (AreaSearchEnv(render_mode="rgb_array", horizon=5) for _ in range(2))
    played.reset(seed=2)
    for _ in range(5):
        played.step(dict.fromkeys(played.agents, RIGHT))
    played.reset()
    fresh.reset(seed=2, options={"episode": 1})
    assert np.array_equal(played.render(), fresh.render())


def test_frames_are_copies_and_do_not_change_the_play() -> None:
    watched, other = (AreaSearchEnv(render_mode="rgb_array") for _ in range(2))
    for env in (watched, other):
        env.reset(seed=2)
    for _ in range(5):
        frame = watched.render()
        before = frame.copy()
        results = [env.step(dict.fromkeys(env.agents, UP)) for env in (watched, other)]
        np.testing.assert_equal(*results)
        watched.render()[...] = 0
        assert np.array_equal(frame, before)


def test_roles_change_the_colors() -> None:
    env = AreaSearchEnv(render_mode="rgb_array")
    env.reset(seed=2)
    frames = [env.render()]
    for roles in ([0] * 4, [1] * 4):
        env.set_roles(roles)
        frames.append(env.render())
    assert not np.array_equal(frames[0], frames[1])
    assert not np.array_equal(frames[1], frames[2])


def test_a_window_can_be_shown_and_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setitem(AreaSearchEnv.metadata, "render_fps", 0)
    env = AreaSearchEnv(render_mode="human", horizon=3)
    env.reset(seed=0)
    while env.agents:
        env.step(dict.fromkeys(env.agents, UP))
        assert env.render() is None
    env.close()
    env.close()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_an_environment_with_an_open_window_can_be_copied(
    copied: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setitem(AreaSearchEnv.metadata, "render_fps", 0)
    env = AreaSearchEnv(render_mode="human")
    env.reset(seed=0)
    try:
        other = copied(env)
        assert np.array_equal(other.state(), env.state())
    finally:
        env.close()
