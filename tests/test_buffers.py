"""``TeamRolloutBuffer``: whole teams, each once, and Stable-Baselines3's numbers."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from helpers import SMALL_ROLE, small_search
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.buffers import DictRolloutBuffer

from sb3_roles import HMAPPO, RoleWrapper
from sb3_roles.common.buffers import TeamRolloutBuffer
from sb3_roles.common.observation_store import (
    pack_bits,
    pack_by_shifts,
    unpack_bits,
    unpack_by_shifts,
)
from sb3_roles.common.policies import Streams
from sb3_roles.hmappo import RoleActorCriticPolicy
from sb3_roles.testing import check_team_buffer

T, N_TEAMS, N_AGENTS = 5, 4, 3
ROWS = N_TEAMS * N_AGENTS
SPACE = spaces.Dict(
    {
        "where": spaces.Box(-np.inf, np.inf, (3,), np.float32),
        "own": spaces.Box(0, 255, (2, 4, 5), np.uint8),
        "shared": spaces.Box(0, 255, (3, 6, 4), np.uint8),
        "flags": spaces.Box(0, 1, (2, 5, 3), np.uint8),
        "agent": spaces.Box(0, np.inf, (2,), np.float32),
    }
)


def observation(t, rng, once=True):
    """Rows that know their step, team and robot; the shared map knows step and team."""
    team, agent = np.divmod(np.arange(ROWS), N_AGENTS)
    shared = rng.integers(0, 255, (N_TEAMS, 3, 6, 4)).astype(np.uint8)
    shared[:, 0, 0, 0] = 10 * t + np.arange(N_TEAMS)
    return {
        "where": np.stack([np.full(ROWS, t), team, agent], axis=1).astype(np.float32),
        "own": rng.integers(0, 255, (ROWS, 2, 4, 5)).astype(np.uint8),
        "shared": shared if once else shared.repeat(N_AGENTS, axis=0),
        "flags": rng.integers(0, 2, (ROWS, 2, 5, 3)).astype(np.uint8),
        "agent": np.stack([agent, np.full(ROWS, N_AGENTS)], axis=1).astype(np.float32),
    }


def make_buffer(cls=TeamRolloutBuffer, steps=T, actions=None):
    actions = spaces.MultiDiscrete([2, 5]) if actions is None else actions
    return cls(steps, SPACE, actions, "cpu", gae_lambda=0.8, gamma=0.9, n_envs=ROWS)


def fill_streams(buffer, once=True, seed=0):
    """Add a rollout of two streams."""
    rng = np.random.default_rng(seed)
    for t in range(T):
        obs = {key: th.as_tensor(value) for key, value in observation(t, rng, once).items()}
        numbers = th.as_tensor(rng.normal(size=(3, ROWS, 2)), dtype=th.float32)
        chosen = Streams(
            actions=th.as_tensor(rng.integers(0, [2, 5], (ROWS, 2))),
            log_probs=tuple(th.as_tensor(rng.normal(size=(ROWS, k))).float() for k in (2, 5)),
            values=numbers[0],
            expected_values=numbers[1],
            active=th.as_tensor(rng.random((ROWS, 2)) < 0.5),
        )
        ends = th.as_tensor(rng.random(N_TEAMS) < 0.3).repeat_interleave(N_AGENTS)
        buffer.add_streams(obs, chosen, numbers[2], ends)


def test_minibatches_are_whole_teams_in_order_and_cover_everything_once():
    check_team_buffer(TeamRolloutBuffer, batches=(1, 3, 20, 100))


@pytest.mark.parametrize("batch", [1, 3, 20, 100])
def test_minibatches_are_full_but_the_last(batch):
    buffer = make_buffer()
    fill_streams(buffer)
    sizes = [len(samples.actions) // N_AGENTS for samples in buffer.minibatches(batch)]
    whole, rest = divmod(T * N_TEAMS, batch)
    assert sizes == [batch] * whole + [rest] * (rest > 0)


def test_every_pass_has_another_order_that_the_seed_repeats():
    buffer = make_buffer()
    fill_streams(buffer)

    def order():
        batches = buffer.minibatches(2)
        return [tuple(b.observations["where"].flatten().tolist()) for b in batches]

    th.manual_seed(0)
    first, second = order(), order()
    th.manual_seed(0)
    assert order() == first
    assert first != second


def fill_stock(buffer, once, seed=3, steps=T):
    """Fill by Stable-Baselines3's interface."""
    rng = np.random.default_rng(seed)
    starts = np.ones(ROWS)
    for t in range(steps):
        obs = observation(t, rng, once)
        numbers = rng.normal(size=(3, ROWS)).astype(np.float32)
        buffer.add(
            obs,
            rng.integers(0, [2, 5], (ROWS, 2)),
            numbers[0],
            starts,
            th.as_tensor(numbers[1]).unsqueeze(1),
            th.as_tensor(numbers[2]),
        )
        dones = (rng.random(N_TEAMS) < 0.3).repeat(N_AGENTS)
        starts = dones.astype(float)
    last = th.as_tensor(rng.normal(size=(ROWS, 1)), dtype=th.float32)
    buffer.compute_returns_and_advantage(last, dones)


