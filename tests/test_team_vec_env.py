"""The two backends of ``make_team_vec_env``: same trajectories, SB3's interface, clear errors."""

import copy
import re
import sys
import threading

import numpy as np
import pytest
import torch
from gymnasium import spaces
from helpers import one_line
from pettingzoo.utils.wrappers import BaseParallelWrapper
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor
from toy_envs import BatchedToy, PlainEnv, ToyEnv

from sb3_roles.common.env_failures import EnvironmentFailed
from sb3_roles.common.team_vec_env import (
    NativeTeamVecEnv,
    SuperSuitTeamVecEnv,
    make_team_vec_env,
    team_seeds,
)
from sb3_roles.zoo.stop_signals import SecondSignal

N_TEAMS, N_AGENTS = 4, BatchedToy.n_agents
TOYS = [(ToyEnv, "native"), (ToyEnv, "supersuit")]
ALL = [*TOYS, (PlainEnv, "supersuit")]


def rollout(vec_env, n_steps=14, action_seed=3):
    """All that an algorithm gets to see, as nested Python and numpy values."""
    rng = np.random.default_rng(action_seed)
    high = vec_env.action_space.n
    steps = [copy.deepcopy(vec_env.reset())]
    for _ in range(n_steps):
        step = vec_env.step(rng.integers(0, high, vec_env.num_envs))
        steps.append(copy.deepcopy((*step, vec_env.reward_components, vec_env.metrics)))
    return steps


@pytest.mark.parametrize(("env", "backend"), ALL)
def test_ppo_with_a_seed_trains_reproducibly(env, backend):
    weights = []
    for _ in range(2):
        vec_env = VecMonitor(make_team_vec_env(env, 2, backend=backend))
        dictionary = isinstance(vec_env.observation_space, spaces.Dict)
        policy = "MultiInputPolicy" if dictionary else "MlpPolicy"
        model = PPO(policy, vec_env, n_steps=8, batch_size=16, n_epochs=1, seed=0, device="cpu")
        before = model.policy.action_net.weight.detach().clone()
        model.learn(2 * 8 * vec_env.num_envs)
        assert model.num_timesteps == 16 * vec_env.num_envs
        assert len(model.ep_info_buffer) > 0
        assert not torch.equal(before, model.policy.action_net.weight)
        weights.append(model.policy.action_net.weight.detach().clone())
    assert torch.equal(*weights)


@pytest.mark.parametrize(("env", "backend"), ALL)
def test_same_seed_same_trajectories(env, backend):
    first = rollout(make_team_vec_env(env, N_TEAMS, 5, backend))
    np.testing.assert_equal(first, rollout(make_team_vec_env(env(), N_TEAMS, 5, backend)))
    other = rollout(make_team_vec_env(env, N_TEAMS, 6, backend))
    with pytest.raises(AssertionError):
        np.testing.assert_equal(first, other)


@pytest.mark.parametrize("expand", [True, False])
def test_native_and_supersuit_are_the_same(expand):
    pair = [
        make_team_vec_env(ToyEnv, N_TEAMS, 11, backend, expand_team_observations=expand)
        for backend in ("native", "supersuit")
    ]
    for attribute in ("n_teams", "n_agents", "num_envs", "team_keys", "component_names"):
        assert getattr(pair[0], attribute) == getattr(pair[1], attribute), attribute
    native, supersuit = (rollout(vec_env, 25) for vec_env in pair)
    np.testing.assert_equal(native, supersuit)
    for a, b in zip(native[1:], supersuit[1:], strict=True):
        for x, y in ((a[0][key], b[0][key]) for key in a[0]):
            assert x.dtype == y.dtype
        assert [x.dtype for x in (*a[1:3], a[4])] == [y.dtype for y in (*b[1:3], b[4])]
        assert all(value.dtype == np.float64 for value in (*a[5].values(), *b[5].values()))
    # The comparison covered ends of both kinds, and several per team.
    ends = np.sum([step[2] for step in native[1:]], axis=0)
    flags = [i["TimeLimit.truncated"] for step in native[1:] for i in step[3] if i]
    assert ends.min() >= 3
    assert {True, False} == set(flags)


