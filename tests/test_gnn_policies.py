"""The policies on the team's graph, and MAPPO with that of H2GNN."""

import pytest
import torch as th
from gnn_teams import SMALL, graphs_of, log_probs, make_policy, observation, played
from helpers import collect, hand_made, one_line, record_logs, same, small_search, weights

from area_search import AreaSearchEnv
from sb3_roles import MAPPO, make_team_vec_env
from sb3_roles.common.distributions import LOG_ZERO
from sb3_roles.gnn import GNNPolicy, H2GNNPolicy

POLICIES = [GNNPolicy, H2GNNPolicy]


@pytest.mark.parametrize("policy_class", POLICIES)
def test_robots_may_be_numbered_in_any_way(policy_class):
    policy = make_policy(policy_class)
    obs = observation(played(4, n_agents=5))
    order = th.tensor([3, 0, 4, 2, 1])
    rows = (order + 5 * th.arange(4).unsqueeze(1)).flatten()
    permuted = {**obs, "position": obs["position"][rows]}
    first = log_probs(policy, obs)
    th.testing.assert_close(log_probs(policy, permuted), first[rows], atol=1e-5, rtol=1e-4)
    assert (first[0] - first[1]).abs().max() > 1e-3


@pytest.mark.parametrize("policy_class", POLICIES)
def test_a_team_is_answered_the_same_in_any_batch(policy_class):
    policy = make_policy(policy_class)
    obs = observation(played(40))
    together = log_probs(policy, obs)
    for m in (0, 17, 39):
        alone = {
            key: value[3 * m : 3 * m + 3] if len(value) == 120 else value[m : m + 1]
            for key, value in obs.items()
        }
        th.testing.assert_close(
            log_probs(policy, alone), together[3 * m : 3 * m + 3], atol=1e-5, rtol=1e-4
        )


@pytest.mark.parametrize("policy_class", POLICIES)
def test_maps_may_be_given_for_each_robot(policy_class):
    policy = make_policy(policy_class)
    obs = observation(played(3))
    repeated = {
        key: value.repeat_interleave(3, dim=0) if key in ("joint", "known", "state") else value
        for key, value in obs.items()
    }
    assert th.equal(log_probs(policy, repeated), log_probs(policy, obs))


@pytest.mark.parametrize("policy_class", POLICIES)
@pytest.mark.parametrize(("n_agents", "size"), [(1, 11), (2, 7), (8, 17), (50, 25)])
def test_the_same_weights_serve_any_team_and_map(policy_class, n_agents, size):
    policy = make_policy(policy_class)
    obs = observation(played(2, n_agents=n_agents, height=size, width=size + 2))
    said = log_probs(policy, obs)
    assert said.shape == (2 * n_agents, 5)
    th.testing.assert_close(said.exp().sum(1), th.ones(2 * n_agents))
    actions, values, log_prob = policy(obs)
    assert len(actions) == len(values) == len(log_prob) == 2 * n_agents


@pytest.mark.parametrize("policy_class", POLICIES)
@pytest.mark.parametrize("seed", range(4))
def test_fresh_embeddings_neither_explode_nor_vanish(policy_class, seed):
    policy = make_policy(policy_class, seed=seed, n_hops=16, hop_width=16)
    sizes = policy.message_passing(graphs_of(played(5))).square().mean((0, 1, 3)).sqrt()
    # Without the scaling they grow up to ten thousandfold.
    assert sizes.max() < 10 * sizes[0]
    assert sizes.min() > sizes[0] / 10


@pytest.mark.parametrize("policy_class", POLICIES)
def test_only_moves_with_an_edge_are_possible(policy_class):
    batch = hand_made(["0.T#", "#1#?", "####"])
    batch.show_known_map()
    policy = make_policy(policy_class)
    said = log_probs(policy, observation(batch))
    possible = [[True, False, True, False, False], [True, True, False, False, False]]
    assert (said.exp() > 0).tolist() == possible
    assert (said[~th.tensor(possible)] < LOG_ZERO / 2).all()
    th.manual_seed(0)
    drawn = th.stack([policy(observation(batch))[0] for _ in range(50)])
    assert set(drawn[:, 0].tolist()) == {0, 2}
    assert set(drawn[:, 1].tolist()) == {0, 1}


def test_a_robot_sees_as_far_as_its_hops():
    # A corridor: the target is 9 cells away; its neighbor's news travel one cell a hop.
    near, far = (hand_made([f"0........{last}"]) for last in (".", "T"))
    for n_hops, differs in ((7, False), (8, True), (12, True)):
        policy = make_policy(n_hops=n_hops)
        said = []
        for batch in (near, far):
            batch.show_known_map()
            # No frontier: only the target tells the maps apart.
            said.append(log_probs(policy, {**observation(batch), "joint": joint_of(batch)}))
        assert (not th.equal(*said)) is differs, n_hops


