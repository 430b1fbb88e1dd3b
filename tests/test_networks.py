"""The policies' networks: teams as graphs, maps of any size, what each network reads."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from helpers import (
    N_MOVES,
    N_ROLES,
    POLICIES,
    SMALL,
    make_observation,
    make_policy,
    one_line,
    policy_space,
    small_search,
)
from torch import nn

from sb3_roles import HMAPPO, MAPPO, TeamWrapper
from sb3_roles.common.torch_layers import (
    NORM_LAYERS,
    FrozenBatchNorm2d,
    MapEncoder,
    RoleHead,
    communication_graph,
    has_fast_bfloat16,
    resolve_precision,
    updating_statistics,
)
from sb3_roles.common.vectors import as_vectors, vector_size

KINDS = list(POLICIES)
TEAM_KEYS = ("joint", "state")


def outputs(policy, obs):
    """All that a policy says, whatever is chosen: probabilities and values by choice, (n, k)."""
    with th.no_grad():
        distribution = policy.get_distribution(obs).distribution
        first = th.zeros((len(obs["agent"]), 2 if isinstance_of_roles(policy) else 1)).long()
        values = [policy.streams(obs, first).values]
        if isinstance_of_roles(policy):
            values += [policy.streams(obs, first + th.tensor([r, 0])).values for r in (0, 1)]
    return SimpleNamespace(choices=distribution.logits, values=th.cat(values, dim=1))


def isinstance_of_roles(policy):
    return len(policy.stream_names) == 2


def assert_close(first, second, atol=1e-6):
    th.testing.assert_close(first.choices, second.choices, atol=atol, rtol=1e-5)
    th.testing.assert_close(first.values, second.values, atol=atol, rtol=1e-5)


def take(obs, rows):
    """Rows of an observation, with the robots numbered anew."""
    taken = {key: value[rows] for key, value in obs.items()}
    n_agents = len(rows)
    taken["agent"] = th.tensor([[i, n_agents] for i in range(n_agents)], dtype=th.float32)
    return taken


def once_per_team(obs, n_agents):
    return {key: v[::n_agents] if key in TEAM_KEYS else v for key, v in obs.items()}


# Teams as graphs


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("radius", [None, 12.0])
def test_permuting_robots_permutes_what_they_do(kind, radius):
    policy = make_policy(kind, communication_radius=radius)
    obs = make_observation(1, 6)
    order = th.tensor([3, 0, 5, 1, 4, 2])
    before, after = outputs(policy, obs), outputs(policy, take(obs, order))
    before.choices, before.values = before.choices[order], before.values[order]
    assert (before.choices - before.choices[0]).abs().max() > 0.1
    assert_close(before, after)


def with_new_features(obs, robot, seed=9):
    """Change all that one robot sees, but not where it is."""
    other = make_observation(1, len(obs["agent"]), seed=seed)
    changed = {key: value.clone() for key, value in obs.items()}
    for key in ("local", "sub_goal"):
        changed[key][robot] = other[key][robot]
    return changed


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("distance", "linked"), [(4.999, True), (5.0, False), (50.0, False)])
def test_robots_hear_only_those_strictly_nearer_than_the_radius(kind, distance, linked):
    policy = make_policy(kind, communication_radius=5.0)
    obs = make_observation(1, 2)
    obs["position"] = th.tensor([[3.0, 4.0], [3.0, 4.0 + distance]])
    before, after = outputs(policy, obs), outputs(policy, with_new_features(obs, 1))
    change = (before.choices[0] - after.choices[0]).abs().max()
    assert change > 1e-3 if linked else change == 0
    assert (before.choices[1] - after.choices[1]).abs().max() > 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_messages_go_one_hop_far(kind):
    # A chain 0 - 1 - 2: the ends do not hear each other.
    policy = make_policy(kind, communication_radius=5.0)
    obs = make_observation(1, 3)
    obs["position"] = th.tensor([[0.0, 0.0], [0.0, 4.0], [0.0, 8.0]])
    before, after = outputs(policy, obs), outputs(policy, with_new_features(obs, 2))
    changed = (before.choices - after.choices).abs().amax(dim=1)
    assert changed[0] == 0
    assert changed[1] > 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_teams_do_not_hear_each_other(kind):
    policy = make_policy(kind)
    obs = make_observation(3, 4)
    alone = [outputs(policy, take(obs, range(4 * t, 4 * t + 4))) for t in range(3)]
    together = outputs(policy, obs)
    expected = SimpleNamespace(
        choices=th.cat([part.choices for part in alone]),
        values=th.cat([part.values for part in alone]),
    )
    assert_close(together, expected)


@pytest.mark.parametrize("kind", KINDS)
def test_without_communication_robots_are_alone(kind):
    policy = make_policy(kind)
    obs = make_observation(1, 5)
    talking = outputs(policy, obs)
    policy.communicate = False
    silent = outputs(policy, obs)
    alone = [outputs(policy, take(obs, [i])) for i in range(5)]
    th.testing.assert_close(
        silent.choices, th.cat([part.choices for part in alone]), atol=1e-6, rtol=1e-5
    )
    assert (silent.choices - talking.choices).abs().max() > 1e-2


@pytest.mark.parametrize("kind", KINDS)
def test_a_policy_without_graph_has_independent_robots(kind):
    policy = make_policy(kind, graph=False)
    obs = make_observation(1, 3)
    before, after = outputs(policy, obs), outputs(policy, with_new_features(obs, 1))
    assert th.equal(before.choices[[0, 2]], after.choices[[0, 2]])


def test_the_graph_is_the_symmetrically_normalized_adjacency():
    position = th.tensor([[[0.0, 0.0], [0.0, 3.0], [0.0, 6.0], [9.0, 9.0]]])
    graph = communication_graph(position, 4.0, position)[0]
    link = 2**-0.5
    expected = [[0, link, 0, 0], [link, 0, link, 0], [0, link, 0, 0], [0, 0, 0, 0]]
    th.testing.assert_close(graph, th.tensor(expected), atol=1e-7, rtol=0)
    everyone = communication_graph(position, None, position)[0]
    th.testing.assert_close(everyone, (1 - th.eye(4)) / 3, atol=1e-7, rtol=0)


def test_a_negative_communication_radius_is_refused():
    with pytest.raises(ValueError, match="communication_radius"):
        make_policy("hmappo", communication_radius=-5.0)


# Maps


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [False, True])
@pytest.mark.parametrize("layout", [th.contiguous_format, th.channels_last])
def test_maps_given_once_per_team_are_those_given_for_each_row(kind, share, layout):
    policy = make_policy(kind, share_encoders=share)
    obs = make_observation(3, 4)
    once = once_per_team(obs, 4)
    for key in ("local", *TEAM_KEYS):
        once[key] = once[key].contiguous(memory_format=layout)
    assert len(once["joint"]) == 3
    assert_close(outputs(policy, obs), outputs(policy, once))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [(5, 5), (60, 40), (8, 31)])
def test_one_policy_reads_maps_of_any_size(kind, size):
    policy = make_policy(kind)
    obs = make_observation(2, 3, *size)
    found = outputs(policy, obs)
    assert th.isfinite(found.choices).all()
    assert th.isfinite(found.values).all()
    changed = {**obs, "joint": 1 - obs["joint"]}
    assert (outputs(policy, changed).choices - found.choices).abs().max() > 1e-3
    changed = {**obs, "state": 1 - obs["state"]}
    assert (outputs(policy, changed).values - found.values).abs().max() > 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_the_weights_do_not_depend_on_the_size_of_the_maps(kind):
    shapes = [
        {name: value.shape for name, value in make_policy(kind, space).state_dict().items()}
        for space in (policy_space(5, 5), policy_space(25, 25), policy_space(60, 40))
    ]
    assert shapes[0] == shapes[1] == shapes[2]


@pytest.mark.parametrize(
    ("style", "sides"),
    [*(("local", n) for n in (1, 3, 5, 6, 9, 13)), ("joint", 5), ("joint", 25), ("state", 5)],
)
def test_encoders_give_vectors_of_the_declared_size(style, sides):
    encoder = MapEncoder(3, style, SMALL[f"{style}_channels"])
    assert encoder(th.rand(2, 3, sides, sides)).shape == (2, encoder.out_features)


def test_the_networks_of_the_paper_have_its_sizes():
    sizes = [
        MapEncoder(channels, style, full).out_features
        for channels, style, full in [
            (4, "local", (8, 16, 32)),
            (2, "joint", (16, 32, 64, 64)),
            (5, "state", (8, 16, 32)),
        ]
    ]
    assert sizes == [32, 64, 128]


# Any team


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n_agents", [1, 2, 7, 50])
def test_one_policy_serves_teams_of_any_size(kind, n_agents):
    policy = make_policy(kind)
    obs = make_observation(2, n_agents)
    actions, values, log_prob = policy(obs)
    assert len(actions) == len(values) == len(log_prob) == 2 * n_agents
    assert th.isfinite(outputs(policy, obs).choices).all()


@pytest.mark.parametrize("algorithm", [MAPPO, HMAPPO])
def test_neither_weights_nor_spaces_depend_on_the_number_of_robots(algorithm):
    models = [algorithm_for(algorithm, n_agents) for n_agents in (1, 2, 5)]
    shapes = [
        {name: value.shape for name, value in model.policy.state_dict().items()} for model in models
    ]
    assert shapes[0] == shapes[1] == shapes[2]
    assert models[0].observation_space == models[1].observation_space == models[2].observation_space
    assert models[0].action_space == models[1].action_space


def algorithm_for(algorithm, n_agents):
    kind = {MAPPO: "mappo", HMAPPO: "hmappo"}[algorithm]
    name = {MAPPO: "TeamPolicy", HMAPPO: "RolePolicy"}[algorithm]
    return algorithm(name, small_search(n_agents=n_agents), policy_kwargs=POLICIES[kind][1])


@pytest.mark.parametrize("kind", KINDS)
def test_rows_that_are_not_whole_teams_are_refused(kind):
    policy = make_policy(kind)
    obs = make_observation(2, 3)
    for rows in ([0, 1], [1, 2, 0], [0, 1, 2, 3, 5, 4], [0, 4, 1, 3, 2, 5]):
        with pytest.raises(ValueError, match="not whole teams"):
            policy({key: value[rows] for key, value in obs.items()})


# Who reads what


def gradient_owners(policy, loss):
    policy.zero_grad(set_to_none=True)
    loss.backward()
    return {name for name, p in policy.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("kind", KINDS)
def test_actors_and_critics_have_separate_weights_named_for_trpo(kind):
    policy = make_policy(kind)
    obs = make_observation(2, 3)
    n_streams = len(policy.stream_names)
    said = policy.streams(obs, th.ones((6, n_streams), dtype=th.long))
    picked = sum(log_probs[:, 0].sum() for log_probs in said.log_probs)
    actors = gradient_owners(policy, picked)
    said = policy.streams(obs, th.ones((6, n_streams), dtype=th.long))
    critics = gradient_owners(policy, said.values.sum())
    everything = {name for name, _ in policy.named_parameters()}
    assert not actors & critics
    assert actors | critics == everything
    assert critics == {name for name in everything if "value" in name}


def test_each_stream_trains_its_own_networks():
    policy = make_policy("hmappo")
    obs = make_observation(2, 3)
    owners = []
    for pick in (
        lambda s: s.log_probs[0],
        lambda s: s.log_probs[1],
        lambda s: s.values[:, 0],
        lambda s: s.values[:, 1],
    ):
        said = policy.streams(obs, th.ones((6, 2), dtype=th.long))
        policy.zero_grad(set_to_none=True)
        (pick(said) ** 2).sum().backward()
        parameters = dict(policy.named_parameters())
        owners.append({k for k, p in parameters.items() if p.grad is not None and p.grad.any()})
    assert sum(len(part) for part in owners) == len(parameters)
    assert set().union(*owners) == set(parameters)


def test_shared_encoders_are_trained_by_all_and_exist_once():
    policy = make_policy("hmappo", share_encoders=True)
    # The state is not for actors: its encoder belongs to the critics, also by name.
    assert set(policy.encoders) == {"shared_local", "shared_joint", "value_state"}
    apart = make_policy("hmappo")
    assert len(apart.encoders) == 2 + 2 + 3 + 3


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [False, True])
def test_the_state_changes_values_but_no_choice(kind, share):
    policy = make_policy(kind, share_encoders=share)
    obs = make_observation(2, 3)
    corrupt = {**obs, "state": 1 - obs["state"]}
    before, after = outputs(policy, obs), outputs(policy, corrupt)
    assert th.equal(before.choices, after.choices)
    assert ((before.values - after.values).abs() > 1e-4).all()
    th.manual_seed(0)
    first = policy(obs)[0]
    th.manual_seed(0)
    assert th.equal(first, policy(corrupt)[0])


@pytest.mark.parametrize("kind", KINDS)
def test_policies_choose_without_the_state(kind):
    policy = make_policy(kind)
    obs = {key: value.numpy() for key, value in make_observation(2, 3).items()}
    expected = policy.predict(obs, deterministic=True)[0]
    del obs["state"]
    assert (policy.predict(obs, deterministic=True)[0] == expected).all()


@pytest.mark.parametrize("kind", KINDS)
def test_the_two_ways_to_evaluate_agree(kind):
    # forward() looks at the chosen role only, evaluate_actions() at all of them.
    policy = make_policy(kind)
    obs = make_observation(2, 3)
    with th.no_grad():
        actions, values, log_prob = policy(obs)
        again, log_prob_again, entropy = policy.evaluate_actions(obs, actions)
    th.testing.assert_close(log_prob, log_prob_again, atol=1e-5, rtol=1e-5)
    th.testing.assert_close(values, again, atol=1e-6, rtol=1e-5)
    assert (entropy > 0).all()


def test_values_to_bootstrap_with_are_the_expectation_over_roles():
    policy = make_policy("hmappo")
    obs = make_observation(4, 3)
    obs["role_due"][::2] = 0.0
    with th.no_grad():
        said = policy.streams(obs)
        by_role = [
            policy.streams(obs, th.tensor([[role, 0]]).repeat(12, 1)).values[:, 1]
            for role in range(N_ROLES)
        ]
    by_role = th.stack(by_role, dim=1)
    expected = (said.log_probs[0].exp() * by_role).sum(1)
    th.testing.assert_close(said.expected_values[:, 1], expected, atol=1e-6, rtol=1e-5)
    th.testing.assert_close(said.expected_values[:, 0], said.values[:, 0])
    taken = by_role.gather(1, said.actions[:, :1])[:, 0]
    th.testing.assert_close(said.values[:, 1], taken, atol=1e-6, rtol=1e-5)
    assert (by_role[:, 0] - by_role[:, 1]).abs().min() > 1e-4
    # A role that goes on is certain, and nothing was decided.
    held = obs["role_due"][:, 0] == 0
    assert th.equal(said.actions[held, 0], obs["role"][held].argmax(1))
    assert th.equal(said.active[:, 0], ~held)
    assert said.active[:, 1].all()


# Parts


def test_the_role_head_is_an_mlp_on_the_explicit_concatenation():
    th.manual_seed(0)
    head = RoleHead(7, 3, (16, 8), 5, gain=1.0)
    plain = nn.Sequential(
        nn.Linear(7 + 3, 16), nn.ReLU(), nn.Linear(16, 8), nn.ReLU(), nn.Linear(8, 5)
    )
    with th.no_grad():
        plain[0].weight.copy_(th.cat([head.features.weight, head.role.weight], dim=1))
        plain[0].bias.copy_(head.features.bias)
        for own, copied in ((plain[2], head.head.hidden[0]), (plain[4], head.head.out)):
            own.load_state_dict(copied.state_dict())
    x, roles = th.randn(20, 7), th.randint(0, 3, (20,))
    expected = plain(th.cat([x, nn.functional.one_hot(roles, 3).float()], dim=1))
    th.testing.assert_close(head(x, roles), expected, atol=1e-6, rtol=1e-5)
    for role in range(3):
        th.testing.assert_close(
            head(x)[:, role], head(x, th.full((20,), role)), atol=1e-6, rtol=1e-5
        )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("norm_layer", NORM_LAYERS)
def test_training_mode_does_not_change_what_a_policy_says(kind, norm_layer):
    policy = make_policy(kind, norm_layer=norm_layer)
    obs = make_observation(3, 3)
    policy.set_training_mode(False)
    before = outputs(policy, obs)
    policy.set_training_mode(True)
    after = outputs(policy, obs)
    assert th.equal(before.choices, after.choices)
    assert th.equal(before.values, after.values)


def test_frozen_statistics_follow_the_data_only_where_they_may():
    layer = FrozenBatchNorm2d(3)
    module = nn.Sequential(layer).train()
    x = th.randn(64, 3, 4, 4) * 2 + 5
    module(x)
    assert th.equal(layer.running_mean, th.zeros(3))
    with updating_statistics(module) as has_statistics:
        assert has_statistics
        module(x)
    th.testing.assert_close(layer.running_mean, 0.1 * x.mean((0, 2, 3)))
    frozen = layer.running_mean.clone()
    module(x)
    assert th.equal(layer.running_mean, frozen)
    with updating_statistics(nn.Linear(1, 1)) as has_statistics:
        assert not has_statistics


def test_normalization_with_statistics_starts_with_a_single_map():
    # One team, whose joint map is given once: 1 x 1 features of a single map at the last layer.
    policy = make_policy("hmappo", norm_layer="frozen_batch")
    obs = once_per_team(make_observation(1, 4), 4)
    with updating_statistics(policy), th.no_grad():
        assert th.isfinite(policy.streams(obs).values).all()


@pytest.mark.parametrize("kind", KINDS)
def test_bf16_says_nearly_what_fp32_says(kind):
    exact, fast = (make_policy(kind, precision=p) for p in ("fp32", "bf16"))
    obs = make_observation(8, 4)
    first, second = outputs(exact, obs), outputs(fast, obs)
    assert second.choices.dtype == second.values.dtype == th.float32
    assert not th.equal(first.choices, second.choices)
    # Eight bits of mantissa through some six layers.
    probability = (first.choices.exp() - second.choices.exp()).abs()
    assert probability.max() < 0.03
    assert (first.values - second.values).abs().max() < 0.03 * first.values.abs().max()
    assert all(p.dtype == th.float32 for p in fast.parameters())
    total = second.choices.exp().sum(1)
    th.testing.assert_close(total, th.ones_like(total), atol=1e-5, rtol=0)


@pytest.mark.skipif(not has_fast_bfloat16(), reason="no bfloat16 in this CPU's hardware")
@pytest.mark.parametrize("size", [5, 11, 18, 25])
def test_gradients_in_bf16_are_those_in_fp32_but_for_rounding(size):
    # Weight gradients of a 3 x 3 convolution over a 1 x 1 map have been uninitialized memory.
    gradients = []
    for precision in ("fp32", "bf16"):
        policy = make_policy("hmappo", policy_space(size, size), precision=precision)
        said = policy.streams(make_observation(4, 3, size, size), th.ones((12, 2)).long())
        (said.values.square().sum() + said.log_probs[0][:, 0].sum()).backward()
        gradients.append({k: p.grad for k, p in policy.named_parameters() if p.grad is not None})
    exact, fast = gradients
    assert exact.keys() == fast.keys()
    for name, gradient in exact.items():
        assert th.isfinite(fast[name]).all(), name
        assert (fast[name] - gradient).norm() <= 0.5 * gradient.norm() + 1e-3, name


def test_auto_precision_takes_what_the_hardware_has():
    expected = "bf16" if has_fast_bfloat16() else "fp32"
    assert resolve_precision("auto", "cpu") == expected
    auto, named = (make_policy("hmappo", precision=p) for p in ("auto", expected))
    obs = make_observation(2, 3)
    assert th.equal(outputs(auto, obs).choices, outputs(named, obs).choices)


# Options

BAD = [
    ({"norm_layer": "grup"}, "did you mean 'group'"),
    ({"precision": "fp23"}, "did you mean 'fp32'"),
    ({"actor_keys": ["locl"]}, "did you mean 'local'"),
    ({"actor_keys": ["state"]}, "must act without it"),
    ({"critic_keys": ["stat"]}, "did you mean 'state'"),
    ({"primitive_keys": ["join"]}, "did you mean 'joint'"),
    ({"primitive_input": "grap"}, "did you mean 'graph'"),
    ({"local_channels": (4, 4)}, "3 convolutions"),
    ({"primitive_arch": ()}, "at least one hidden layer"),
    ({"use_sde": True}, "discrete"),
]


@pytest.mark.parametrize(("options", "hint"), BAD)
def test_bad_options_give_one_line(options, hint):
    with pytest.raises(ValueError) as caught:
        make_policy("hmappo", **options)
    assert hint in one_line(caught.value)


@pytest.mark.parametrize(
    ("space", "values", "expected"),
    [
        (spaces.Discrete(3), [2, 0], [[0, 0, 1], [1, 0, 0]]),
        # As SB3's buffers hand them back.
        (spaces.Discrete(3), [[2], [0]], [[0, 0, 1], [1, 0, 0]]),
        (spaces.MultiDiscrete([2, 3]), [[1, 0], [0, 2]], [[0, 1, 1, 0, 0], [1, 0, 0, 0, 1]]),
        (spaces.MultiBinary(2), [[0, 1], [1, 1]], [[0, 1], [1, 1]]),
        (spaces.Box(0, 1, (1, 2), np.float32), [[[0.5, 1]], [[0, 0]]], [[0.5, 1], [0, 0]]),
        (spaces.Box(0, np.inf, (1,), np.float32), [[0], [np.e - 1]], [[0], [1]]),
        (spaces.Box(0, 255, (2,), np.uint8), [[255, 0], [1, 2]], [[255, 0], [1, 2]]),
    ],
)
def test_observations_become_vectors(space, values, expected):
    vectors = as_vectors(space, th.as_tensor(np.array(values, space.dtype)))
    assert vectors.dtype == th.float32
    assert vectors.shape == (2, vector_size(space))
    np.testing.assert_allclose(vectors.numpy(), expected, rtol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_choices_that_are_observed_are_read_as_one_hots(kind):
    space = policy_space()
    discrete = make_policy(kind, spaces.Dict({**space.spaces, "hint": spaces.Discrete(4)}))
    box = make_policy(kind, spaces.Dict({**space.spaces, "hint": spaces.Box(0, 1, (4,))}))
    box.load_state_dict(discrete.state_dict())
    obs, hint = make_observation(2, 3), th.tensor([0, 1, 2, 3, 1, 0])
    given = outputs(discrete, {**obs, "hint": hint})
    same = outputs(box, {**obs, "hint": th.eye(4)[hint]})
    other = outputs(discrete, {**obs, "hint": 3 - hint})
    assert_close(given, same)
    assert not th.allclose(given.choices, other.choices)
    assert not th.allclose(given.values, other.values)


def vector_space(**boxes):
    structure = {key: policy_space()[key] for key in ("agent", "role", "role_due")}
    return spaces.Dict({**boxes, **structure})


def test_an_unknown_normalization_is_refused_also_where_no_map_is_normalized():
    space = vector_space(observation=spaces.Box(-1, 1, (3,)))
    with pytest.raises(ValueError, match="norm_layer"):
        make_policy("hmappo", space, norm_layer="grup")


def test_actors_with_nothing_to_read_are_refused():
    # 'state' is for critics: nothing is left for the actors.
    space = vector_space(state=spaces.Box(-1, 1, (3,)))
    with pytest.raises(ValueError, match="actor"):
        make_policy("hmappo", space)


@pytest.mark.parametrize(
    ("algorithm", "name", "right"),
    [(HMAPPO, "RolePolcy", "RolePolicy"), (MAPPO, "MlpPolicy", "TeamPolicy")],
)
def test_an_unknown_policy_is_named_with_what_is_allowed(algorithm, name, right):
    with pytest.raises(ValueError, match=f"unknown policy '{name}': allowed are {right}"):
        algorithm(name, TeamWrapper(small_search()))


def test_policies_ask_for_the_wrappers():
    with pytest.raises(ValueError, match="TeamWrapper or RoleWrapper"):
        make_policy("mappo", spaces.Dict({"observation": spaces.Box(-1, 1, (3,))}))
    policy_class, options = POLICIES["hmappo"]
    with pytest.raises(ValueError, match="RoleWrapper"):
        policy_class(policy_space(), spaces.Discrete(N_MOVES), lambda _: 1e-3, **options)
    with pytest.raises(ValueError, match="RoleWrapper"):
        HMAPPO("RolePolicy", TeamWrapper(small_search()), policy_kwargs=options)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("side", [None, 40], ids=["reference", "larger"])
def test_prepared_observations_say_the_same(kind, side):
    default = dict.fromkeys(("local_channels", "joint_channels", "state_channels"))
    policy = make_policy(kind, encoder="patches", **default)
    obs = make_observation(3, 2, side or 25, side or 25)
    prepared = policy.prepare(obs)
    # What has another number of patches than the encoder's reference stays a map.
    assert prepared["joint"].ndim == (3 if side is None else 4)
    assert_close(outputs(policy, prepared), outputs(policy, obs), atol=0)
    twice = policy.prepare(prepared)
    assert all(th.equal(twice[key], prepared[key]) for key in prepared)