@pytest.mark.parametrize(("env", "backend"), TOYS)
def test_infos_and_final_metrics(env, backend):
    vec_env = make_team_vec_env(env, N_TEAMS, 2, backend)
    previous = vec_env.reset()
    assert vec_env.reward_components.shape == (N_TEAMS * N_AGENTS, 2)
    finished = 0
    for _ in range(12):
        actions = np.arange(vec_env.num_envs) % 3
        previous = copy.deepcopy(previous)
        observations, rewards, dones, infos = vec_env.step(actions)
        total = (previous["vector"][:, 0] + actions).reshape(N_TEAMS, N_AGENTS).sum(axis=1)
        np.testing.assert_equal(vec_env.metrics["distance"], total.astype(float))
        np.testing.assert_array_equal(vec_env.reward_components[:, 0], actions)
        np.testing.assert_allclose(vec_env.reward_components @ [1, 0.5], rewards)
        for row, info in enumerate(infos):
            team = row // N_AGENTS
            if not dones[row]:
                assert info == {}
                continue
            finished += 1
            assert set(info) == {"terminal_observation", "TimeLimit.truncated", "episode_metrics"}
            terminal = info["terminal_observation"]["vector"]
            assert terminal[0] == previous["vector"][row, 0] + actions[row]
            assert terminal[1] == previous["vector"][row, 1] + 1
            assert observations["vector"][row, 1] == 0
            at_horizon = terminal[1] == BatchedToy.horizon
            assert info["TimeLimit.truncated"] is bool(at_horizon and total[team] % 5 != 0)
            assert info["episode_metrics"] == {"length": terminal[1], "total": total[team]}
        previous = observations
    assert finished > 0


@pytest.mark.parametrize(("env", "backend"), TOYS)
def test_infos_of_rows_share_nothing(env, backend):
    vec_env = make_team_vec_env(env, 2, 0, backend)
    vec_env.reset()
    seen_end = False
    for _ in range(BatchedToy.horizon):
        _, rewards, dones, infos = vec_env.step(np.zeros(vec_env.num_envs, int))
        assert len({id(info) for info in infos}) == vec_env.num_envs
        rows = np.flatnonzero(dones)
        for info in infos:
            info["mine"] = 1
        rewards += 100
        vec_env.reward_components += 100
        if rows.size:
            seen_end = True
            first, second = (infos[row] for row in rows[:2])
            first["episode_metrics"]["length"] = -1
            first["terminal_observation"]["joint"][:] = 7
            assert second["episode_metrics"]["length"] > 0
            assert second["terminal_observation"]["joint"].max() <= 1
    assert seen_end
    _, rewards, _, infos = vec_env.step(np.zeros(vec_env.num_envs, int))
    assert not any("mine" in info for info in infos)
    assert rewards.max() < 100
    assert vec_env.reward_components.max() < 100


def test_infos_of_a_foreign_environment_survive_the_reset():
    vec_env = make_team_vec_env(PlainEnv, 2, 0)
    vec_env.reset()
    assert vec_env.reset_infos == [{"late": 0}] * 4
    for clock in range(1, 6):
        *_, dones, infos = vec_env.step(np.ones(4, int))
        assert [info["late"] for info in infos] == [clock] * 4
    assert dones.all()
    assert infos[0]["TimeLimit.truncated"] is True
    assert vec_env.reward_components.shape == (4, 0)
    assert vec_env.metrics == {}


def test_team_seeds():
    assert team_seeds(7, 3) == team_seeds(7, 6)[:3]
    many = team_seeds(0, 50) + team_seeds(1, 50) + team_seeds(None, 50) + team_seeds(None, 50)
    assert len(set(many)) == 200
    assert all(type(seed) is int and 0 <= seed < 2**32 for seed in many)


