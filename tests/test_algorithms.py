"""MAPPO, HMAPPO and stock algorithms: they learn, repeat, resume a file, and refuse nonsense."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from helpers import (
    SMALL_ROLE,
    SMALL_TEAM,
    collect,
    one_line,
    record_logs,
    same,
    sharpen,
    small_search,
    weights,
)
from pettingzoo import ParallelEnv
from sb3_contrib import TRPO
from sb3_contrib.common.maskable.utils import get_action_masks
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.dqn.policies import QNetwork
from toy_envs import BareCountingEnv, CountingEnv, PlainEnv

from area_search import BatchedAreaSearch, get_scene
from sb3_roles import HMAPPO, MAPPO, RoleWrapper, TeamWrapper
from sb3_roles.common.buffers import TeamRolloutBuffer
from sb3_roles.common.callbacks import TeamMetricsCallback
from sb3_roles.common.row_policies import open_moves
from sb3_roles.common.team_vec_env import make_team_vec_env, team_seeds
from sb3_roles.common.torch_layers import NORM_LAYERS, FrozenBatchNorm2d, has_fast_bfloat16
from sb3_roles.evaluation.episodes import run_episodes
from sb3_roles.evaluation.evaluators import VecEnvEvaluator
from sb3_roles.evaluation.policies import PolicyController
from sb3_roles.hmappo import RoleActorCriticPolicy
from sb3_roles.zoo.config import resolve
from sb3_roles.zoo.models import make_env
from sb3_roles.zoo.models import make_model as make_zoo_model

OURS = {"mappo": (MAPPO, "TeamPolicy", SMALL_TEAM), "hmappo": (HMAPPO, "RolePolicy", SMALL_ROLE)}
STOCK = {
    "ppo": (PPO, {"n_steps": 10, "batch_size": 30, "n_epochs": 2}),
    "a2c": (A2C, {"n_steps": 10}),
    "trpo": (
        TRPO,
        {"n_steps": 10, "batch_size": 30, "sub_sampling_factor": 1, "n_critic_updates": 2},
    ),
}
KINDS = list(OURS)


def make_model(kind="hmappo", env=None, policy=None, sharp=True, **options):
    """A small model; its fresh policy is not nearly uniform, so that differences show."""
    algorithm, name, small = OURS[kind]
    if env is None:
        env = small_search(roles={} if kind == "hmappo" else None)
    settings = {"n_steps": 10, "batch_size": 8, "n_epochs": 2, "seed": 0, "device": "cpu"}
    model = algorithm(
        name, env, policy_kwargs={**small, **(policy or {})}, **{**settings, **options}
    )
    if sharp:
        sharpen(model.policy)
    return model


# Before a step is taken, the policy that learns is the policy that acted


def deviations(model):
    """The largest log-ratio, and what the update reports, with learning rate 0."""
    collect(model)
    reports = []
    model._log_update = lambda history, *_: reports.extend(
        report for records in history for report in records
    )
    largest = 0.0
    model.policy.set_training_mode(True)
    for batch in model.rollout_buffer.minibatches(model.batch_size):
        with th.no_grad():
            now = model.policy.streams(batch.observations, batch.actions)
        for new, old in zip(now.log_probs, batch.old_log_probs, strict=True):
            largest = max(largest, float((new - old).clamp(min=-1e3).abs().max()))
    before = {name: value.clone() for name, value in model.policy.named_parameters()}
    model.train()
    assert same(before, dict(model.policy.named_parameters()))
    n_minibatches = len(list(model.rollout_buffer.minibatches(model.batch_size)))
    assert n_minibatches > 2
    assert len(reports) == len(model.policy.stream_names) * n_minibatches * model.n_epochs
    return largest, reports


def check_no_deviation(model):
    largest, reports = deviations(model)
    assert largest < 1e-5
    assert all(float(report.clip_fraction) == 0.0 for report in reports)
    assert max(abs(float(report.kl)) for report in reports) < 1e-7
    assert max(float(report.entropy) for report in reports) > 0.1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("norm_layer", NORM_LAYERS)
@pytest.mark.parametrize("role_every", [1, 3])
def test_with_learning_rate_0_nothing_diverges(kind, norm_layer, role_every):
    roles = {"role_every": role_every} if kind == "hmappo" else None
    env = small_search(sub_goal="nearest", roles=roles)
    policy = {"norm_layer": norm_layer}
    check_no_deviation(make_model(kind, env, policy, learning_rate=0.0, batch_size=6))


@pytest.mark.skipif(not has_fast_bfloat16(), reason="no bfloat16 in this CPU's hardware")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("norm_layer", NORM_LAYERS)
def test_with_learning_rate_0_nothing_diverges_in_bf16(kind, norm_layer):
    env = small_search(height=25, width=25, roles={} if kind == "hmappo" else None)
    policy = {"norm_layer": norm_layer, "precision": "bf16"}
    check_no_deviation(make_model(kind, env, policy, learning_rate=0.0, batch_size=6))


@pytest.mark.skipif(not has_fast_bfloat16(), reason="no bfloat16 in this CPU's hardware")
def test_bf16_learns_on_small_maps():
    model = make_model(policy={"precision": "bf16"}, sharp=False)
    model.learn(3 * 10 * model.n_envs)


def test_normalization_with_statistics_learns_on_one_team():
    env = small_search(n_teams=1, roles={})
    model = make_model(env=env, policy={"norm_layer": "frozen_batch"})
    model.learn(2 * 10 * env.num_envs)


def test_statistics_see_more_of_an_episode_than_its_start():
    # The usual setting, and the default for area search: a rollout is as long as an episode.
    env = small_search(n_teams=4, horizon=10, roles={})
    model = make_model(env=env, policy={"norm_layer": "frozen_batch"}, n_steps=10)
    starts = set()
    seen = []
    streams = model.policy.streams
    layers = [m for m in model.policy.modules() if isinstance(m, FrozenBatchNorm2d)]

    def recorded(obs, *args, **kwargs):
        if layers[0].training:
            seen.append(obs["joint"].clone())
        return streams(obs, *args, **kwargs)

    model.policy.streams = recorded
    for _ in range(3):
        starts.add(env.team_env.batched.observations["joint"].tobytes())
        collect(model)
        model.train()
    assert layers and seen
    maps = {one.numpy().tobytes() for batch in seen for one in batch}
    assert len(maps) > 4 * len(starts), "all statistics are those of first observations"


# Learning


class SignalEnv(ParallelEnv):
    """Each robot sees a signal; the environment pays one component for each signal and move."""

    render_mode = None
    reward_component_names = ("explore", "cover")

    def __init__(self, mate=False, n_agents=2):
        self.metadata = {}
        self.mate = mate
        self.possible_agents = [f"robot_{i}" for i in range(n_agents)]

    def observation_space(self, agent):
        return spaces.Dict({k: spaces.Box(0, 1, (2,), np.float32) for k in ("signal", "blank")})

    def action_space(self, agent):
        return spaces.Discrete(3)

    def observe(self):
        self.signal = self.rng.integers(0, 2, len(self.agents))
        blank = np.zeros(2, np.float32)
        one_hot = np.eye(2, dtype=np.float32)[self.signal]
        return {a: {"signal": s, "blank": blank} for a, s in zip(self.agents, one_hot, strict=True)}

    def reset(self, seed=None, options=None):
        self.rng = np.random.default_rng(seed) if seed is not None else self.rng
        self.agents, self.clock = list(self.possible_agents), 0
        return self.observe(), {a: {} for a in self.agents}

    def step(self, actions):
        self.clock += 1
        wanted = 1 + (self.signal[::-1] if self.mate else self.signal)
        moves = np.array([actions[a] for a in self.agents])
        paid = (moves == wanted)[:, None] & (wanted[:, None] == [1, 2])
        infos = {
            a: {"reward_components": dict(zip(("explore", "cover"), p.astype(float), strict=True))}
            for a, p in zip(self.agents, paid, strict=True)
        }
        rewards = dict(zip(self.agents, paid.sum(axis=1).astype(float), strict=True))
        over = dict.fromkeys(self.agents, self.clock >= 8)
        return self.observe(), rewards, dict.fromkeys(self.agents, False), over, infos


def success(model, env, n_steps=50):
    """Mean reward; 1 is perfect, a uniform choice among three moves has 1 / 3."""
    observations, total = env.reset(), 0.0
    for _ in range(n_steps):
        actions, _ = model.predict(observations, deterministic=True)
        observations, rewards, _, _ = env.step(actions)
        total += rewards.mean()
    return total / n_steps


LEARNING = {
    "n_steps": 16,
    "batch_size": 64,
    "n_epochs": 4,
    "learning_rate": 5e-3,
    "gamma": 0.0,
    "sharp": False,
}


def test_hmappo_learns_which_role_makes_the_right_move_pay():
    # The move can not depend on the signal: it must be told by a role, which must be chosen by it.
    env = RoleWrapper(make_team_vec_env(SignalEnv, 8, 0))
    policy = {"primitive_keys": ["blank"], "share_encoders": True}
    model = make_model("hmappo", env, policy, **LEARNING)
    before = success(model, env)
    model.learn(16 * env.num_envs * 12)
    assert before < 0.6
    assert success(model, env) > 0.95
    # One role for ever can be right for one of two signals only.
    fixed = RoleWrapper(make_team_vec_env(SignalEnv, 8, 0), role_control="cover")
    model = make_model("hmappo", fixed, policy, **LEARNING)
    model.learn(16 * env.num_envs * 12)
    assert success(model, fixed) < 0.6


@pytest.mark.parametrize("graph", [True, False])
def test_mappo_learns_what_only_a_team_mate_sees_through_the_graph(graph):
    env = make_team_vec_env(lambda: SignalEnv(mate=True), 8, 0)
    model = make_model("mappo", env, {"graph": graph}, **LEARNING)
    model.learn(16 * env.num_envs * 12)
    env = TeamWrapper(env)
    if graph:
        assert success(model, env) > 0.95
        model.policy.communicate = False
    assert success(model, env) < 0.6


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_repeats_a_run_bit_by_bit(kind):
    runs = []
    for seed in (1, 1, 2):
        model = make_model(kind, seed=seed, sharp=False)
        model.learn(3 * 10 * model.n_envs)
        runs.append(weights(model))
    assert same(runs[0], runs[1])
    assert not same(runs[0], runs[2])


# Files and robots


@pytest.mark.parametrize("kind", KINDS)
def test_a_saved_model_acts_as_before_and_can_learn_on(kind, tmp_path):
    model = make_model(kind, kl_coef=0.5, policy={"norm_layer": "frozen_batch"})
    model.learn(2 * 10 * model.n_envs)
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", device="cpu", trust=True)
    assert same(weights(model), weights(loaded))
    assert loaded.kl_coefs == model.kl_coefs
    assert loaded.kl_coefs[0] != 0.5
    observations = model.env.reset()
    for deterministic in (True, False):
        actions = []
        for one in (model, loaded):
            th.manual_seed(0)
            actions.append(one.predict(observations, deterministic=deterministic)[0])
        np.testing.assert_array_equal(*actions)
    bare = small_search(roles={} if kind == "hmappo" else None)
    learner = type(model).load(tmp_path / "model", env=bare, device="cpu", trust=True)
    learner.learn(10 * model.n_envs)
    assert not same(weights(model), weights(learner))


@pytest.mark.parametrize("kind", KINDS)
def test_one_saved_policy_acts_for_1_to_50_robots(kind, tmp_path):
    model = make_model(kind)
    model.learn(10 * model.n_envs)
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", device="cpu", trust=True)
    wrapper = RoleWrapper if kind == "hmappo" else TeamWrapper
    for n_agents in (1, 2, 3, 13, 50):
        env = wrapper(small_search(n_teams=2, n_agents=n_agents))
        observations = env.reset()
        for _ in range(2):
            actions, _ = loaded.predict(observations, deterministic=False)
            assert actions.shape == (2 * n_agents, *env.action_space.shape)
            observations, *_ = env.step(actions)


def test_the_state_changes_values_but_no_action():
    model = make_model()
    observations = model.env.reset()
    corrupt = {**observations, "state": 1 - observations["state"]}
    without = {key: value for key, value in observations.items() if key != "state"}
    expected = model.predict(observations, deterministic=True)[0]
    for other in (corrupt, without):
        np.testing.assert_array_equal(model.predict(other, deterministic=True)[0], expected)
    with th.no_grad():
        values, changed = (
            model.policy.predict_values(model.policy.obs_to_tensor(obs)[0])
            for obs in (observations, corrupt)
        )
    assert ((values - changed).abs() > 1e-4).all()


# Returns at the end of episodes, with critics that are constants


class PaidEnv(PlainEnv):
    """Pays explore = 1 and cover = 2 at every step; its teams end in a way that is given."""

    reward_component_names = ("explore", "cover")
    terminates = ()

    def step(self, actions):
        observations, _, terminations, truncations, _ = super().step(actions)
        agents = list(observations)
        over = truncations[agents[0]]
        for agent in agents:
            terminations[agent] = over and agent in self.terminates
            truncations[agent] = over and agent not in self.terminates
        components = {"reward_components": {"explore": 1.0, "cover": 2.0}}
        infos = {agent: dict(components) for agent in agents}
        return observations, dict.fromkeys(agents, 3.0), terminations, truncations, infos


class TerminatingEnv(PaidEnv):
    terminates = ("a", "b")


class HalfTerminatingEnv(PaidEnv):
    terminates = ("a",)


GAMMA, ROLE_GAMMA, ROLE_VALUE = 0.9, 0.6, 10.0
BY_ROLE = th.tensor([4.0, 8.0])
PROBABILITY = th.tensor([0.3, 0.7])


def constant_critics(env, gae_lambda, n_steps=5):
    """HMAPPO whose role value is a constant, and whose primitive value is one for each role."""
    model = make_model(
        "hmappo",
        env,
        {"value_arch": (2,)},
        gamma=GAMMA,
        role_gamma=ROLE_GAMMA,
        gae_lambda=gae_lambda,
        n_steps=n_steps,
        normalize_advantage=False,
    )
    policy = model.policy
    with th.no_grad():
        for module in (policy.role_net, policy.role_value_net, policy.value_net):
            for parameter in module.parameters():
                parameter.zero_()
        policy.role_net.out.bias.copy_(PROBABILITY.log())
        policy.role_value_net.out.bias.fill_(ROLE_VALUE)
        policy.value_net.role.weight.copy_(th.eye(2))
        policy.value_net.head.out.weight.copy_(BY_ROLE[None])
    collect(model)
    return next(model.rollout_buffer.minibatches(10_000))


def check_bootstrap(samples, goes_on):
    """With lambda 0: r + gamma E of the next step, or r where the episode terminated."""
    roles = samples.actions[:, 0]
    paid = th.tensor([1.0, 2.0])[roles]
    expected_value = float((PROBABILITY * BY_ROLE).sum())
    role_returns = 3.0 + goes_on * ROLE_GAMMA * ROLE_VALUE
    th.testing.assert_close(samples.returns[:, 0], role_returns, rtol=1e-5, atol=1e-5)
    move_returns = paid + goes_on * GAMMA * expected_value
    th.testing.assert_close(samples.returns[:, 1], move_returns, rtol=1e-5, atol=1e-5)
    th.testing.assert_close(
        samples.advantages[:, 1], move_returns - BY_ROLE[roles], rtol=1e-5, atol=1e-5
    )
    assert set(roles.tolist()) == {0, 1}


@pytest.mark.parametrize("horizon", [1, 2, 5, 100])
def test_truncated_episodes_go_on_with_the_expected_value(horizon):
    env = RoleWrapper(make_team_vec_env(lambda: PaidEnv(horizon), 4, 0))
    samples = constant_critics(env, 0.0)
    check_bootstrap(samples, th.ones(len(samples.actions)))


def test_terminated_episodes_do_not_go_on():
    env = RoleWrapper(make_team_vec_env(lambda: TerminatingEnv(1), 4, 0))
    samples = constant_critics(env, 0.0)
    check_bootstrap(samples, th.zeros(len(samples.actions)))


def test_robots_of_one_team_can_end_in_different_ways():
    # Robot a terminates while robot b is truncated: both are done, which a team must be.
    env = RoleWrapper(make_team_vec_env(lambda: HalfTerminatingEnv(1), 4, 0))
    samples = constant_critics(env, 0.0)
    check_bootstrap(samples, samples.observations["agent"][:, 0])


@pytest.mark.parametrize("env_class", [PaidEnv, TerminatingEnv])
def test_long_returns_end_with_the_episode(env_class):
    # Lambda 1, episodes of 2 steps, 4 steps: the role returns of both steps by hand.
    env = RoleWrapper(make_team_vec_env(lambda: env_class(2), 3, 0))
    samples = constant_critics(env, 1.0, n_steps=4)
    tail = ROLE_GAMMA * ROLE_VALUE if env_class is PaidEnv else 0.0
    expected = [3.0 + ROLE_GAMMA * (3.0 + tail), 3.0 + tail]
    found = sorted(samples.returns[:, 0].tolist(), reverse=expected[0] > expected[1])
    assert found == pytest.approx([expected[0]] * 12 + [expected[1]] * 12)


def test_collecting_leaves_the_rewards_of_the_wrapper_alone():
    env = RoleWrapper(make_team_vec_env(lambda: PaidEnv(1), 4, 0))
    samples = constant_critics(env, 0.0)
    assert len(samples.actions) == 5 * 8
    assert env.stream_rewards[:, 0].tolist() == [3.0] * 8


# Every algorithm on our environment and on a foreign one


def search(backend):
    return small_search(backend=backend, sub_goal="assigned")


ENVS = {
    "native": lambda: search("native"),
    "supersuit": lambda: search("supersuit"),
    "foreign": lambda: make_team_vec_env(lambda: PlainEnv(7), 3, 0),
}


@pytest.mark.parametrize("env_name", ENVS)
@pytest.mark.parametrize("algorithm", [*OURS, *STOCK])
def test_every_algorithm_trains_everywhere(algorithm, env_name):
    env = ENVS[env_name]()
    if algorithm in OURS:
        model = make_model(algorithm, env, sharp=False)
    else:
        algorithm_class, options = STOCK[algorithm]
        model = algorithm_class(
            RoleActorCriticPolicy,
            RoleWrapper(env),
            rollout_buffer_class=TeamRolloutBuffer,
            policy_kwargs=SMALL_ROLE,
            seed=0,
            device="cpu",
            **options,
        )
    before = weights(model)
    model.learn(2 * 10 * env.num_envs)
    after = weights(model)
    assert model.num_timesteps == 2 * 10 * env.num_envs
    assert all(th.isfinite(value).all() for value in after.values())
    moved = {name for name in after if not th.equal(before[name], after[name])}
    # What only the primitive critic owns is not part of stock algorithms.
    critic = {name for name in after if "value_primitive" in name or name.startswith("value_net")}
    idle = set() if algorithm in OURS else critic
    assert not moved & idle
    assert len(moved) > 0.9 * len(after.keys() - idle)
    model.predict(model.env.reset())


SMALL_SCENE = {"height": 9, "width": 9, "n_targets": 10, "horizon": 12, "n_agents": 3}


def registered(algo, env="area-search-v0", **settings):
    """A small untrained model of the registry, and its configuration."""
    defaults = {"n_timesteps": 100, "n_envs": 2, "n_steps": 4, "batch_size": 4, "n_epochs": 2}
    settings = {**defaults, **settings}
    if env == "area-search-v0":
        settings["env_kwargs"] = SMALL_SCENE
    config = resolve(algo, env, settings, seed=0)
    return make_zoo_model(config, make_env(config), "cpu"), config


@pytest.mark.parametrize("env", [CountingEnv, BareCountingEnv])
@pytest.mark.parametrize("algo", ["mappo", "hmappo", "ppo", "maskable_ppo", "recurrent_ppo"])
def test_observations_of_discrete_spaces_can_be_learned_from(algo, env):
    name = f"toy_envs:{env.__name__}"
    policy = {"net_arch": [8]} if "_" in algo else {"graph_width": 8}
    policy |= {"lstm_hidden_size": 8} if algo == "recurrent_ppo" else {}
    model, config = registered(algo, name, n_steps=10, policy_kwargs=policy)
    before = weights(model)
    model.learn(2 * 10 * model.n_envs)
    moved = [name for name, value in weights(model).items() if not th.equal(value, before[name])]
    assert moved
    assert all(th.isfinite(value).all() for value in weights(model).values())
    scores = VecEnvEvaluator(make_env(config), 3)(model)
    assert scores["length"] == 5.0


@pytest.mark.parametrize("algo", ["maskable_ppo", "recurrent_ppo", "ppo"])
def test_actions_that_are_drawn_do_not_depend_on_who_is_simulated_beside(algo):
    model, _ = registered(algo)
    controller = PolicyController(model, deterministic=False)
    state = th.get_rng_state()
    scene = get_scene("hard", **SMALL_SCENE)
    whole = run_episodes(controller, scene, 20, seed=1)
    assert set(np.unique(whole.roles)) == {0, 1}
    for batch_size in (1, 7):
        again = run_episodes(controller, scene, 20, seed=1, batch_size=batch_size)
        np.testing.assert_array_equal(whole.roles, again.roles)
        for name, curves in whole.curves.items():
            np.testing.assert_array_equal(curves, again.curves[name])
    assert th.equal(state, th.get_rng_state())
    likeliest = run_episodes(PolicyController(model), scene, 20, seed=1)
    assert not np.array_equal(whole.curves["cover"], likeliest.curves["cover"])


@pytest.mark.parametrize("algo", ["maskable_ppo", "recurrent_ppo"])
def test_the_likeliest_actions_are_those_of_predict(algo):
    model, _ = registered(algo)
    controller, batch = PolicyController(model), BatchedAreaSearch("hard", 2, **SMALL_SCENE)
    env = model.env
    env.seed(11)
    observations, state, starts = env.reset(), None, np.ones(env.num_envs, np.bool_)
    batch.reset([int(seed) for seed in team_seeds(11, 2)])
    controller.begin(batch)
    for _ in range(11):
        masks = {"action_masks": get_action_masks(env)} if algo == "maskable_ppo" else {}
        actions, state = model.predict(observations, state, starts, True, **masks)
        observations, _, starts, _ = env.step(actions)
        moves, _ = controller.predict({})
        np.testing.assert_array_equal(controller.roles.ravel(), actions[:, 0])
        np.testing.assert_array_equal(moves, actions[:, 1])
        batch.step(moves.reshape(2, 3))


def test_masked_moves_are_never_drawn():
    model, _ = registered("maskable_ppo")
    controller, batch = (
        PolicyController(model, deterministic=False),
        BatchedAreaSearch("hard", 50, **SMALL_SCENE),
    )
    batch.reset(0)
    controller.begin(batch)
    tried = set()
    for _ in range(12):
        open_ = open_moves(batch.observations["local"].reshape(150, 4, 9, 9))
        moves, _ = controller.predict({})
        assert open_[np.arange(150), moves].all()
        tried |= set(moves)
        batch.step(moves.reshape(50, 3))
    assert tried == {0, 1, 2, 3, 4}


def test_only_actor_critic_policies_are_played():
    with pytest.raises(ValueError) as caught:
        PolicyController(
            QNetwork(
                spaces.Box(0, 1, (2,)),
                spaces.Discrete(2),
                FlattenExtractor(spaces.Box(0, 1, (2,))),
                2,
            )
        )
    assert one_line(caught.value) == "only actor-critic policies can be played, not QNetwork"


@pytest.mark.parametrize("view_radius", [1, 2])
def test_small_windows_can_be_learned_from(view_radius):
    env = small_search(view_radius=view_radius, roles={})
    model = make_model("hmappo", env, sharp=False)
    model.learn(10 * env.num_envs)


@pytest.mark.parametrize(
    "roles",
    [
        {"role_every": 5},
        {"role_every": 4},
        {"role_control": "random"},
        {"role_control": "random", "role_every": 3},
        {"role_control": "explore"},
        {"reward_sharing": "same_role", "primitive_weights": "role_reward"},
    ],
)
def test_lasting_and_controlled_roles_train(roles):
    env = small_search(roles=roles)
    model = make_model(env=env, kl_coef=0.5, policy={"see_role": True})
    before = weights(model)
    model.learn(3 * 10 * env.num_envs)
    after = weights(model)
    assert all(th.isfinite(value).all() for value in after.values())
    moved = {name for name in after if not th.equal(before[name], after[name])}
    assert any(name.startswith("action_net") for name in moved)
    assert any(name.startswith("role_value_net") for name in moved)
    actor = {name for name in moved if name.startswith(("role_net", "role_mlp", "role_graph"))}
    assert bool(actor) == ("role_control" not in roles)


# Settings

BAD = [
    ("n_steps", 0),
    ("n_steps", 2.5),
    ("batch_size", 0),
    ("n_epochs", -1),
    ("gamma", 1.01),
    ("gamma", float("nan")),
    ("gae_lambda", -0.1),
    ("learning_rate", -1e-3),
    ("learning_rate", "5e-4"),
    ("clip_range", -0.2),
    ("ent_coef", float("nan")),
    ("vf_coef", -1.0),
    ("kl_coef", float("inf")),
    ("kl_target", -0.01),
    ("max_grad_norm", 0.0),
    ("max_grad_norm", "0.5"),
    ("target_kl", 0.0),
    ("target_kl", "1e-2"),
    ("role_gamma", 2.0),
    ("role_gae_lambda", "0.9"),
    ("role_clip_range", -1.0),
    ("role_ent_coef", "0.01"),
    ("role_vf_coef", float("nan")),
    ("role_kl_coef", -0.5),
]


@pytest.mark.parametrize(("name", "value"), BAD)
def test_bad_settings_give_one_line_that_names_them(name, value):
    with pytest.raises(ValueError) as caught:
        make_model(**{name: value})
    message = one_line(caught.value)
    assert name in message
    assert str(value) in message


def test_algorithms_ask_for_teams():
    for kind in KINDS:
        with pytest.raises(ValueError, match="make_team_vec_env"):
            make_model(kind, env=PlainEnv())


class PoisonedWrapper(RoleWrapper):
    """One robot is paid NaN once."""

    steps = 0

    def step_wait(self):
        result = super().step_wait()
        self.steps += 1
        if self.steps == 9:
            self.stream_rewards[1, 1] = np.nan
        return result


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("normalize", [True, False])
def test_a_reward_that_is_not_a_number_stops_before_the_weights_change(normalize, seed):
    env = PoisonedWrapper(make_team_vec_env(PlainEnv, 3, 0))
    model = make_model(env=env, batch_size=2, normalize_advantage=normalize, seed=seed)
    before = weights(model)
    with pytest.raises((ValueError, FloatingPointError)) as caught:
        model.learn(10 * env.num_envs)
    assert "reward" in one_line(caught.value)
    assert same(before, weights(model))


def test_a_gradient_that_is_not_a_number_stops_before_the_weights_change():
    model = make_model()
    collect(model)
    before = weights(model)
    handle = model.policy.action_net.features.weight.register_hook(lambda g: g * float("nan"))
    with pytest.raises(FloatingPointError, match="no step was taken"):
        model.train()
    handle.remove()
    assert same(before, weights(model))


# The adaptive penalty, early stopping, logs


def test_a_timid_update_halves_the_coefficients_of_the_penalty():
    model = make_model(learning_rate=0.0, kl_coef=0.5, role_kl_coef=0.2)
    logs = record_logs(model)
    model.learn(3 * 10 * model.n_envs)
    assert [log["train/role_kl_coef"] for log in logs[1:]] == [0.2, 0.1]
    assert [log["train/primitive_kl_coef"] for log in logs[1:]] == [0.5, 0.25]
    assert model.kl_coefs == pytest.approx([0.2 / 8, 0.5 / 8])


def test_the_coefficients_follow_the_logged_divergence():
    model = make_model(learning_rate=1e-2, kl_coef=0.5, kl_target=0.01, n_epochs=4)
    logs = record_logs(model)
    model.learn(6 * 10 * model.n_envs)
    changes = set()
    for name, last in (("role", model.kl_coefs[0]), ("primitive", model.kl_coefs[1])):
        divergences = [log[f"train/{name}_kl"] for log in logs[1:]]
        coefficients = [log[f"train/{name}_kl_coef"] for log in logs[1:]]
        for i, (kl, after) in enumerate(zip(divergences[:-1], coefficients[1:], strict=True)):
            factor = 1.5 if kl > 0.02 else 0.5 if kl < 0.005 else 1.0
            assert after == pytest.approx(coefficients[i] * factor)
            changes.add(factor)
        assert last > 0
    assert len(changes) > 1


def test_the_penalty_holds_the_policy_back():
    divergence = []
    for kl_coef in (0.0, 100.0):
        model = make_model("mappo", kl_coef=kl_coef, learning_rate=3e-3, n_epochs=6, seed=3)
        logs = record_logs(model)
        model.learn(2 * 10 * model.n_envs)
        model.logger.dump()
        divergence.append(logs[-1]["train/kl"])
    assert divergence[1] < 0.5 * divergence[0]


def test_an_update_stops_where_it_has_gone_too_far():
    model = make_model(learning_rate=0.05, target_kl=0.01, n_epochs=10)
    collect(model)
    logs = record_logs(model)
    model.train()
    model.logger.dump()
    assert 0 < logs[-1]["train/optimizer_steps"] < 10 * 20 / 8
    free = make_model(learning_rate=0.05, n_epochs=10)
    collect(free)
    logs = record_logs(free)
    free.train()
    free.logger.dump()
    assert logs[-1]["train/optimizer_steps"] == 10 * 3


@pytest.mark.parametrize("kind", KINDS)
def test_logs_count_joint_steps_and_robot_steps(kind):
    model = make_model(kind, env=small_search(n_teams=2, n_agents=3))
    logs = record_logs(model)
    model.learn(3 * 10 * 6, callback=TeamMetricsCallback())
    assert [log["time/env_steps"] for log in logs] == [20, 40, 60]
    assert [log["time/agent_steps"] for log in logs] == [60, 120, 180]
    prefixes = ["train/"] if kind == "mappo" else ["train/role_", "train/primitive_"]
    for prefix in prefixes:
        for name in ("loss", "policy_loss", "value_loss", "entropy", "kl", "clip_fraction"):
            assert np.isfinite(logs[-1][prefix + name])


@pytest.mark.parametrize("kind", KINDS)
def test_streams_of_hmappo_have_their_own_settings(kind):
    # A coefficient of the role stream does not move the primitive networks, and the reverse.
    def after(**options):
        model = make_model("hmappo", max_grad_norm=None, **options)
        model.learn(10 * model.n_envs)
        return weights(model)

    plain = after(ent_coef=0.01, role_ent_coef=0.01)
    names = {"mappo": "ent_coef", "hmappo": "role_ent_coef"}
    other = after(**{"ent_coef": 0.01, "role_ent_coef": 0.01, names[kind]: 0.5})
    moved = {name for name in plain if not th.equal(plain[name], other[name])}
    actor = "action_net" if kind == "mappo" else "role_net"
    assert any(name.startswith(actor) for name in moved)
    own = ("action_net", "encoders.primitive") if kind == "mappo" else ("role_", "encoders.role_")
    assert all(name.startswith(own) for name in moved)
