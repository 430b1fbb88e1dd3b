"""Shards of a minibatch: the same step as the whole minibatch, on however many threads."""

from __future__ import annotations

import copy

import pytest
import torch as th
from helpers import small_search

from sb3_roles import HMAPPO, MAPPO
from sb3_roles.common.shards import add_gradients, set_gradients, shards_of, trainable
from sb3_roles.common.threads import ThreadCrew

CPU = th.device("cpu")


def trained(algorithm, n_shards, threads, **options):
    model = algorithm(
        next(iter(algorithm.policy_aliases)),
        small_search(),
        n_steps=4,
        batch_size=6,
        n_epochs=2,
        n_shards=n_shards,
        seed=3,
        device="cpu",
        **options,
    )
    before = th.get_num_threads()
    th.set_num_threads(threads)
    try:
        model.learn(2 * 4 * model.n_envs)
        assert th.get_num_threads() == threads
    finally:
        th.set_num_threads(before)
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


@pytest.mark.parametrize("algorithm", [MAPPO, HMAPPO])
def test_threads_change_nothing(algorithm):
    one, two = (trained(algorithm, 2, threads) for threads in (1, 2))
    assert all(th.equal(one[name], two[name]) for name in one)


@pytest.mark.parametrize("algorithm", [MAPPO, HMAPPO])
def test_a_sharded_step_is_that_of_the_whole_minibatch_but_for_rounding(algorithm):
    # Plain descent: Adam turns the rounding of tiny gradients into whole steps.
    plain = {"policy_kwargs": {"optimizer_class": th.optim.SGD}, "learning_rate": 0.01}
    whole = trained(algorithm, 1, 1, **plain)
    for n_shards in (2, 5, 100):
        sharded = trained(algorithm, n_shards, 1, **plain)
        for name, value in whole.items():
            th.testing.assert_close(sharded[name], value, atol=1e-5, rtol=1e-4)


def test_every_pair_is_in_one_shard_and_results_keep_their_order():
    shards = shards_of(th.arange(7), 3)
    assert [part.tolist() for part in shards] == [[0, 1, 2], [3, 4], [5, 6]]
    assert len(shards_of(th.arange(2), 3)) == 2
    with ThreadCrew(2, CPU) as crew:
        assert crew.map(lambda part: part.sum().item(), shards) == [3, 7, 11]


def test_an_error_in_a_shard_is_raised_and_the_threads_are_given_back():
    before = th.get_num_threads()

    def fail(part):
        raise FloatingPointError(f"{part.tolist()}")

    th.set_num_threads(2)
    try:
        with pytest.raises(FloatingPointError, match="0"), ThreadCrew(2, CPU) as crew:
            crew.map(fail, shards_of(th.arange(2), 2))
        assert th.get_num_threads() == 2
    finally:
        th.set_num_threads(before)


def test_gradients_are_added_and_what_none_depends_on_has_none():
    parts = [(th.ones(2), None, None), (th.ones(2), th.ones(1), None)]
    first, second, third = add_gradients(parts)
    assert first.tolist() == [2.0, 2.0] and second.tolist() == [1.0] and third is None


@pytest.mark.parametrize("fused", [False, True])
def test_convolutions_get_their_own_gradients(fused):
    th.manual_seed(0)
    mine = th.nn.Conv2d(16, 32, 3, stride=2)
    plain = copy.deepcopy(mine)
    # As maps come out of the buffer, which moves the gradient of the weights about in memory.
    maps = th.randn(8, 16, 9, 9).to(memory_format=th.channels_last)
    parameters = trainable(mine)
    gradients = th.autograd.grad(mine(maps).square().mean(), parameters)
    assert any(g.stride() != p.stride() for g, p in zip(gradients, parameters, strict=True))
    set_gradients(parameters, gradients)
    plain(maps).square().mean().backward()
    for module, options in ((mine, {"fused": fused}), (plain, {})):
        th.optim.Adam(module.parameters(), lr=1e-2, **options).step()
    for one, other in zip(mine.parameters(), plain.parameters(), strict=True):
        th.testing.assert_close(one, other, atol=1e-6, rtol=1e-5)


def test_what_is_frozen_stays_and_the_rest_learns():
    model = HMAPPO("RolePolicy", small_search(), n_steps=4, batch_size=8, n_shards=2, device="cpu")
    model.policy.encoders.requires_grad_(False)
    before = {name: value.clone() for name, value in model.policy.named_parameters()}
    model.learn(2 * 4 * model.n_envs)
    for name, value in model.policy.named_parameters():
        if name.startswith("encoders."):
            assert th.equal(value, before[name])
    assert not th.equal(model.policy.value_net.role.weight, before["value_net.role.weight"])