@pytest.mark.parametrize(("env", "backend"), ALL)
def test_seeding(env, backend):
    def flat(observations):
        return observations["vector"] if isinstance(observations, dict) else observations

    few, many = (make_team_vec_env(env, n, 3, backend) for n in (2, 4))
    rows = few.num_envs
    first = flat(few.reset()).copy()
    np.testing.assert_equal(first, flat(many.reset())[:rows])
    assert not np.array_equal(first[: rows // 2], first[rows // 2 :])
    # A second reset goes on with the stream; seed() starts it again, once.
    assert not np.array_equal(first, flat(few.reset()))
    seeds = few.seed(3)
    assert list(seeds) == [seed for seed in team_seeds(3, 2) for _ in range(few.n_agents)]
    np.testing.assert_equal(first, flat(few.reset()).copy())
    assert not np.array_equal(first, flat(few.reset()))
    # Without a seed copies differ, also if they were pickled with one generator.
    unseeded = flat(make_team_vec_env(env(), 2, None, backend).reset())
    assert not np.array_equal(unseeded[: rows // 2], unseeded[rows // 2 :])


def test_reset_continues_the_same_stream_on_both_backends():
    results = []
    for backend in ("native", "supersuit"):
        vec_env = make_team_vec_env(ToyEnv, 2, 9, backend)
        vec_env.reset()
        vec_env.step(np.ones(vec_env.num_envs, int))
        results.append([copy.deepcopy(vec_env.reset()), vec_env.metrics])
        assert not vec_env.metrics["distance"].any()
    np.testing.assert_equal(*results)


@pytest.mark.parametrize("expand", [True, False])
@pytest.mark.parametrize(("env", "backend"), TOYS)
def test_returned_observations_stay_valid_for_one_more_step(env, backend, expand):
    vec_env = make_team_vec_env(env, 2, 1, backend, expand_team_observations=expand)
    held = vec_env.reset()
    for _ in range(9):
        before = copy.deepcopy(held)
        following, *_ = vec_env.step(np.ones(vec_env.num_envs, int))
        np.testing.assert_equal(before, held)
        assert not np.array_equal(held["vector"], following["vector"])
        assert not any(np.shares_memory(held[key], following[key]) for key in held)
        held = following


@pytest.mark.parametrize("expand", [True, False])
def test_channels_last_layout_is_kept_without_a_copy(expand):
    vec_env = make_team_vec_env(ToyEnv, N_TEAMS, 0, "native", expand_team_observations=expand)
    held = [vec_env.reset()]
    held += [vec_env.step(np.zeros(vec_env.num_envs, int))[0] for _ in range(2)]
    for key in ("local", "joint"):
        for observations in held:
            tensor = torch.from_numpy(observations[key])
            assert tensor.is_contiguous(memory_format=torch.channels_last)
            assert not tensor.is_contiguous()
        # The ring has two slots: the third observation is where the first was.
        assert held[0][key].ctypes.data == held[2][key].ctypes.data
    # All rows are one block: the first axis steps over exactly one row.
    assert held[0]["local"].strides[0] == held[0]["local"][0].nbytes


@pytest.mark.parametrize(("env", "backend"), TOYS)
def test_team_observations_once_per_team(env, backend):
    rows = rollout(make_team_vec_env(env, N_TEAMS, 4, backend))
    once = rollout(make_team_vec_env(env, N_TEAMS, 4, backend, expand_team_observations=False))
    pairs = [(rows[0], once[0])]
    pairs += [(a[0], b[0]) for a, b in zip(rows[1:], once[1:], strict=True)]
    for full, compact in pairs:
        assert compact["joint"].shape == (N_TEAMS, 3, 4, 5)
        np.testing.assert_equal(full["joint"], np.repeat(compact["joint"], N_AGENTS, axis=0))
        np.testing.assert_equal(full["local"], compact["local"])
    np.testing.assert_equal([s[1:] for s in rows[1:]], [s[1:] for s in once[1:]])


def test_truncation_is_bootstrapped_and_termination_is_not():
    """With a constant value V, PPO's stored reward at the horizon is r + gamma V."""
    value, gamma = 10.0, 0.5
    stored = {}
    for backend in ("native", "supersuit"):
        vec_env = make_team_vec_env(ToyEnv, N_TEAMS, backend=backend)
        model = PPO("MultiInputPolicy", vec_env, n_steps=16, gamma=gamma, seed=1, n_epochs=1)
        with torch.no_grad():
            model.policy.value_net.weight.zero_()
            model.policy.value_net.bias.fill_(value)
        expected = []
        step_wait = vec_env.step_wait

        def spy(step_wait=step_wait, expected=expected, vec_env=vec_env):
            result = step_wait()
            flags = [info.get("TimeLimit.truncated", None) for info in result[3]]
            bonus = np.array([gamma * value if flag else 0.0 for flag in flags])
            expected.append((vec_env.reward_components @ [1, 0.5] + bonus, flags))
            return result

        vec_env.step_wait = spy
        model.train = lambda: None
        model.learn(16 * vec_env.num_envs)
        np.testing.assert_allclose(
            model.rollout_buffer.rewards, [rewards for rewards, _ in expected]
        )
        assert {flag for _, flags in expected for flag in flags} == {True, False, None}
        stored[backend] = model.rollout_buffer.rewards
    np.testing.assert_equal(stored["native"], stored["supersuit"])


def test_attributes_and_methods_go_to_the_team_of_the_row():
    vec_env = make_team_vec_env(ToyEnv, 2, 0, "supersuit")
    vec_env.set_attr("level", 4, indices=[3])
    assert vec_env.get_attr("level") == [0, 0, 0, 4, 4, 4]
    assert vec_env.get_attr("level", -1) == [4]
    # Once per team, not once per row.
    assert vec_env.env_method("scaled", 2, indices=[0, 1, 5]) == [2, 2, 10]
    assert vec_env.get_attr("level", [0, 5]) == [1, 5]
    assert vec_env.has_attr("scaled")
    assert not vec_env.has_attr("nothing")
    with pytest.raises(IndexError):
        vec_env.get_attr("level", 6)


def test_attributes_and_methods_of_the_batched_environment():
    vec_env = make_team_vec_env(ToyEnv, 2, 0, "native")
    vec_env.set_attr("horizon", 9, indices=0)
    assert vec_env.get_attr("horizon") == [9] * 6
    assert vec_env.env_method("episode_metrics", 1, indices=[2])[0]["length"] == 0
    assert vec_env.has_attr("horizon")
    assert not vec_env.has_attr("nothing")


def test_wrapped_environments():
    class Inert(BaseParallelWrapper):
        pass

    vec_env = make_team_vec_env(lambda: Inert(ToyEnv()), 2, 0)
    # ToyEnv's batched form would leave the wrapper out.
    assert isinstance(vec_env, SuperSuitTeamVecEnv)
    assert vec_env.team_keys == ("joint",)
    assert vec_env.env_is_wrapped(Inert) == [True] * 6
    assert make_team_vec_env(ToyEnv, 1).env_is_wrapped(Inert) == [False] * 3
    vec_env.set_attr("level", 3)
    assert vec_env.env_method("scaled", 1) == [4] * 6
    with pytest.raises(ValueError, match=r"Inert itself does not have.*supersuit"):
        make_team_vec_env(Inert(ToyEnv()), 2, backend="native")


@pytest.mark.parametrize(("env", "backend"), TOYS)
def test_rendering_is_one_image_per_team(env, backend):
    vec_env = make_team_vec_env(env, N_TEAMS, 0, backend)
    observations = vec_env.reset()
    first_robots = observations["vector"][::N_AGENTS, 0]
    assert vec_env.render_mode == "rgb_array"
    assert [int(image[0, 0, 0]) for image in vec_env.get_images()] == first_robots.tolist()
    tiled = vec_env.render("rgb_array")
    assert tiled.shape == (8, 12, 3)
    assert int(tiled[-1, -1, 0]) == first_robots[-1]


def test_render_mode_of_environments_that_do_not_declare_one():
    class Bare(PlainEnv):
        pass

    del PlainEnv.render_mode
    try:
        vec_env = make_team_vec_env(Bare, 2)
        assert vec_env.render_mode is None
        assert vec_env.get_attr("render_mode") == [None] * 4
    finally:
        PlainEnv.render_mode = None
    with pytest.warns(UserWarning, match="no images"):
        assert vec_env.get_images() == [None, None]


def test_the_batched_form_need_not_declare_how_it_renders():
    class Silent(BatchedToy):
        render_mode = property()  # hasattr() is False

    class Env(ToyEnv):
        def batched(self, n_teams):
            return Silent(n_teams)

    for env in (Env, ToyEnv):
        for backend in ("native", "supersuit"):
            vec_env = make_team_vec_env(env, 2, 0, backend)
            assert vec_env.metadata["render_fps"] == 7
            assert vec_env.render_mode == "rgb_array"
            assert vec_env.get_attr("render_mode") == ["rgb_array"] * 6


@pytest.mark.parametrize("mode", [None, "human"])
def test_human_rendering_asks_each_team_once(mode):
    frames = []
    batched = BatchedToy(3)
    batched.render_mode = "human"
    batched.render = lambda team, mode: frames.append((team, mode))
    vec_env = NativeTeamVecEnv(batched)
    assert vec_env.render(mode) is None
    assert frames == [(0, "human"), (1, "human"), (2, "human")]


@pytest.mark.parametrize(
    ("space", "part"),
    [
        (spaces.Discrete(3, start=1), "subtract start=1"),
        (spaces.MultiDiscrete([[2, 2]]), "flatten nvec"),
        (spaces.Text(5), "encode it as one of them"),
    ],
)
@pytest.mark.parametrize("key", ["hint", None])
def test_observations_that_no_policy_reads_are_refused_with_key_and_space(space, part, key):
    class Odd(PlainEnv):
        def observation_space(self, agent):
            return space if key is None else spaces.Dict({key: space})

    with pytest.raises(ValueError) as caught:
        make_team_vec_env(Odd, 2)
    message = one_line(caught.value)
    assert str(space) in message
    assert part in message
    assert ("observation 'hint'" if key else "the observation is") in message


def test_close_twice():
    vec_env = make_team_vec_env(ToyEnv, 2)
    vec_env.close()
    vec_env.close()
    assert vec_env.batched.closed == 1
    foreign = make_team_vec_env(PlainEnv, 2)
    closed = []
    foreign.set_attr("close", lambda: closed.append(1))
    foreign.close()
    foreign.close()
    assert closed == [1, 1]


def test_reset_options_reach_each_team_or_are_refused():
    foreign = make_team_vec_env(PlainEnv, 2)
    foreign.set_options({"wind": 3})
    foreign.reset()
    assert foreign.get_attr("options") == [{"wind": 3}] * 4
    foreign.reset()
    assert foreign.get_attr("options") == [None] * 4
    native = make_team_vec_env(ToyEnv, 2)
    native.set_options({"wind": 3})
    with pytest.raises(ValueError, match="no reset options"):
        native.reset()


def test_backend_choice():
    assert isinstance(make_team_vec_env(ToyEnv, 1), NativeTeamVecEnv)
    assert isinstance(make_team_vec_env(PlainEnv, 1), SuperSuitTeamVecEnv)
    assert isinstance(make_team_vec_env(ToyEnv(), 1, backend="supersuit"), SuperSuitTeamVecEnv)
    with pytest.raises(ValueError, match=r"auto.*native.*supersuit.*did you mean 'supersuit'"):
        make_team_vec_env(ToyEnv, 1, backend="superset")
    with pytest.raises(ValueError, match=r"batched\(n_teams\), which PlainEnv"):
        make_team_vec_env(PlainEnv, 1, backend="native")
    with pytest.raises(ValueError, match="n_envs is 0"):
        make_team_vec_env(PlainEnv, 0)
    with pytest.raises(TypeError, match="aec_to_parallel"):
        make_team_vec_env(lambda: object(), 1)


class Odd(PlainEnv):
    def action_space(self, agent):
        return spaces.Discrete(2 if agent == "a" else 5)


class Nested(PlainEnv):
    def observation_space(self, agent):
        return spaces.Dict({"x": spaces.Tuple([spaces.Discrete(2)])})


class UnknownKey(ToyEnv):
    team_observation_keys = ("global",)


class OneString(ToyEnv):
    metric_names = "distance"


class Viewed(PlainEnv):
    """Does not survive pickling: the view loses its array."""

    def __init__(self):
        super().__init__()
        self.memory = np.zeros(3, np.float32)
        self.view = self.memory[:]

    def observe(self):
        self.memory[:] = self.rng.normal(size=3)
        return {"a": self.view, "b": self.view}


class Locked(Viewed):
    """Can not be pickled at all."""

    def __init__(self):
        super().__init__()
        self.lock = threading.Lock()


SHARED = PlainEnv()


def shared():
    return SHARED


def test_a_function_that_makes_the_environment_avoids_pickling():
    vec_env = make_team_vec_env(Locked, 3, 0)
    observations = vec_env.reset()
    assert len(np.unique(observations)) == 9
    np.testing.assert_equal(observations[::2], observations[1::2])


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (Odd, r"action_space of 'a' is Discrete\(2\) and that of \['b'\] is \[Discrete\(5\)\]"),
        (Nested, r"flatten \['x'\]"),
        (UnknownKey, r"\['global'\] are not keys.*'local'"),
        (OneString, r"\('distance',\)"),
        (Locked(), "cloudpickle.*function that makes"),
        (Viewed(), r"views of one another.*function that makes"),
        (shared, "same environment at every call"),
    ],
)
def test_environments_that_are_refused(env, message):
    with pytest.raises(ValueError, match=message):
        make_team_vec_env(env, 2, backend="supersuit")


class EarlyDeath(PlainEnv):
    def step(self, actions):
        result = super().step(actions)
        result[2]["b"] = True
        return result


class Absent(PlainEnv):
    def step(self, actions):
        result = super().step(actions)
        del result[0]["a"]
        return result


class NoComponents(PlainEnv):
    reward_component_names = ("x",)


class OtherMetric(PlainEnv):
    metric_names = ("x",)

    def step(self, actions):
        result = super().step(actions)
        return *result[:4], {agent: {"metrics": {"y": 1.0}} for agent in result[4]}


class NotANumber(PlainEnv):
    def step(self, actions):
        result = super().step(actions)
        result[1]["b"] = float("nan")
        return result


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (EarlyDeath, r"\['b'\] are done while \['a'\] are not"),
        (Absent, r"no observation for agents \['a'\]"),
        (NoComponents, r"infos\['a'\] has no 'reward_components'"),
        (OtherMetric, r"\['y'\], but not the declared \['x'\]"),
        (NotANumber, "nan of team 0, agent 'b'"),
    ],
)
def test_steps_that_are_refused(env, message):
    vec_env = make_team_vec_env(env, 2, 0)
    vec_env.reset()
    with pytest.raises(ValueError, match=message):
        vec_env.step(np.zeros(4, int))


