"""``goal_key`` and ``goal_prior``: a role sees its own sub-goal, and heads for it untrained."""

from __future__ import annotations

import pytest
import torch as th
from helpers import N_MOVES, collect, make_observation, make_policy, one_line, small_search

from sb3_roles import HMAPPO, MAPPO

EXPLORE, COVER = 0, 1


def distribution(policy, obs):
    with th.no_grad():
        return policy.get_distribution(obs)


def test_a_role_weighs_its_own_sub_goal_and_those_of_others():
    options = {"goal_key": "sub_goal", "goal_prior": 3.0, "other_goal_prior": 0.5}
    policy = make_policy("hmappo", **options)
    obs = make_observation(3, 4)
    obs["sub_goal"][:, :, :N_MOVES] = 0.0
    before = distribution(policy, obs).move_log_probs
    # The networks read the flags, too: without them only the weights are left.
    with th.no_grad():
        for parameter in policy.action_net.features.parameters():
            parameter.zero_()
    plain = distribution(policy, obs).move_log_probs
    assert before.shape == plain.shape == (12, 2, N_MOVES)
    obs["sub_goal"][:, EXPLORE, 2] = 1.0
    ratio = distribution(policy, obs).move_log_probs - plain
    gain = ratio[..., 2] - ratio[..., 0]
    th.testing.assert_close(gain[:, EXPLORE], th.full((12,), 3.0))
    th.testing.assert_close(gain[:, COVER], th.full((12,), 0.5))


def test_rows_behind_those_of_the_roles_count_for_every_role():
    env = small_search(8, sub_goal="routes", roles={})
    options = {"goal_key": "sub_goal", "goal_prior": 3.0, "shared_goal_prior": 0.25}
    model = HMAPPO("RolePolicy", env, n_steps=10, batch_size=16, seed=0, policy_kwargs=options)
    weights = model.policy.goal_net.weights.detach()
    expected = th.tensor([[3.0, 1.0, 0.25], [1.0, 3.0, 0.25]])
    th.testing.assert_close(weights.cpu(), expected)
    model.learn(8 * 3 * 10)
    moved = (model.policy.goal_net.weights.detach().cpu() - expected).abs()
    # Each role has learned for itself what the shared row is worth.
    assert moved[:, 2].min() > 1e-6
    assert moved[0, 2] != moved[1, 2]


def test_one_role_and_all_roles_are_the_same_function():
    policy = make_policy("hmappo", goal_key="sub_goal", goal_prior=1.5)
    obs = make_observation(3, 4)
    every = distribution(policy, obs).move_log_probs
    for role in (EXPLORE, COVER):
        actions = th.tensor([[role, 0]]).repeat(12, 1)
        with th.no_grad():
            given = policy.streams(obs, actions).log_probs[1]
        th.testing.assert_close(given, every[:, role], atol=1e-6, rtol=1e-5)


def untrained(model_class, prior, **roles):
    env = small_search(8, sub_goal="nearest", **roles)
    name = "RolePolicy" if roles else "TeamPolicy"
    options = {"goal_key": "sub_goal", "goal_prior": prior}
    if roles:
        options["other_goal_prior"] = 0.0
    return model_class(name, env, n_steps=10, batch_size=16, seed=0, policy_kwargs=options)


def chosen_moves(model, steps=10):
    """Roles, moves and the flags of first moves towards both sub-goals, as collected."""
    collect(model)
    buffer = model.rollout_buffer
    flags = buffer._stores["sub_goal"].memory[..., :N_MOVES] > 0
    return buffer._actions, flags


def test_an_untrained_robot_heads_for_the_sub_goal_of_its_role():
    actions, flags = chosen_moves(untrained(HMAPPO, 12.0, roles={}))
    roles, moves = actions[..., 0], actions[..., 1]
    own = flags.gather(2, roles[..., None, None].expand(*roles.shape, 1, N_MOVES)).squeeze(2)
    has_goal = own.any(-1)
    assert has_goal.float().mean() > 0.5
    towards = own.gather(2, moves.unsqueeze(-1)).squeeze(-1)
    assert towards[has_goal].float().mean() > 0.99
    assert {0, 1} == set(roles.unique().tolist())


def test_without_roles_it_heads_for_both_sub_goals():
    actions, flags = chosen_moves(untrained(MAPPO, 12.0))
    both = flags.sum(2)
    best = both.gather(2, actions[..., :1]).squeeze(-1) == both.amax(-1)
    assert best.float().mean() > 0.99


def test_the_weights_of_the_sub_goals_are_learned():
    for model in (untrained(HMAPPO, 2.0, roles={}), untrained(MAPPO, 2.0)):
        weights = model.policy.goal_net.weights
        before = weights.detach().clone()
        assert before.diagonal().eq(2.0).all() if before.ndim == 2 else before.eq(2.0).all()
        model.learn(8 * 3 * 10)
        assert (weights - before).abs().min() > 1e-5


@pytest.mark.parametrize("kind", ["hmappo", "mappo"])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"goal_key": "sub_gaol"}, "did you mean 'sub_goal'?"),
        ({"goal_key": "local"}, "rows"),
        ({"goal_key": "position"}, "unknown goal_key"),
        ({"goal_key": "state"}, "goal_key"),
    ],
)
def test_wrong_options_are_one_line(kind, options, message):
    with pytest.raises(ValueError) as error:
        make_policy(kind, **options)
    assert message in one_line(error.value)


def test_rows_have_weights_of_their_own_without_roles():
    policy = make_policy("mappo", goal_key="sub_goal", goal_prior=[0.0, 4.0])
    assert policy.goal_net.weights.tolist() == [0.0, 4.0]
    with pytest.raises(ValueError, match="one for each of the 2 rows of 'sub_goal'"):
        make_policy("mappo", goal_key="sub_goal", goal_prior=[1.0, 2.0, 3.0])
