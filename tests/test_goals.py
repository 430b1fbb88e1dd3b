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


def with_row(obs, role, seed):
    """The same observation with other features of one role's sub-goal."""
    th.manual_seed(seed)
    changed = {key: value.clone() for key, value in obs.items()}
    changed["sub_goal"][:, role] = th.rand_like(changed["sub_goal"][:, role]) * 5
    return changed


def test_a_move_depends_on_the_sub_goal_of_its_role_only():
    policy = make_policy("hmappo", goal_key="sub_goal", goal_prior=1.5)
    obs = make_observation(3, 4)
    moves = distribution(policy, obs).move_log_probs
    assert moves.shape == (12, 2, N_MOVES)
    changed = distribution(policy, with_row(obs, EXPLORE, 1)).move_log_probs
    assert th.equal(moves[:, COVER], changed[:, COVER])
    assert (moves[:, EXPLORE] - changed[:, EXPLORE]).abs().max() > 1e-2
    # The role actor chooses between the sub-goals: it sees both.
    roles = distribution(policy, obs).role_log_probs
    assert (roles - distribution(policy, with_row(obs, COVER, 2)).role_log_probs).abs().max() > 1e-4


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


def test_the_weight_of_the_sub_goal_is_learned():
    for model in (untrained(HMAPPO, 2.0, roles={}), untrained(MAPPO, 2.0)):
        parameters = dict(model.policy.named_parameters())
        (name,) = [name for name in parameters if "goal_prior" in name or "goal_weights" in name]
        assert parameters[name].tolist() == [2.0, 2.0]
        model.learn(8 * 3 * 10)
        assert all(abs(weight - 2.0) > 1e-5 for weight in parameters[name].tolist())


@pytest.mark.parametrize("kind", ["hmappo", "mappo"])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"goal_prior": 1.0}, "goal_prior needs goal_key"),
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