class Failing(PlainEnv):
    """Fails in its third step; what happens there is patched in."""

    def step(self, actions):
        return self.fail() if self.clock == 2 else super().step(actions)

    def fail(self):
        raise OSError("no such map:\nhard")


def leave(env):
    sys.exit(0)


@pytest.mark.parametrize(
    ("fail", "message"),
    [
        (None, r"OSError in step 3: no such map: hard \(test_team_vec_env.py:\d+\)"),
        (leave, r"SystemExit in step 3: 0 \(test_team_vec_env.py:\d+\)"),
        # What a library raises is told by the line that called it.
        (lambda env: np.zeros(2).reshape(3), r"ValueError in step 3: .* \(test_team_vec_env.py"),
        (lambda env: ({}, {}, {}, {}), r"step 3: expected 5 dicts by agent .*, got 4 values"),
        (lambda env: ({}, {}, {}, {}, None), r"step 3: expected 5 dicts .*, got NoneType as info"),
        (
            lambda env: (env.observe(), {}, {}, {}, {"a": None}),
            "what it returned can not be put together: TypeError: .* is not iterable",
        ),
    ],
)
def test_an_error_of_an_environment_is_told_as_such(monkeypatch, fail, message):
    if fail is not None:
        monkeypatch.setattr(Failing, "fail", fail)
    vec_env = make_team_vec_env(Failing, 2, 0)
    for _ in range(2):
        vec_env.reset()
        for _ in range(2):
            vec_env.step(np.zeros(4, int))
    with pytest.raises(EnvironmentFailed, match="environment test_team_vec_env:Failing: ") as seen:
        vec_env.step(np.zeros(4, int))
    assert re.search(message, str(seen.value))
    assert "\n" not in str(seen.value)


