"""Returns and the PPO objective against brute force, closed forms and enumeration."""

import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_roles.common.losses import adapt_kl_coef, lambda_returns, stream_loss
from sb3_roles.testing import check_returns, check_stream_loss
from sb3_roles.testing.returns import random_rollout

GAMMA = th.tensor([0.9, 0.7], dtype=th.float64)
LAMBDA = th.tensor([0.95, 0.4], dtype=th.float64)


def compute(rollout, gamma=GAMMA, lam=LAMBDA):
    rewards, values, last, ends = (th.as_tensor(array) for array in rollout)
    return lambda_returns(rewards, values, last, ends, gamma, lam).numpy()


@pytest.mark.parametrize("seed", range(4))
def test_returns_are_the_weighted_mean_of_n_step_returns_in_every_stream(seed):
    check_returns(lambda_returns, seed)


@pytest.mark.parametrize("seed", range(4))
def test_the_objective_is_that_of_the_slow_reference_with_its_gradients(seed):
    check_stream_loss(stream_loss, seed)


def test_lambda_one_is_the_discounted_sum_and_lambda_zero_looks_one_step_ahead():
    rewards, values, last, ends = rollout = random_rollout(9)
    following = np.concatenate([values[1:], last[None]])
    goes_on = ~ends[..., None]
    gamma = GAMMA.numpy()

    one_step = rewards + gamma * goes_on * following
    np.testing.assert_allclose(compute(rollout, lam=th.zeros(2).double()), one_step, rtol=1e-12)

    discounted, tail = np.zeros_like(rewards), last
    for t in reversed(range(len(rewards))):
        tail = discounted[t] = rewards[t] + gamma * goes_on[t] * tail
    np.testing.assert_allclose(compute(rollout, lam=th.ones(2).double()), discounted, rtol=1e-12)


def test_streams_do_not_touch_each_other():
    rewards, values, last, ends = random_rollout(2)
    before = compute((rewards, values, last, ends))
    rewards, values, last = rewards.copy(), values.copy(), last.copy()
    for array in (rewards, values, last):
        array[..., 1] += 7.0
    after = compute((rewards, values, last, ends))
    assert np.array_equal(before[..., 0], after[..., 0])
    assert (np.abs(before[..., 1] - after[..., 1]) > 1.0).all()


