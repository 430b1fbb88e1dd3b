"""Numbers that are not finite: where they are found, what is kept, and that it is noticed."""

from __future__ import annotations

import pickle
import tempfile

import numpy as np
import pytest
import safetensors
import torch as th
from gymnasium import spaces
from helpers import collect, same, weights
from toy_envs import BatchedToy, PlainEnv, ToyEnv

from sb3_roles.common import base_team_vec_env, losses, not_finite
from sb3_roles.common.losses import StreamLoss, check_same_policy
from sb3_roles.common.not_finite import NotFiniteError, dump, guard_optimizer
from sb3_roles.common.team_vec_env import make_team_vec_env
from sb3_roles.mappo import mappo
from sb3_roles.prove import not_finite as experiment
from sb3_roles.prove.small_runs import small_run
from sb3_roles.zoo.models import make_env, make_model

BAD = [np.nan, np.inf, -np.inf]


class BadToy(BatchedToy):
    """Something is not finite in the second step."""

    bad, value = "vector", np.nan

    def step(self, actions):
        super().step(actions)
        if self.clock.max() == 2:
            array = self.vector if self.bad == "vector" else getattr(self, self.bad)
            array[1, 2, ...] = self.value


def bad_toy(bad, value):
    class Toy(ToyEnv):
        def batched(self, n_teams):
            toy = BadToy(n_teams)
            toy.bad, toy.value = bad, value
            return toy

    env = make_team_vec_env(Toy, 3, 0)
    env.reset()
    return env


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize(
    ("bad", "part", "words"),
    [
        ("vector", "observation", "observation 'vector'"),
        ("rewards", "reward", "reward"),
        ("reward_components", "reward", "reward component"),
    ],
)
def test_the_native_adapter_names_key_team_and_agent(bad, part, words, value):
    env = bad_toy(bad, value)
    env.step(np.zeros(9, np.int64))
    with pytest.raises(NotFiniteError) as caught:
        env.step(np.zeros(9, np.int64))
    assert caught.value.part == part
    message = str(caught.value)
    assert message.startswith(f"{words} {value}")
    assert "team 1, agent 'robot_2' (row 5)" in message
    (kept,) = caught.value.tensors.values()
    assert not np.isfinite(np.asarray(kept)).all()


class BadEnv(PlainEnv):
    """Observes a number that is none at a time."""

    when = 2

    def observe(self):
        seen = super().observe()
        if self.clock == self.when:
            seen["b"][1] = np.inf
        return seen


@pytest.mark.parametrize(("when", "words"), [(0, "reset"), (2, "agent 'b'"), (5, "end of an")])
def test_the_supersuit_adapter_looks_at_all_observations(monkeypatch, when, words):
    monkeypatch.setattr(BadEnv, "when", when)
    env = make_team_vec_env(BadEnv, 2, 0)
    with pytest.raises(NotFiniteError, match=words):
        env.reset()
        for _ in range(6):
            env.step(np.zeros(4, np.int64))
    monkeypatch.setattr(BadEnv, "when", -1)
    env.reset()
    for _ in range(6):
        env.step(np.zeros(4, np.int64))


def test_the_last_observation_of_an_episode_is_looked_at():
    env = bad_toy("vector", np.nan)
    env.batched.horizon = 2
    env.step(np.zeros(9, np.int64))
    with pytest.raises(NotFiniteError, match="at the end of an episode"):
        env.step(np.zeros(9, np.int64))


def test_only_numbers_with_a_point_are_looked_at():
    space = spaces.Dict(
        {
            "map": spaces.Box(0, 1, (2, 2), np.uint8),
            "count": spaces.Discrete(3),
            "place": spaces.Box(-1, 1, (2,), np.float32),
            "exact": spaces.Box(-1, 1, (2,), np.float64),
        }
    )
    assert set(base_team_vec_env._float_keys(space)) == {"place", "exact"}
    assert base_team_vec_env._float_keys(space["place"]) == ("",)
    assert base_team_vec_env._float_keys(space["map"]) == ()