def rows_of(buffer, batch_size):
    """All rows that a buffer yields, by (t, row)."""
    rows = {}
    for samples in buffer.get(batch_size):
        where = samples.observations["where"].long().tolist()
        for i, (t, team, agent) in enumerate(where):
            assert (t, team * N_AGENTS + agent) not in rows
            rows[t, team * N_AGENTS + agent] = [
                *samples.actions[i].tolist(),
                float(samples.old_values[i]),
                float(samples.old_log_prob[i]),
                float(samples.advantages[i]),
                float(samples.returns[i]),
            ]
    return rows


@pytest.mark.parametrize("once", [True, False])
@pytest.mark.parametrize("batch_size", [None, 7])
def test_the_interface_of_sb3_gives_the_numbers_of_its_own_buffer(once, batch_size):
    ours, stock = make_buffer(), make_buffer(DictRolloutBuffer)
    for _ in range(2):  # The second rollout finds nothing of the first.
        ours.reset()
        stock.reset()
        fill_stock(ours, once)
        fill_stock(stock, False)
        np.testing.assert_allclose(ours.returns, stock.returns, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(ours.values, stock.values, rtol=1e-6)
        found, expected = rows_of(ours, batch_size), rows_of(stock, None)
        assert found.keys() == expected.keys()
        for key, numbers in expected.items():
            assert found[key] == pytest.approx(numbers, rel=1e-5, abs=1e-6)


def test_a_batch_in_rows_is_rounded_down_to_whole_teams():
    buffer = make_buffer()
    fill_stock(buffer, True)
    sizes = [len(samples.actions) for samples in buffer.get(7)]
    assert sizes == [6] * 10
    assert [len(samples.actions) for samples in buffer.get(1)] == [3] * 20


def test_what_a_team_shares_is_stored_once_as_bytes_and_flags_as_bits():
    once, for_each = make_buffer(), make_buffer()
    fill_streams(once, True)
    fill_streams(for_each, False)
    per_row = 3 * 4 + 2 * 4 + 2 * 4 * 5 + -(-2 * 5 * 3 // 8)
    shared = 3 * 6 * 4
    assert once.nbytes == T * (ROWS * per_row + N_TEAMS * shared)
    assert for_each.nbytes == T * ROWS * (per_row + shared)


@pytest.mark.parametrize("count", [1, 8, 30, 41])
def test_bits_come_back_on_every_device(count):
    rng = np.random.default_rng(count)
    flags = th.as_tensor(rng.integers(0, 2, (7, count)).astype(np.uint8))
    packed = pack_bits(flags)
    assert packed.shape == (7, -(-count // 8)) and packed.dtype == th.uint8
    assert th.equal(unpack_bits(packed, count), flags)
    # What other devices than the CPU do.
    assert th.equal(pack_by_shifts(flags), packed)
    assert th.equal(unpack_by_shifts(packed, count), flags)


def test_maps_leave_the_buffer_as_they_came_with_channels_last_in_memory():
    buffer = make_buffer()
    fill_streams(buffer)
    samples = next(buffer.minibatches(4))
    maps = samples.observations["shared"]
    assert maps.shape == (4, 3, 6, 4)
    assert maps.dtype == th.uint8
    assert maps.is_contiguous(memory_format=th.channels_last)


def test_the_buffer_needs_to_know_the_teams():
    space = spaces.Dict({"where": SPACE["where"]})
    with pytest.raises(ValueError, match="TeamWrapper or RoleWrapper"):
        TeamRolloutBuffer(T, space, spaces.Discrete(2), "cpu", n_envs=ROWS)


@pytest.mark.parametrize("algorithm", [PPO, A2C])
def test_a_stock_buffer_that_mixes_teams_is_an_error(algorithm):
    env = small_search(n_teams=4, expand=True, roles={})
    size = {"batch_size": 24} if algorithm is PPO else {}
    model = algorithm(
        RoleActorCriticPolicy, env, n_steps=8, policy_kwargs=SMALL_ROLE, device="cpu", **size
    )
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    with pytest.raises(ValueError, match="rollout_buffer_class=TeamRolloutBuffer"):
        model.learn(8 * env.num_envs)
    assert all(th.equal(before[k], v) for k, v in model.policy.state_dict().items())


def test_teams_of_another_size_can_follow_with_as_many_rows():
    # Train on small teams, go on with larger ones: set_env() asks for as many rows only.
    model = HMAPPO(
        "RolePolicy",
        small_search(n_teams=4, n_agents=2, expand=True, roles={}),
        n_steps=6,
        batch_size=4,
        n_epochs=1,
        policy_kwargs=SMALL_ROLE,
        seed=0,
    )
    model.learn(6 * 8)
    larger = small_search(n_teams=2, n_agents=4, expand=True, roles={})
    assert isinstance(larger, RoleWrapper)
    model.set_env(larger)
    model.learn(6 * 8)
    samples = next(model.rollout_buffer.minibatches(1))
    assert samples.observations["agent"].tolist() == [[i, 4] for i in range(4)]