@pytest.mark.parametrize("seed", range(3))
def test_with_unconditioned_values_the_advantage_is_the_gae_of_sb3(seed):
    rewards, values, last, ends = random_rollout(seed, streams=1)
    steps, rows, _ = rewards.shape
    stock = RolloutBuffer(
        steps,
        spaces.Box(-1, 1, (1,)),
        spaces.Discrete(2),
        "cpu",
        gae_lambda=0.8,
        gamma=0.93,
        n_envs=rows,
    )
    starts = np.ones(rows)
    for t in range(steps):
        stock.add(
            np.zeros((rows, 1)),
            np.zeros(rows),
            rewards[t, :, 0],
            starts,
            th.as_tensor(values[t, :, 0]),
            th.zeros(rows),
        )
        starts = ends[t].astype(float)
    stock.compute_returns_and_advantage(th.as_tensor(last[:, 0]), ends[-1])
    returns = compute(
        (rewards, values, last, ends),
        th.tensor([0.93], dtype=th.float64),
        th.tensor([0.8], dtype=th.float64),
    )
    np.testing.assert_allclose(returns[..., 0], stock.returns, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose((returns - values)[..., 0], stock.advantages, rtol=1e-5, atol=1e-5)


def test_a_critic_that_knows_the_role_is_followed_by_the_mean_over_the_next_role():
    # Two steps, the episode goes on; the critic's values by role and the probabilities are given.
    by_role = np.array([[1.0, 5.0], [2.0, 10.0], [4.0, 8.0]])
    probabilities = np.array([[0.5, 0.5], [0.25, 0.75], [0.9, 0.1]])
    expected = (by_role * probabilities).sum(1)
    rollout = (
        np.array([[[1.0]], [[2.0]]]),
        expected[:2].reshape(2, 1, 1),
        expected[2:].reshape(1, 1),
        np.zeros((2, 1), bool),
    )
    gamma, lam = th.tensor([0.5]).double(), th.tensor([0.5]).double()
    last = 2.0 + 0.5 * 4.4
    first = 1.0 + 0.5 * (0.5 * 8.0 + 0.5 * last)
    np.testing.assert_allclose(compute(rollout, gamma, lam).ravel(), [first, last], rtol=1e-12)


def log_softmax_rows(seed, rows=5, choices=4):
    logits = np.random.default_rng(seed).normal(size=(rows, choices))
    return th.log_softmax(th.as_tensor(logits), dim=1)


def evaluate(log_probs, old, actions, advantages, active=None, **options):
    rows = len(actions)
    settings = {
        "values": th.zeros(rows, dtype=th.float64),
        "returns": th.zeros(rows, dtype=th.float64),
        "clip_range": 0.2,
        "ent_coef": 0.0,
        "vf_coef": 0.0,
        "kl_coef": 0.0,
    } | options
    return stream_loss(
        log_probs=log_probs,
        actions=th.as_tensor(actions),
        old_log_probs=old,
        advantages=th.as_tensor(advantages, dtype=th.float64),
        active=th.ones(rows, dtype=th.bool) if active is None else th.as_tensor(active),
        **settings,
    )


# ratio, advantage -> what the surrogate counts, and whether it still pushes the policy
CLIPPING = [
    (1.1, 2.0, 2.2, True),
    (1.5, 2.0, 2.4, False),
    (0.5, 2.0, 1.0, True),
    (1.5, -2.0, -3.0, True),
    (0.5, -2.0, -1.6, False),
    (0.9, -2.0, -1.8, True),
]


@pytest.mark.parametrize(("ratio", "advantage", "surrogate", "pushes"), CLIPPING)
def test_the_surrogate_is_clipped_where_the_policy_has_gone_far_enough(
    ratio, advantage, surrogate, pushes
):
    old = th.tensor([[0.4, 0.6]], dtype=th.float64).log()
    new = th.tensor([[0.4 * ratio, 1 - 0.4 * ratio]], dtype=th.float64).log().requires_grad_()
    part = evaluate(new, old, [0], [advantage])
    assert part.loss.item() == pytest.approx(-surrogate, rel=1e-12)
    assert float(part.clip_fraction) == float(abs(ratio - 1) > 0.2)
    part.loss.backward()
    slope = -advantage * ratio if pushes else 0.0
    assert new.grad[0].tolist() == pytest.approx([slope, 0.0])


def test_the_surrogate_is_the_mean_over_rows():
    new, old = log_softmax_rows(0), log_softmax_rows(1)
    actions = [0, 1, 2, 3, 0]
    advantages = [1.0, -2.0, 0.5, 3.0, -1.0]
    expected = []
    for row, (action, advantage) in enumerate(zip(actions, advantages, strict=True)):
        ratio = math.exp(float(new[row, action]) - float(old[row, action]))
        expected.append(min(ratio * advantage, min(max(ratio, 0.8), 1.2) * advantage))
    part = evaluate(new, old, actions, advantages)
    assert float(part.policy_loss) == pytest.approx(-np.mean(expected), rel=1e-12)


def test_kl_and_entropy_are_exact():
    new, old = log_softmax_rows(2), log_softmax_rows(3)
    p, q = old.exp().tolist(), new.exp().tolist()
    rows, choices = range(len(p)), range(len(p[0]))
    kl = np.mean([sum(p[i][k] * math.log(p[i][k] / q[i][k]) for k in choices) for i in rows])
    entropy = np.mean([-sum(q[i][k] * math.log(q[i][k]) for k in choices) for i in rows])
    assert kl > 0.1
    part = evaluate(new, old, [0] * 5, [0.0] * 5)
    assert float(part.kl) == pytest.approx(kl, rel=1e-10)
    assert float(part.entropy) == pytest.approx(entropy, rel=1e-10)


def test_the_objective_adds_its_terms_with_their_coefficients():
    values = th.tensor([1.0, 2.0, 3.0, 4.0, 5.0], dtype=th.float64)
    returns = th.tensor([0.0, 2.0, 5.0, 4.0, 2.0], dtype=th.float64)
    part = evaluate(
        log_softmax_rows(4),
        log_softmax_rows(5),
        [1] * 5,
        [1.0, 2.0, -1.0, 0.0, 0.5],
        values=values,
        returns=returns,
        ent_coef=0.03,
        vf_coef=0.7,
        kl_coef=0.4,
    )
    assert float(part.value_loss) == pytest.approx((1 + 0 + 4 + 0 + 9) / 5)
    total = part.policy_loss + 0.4 * part.kl + 0.7 * part.value_loss - 0.03 * part.entropy
    assert float(part.loss) == pytest.approx(float(total), rel=1e-12)


def test_rows_in_which_a_stream_does_not_decide_train_its_critic_only():
    active = [True, False, True, False, False]
    new, old = log_softmax_rows(6).requires_grad_(), log_softmax_rows(7)
    values = th.zeros(5, dtype=th.float64, requires_grad=True)
    coefficients = {"vf_coef": 0.5, "ent_coef": 0.1, "kl_coef": 0.3}
    advantages = [1.0, 100.0, -2.0, 50.0, -70.0]
    part = evaluate(
        new,
        old,
        [0, 1, 2, 3, 0],
        advantages,
        active,
        values=values,
        returns=th.ones(5, dtype=th.float64),
        **coefficients,
    )
    part.loss.backward()
    idle = ~th.tensor(active)
    assert (new.grad[idle] == 0).all()
    assert (new.grad[~idle].abs().sum(1) > 0).all()
    assert values.grad.tolist() == pytest.approx([0.5 * 2 * -1 / 5] * 5)
    # Means are over the rows that decided.
    alone = evaluate(
        new.detach()[~idle], old[~idle], [0, 2], [1.0, -2.0], ent_coef=0.1, kl_coef=0.3
    )
    for name in ("policy_loss", "entropy", "kl", "clip_fraction"):
        assert getattr(part, name).item() == pytest.approx(getattr(alone, name).item(), rel=1e-12)


def test_a_minibatch_without_any_decision_has_no_policy_gradient():
    new = log_softmax_rows(6).requires_grad_()
    part = evaluate(
        new, log_softmax_rows(7), [0] * 5, [1.0] * 5, [False] * 5, ent_coef=0.1, kl_coef=0.3
    )
    part.loss.backward()
    assert (new.grad == 0).all()
    assert [x.item() for x in (part.loss, part.entropy, part.kl)] == [0.0, 0.0, 0.0]


def test_the_kl_coefficient_follows_the_divergence():
    target = 0.01
    assert adapt_kl_coef(0.5, 0.0201, target) == pytest.approx(0.75)
    assert adapt_kl_coef(0.5, 0.0199, target) == 0.5
    assert adapt_kl_coef(0.5, 0.0051, target) == 0.5
    assert adapt_kl_coef(0.5, 0.0049, target) == pytest.approx(0.25)
    assert adapt_kl_coef(0.5, 0.0, target) == pytest.approx(0.25)


def test_the_kl_coefficient_can_come_back_from_many_timid_updates():
    coefficient = 0.5
    for _ in range(1200):
        coefficient = adapt_kl_coef(coefficient, 0.0, 0.01)
    assert coefficient > 0.0, "it has underflowed to 0, which switches the penalty off for good"