def test_what_is_kept_is_bounded(tmp_path, monkeypatch):
    tensors = {"a": th.arange(100.0), "b": np.full((100, 4), np.nan, np.float32), "c": th.ones(())}
    error = NotFiniteError("loss", "the loss is nan", {"a": tensors["a"]}).found_in("here", tensors)
    assert str(error) == "the loss is nan (here)"
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.part, set(again.tensors)) == (str(error), "loss", {"a", "b", "c"})
    path = tmp_path / "x.safetensors"
    for most, rows in ((1 << 20, 100), (1000, 49)):
        monkeypatch.setattr(not_finite, "MOST_BYTES", most)
        assert dump(path, error)
        with safetensors.safe_open(path, "pt") as file:
            assert len(file.get_tensor("a")) == len(file.get_tensor("b")) == rows
            assert file.metadata()["part"] == "loss"
        assert path.stat().st_size < most + 1000
    assert not dump(tmp_path / "none", NotFiniteError("loss", "the loss is nan"))
    assert [file.name for file in tmp_path.iterdir()] == ["x.safetensors"]


def test_the_optimizer_of_a_stock_algorithm_is_guarded():
    policy = th.nn.Linear(3, 2)
    policy.optimizer = th.optim.Adam(policy.parameters(), 0.1)
    guard_optimizer(policy)
    policy(th.ones(3)).sum().backward()
    policy.optimizer.step()
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    for value in BAD:
        policy.bias.grad[1] = value
        with pytest.raises(NotFiniteError, match="the gradient of bias"):
            policy.optimizer.step()
        assert same(before, policy.state_dict())


def made(algo="mappo", **changes):
    config = small_run(algo, **changes)
    return make_model(config, make_env(config))


def test_a_policy_that_computes_otherwise_while_it_trains_is_refused():
    model = made()
    collect(model)
    head = model.policy.action_net
    before = weights(model)
    head.register_forward_hook(lambda module, seen, out: out * 3.0 + th.arange(5.0))
    with pytest.raises(ValueError, match="is not the one that acted: before the first step"):
        model.train()
    assert same(before, weights(model))


def test_rounding_is_no_other_policy():
    zero = th.zeros(())
    for kl, refused in ((0.0, False), (-1e-8, False), (losses._SAME_KL / 2, False), (0.1, True)):
        loss = StreamLoss(zero, zero, zero, zero, th.tensor(kl), zero)
        if refused:
            with pytest.raises(ValueError, match="the move policy"):
                check_same_policy(["move"], [loss])
        else:
            check_same_policy(["move"], [loss])


# The experiment notices what it is for


def trial(folder, algo, part, seed=0):
    return experiment.trial(algo, part, np.nan, folder, np.random.default_rng(seed))


def test_an_adapter_that_does_not_look_is_noticed(tmp_path, monkeypatch):
    assert trial(tmp_path / "good", "ppo", "observation") == []
    monkeypatch.setattr(base_team_vec_env.TeamVecEnv, "_check_finite", lambda *_: None)
    assert any("not named" in one for one in trial(tmp_path / "bad", "ppo", "observation"))


def test_steps_that_nobody_looks_at_are_noticed(tmp_path, monkeypatch):
    monkeypatch.setattr(mappo, "check_loss", lambda loss: None)
    clip = th.nn.utils.clip_grad_norm_
    monkeypatch.setattr(th.nn.utils, "clip_grad_norm_", lambda found, most, **_: clip(found, most))
    found = trial(tmp_path / "run", "mappo", "loss")
    assert "weights or optimizer changed" in found


def test_a_stock_algorithm_without_the_guard_is_noticed(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_roles.zoo.models.guard_optimizer", lambda policy: None)
    assert "weights or optimizer changed" in trial(tmp_path / "run", "ppo", "gradient")


def test_stock_training_leaves_nothing_in_the_temporary_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert experiment._stock().startswith("SB3's PPO ")
    assert not list(tmp_path.glob("SB3-*"))