def joint_of(batch):
    joint = th.from_numpy(batch.observations["joint"].copy())
    joint[:, 0] = 0
    return joint


def test_hops_are_weighted_by_heads_of_their_own():
    policy = make_policy(H2GNNPolicy)
    hops = th.randn(7, 5, 8)
    out = policy.attend(hops)
    heads = []
    for h in range(4):
        # By hand: per head 2 columns of the query, and of keys and values side by side.
        query = policy.query(hops[:, 0])[:, 2 * h : 2 * h + 2]
        key_value = policy.answer(hops)[:, :, 4 * h : 4 * h + 4]
        keys, values = key_value[..., :2], key_value[..., 2:]
        scores = (keys * query.unsqueeze(1)).sum(-1) / 2**0.5
        heads.append((scores.softmax(1).unsqueeze(-1) * values).sum(1))
    th.testing.assert_close(out, policy.attended(th.cat(heads, dim=1)))
    # The order of the hops carries nothing but the first, which asks.
    shuffled = hops[:, [0, 3, 1, 4, 2]]
    th.testing.assert_close(policy.attend(shuffled), out)


@pytest.mark.parametrize("policy_class", POLICIES)
def test_actors_do_not_read_the_state_and_share_nothing_with_critics(policy_class):
    policy = make_policy(policy_class)
    obs = observation(played(2))
    changed = {**obs, "state": 1 - obs["state"]}
    assert th.equal(log_probs(policy, obs), log_probs(policy, changed))
    del changed["state"]
    assert th.equal(log_probs(policy, obs), log_probs(policy, changed))
    policy.get_distribution(obs).distribution.logits[:, 0].sum().backward()
    actor = {name for name, p in policy.named_parameters() if p.grad is not None}
    critic = {name for name, _ in policy.named_parameters() if "value" in name}
    assert actor.isdisjoint(critic)
    assert actor | critic == {name for name, _ in policy.named_parameters()}


BAD = [
    ({"n_hops": 0}, "n_hops must be a whole number"),
    ({"hop_width": 6.0}, "hop_width must be a whole number"),
    ({"precision": "fp23"}, "did you mean 'fp32'"),
    ({"use_sde": True}, "discrete"),
    ({"critic_keys": ["stat"]}, "did you mean 'state'"),
]


@pytest.mark.parametrize(("options", "hint"), BAD)
def test_bad_options_give_one_line(options, hint):
    with pytest.raises(ValueError) as caught:
        make_policy(**options)
    assert hint in one_line(caught.value)


def test_heads_must_divide_the_embedding():
    with pytest.raises(ValueError, match="n_heads must divide hop_width, 8, got 3"):
        make_policy(H2GNNPolicy, n_heads=3)


def test_an_environment_without_the_known_map_is_refused():
    with pytest.raises(ValueError) as caught:
        MAPPO(H2GNNPolicy, small_search(), policy_kwargs=SMALL)
    assert "known_map: true" in one_line(caught.value)


# H2GNN is MAPPO with its policy


def h2gnn(**options):
    env = small_search(known_map=True)
    return MAPPO(
        H2GNNPolicy,
        env,
        n_steps=10,
        batch_size=8,
        n_epochs=2,
        seed=0,
        policy_kwargs=SMALL,
        **options,
    )


def test_a_critic_that_reads_patches_leaves_the_graph_its_maps():
    env = make_team_vec_env(lambda: AreaSearchEnv("hard", known_map=True), n_envs=2, seed=0)
    options = {**SMALL, "encoder": "patches", "norm_layer": "none"}
    for name in ("joint_channels", "local_channels", "state_channels"):
        options.pop(name, None)
    model = MAPPO(H2GNNPolicy, env, n_steps=4, batch_size=4, policy_kwargs=options)
    before = weights(model)
    model.learn(4 * model.n_envs)
    assert not same(weights(model), before)


def test_learning_rate_0_leaves_the_ratio_at_1():
    model = h2gnn(learning_rate=0.0)
    logs = record_logs(model)
    collect(model)
    before = weights(model)
    model.train()
    model.logger.dump()
    assert logs[-1]["train/clip_fraction"] == 0
    assert abs(logs[-1]["train/kl"]) < 1e-6
    assert same(weights(model), before)


def test_mappo_trains_all_weights_and_repeats_itself():
    runs = []
    for _ in range(2):
        model = h2gnn(learning_rate=1e-2)
        before = weights(model)
        collect(model)
        model.train()
        runs.append(weights(model))
    assert same(*runs)
    assert not [name for name in before if th.equal(before[name], runs[0][name])]
