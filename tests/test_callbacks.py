"""Callbacks count episodes of teams, and evaluation leaves no trace in the training."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
import torch as th
from helpers import one_line
from sb3_contrib import TRPO, MaskablePPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.logger import configure
from toy_envs import PlainEnv, ToyEnv, WitnessEnv

from area_search import AreaSearchEnv
from sb3_roles import HMAPPO, MAPPO, RoleWrapper, TeamWrapper, make_team_vec_env
from sb3_roles.baselines.area import area_scene
from sb3_roles.common.buffers import TeamRolloutBuffer
from sb3_roles.common.callbacks import RoleCallback, TeamMetricsCallback, TeamProgressBar
from sb3_roles.common.checkpoint import read_checkpoint
from sb3_roles.common.env_failures import EnvironmentFailed
from sb3_roles.common.row_policies import MaskedRowPolicy, MaskWrapper
from sb3_roles.evaluation import evaluators
from sb3_roles.evaluation.callback import EvaluationCallback
from sb3_roles.evaluation.episodes import held_out_seed, selection_seed
from sb3_roles.evaluation.evaluators import VecEnvEvaluator, make_evaluator

SMALL = {
    "local_channels": [4] * 3,
    "joint_channels": [4] * 4,
    "state_channels": [4] * 3,
    "graph_width": 8,
}
HORIZON, N_TEAMS = 6, 4


def search(n_agents=3, **options):
    options = {"height": 7, "width": 7, "n_targets": 8, "horizon": HORIZON, **options}
    return lambda: AreaSearchEnv("hard", n_agents=n_agents, **options)


def make_model(algo=HMAPPO, n_envs=N_TEAMS, n_steps=HORIZON, wrapper=None, env=None, keys=None):
    venv = make_team_vec_env(env or search(), n_envs, seed=0)
    rows = n_envs * venv.n_agents
    common = {"n_steps": n_steps, "seed": 3, "device": "cpu", "policy_kwargs": dict(SMALL)}
    common["policy_kwargs"] |= {"actor_keys": keys, "critic_keys": keys}
    if algo is MAPPO:
        return MAPPO("TeamPolicy", TeamWrapper(venv), batch_size=12, n_epochs=1, **common)
    venv = RoleWrapper(venv, **(wrapper or {}))
    if algo is HMAPPO:
        return HMAPPO("RolePolicy", venv, batch_size=12, n_epochs=1, **common)
    from sb3_roles.hmappo.policies import RoleActorCriticPolicy

    extra = {} if algo is A2C else {"batch_size": rows}
    extra |= {"sub_sampling_factor": 1, "n_critic_updates": 1} if algo is TRPO else {}
    extra |= {"n_epochs": 1} if algo is PPO else {}
    return algo(
        RoleActorCriticPolicy, venv, rollout_buffer_class=TeamRolloutBuffer, **extra, **common
    )


class Scripted:
    """Plays the roles it is told, through the algorithm's own loop."""

    def __init__(self, callback, roles, n_envs=1, **options):
        self.model = make_model(n_envs=n_envs, **options)
        streams = self.model.policy.streams

        def scripted(obs, *args, **kwargs):
            chosen = streams(obs, *args, **kwargs)
            if not args and "actions" not in kwargs:
                t = self.model.num_timesteps // self.model.env.num_envs
                chosen.actions[:, 0] = th.as_tensor(roles(t, len(chosen.actions)))
            return chosen

        self.model.policy.streams = scripted
        self.model.train = lambda: None
        self.model.learn(1, callback=callback)


def test_three_robots_for_one_episode_are_one_episode():
    callback = TeamMetricsCallback()
    model = make_model(n_envs=1)
    model.learn(1, callback=callback)
    assert model.num_timesteps == 3 * HORIZON
    assert callback.team_episodes == len(callback.window) == 1
    summary = callback.summary()
    assert summary["length"] == HORIZON
    assert callback.window[0].curve.shape == (HORIZON,)
    assert callback.window[0].curve[-1] == summary["explo_paper"]


def test_returns_are_sums_over_the_team():
    callback = TeamMetricsCallback()
    options = {"role_weights": {"cover": 2.0}, "primitive_weights": "role_reward"}
    make_model(n_envs=1, wrapper=options).learn(1, callback=callback)
    episode = callback.window[0]
    # Two for each of the 8 targets that the team covered.
    assert episode.returns == pytest.approx([16 * episode.metrics["cover"]] * 2)
    assert callback.summary()["return_role"] == episode.returns[0]