@pytest.mark.parametrize("name", ["observation_space", "action_space", "render", "close"])
def test_so_is_one_outside_of_its_steps(monkeypatch, name):
    def fail(env, agent=None):
        raise RuntimeError("no window")

    monkeypatch.setattr(PlainEnv, "render_mode", "rgb_array", raising=False)
    vec_env = make_team_vec_env(PlainEnv, 1, 0)
    vec_env.reset()
    monkeypatch.setattr(PlainEnv, name, fail)
    use = {"render": vec_env.render, "close": vec_env.close}
    message = rf"toy_envs:PlainEnv: RuntimeError in {name}: no window \(test_team_vec_env.py:\d+\)"
    with pytest.raises(EnvironmentFailed, match=message):
        use.get(name, lambda: make_team_vec_env(PlainEnv, 1, 0))()


def test_all_environments_are_closed_whichever_fails(monkeypatch):
    closed = []

    def fail(env):
        closed.append(env)
        raise RuntimeError("simulator is gone")

    vec_env = make_team_vec_env(PlainEnv, 3, 0)
    monkeypatch.setattr(PlainEnv, "close", fail)
    with pytest.raises(EnvironmentFailed, match="RuntimeError in close: simulator is gone"):
        vec_env.close()
    assert len(closed) == 3


