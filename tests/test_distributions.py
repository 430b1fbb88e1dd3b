"""``RoleDistribution`` against the enumeration of all (role, move) pairs, and by sampling."""

import itertools
import math

import pytest
import torch as th
from stable_baselines3.common.distributions import kl_divergence as sb3_kl_divergence

from sb3_roles.common.distributions import (
    RoleDistribution,
    entropy,
    kl_divergence,
    role_log_probabilities,
    sample_index,
)

N_ROLES, N_MOVES, ROWS = 3, 4, 6
PAIRS = list(itertools.product(range(N_ROLES), range(N_MOVES)))


def parameters(seed, rows=ROWS, held=()):
    """Random log-probabilities; the rows in ``held`` go on in role row % N_ROLES."""
    generator = th.Generator().manual_seed(seed)
    logits = th.randn(rows, N_ROLES, generator=generator) * 2
    moves = th.log_softmax(th.randn(rows, N_ROLES, N_MOVES, generator=generator) * 2, dim=2)
    due = th.ones(rows, dtype=th.bool)
    due[list(held)] = False
    one_hot = th.eye(N_ROLES)[th.arange(rows) % N_ROLES]
    return role_log_probabilities(logits, one_hot, due), moves


def make(seed, held=()):
    return RoleDistribution().proba_distribution(*parameters(seed, held=held))


def enumerate_pairs(seed, held=()):
    """p(role, move) = p(role) p(move | role) of each row, by pairs."""
    roles, moves = (x.double().exp() for x in parameters(seed, held=held))
    return [{(r, m): float(roles[i, r] * moves[i, r, m]) for r, m in PAIRS} for i in range(ROWS)]


@pytest.mark.parametrize("held", [(), (1, 4)])
def test_log_probabilities_are_those_of_the_pairs(held):
    distribution, expected = make(0, held), enumerate_pairs(0, held)
    total = th.zeros(ROWS)
    for pair in PAIRS:
        log_prob = distribution.log_prob(th.tensor([pair] * ROWS))
        total += log_prob.exp()
        for row in range(ROWS):
            probability = expected[row][pair]
            assert math.exp(log_prob[row]) == pytest.approx(probability, rel=1e-5, abs=1e-30)
    assert total.tolist() == pytest.approx([1.0] * ROWS, rel=1e-6)


@pytest.mark.parametrize("held", [(), (1, 4)])
def test_entropy_is_exact(held):
    expected = [
        -sum(p * math.log(p) for p in row.values() if p > 0) for row in enumerate_pairs(1, held)
    ]
    assert make(1, held).entropy().tolist() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("held", [(), (1, 4)])
def test_the_kl_divergence_of_sb3_is_exact(held):
    expected = [
        sum(p * math.log(p / q[pair]) for pair, p in row.items() if p > 0)
        for row, q in zip(enumerate_pairs(2, held), enumerate_pairs(3, held), strict=True)
    ]
    found = sb3_kl_divergence(make(2, held), make(3, held))
    assert min(expected) > 0.05
    assert found.tolist() == pytest.approx(expected, rel=1e-4)


def test_kl_and_entropy_of_the_levels_add_up_to_those_of_the_pair():
    # Chain rule: KL(pair) = KL(role) + sum over roles of p(role) KL(move | role).
    (roles, moves), (new_roles, new_moves) = parameters(4), parameters(5)
    by_role = th.stack([kl_divergence(moves[:, r], new_moves[:, r]) for r in range(N_ROLES)], 1)
    chain = kl_divergence(roles, new_roles) + (roles.exp() * by_role).sum(1)
    assert chain.tolist() == pytest.approx(sb3_kl_divergence(make(4), make(5)).tolist(), rel=1e-4)
    by_role = th.stack([entropy(moves[:, r]) for r in range(N_ROLES)], 1)
    chain = entropy(roles) + (roles.exp() * by_role).sum(1)
    assert chain.tolist() == pytest.approx(make(4).entropy().tolist(), rel=1e-5)