@pytest.mark.parametrize("algo", [HMAPPO, MAPPO, PPO, A2C, TRPO])
def test_every_algorithm_logs_teams(algo, tmp_path):
    metrics, roles = TeamMetricsCallback(), RoleCallback(path=tmp_path / "roles.csv")
    model = make_model(algo)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(2 * HORIZON * N_TEAMS * 3, callback=[metrics, roles], log_interval=1)
    assert metrics.team_episodes == 2 * N_TEAMS
    with open(tmp_path / "progress.csv") as file:
        last = list(csv.DictReader(file))[-1]
    assert float(last["rollout/team_episodes"]) >= N_TEAMS
    assert float(last["time/env_steps"]) == 2 * HORIZON * N_TEAMS
    assert float(last["time/agent_steps"]) == 2 * HORIZON * N_TEAMS * 3
    assert 0 <= float(last["rollout/cover"]) <= 1
    assert 0 <= float(last["rollout/t90_share"]) <= 1
    has_roles = algo is not MAPPO
    assert ("rollout/return_role" if has_roles else "rollout/return") in last
    assert ("roles/switch_rate" in last) == has_roles
    assert (tmp_path / "roles.csv").exists() == has_roles
    if has_roles:
        assert roles.roles_per_step.shape == (HORIZON, 2)
        np.testing.assert_allclose(roles.roles_per_step.sum(axis=1), 1.0)
        with open(tmp_path / "roles.csv") as file:
            assert len(list(csv.DictReader(file))) == HORIZON


def test_metrics_of_other_environments_are_logged():
    callback = TeamMetricsCallback()
    make_model(MAPPO, env=ToyEnv, n_steps=8, keys=["vector"]).learn(8 * 12, callback=callback)
    summary = callback.summary()
    assert callback.team_episodes >= 8
    assert {"length", "total", "return"} <= set(summary)
    assert "time_e_paper" not in summary


def test_time_e_paper_is_of_the_mean_curve():
    from sb3_roles.common.callbacks import TeamEpisode

    callback = TeamMetricsCallback()
    for curve in ([0.5, 0.8, 1.0, 1.0], [0.8, 1.0]):  # The second ended early: 1.0 from there on.
        callback.window.append(TeamEpisode({}, np.zeros(1), np.array(curve)))
    # Means .65, .9, 1: the second does not exceed .9.
    assert callback.summary()["time_e_paper"] == 2
    callback.window.append(TeamEpisode({}, np.zeros(1), np.zeros(4)))
    assert "time_e_paper" not in callback.summary()


@pytest.mark.parametrize("name", ["explore", "cover"])
def test_a_fixed_role_has_all_of_the_share(name):
    callback = RoleCallback()
    make_model(wrapper={"role_control": name}).learn(1, callback=callback)
    summary = callback.summary()
    other = {"explore": "cover", "cover": "explore"}[name]
    for part in ("", "_begin", "_middle", "_end"):
        assert summary[name + part] == 1.0
        assert summary[other + part] == 0.0
    assert summary["switch_rate"] == 0.0


