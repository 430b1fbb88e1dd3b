"""Groups of teams played one by one, elsewhere, give the rollouts of all teams together."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch as th
from helpers import record_logs, same, small_search, weights
from stable_baselines3.common.callbacks import BaseCallback

from area_search import AreaSearchEnv, BatchedAreaSearch
from sb3_roles import HMAPPO, MAPPO, RoleWrapper, make_team_vec_env
from sb3_roles.common.callbacks import RoleCallback, TeamMetricsCallback
from sb3_roles.common.env_state import (
    env_state,
    join_states,
    parts_gap,
    set_env_state,
    take_rows,
    take_state,
)
from sb3_roles.common.group_play import GroupStage, TaskPlayer
from sb3_roles.common.rollouts import split_teams
from sb3_roles.common.snapshot import capture

N_TEAMS, N_STEPS = 5, 12


def make(kind="hmappo", n_teams=N_TEAMS, n_groups=1, backend="native", seed=3, **policy):
    """Small models: ends of episodes fall in the middle of rollouts."""
    roles = {
        "mappo": None,
        "hmappo": {},
        "mix": {},
        "random": {"role_control": "random", "role_every": 3},
        "lasting": {"role_every": 3, "reward_sharing": "same_role"},
    }[kind]
    # What scenes of a mix differ in, the target density, shows in routes.
    task = {"sub_goal": "nearest"}
    if kind == "mix":
        task = {"sub_goal": "routes", "scene": ["obstacles_16", "hard", "obstacles_52"]}
    env = small_search(n_teams, backend, roles=roles, early_stop_patience=8, **task)
    algorithm = MAPPO if kind == "mappo" else HMAPPO
    return algorithm(
        next(iter(algorithm.policy_aliases)),
        env,
        n_steps=N_STEPS,
        batch_size=12,
        n_epochs=1,
        rollout_groups=n_groups,
        policy_kwargs=policy,
        seed=seed,
        device="cpu",
    )


class Elsewhere(TaskPlayer):
    """Plays tasks in another order, in stages that have played something else before."""

    def __init__(self, model, stages):
        super().__init__(model)
        self._stages = stages

    def run(self, tasks, weights):
        sent = pickle.dumps((list(tasks), dict(weights)))
        tasks, weights = pickle.loads(sent)
        records = [None] * len(tasks)
        for k in reversed(range(len(tasks))):
            record = self._stages[tasks[k].n_teams].play(tasks[k], weights)
            records[k] = pickle.loads(pickle.dumps(record))
        return records


def stages(n_groups, *args, **options):
    """Stages of all sizes of groups; models seed this process, so they come before the others."""
    sizes = {teams.stop - teams.start for teams in split_teams(N_TEAMS, n_groups)}
    small = {n: make(*args, n_teams=n, seed=9, **options) for n in sizes}
    return {n: GroupStage(model, model.env) for n, model in small.items()}


class Witness(BaseCallback):
    """Writes down all that a callback can see of a step."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def _on_step(self):
        names = ("actions", "rewards", "dones", "new_obs", "obs", "infos")
        row = {name: self.locals[name] for name in names}
        env = self.training_env
        row |= {
            "metrics": env.team_env.metrics,
            "components": env.team_env.reward_components,
        }
        if isinstance(env, RoleWrapper):
            row |= {"stream_rewards": env.stream_rewards, "state": env.get_state()}
        row["steps"] = self.num_timesteps
        self.seen.append({name: plain(value) for name, value in row.items()})
        return True


def plain(value):
    """Turn values into lists, which are equal whatever they were laid out like."""
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    if isinstance(value, list):
        return [plain(one) for one in value]
    return np.asarray(value).tolist() if isinstance(value, (np.ndarray, th.Tensor)) else value


def train(model, n_rollouts=3):
    dumps = record_logs(model)
    witness = Witness()
    callbacks = [witness, TeamMetricsCallback(20), RoleCallback(20)]
    model.learn(n_rollouts * N_STEPS * model.n_envs, callbacks)
    logs = [
        {k: v for k, v in dump.items() if k not in ("time/fps", "time/time_elapsed")}
        for dump in dumps
    ]
    return logs, witness.seen, plain(capture(model)["state"] | {"elapsed_ns": 0, "logger": 0})


@pytest.mark.parametrize(
    ("kind", "policy"),
    [
        ("mappo", {"encoder": "patches"}),
        ("hmappo", {"share_encoders": True}),
        ("random", {"encoder": "patches"}),
        ("lasting", {"encoder": "patches", "see_role": True}),
        ("mix", {"encoder": "patches"}),
    ],
)
@pytest.mark.parametrize("n_groups", [1, 3])
def test_groups_played_elsewhere_are_the_rollout(kind, policy, n_groups):
    here = make(kind, n_groups=n_groups, **policy)
    expected = train(here)
    elsewhere = stages(n_groups, kind, **policy)
    there = make(kind, n_groups=n_groups, **policy)
    there.player = Elsewhere(there, elsewhere)
    found = train(there)
    assert same(weights(here), weights(there))
    for one, other in zip(expected, found, strict=True):
        assert one == other


def test_groups_of_any_backend():
    backend = "supersuit"
    here = make(n_groups=2, backend=backend, encoder="patches")
    expected = train(here, 2)
    elsewhere = stages(2, backend=backend, encoder="patches")
    there = make(n_groups=2, backend=backend, encoder="patches")
    there.player = Elsewhere(there, elsewhere)
    assert train(there, 2)[0] == expected[0]
    assert same(weights(here), weights(there))


@pytest.mark.parametrize("backend", ["native", "supersuit"])
def test_a_state_is_the_sum_of_its_parts(backend):
    env = small_search(N_TEAMS, backend, roles={"role_control": "random"})
    env.reset()
    rng = np.random.default_rng(0)

    def play(one, actions):
        for action in actions:
            roles = one.current_roles if isinstance(one, RoleWrapper) else None
            seen, rewards, dones, _ = one.step(np.stack([roles, action], axis=1))
        return plain((seen, rewards, dones))[0]

    play(env, rng.integers(0, 5, (7, 15)))
    state = env_state(env)
    assert parts_gap(env, state) is None
    parts = [take_state(env, state, teams) for teams in split_teams(N_TEAMS, 3)]
    actions = rng.integers(0, 5, (8, 15))
    expected = play(env, actions)
    other = small_search(N_TEAMS, backend, roles={"role_control": "random"})
    other.reset()
    set_env_state(other, join_states(other, parts))
    again = play(other, actions)
    for key, value in expected.items():
        np.testing.assert_array_equal(value, again[key])
    for teams, part in zip(split_teams(N_TEAMS, 3), parts, strict=True):
        few = small_search(teams.stop - teams.start, backend, roles={"role_control": "random"})
        few.reset()
        set_env_state(few, part)
        found = play(few, actions[:, teams.start * 3 : teams.stop * 3])
        for key, value in take_rows(expected, teams, N_TEAMS).items():
            np.testing.assert_array_equal(value, found[key])


class Counting(BatchedAreaSearch):
    """Has a number of its own in its state."""

    def get_state(self):
        return {**super().get_state(), "played": 3}


def test_a_state_that_belongs_to_no_team_is_refused():
    class Env(AreaSearchEnv):
        def batched(self, n_teams):
            return Counting("hard", n_teams, n_agents=3)

    env = make_team_vec_env(lambda: Env("hard", n_agents=3), 2)
    env.reset()
    assert parts_gap(env, env_state(env)) == (
        "the state of environment area-search-v0 can not be divided by teams: played is no array "
        "with a row, or the same number of rows, for each of 2 teams"
    )