@pytest.mark.parametrize("error", [KeyboardInterrupt, SecondSignal(143), MemoryError])
def test_stops_and_a_lack_of_memory_pass_through_an_environment(monkeypatch, error):
    def fail(env, actions):
        raise error

    monkeypatch.setattr(PlainEnv, "step", fail)
    vec_env = make_team_vec_env(PlainEnv, 1, 0)
    vec_env.reset()
    with pytest.raises(error if isinstance(error, type) else SecondSignal):
        vec_env.step(np.zeros(2, int))


def test_an_error_of_a_batched_environment_is_told_as_such(monkeypatch):
    vec_env = make_team_vec_env(ToyEnv, 2, 0)
    vec_env.reset()

    def step(actions):
        raise KeyError("robot_7")

    vec_env.batched.step = step
    message = r"environment toy_envs:BatchedToy: KeyError in step\(\): 'robot_7' \(test_team"
    with pytest.raises(EnvironmentFailed, match=message):
        vec_env.step(np.zeros(6, int))


def test_native_rewards_and_observations_are_checked():
    vec_env = make_team_vec_env(ToyEnv, 2, 0)
    vec_env.reset()
    vec_env.batched.step = lambda actions: vec_env.batched.rewards.__setitem__((1, 2), np.inf)
    with pytest.raises(ValueError, match="inf of team 1, agent 'robot_2'"):
        vec_env.step(np.zeros(6, int))
    batched = BatchedToy(2)
    batched.vector = np.zeros((2, 3, 2), np.float64)
    with pytest.raises(ValueError, match=r"'vector' is .*float64.*expected.*float32"):
        NativeTeamVecEnv(batched).reset()


def test_a_false_team_key_is_refused():
    class FalseKey(ToyEnv):
        team_observation_keys = ("local",)

    with pytest.raises(ValueError, match=r"'local' is declared.*'robot_\d' sees another"):
        make_team_vec_env(FalseKey, 2, 0, "supersuit").reset()


@pytest.mark.parametrize(("env", "backend"), ALL)
def test_wrong_actions_and_a_missing_reset(env, backend):
    vec_env = make_team_vec_env(env, 2, 0, backend)
    with pytest.raises(RuntimeError, match="reset"):
        vec_env.step(np.zeros(vec_env.num_envs, int))
    vec_env.reset()
    with pytest.raises(ValueError, match=rf"expected \({vec_env.num_envs},\)"):
        vec_env.step(np.zeros((2, vec_env.n_agents), int))