def test_gradients_are_finite_and_zero_for_the_roles_that_are_not_chosen():
    logits = th.randn(4, N_ROLES, generator=th.Generator().manual_seed(0)).requires_grad_()
    due = th.tensor([True, True, False, False])
    roles = role_log_probabilities(logits, th.eye(N_ROLES)[[0, 1, 2, 0]], due)
    moves = parameters(0, rows=4)[1]
    distribution = RoleDistribution().proba_distribution(roles, moves)
    other = RoleDistribution().proba_distribution(roles.detach() * 1.0, moves.flip(1))
    actions = th.tensor([[0, 0], [2, 1], [2, 3], [0, 2]])
    loss = distribution.log_prob(actions).sum() + distribution.entropy().sum()
    loss = loss + sb3_kl_divergence(other, distribution).sum() + entropy(roles).sum()
    loss.backward()
    assert th.isfinite(logits.grad).all()
    assert (logits.grad[~due] == 0).all()
    assert (logits.grad[due].abs().sum(1) > 0).all()


def chi_square(counts, probabilities):
    expected = probabilities * counts.sum()
    return float(((counts - expected) ** 2 / expected).sum())


def test_samples_have_the_frequencies_of_the_pairs():
    roles, moves = parameters(6, rows=1)
    n = 200_000
    distribution = RoleDistribution().proba_distribution(
        roles.expand(n, -1), moves.expand(n, -1, -1)
    )
    th.manual_seed(0)
    sample = distribution.get_actions()
    counts = th.bincount(sample[:, 0] * N_MOVES + sample[:, 1], minlength=len(PAIRS)).double()
    probabilities = (roles.unsqueeze(2) + moves).flatten().double().exp()
    # The 99.9 % quantile of chi-square with 11 degrees of freedom.
    assert chi_square(counts, probabilities) < 31.26


def test_single_draws_have_the_frequencies_of_the_choices():
    log_probs = th.tensor([[0.5, 0.2, 0.2, 0.1]]).log()
    th.manual_seed(1)
    counts = th.bincount(sample_index(log_probs.expand(100_000, -1)), minlength=4).double()
    # The 99.9 % quantile of chi-square with 3 degrees of freedom.
    assert chi_square(counts, log_probs[0].double().exp()) < 16.27


def test_a_held_role_has_probability_one_and_is_never_violated():
    n = 1_000_000
    held = th.arange(n) % N_ROLES
    # The role policy would choose another one nearly always.
    logits = 50.0 * th.eye(N_ROLES)[(held + 1) % N_ROLES]
    roles = role_log_probabilities(logits, th.eye(N_ROLES)[held], th.zeros(n, dtype=th.bool))
    chosen = roles.gather(1, held.unsqueeze(1))
    assert (chosen == 0).all()
    assert (roles.exp().sum(1) == 1).all()
    assert (entropy(roles) == 0).all()
    assert (kl_divergence(roles, roles) == 0).all()
    th.manual_seed(2)
    moves = th.log_softmax(th.randn(1, N_ROLES, N_MOVES), dim=2).expand(n, -1, -1)
    distribution = RoleDistribution().proba_distribution(roles, moves)
    assert th.equal(distribution.sample()[:, 0], held)
    assert th.equal(distribution.mode()[:, 0], held)


def test_impossible_choices_are_never_drawn():
    zero = -1.0e9
    log_probs = th.tensor([[zero, math.log(0.5), zero, math.log(0.5), zero]])
    th.manual_seed(3)
    counts = th.bincount(sample_index(log_probs.expand(1_000_000, -1)), minlength=5).tolist()
    assert [counts[k] for k in (0, 2, 4)] == [0, 0, 0]
    assert min(counts[1], counts[3]) > 490_000


def test_the_mode_is_the_best_role_and_the_best_move_in_it():
    # The most probable pair is (1, 0), but the most probable role is 0.
    roles = th.tensor([[0.6, 0.4]]).log()
    moves = th.tensor([[[0.2, 0.5, 0.3], [0.9, 0.05, 0.05]]]).log()
    distribution = RoleDistribution().proba_distribution(roles, moves)
    assert distribution.get_actions(deterministic=True).tolist() == [[0, 1]]
    assert distribution.actions_from_params(roles, moves, deterministic=True).tolist() == [[0, 1]]


def test_actions_from_parameters_come_with_their_log_probability():
    th.manual_seed(4)
    actions, log_prob = RoleDistribution().log_prob_from_params(*parameters(7))
    expected = enumerate_pairs(7)
    for row, pair in enumerate(actions.tolist()):
        assert math.exp(log_prob[row]) == pytest.approx(expected[row][tuple(pair)], rel=1e-5)
