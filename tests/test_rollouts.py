"""Groups of teams in a rollout: on any number of threads the same, each with draws of its own."""

from __future__ import annotations

import pytest
import torch as th
from helpers import collect, same, small_search, weights

from sb3_roles import HMAPPO, MAPPO
from sb3_roles.common.env_state import take_rows
from sb3_roles.common.policies import Streams
from sb3_roles.common.rollouts import act, make_groups, split_teams
from sb3_roles.common.threads import ThreadCrew

N_TEAMS = 5
CPU = th.device("cpu")


@pytest.fixture
def threads():
    """Sets torch's threads, and puts them back."""
    before = th.get_num_threads()
    yield th.set_num_threads
    th.set_num_threads(before)


def make(algorithm, n_groups):
    env = small_search(N_TEAMS, sub_goal="nearest", roles={} if algorithm is HMAPPO else None)
    policy = next(iter(algorithm.policy_aliases))
    return algorithm(
        policy,
        env,
        n_steps=12,
        batch_size=30,
        n_epochs=1,
        rollout_groups=n_groups,
        seed=3,
        device="cpu",
    )


def rollout(model):
    buffer = model.rollout_buffer
    return {
        "actions": buffer._actions.clone(),
        "values": buffer._values.clone(),
        "rewards": buffer._rewards.clone(),
        "returns": buffer._returns.clone(),
        **{f"log_probs_{s}": one.clone() for s, one in enumerate(buffer._log_probs)},
        **{key: store.memory.clone() for key, store in buffer._stores.items()},
    }


@pytest.mark.parametrize("algorithm", [MAPPO, HMAPPO])
@pytest.mark.parametrize("n_groups", [2, 3])
def test_threads_change_nothing(algorithm, n_groups, threads):
    found = []
    for n_threads in (1, 2, 4):
        model = make(algorithm, n_groups)
        threads(n_threads)
        model.env.set_attr("n_threads", n_threads)
        collect(model)
        assert th.get_num_threads() == n_threads
        threads(1)
        found.append(rollout(model))
    assert same(found[0], found[1]) and same(found[0], found[2])


@pytest.mark.parametrize("algorithm", [MAPPO, HMAPPO])
def test_a_group_is_a_function_of_its_own_teams_and_generator(algorithm):
    """What the buffer holds of a group is what a policy says of that group alone."""
    model = make(algorithm, 3)
    state = th.get_rng_state()
    _, callback = model._setup_learn(10**6, None)
    first = {key: value.copy() for key, value in model._last_obs.items()}
    th.set_rng_state(state)
    groups = make_groups(N_TEAMS, 3, 3)
    th.set_rng_state(state)
    assert model.collect_rollouts(model.env, callback, model.rollout_buffer, 1)
    buffer = model.rollout_buffer
    assert [group.teams for group in groups] == [slice(0, 2), slice(2, 4), slice(4, 5)]
    for group in groups:
        seen = take_rows(first, group.teams, N_TEAMS)
        chosen = act(model.policy, seen, group.generator(CPU)).chosen
        assert isinstance(chosen, Streams)
        assert th.equal(buffer._actions[0, group.rows], chosen.actions)
        assert th.equal(buffer._values[0, group.rows], chosen.values)
        assert th.equal(buffer._log_probs[0][0, group.rows], chosen.log_probs[0])


def test_groups_differ_in_their_draws_and_rollouts_too():
    model = make(MAPPO, N_TEAMS)
    drawn = []
    for _ in range(2):
        groups = make_groups(4, 3, 4)
        drawn += [th.rand(8, generator=group.generator(CPU)).tolist() for group in groups]
    assert len({tuple(one) for one in drawn}) == 8
    th.manual_seed(0)
    again = [th.rand(3, generator=one.generator(CPU)) for one in make_groups(4, 3, 4)]
    th.manual_seed(0)
    assert all(
        th.equal(th.rand(3, generator=one.generator(CPU)), draw)
        for one, draw in zip(make_groups(4, 3, 4), again, strict=True)
    )
    assert model.rollout_groups == N_TEAMS


@pytest.mark.parametrize("backend", ["native", "supersuit"])
def test_groups_see_what_their_teams_share(backend):
    """Team keys have one row for each team: both layouts go the same way through a rollout."""
    found = []
    for expand in (False, True):
        env = small_search(N_TEAMS, backend, expand=expand, sub_goal="nearest")
        model = MAPPO("TeamPolicy", env, n_steps=12, rollout_groups=2, seed=0, device="cpu")
        collect(model)
        found.append(rollout(model))
    for name in ("actions", "rewards"):
        assert th.equal(found[0][name], found[1][name])
    assert found[0]["joint"].shape[1] == N_TEAMS
    assert found[1]["joint"].shape[1] == 3 * N_TEAMS
    assert th.equal(found[0]["joint"], found[1]["joint"][:, ::3])


@pytest.mark.parametrize("algorithm", [MAPPO, HMAPPO])
def test_values_at_truncations_are_those_of_the_group(algorithm):
    """Grouped and whole rollouts of the same actions agree but for rounding, truncations too."""
    found = []
    for n_groups in (1, 3):
        model = make(algorithm, n_groups)
        with pytest.MonkeyPatch.context() as patch:
            # Draws that no generator decides.
            patch.setattr(
                f"{type(model.policy).__module__}.sample_index",
                lambda log_probs, _: th.arange(len(log_probs)) % 2,
            )
            collect(model)
        assert model.rollout_buffer._ends.any()
        found.append(rollout(model))
    for name in ("rewards", "returns", "values"):
        th.testing.assert_close(found[0][name], found[1][name], atol=1e-5, rtol=1e-4)
    assert th.equal(found[0]["actions"], found[1]["actions"])


@pytest.mark.parametrize("algorithm", [MAPPO, HMAPPO])
def test_a_rollout_of_one_group_repeats_and_learns_what_it_learned(algorithm):
    found = []
    for _ in range(2):
        model = make(algorithm, 1)
        model.learn(2 * model.n_steps * model.n_envs)
        found.append(weights(model))
    assert same(*found)


def test_more_groups_than_teams_are_refused():
    with pytest.raises(ValueError, match=r"rollout_groups must be from 1 to .* teams, 5, got 6"):
        make(MAPPO, 6)
    with pytest.raises(ValueError, match="rollout_groups must be a whole number of at least 1"):
        make(MAPPO, 0)
    assert [part.stop - part.start for part in split_teams(7, 3)] == [3, 2, 2]


def test_a_crew_gives_the_threads_back_and_keeps_the_order(threads):
    threads(3)
    with ThreadCrew(2, CPU, inside=1) as crew:
        assert th.get_num_threads() == 1
        assert crew.map(lambda part: (part, th.get_num_threads()), [4, 3, 2, 1]) == [
            (4, 1),
            (3, 1),
            (2, 1),
            (1, 1),
        ]
    assert th.get_num_threads() == 3