def test_roles_by_step_and_switching_rate_in_closed_form():
    always, never, one = RoleCallback(), RoleCallback(), RoleCallback()
    Scripted(always, lambda t, n: np.full(n, t % 2))
    assert always.summary()["switch_rate"] == 1.0
    assert always.summary()["explore"] == 0.5
    assert always.roles_per_step.tolist() == [[1.0, 0.0], [0.0, 1.0]] * (HORIZON // 2)
    Scripted(never, lambda t, n: np.arange(n) % 2)
    assert never.summary()["switch_rate"] == 0.0
    assert never.summary()["explore"] == pytest.approx(2 / 3)
    # One robot of three switches once, at the third of six steps.
    Scripted(one, lambda t, n: np.where(np.arange(n) == 0, t >= 2, 0))
    assert one.summary()["switch_rate"] == pytest.approx(1 / (3 * (HORIZON - 1)))
    assert one.summary()["cover_begin"] == 0.0
    assert one.summary()["cover_end"] == pytest.approx(1 / 3)


def test_a_new_episode_is_no_switch():
    callback = RoleCallback()
    Scripted(callback, lambda t, n: np.full(n, t // HORIZON % 2), n_steps=2 * HORIZON)
    assert len(callback.window) == 2
    assert callback.summary()["switch_rate"] == 0.0
    assert callback.summary()["explore"] == 0.5


def weights_after(callbacks, n_steps=4):
    model = make_model(n_steps=n_steps)
    model.learn(4 * n_steps * N_TEAMS * 3, callback=callbacks)
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


@pytest.mark.parametrize("deterministic", [True, False])
def test_evaluation_does_not_change_the_training(deterministic, tmp_path):
    plain = weights_after(None)
    callback = EvaluationCallback(
        16, n_episodes=3, seed=1, deterministic=deterministic, folder=tmp_path
    )
    evaluated = weights_after([callback, TeamMetricsCallback(), RoleCallback()])
    assert [row["env_steps"] for row in callback.history] == [16, 32, 48, 64]
    assert all(th.equal(plain[name], evaluated[name]) for name in plain)


def test_evaluation_counts_joint_steps_and_keeps_the_best(tmp_path):
    scores = iter([0.2, 0.5, 0.4, float("nan"), 0.5])
    seen = []

    def evaluate(model):
        th.rand(3)
        seen.append({k: v.clone() for k, v in model.policy.state_dict().items()})
        return {"cover": next(scores), "n_episodes": 7.0}

    callback = EvaluationCallback(40, evaluate=evaluate, folder=tmp_path)
    model = make_model(n_steps=10)
    model.learn(5 * 40 * 3, callback=callback)
    assert [row["env_steps"] for row in callback.history] == [40, 80, 120, 160, 200]
    saved = read_checkpoint(tmp_path / "best" / "model.ckpt")
    best = saved.manifest["record"]
    assert (best["metric"], best["value"], best["env_steps"]) == ("cover", 0.5, 80)
    assert saved.policy.keys() == seen[1].keys()
    assert all(th.equal(value, seen[1][name]) for name, value in saved.policy.items())
    assert sorted(path.name for path in tmp_path.rglob("*")) == [
        "best",
        "evaluations.csv",
        "model.ckpt",
    ]
    with open(tmp_path / "evaluations.csv") as file:
        rows = list(csv.DictReader(file))
    assert [row["agent_steps"] for row in rows] == ["120", "240", "360", "480", "600"]


def test_the_best_policy_is_selected_on_episodes_of_its_own():
    callback = EvaluationCallback(16, n_episodes=2, seed=7)
    model = make_model()
    model.learn(HORIZON * N_TEAMS * 3, callback=callback)
    assert callback.evaluate.stream_seed == selection_seed(7)
    assert make_evaluator(model, 2, 7).stream_seed == held_out_seed(7)
    assert area_scene(model.env) == callback.evaluate.scene
    assert area_scene(TeamWrapper(make_team_vec_env(PlainEnv, 1, 0))) is None


def test_other_environments_are_evaluated_on_other_streams_than_they_select_on():
    class Watcher:
        """Does nothing, and keeps what it sees first."""

        policy, first = None, None

        def predict(self, observations, *_):
            self.first = observations["observation"] if self.first is None else self.first
            return np.zeros(len(observations["observation"]), int), None

    seen = []
    for stream in ("held_out", "selection", "selection"):
        watcher = Watcher()
        env = TeamWrapper(make_team_vec_env(PlainEnv, 2))
        VecEnvEvaluator(env, 2, seed=3, stream=stream)(watcher)
        seen.append(watcher.first)
    assert np.array_equal(seen[1], seen[2])
    assert not np.any(seen[0] == seen[1])


def test_an_episode_that_does_not_end_stops_an_evaluation(monkeypatch):
    class Still:
        policy = None

        def predict(self, observations, *_):
            return np.zeros(len(observations["observation"]), int), None

    monkeypatch.setattr(evaluators, "MAX_EPISODE_STEPS", 7)
    for horizon, ends in ((7, True), (8, False)):
        env = TeamWrapper(make_team_vec_env(lambda horizon=horizon: PlainEnv(horizon), 2))
        evaluator = VecEnvEvaluator(env, 4)
        if ends:
            assert evaluator(Still())["length"] == 7
            continue
        with pytest.raises(EnvironmentFailed, match=r"within 7 steps; .*check_episode_ends"):
            evaluator(Still())


def test_other_environments_are_evaluated_by_their_return():
    def wrapped(n_envs, seed):
        return TeamWrapper(make_team_vec_env(PlainEnv, n_envs, seed))

    evaluator = VecEnvEvaluator(wrapped(2, None), n_episodes=5, seed=4)
    options = {"n_steps": 5, "batch_size": 5, "n_epochs": 1, "device": "cpu", "seed": 0}
    weights = []
    for callback in (None, EvaluationCallback(10, evaluate=evaluator)):
        model = MAPPO("TeamPolicy", wrapped(2, 0), **options)
        model.learn(5 * 2 * 2 * 4, callback=callback)
        weights.append(model.policy.state_dict())
    assert all(th.equal(value, weights[1][name]) for name, value in weights[0].items())
    assert callback.metric == "return"
    assert [row["n_episodes"] for row in callback.history] == [5.0] * 4
    assert callback.history[0]["length"] == 5.0
    assert 0 <= callback.history[0]["return"] <= 10
    assert evaluator(model) == evaluator(model)


def test_another_environment_needs_its_evaluator():
    with pytest.raises(ValueError, match="VecEnvEvaluator"):
        make_model(MAPPO, env=ToyEnv, keys=["vector"]).learn(1, callback=EvaluationCallback(10))


def test_an_unknown_metric_is_named():
    callback = EvaluationCallback(1, metric="cver", evaluate=lambda model: {"cover": 0.0})
    with pytest.raises(ValueError, match="did you mean 'cover'"):
        make_model().learn(1, callback=callback)


class OneMove(MaskWrapper):
    """All moves but one are masked."""

    move = 0

    def _look(self, observations):
        super()._look(observations)
        self.masks[:, 2:] = np.arange(2) == self.move
        return observations


def masked_model(role_every):
    env = MaskWrapper(RoleWrapper(make_team_vec_env(PlainEnv, 1, 0), role_every=role_every), False)
    return MaskablePPO(MaskedRowPolicy, env, n_steps=4, batch_size=4, seed=0, device="cpu")


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("move", [0, 1])
def test_policies_with_masks_are_evaluated_with_them(move, deterministic):
    env = OneMove(RoleWrapper(make_team_vec_env(PlainEnv, 2, 0)), False)
    env.move = move
    scores = VecEnvEvaluator(env, 4, deterministic=deterministic)(masked_model(1))
    # Both robots are paid the number of their move, at each of 5 steps.
    assert scores["return"] == 2 * 5 * move


def test_roles_that_last_are_kept_in_the_evaluation_of_a_policy_with_masks():
    env = MaskWrapper(RoleWrapper(make_team_vec_env(PlainEnv, 2, 0), role_every=3), False)
    # A role that does not go on is an error of the wrapper.
    scores = VecEnvEvaluator(env, 4, deterministic=False)(masked_model(3))
    assert scores["length"] == 5.0


def test_closing_the_callback_closes_the_environment_of_its_evaluation():
    WitnessEnv.closed.clear()
    env = TeamWrapper(make_team_vec_env(WitnessEnv, 2))
    callback = EvaluationCallback(10, evaluate=VecEnvEvaluator(env, 2))
    assert not WitnessEnv.closed
    callback.close()
    assert len(WitnessEnv.closed) == 2
    # Nothing is open in a function, nor before the first evaluation.
    EvaluationCallback(10, evaluate=lambda model: {}).close()
    EvaluationCallback(10).close()


@pytest.mark.filterwarnings("ignore:rich is experimental")
@pytest.mark.parametrize("algo", [PPO, HMAPPO])
def test_the_progress_bar_counts_joint_steps(algo):
    bar = TeamProgressBar()
    model = make_model(algo)
    rollout = HORIZON * N_TEAMS
    model.learn(2 * rollout * 3, callback=bar)
    assert (bar.pbar.total, bar.pbar.n) == (2 * rollout, 2 * rollout)
    # A run that goes on begins where it was.
    model.learn(rollout * 3, callback=bar, reset_num_timesteps=False)
    assert (bar.pbar.total, bar.pbar.initial, bar.pbar.n) == (
        3 * rollout,
        2 * rollout,
        3 * rollout,
    )


@pytest.mark.parametrize("callback", [TeamMetricsCallback, RoleCallback])
def test_windows_hold_the_last_episodes(callback):
    one = callback(window=3)
    make_model().learn(2 * HORIZON * N_TEAMS * 3, callback=one)
    assert len(one.window) == 3
    for wrong in (0, 2.5, True):
        with pytest.raises(ValueError) as caught:
            callback(window=wrong)
        assert one_line(caught.value) == (
            f"window must be a whole number of at least 1, got {wrong!r}"
        )


@pytest.mark.parametrize("options", [{"eval_freq": 0}, {"eval_freq": 5, "n_episodes": 0}])
def test_wrong_numbers_are_refused(options):
    with pytest.raises(ValueError, match="whole number of at least 1"):
        EvaluationCallback(**options)


def test_states_continue_in_the_middle_of_an_episode():
    def callbacks():
        return [
            TeamMetricsCallback(window=5),
            RoleCallback(window=5),
            EvaluationCallback(16, n_episodes=2, seed=1),
        ]

    whole, first, second = callbacks(), callbacks(), callbacks()
    rollout = 4 * N_TEAMS * 3  # 4 steps of episodes of 6.
    make_model(n_steps=4).learn(4 * rollout, callback=whole)
    model = make_model(n_steps=4)
    model.learn(2 * rollout, callback=first)
    for old, new in zip(first, second, strict=True):
        plain = {
            key: value if isinstance(value, np.ndarray) else json.loads(json.dumps(value))
            for key, value in old.get_state().items()
        }
        new.set_state(plain)
    model.learn(2 * rollout, callback=second, reset_num_timesteps=False)
    assert second[0].summary() == whole[0].summary()
    assert second[1].summary() == whole[1].summary()
    np.testing.assert_array_equal(second[1].roles_per_step, whole[1].roles_per_step)
    assert second[2].history == whole[2].history
