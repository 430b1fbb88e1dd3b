"""Episodes are recorded the same in any batch, and metrics have their closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th

from area_search import AreaSearchEnv, BatchedAreaSearch, get_scene
from sb3_roles import HMAPPO, MAPPO, RoleWrapper, TeamWrapper, make_team_vec_env
from sb3_roles.baselines import CONTROLLER_NAMES, CONTROLLERS, controller_class
from sb3_roles.baselines.random import RandomController
from sb3_roles.common.team_vec_env import team_seeds
from sb3_roles.evaluation.episodes import EpisodeRecords, Player, run_episodes
from sb3_roles.evaluation.evaluators import SceneEvaluator, held_out_seed
from sb3_roles.evaluation.metrics import mean_and_error, summarize, t90, time_e_paper
from sb3_roles.evaluation.policies import PolicyController

PLAIN = get_scene("hard", horizon=12)
STOPPING = get_scene("hard", horizon=40, early_stop_patience=6)


def assert_same(first: EpisodeRecords, second: EpisodeRecords) -> None:
    for name in ("episode", "length", "t90_true", "t90_paper"):
        assert np.array_equal(getattr(first, name), getattr(second, name)), name
    assert first.curves.keys() == second.curves.keys()
    for name, curves in first.curves.items():
        assert np.array_equal(curves, second.curves[name]), name


@pytest.mark.parametrize("name", CONTROLLER_NAMES)
@pytest.mark.parametrize("scene", [PLAIN, STOPPING], ids=["horizon", "early_stop"])
def test_records_do_not_depend_on_the_batch(name, scene):
    controller = controller_class(name)()
    whole = run_episodes(controller, scene, 60, seed=3, first_episode=7, batch_size=500)
    assert whole.episode.tolist() == list(range(7, 67))
    for batch_size in (1, 7, 60):
        again = run_episodes(
            controller_class(name)(), scene, 60, seed=3, first_episode=7, batch_size=batch_size
        )
        assert_same(whole, again)
    part = run_episodes(controller, scene, 5, seed=3, first_episode=30)
    assert np.array_equal(part.curves["cover"], whole.curves["cover"][23:28])


def test_an_episode_is_recorded_until_it_ends():
    records = run_episodes(RandomController(), STOPPING, 50, seed=1)
    assert records.length.min() < records.length.max()
    for row, length in enumerate(records.length):
        batch, controller = BatchedAreaSearch(STOPPING), RandomController()
        batch.reset([1], row)
        controller.begin(batch)
        for t in range(length):
            assert not (batch.terminated[0] or batch.truncated[0])
            actions, _ = controller.predict({})
            batch.step(actions.reshape(1, -1))
            for name, curves in records.curves.items():
                assert curves[row, t] == batch.metrics[name][0]
        assert batch.terminated[0] or batch.truncated[0]
        final = batch.episode_metrics(0)
        assert final["length"] == length
        assert final["t90_true"] == records.t90_true[row]
        assert final["t90_paper"] == records.t90_paper[row]
        for name, curves in records.curves.items():
            assert np.all(curves[row, length:] == final[name])


def test_the_registry_loads_what_it_names():
    assert tuple(CONTROLLERS) == CONTROLLER_NAMES
    with pytest.raises(ValueError, match="did you mean 'random'"):
        controller_class("randon")


def test_random_actions_are_uniform_and_independent_of_the_team_mates():
    batch, controller = BatchedAreaSearch("hard", 4000, n_agents=5), RandomController()
    batch.reset(0)
    controller.begin(batch)
    first = controller.act(batch)
    batch.step(first)
    second = controller.act(batch)
    n = first.size
    for actions in (first, second):
        counts = np.bincount(actions.ravel(), minlength=5)
        # Chi-squared with 4 degrees of freedom: above 23.5 once in 10,000 draws.
        assert ((counts - n / 5) ** 2 / (n / 5)).sum() < 23.5
    for one, other in ((first[:, 0], first[:, 1]), (first[:, 0], second[:, 0])):
        assert abs(np.mean(one == other) - 0.2) < 4 * np.sqrt(0.2 * 0.8 / len(one))


def test_a_scripted_controller_needs_its_teams():
    with pytest.raises(RuntimeError, match=r"call begin\(batch\) first"):
        RandomController().predict({})


class Learned:
    """Like an SB3 model: no ``begin``, reads rows, keeps a state."""

    def __init__(self):
        self.calls = []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        shapes = {key: value.shape for key, value in observation.items()}
        self.calls.append((shapes, state, episode_start.copy(), deterministic))
        rows = len(observation["local"])
        return np.zeros(rows, np.int64), (np.full(rows, len(self.calls)),)


def test_a_learned_controller_gets_one_row_for_each_robot():
    controller = Learned()
    run_episodes(controller, PLAIN, 6, 0, batch_size=3, sub_goal="nearest", deterministic=True)
    assert len(controller.calls) == 2 * PLAIN.horizon
    for t, (shapes, state, episode_start, deterministic) in enumerate(controller.calls):
        assert shapes == {
            "local": (12, 4, 9, 9),
            "joint": (12, 2, 25, 25),
            "position": (12, 2),
            "state": (12, 5, 25, 25),
            "sub_goal": (12, 2, 6),
        }
        begins = t % PLAIN.horizon == 0
        assert episode_start.tolist() == [begins] * 12
        assert (state is None) == begins
        assert deterministic


def test_a_wrong_number_of_actions_is_refused():
    class Wrong:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return np.zeros(3, np.int64), None

    with pytest.raises(ValueError, match=r"Wrong.predict returned .* expected \(8,\)"):
        run_episodes(Wrong(), PLAIN, 2, 0)


@pytest.mark.parametrize(
    "options",
    [
        {"n_episodes": 0},
        {"batch_size": 0},
        {"first_episode": -1},
        {"seed": -1},
        {"n_episodes": 1.5},
    ],
)
def test_wrong_numbers_are_refused(options):
    values = {"n_episodes": 2, "seed": 0, **options}
    with pytest.raises(ValueError, match=f"{next(iter(options))} must be a whole number"):
        run_episodes(RandomController(), PLAIN, **values)


def test_mean_and_standard_error():
    assert mean_and_error(np.array([1.0, 3.0])) == (2.0, 1.0)
    mean, error = mean_and_error(np.arange(5.0))
    assert mean == 2.0
    assert error == pytest.approx(np.sqrt(2.5 / 5))
    assert mean_and_error(np.array([4.0])) == (4.0, None)
    assert mean_and_error(np.array([])) == (None, None)


def ramps(n: int, ends: list[float], horizon: int = 10) -> np.ndarray:
    """Curves that jump from 0 to the given values at the given steps."""
    return np.array([[end if t >= 4 else 0.0 for t in range(horizon)] for end in ends * n])


def test_time_e_paper_of_the_mean_curve():
    # All equal: no spread.
    assert time_e_paper(ramps(20, [1.0])) == (4, 0.0)
    # The mean of a slow and a fast half crosses where the halves' mean does.
    curves = np.repeat([np.linspace(0.1, 1.0, 10), np.linspace(0.2, 2.0, 10)], 50, axis=0)
    # 0.15 (t + 1) > 0.9 first at t = 6: it equals 0.9 at t = 5.
    time, error = time_e_paper(curves)
    assert time == 6
    # Half of the resampled means are above 0.9 at t = 5, the others are not before t = 6.
    assert error == pytest.approx(0.5, abs=0.05)
    assert time_e_paper(curves) == (time, error)


@pytest.mark.parametrize("top", [0.0, 0.5, 0.9])
def test_time_e_paper_is_a_dash_when_the_mean_never_exceeds(top):
    assert time_e_paper(ramps(30, [top])) == (None, None)


def test_time_e_paper_counts_resamples_that_never_get_there_as_the_horizon():
    # Two episodes with final values 0 and 2: the mean is 1, from step 4 on. Of the resamples a
    # quarter has a mean of 0 and counts as 10, the others get there at 4.
    time, error = time_e_paper(ramps(1, [0.0, 2.0]), n_resamples=20_000)
    assert time == 4
    assert error == pytest.approx(6 * np.sqrt(0.25 * 0.75), rel=0.03)


def test_time_e_paper_of_one_episode_has_no_error():
    assert time_e_paper(ramps(1, [1.0])) == (4, None)


def test_t90_is_over_the_episodes_that_get_there():
    assert t90(np.array([10, -1, 14, -1])) == (12.0, 2.0, 0.5)
    assert t90(np.array([-1, -1])) == (None, None, 0.0)


def test_summary_is_in_percent_and_steps():
    curves = {name: np.tile([[0.2, 0.4], [0.3, 0.6]], 1) for name in ("explo_paper", "cover")}
    records = EpisodeRecords(
        episode=np.arange(2),
        length=np.array([2, 2]),
        curves=curves,
        t90_true=np.array([-1, 1]),
        t90_paper=np.array([-1, -1]),
        seconds=1.0,
    )
    summary = summarize(records)
    assert summary["cover"]["mean"] == pytest.approx(50.0)
    assert summary["cover"]["se"] == pytest.approx(10.0)
    assert summary["t90_true"] == {"mean": 1.0, "se": None, "unit": "steps", "share": 0.5}
    assert summary["time_e_paper"] == {"mean": None, "se": None, "unit": "steps"}


SMALL = {
    "local_channels": [4] * 3,
    "joint_channels": [4] * 4,
    "state_channels": [4] * 3,
    "graph_width": 8,
}
TINY = get_scene("hard", height=9, width=9, n_targets=10, horizon=8, n_agents=3)


def tiny_policy(sub_goal="assigned", algo=HMAPPO, scene=TINY, **wrapper):
    """An untrained policy, with outputs large enough to tell one observation from another."""
    venv = make_team_vec_env(lambda: AreaSearchEnv(scene, sub_goal=sub_goal), 2, seed=0)
    options = {"policy_kwargs": SMALL, "n_steps": 2, "batch_size": 4, "device": "cpu", "seed": 1}
    if algo is MAPPO:
        return MAPPO("TeamPolicy", TeamWrapper(venv), **options)
    model = HMAPPO("RolePolicy", RoleWrapper(venv, **wrapper), **options)
    for layer in (model.policy.role_net.out, model.policy.action_net.head.out):
        layer.weight.data *= 100
    return model


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("algo", [HMAPPO, MAPPO])
def test_a_policy_plays_the_same_in_any_batch(algo, deterministic):
    controller = PolicyController(tiny_policy(algo=algo), deterministic=deterministic)
    before = th.get_rng_state()
    whole = run_episodes(controller, TINY, 30, seed=3)
    for batch_size in (1, 7):
        again = run_episodes(controller, TINY, 30, seed=3, batch_size=batch_size)
        assert_same(whole, again)
        assert np.array_equal(whole.roles, again.roles)
    assert th.equal(before, th.get_rng_state())
    assert set(np.unique(whole.roles)) == ({0, 1} if algo is HMAPPO else {-1})


def test_a_policy_acts_as_in_its_training_environment():
    model = tiny_policy(role_every=3)
    controller = PolicyController(model)
    batch = BatchedAreaSearch(TINY, 2, "assigned")
    env = model.env
    env.seed(11)
    obs = env.reset()
    batch.reset([int(s) for s in team_seeds(11, 2)])
    player = Player(controller, batch)
    for _ in range(TINY.horizon - 1):
        actions, _ = model.predict(obs, deterministic=True)
        obs, *_ = env.step(actions)
        player.step()
        assert np.array_equal(player.roles.ravel(), actions[:, 0])
        assert np.array_equal(obs["position"], batch.position.reshape(-1, 2))


@pytest.mark.parametrize("n_agents", [1, 2, 15, 50])
def test_one_policy_serves_teams_and_maps_of_any_size(n_agents):
    controller = PolicyController(tiny_policy())
    for side in (9, 14):
        scene = TINY.with_options(n_agents=n_agents, height=side, width=side + 2)
        records = run_episodes(controller, scene, 3, seed=0)
        assert records.roles.shape == (3, TINY.horizon, n_agents)
        assert records.roles.min() >= 0
        assert records.curves["explo_true"][:, -1].min() > 0


def test_no_action_depends_on_the_state():
    controller = PolicyController(tiny_policy())
    whole = run_episodes(controller, TINY, 10, seed=0)
    assert "state" not in controller.keys

    class Blinded(PolicyController):
        def begin(self, batch):
            super().begin(batch)
            del batch.observations["state"]

    assert_same(whole, run_episodes(Blinded(tiny_policy()), TINY, 10, seed=0))


@pytest.mark.parametrize("name", ["explore", "cover"])
def test_a_controlled_role_is_recorded_until_the_end(name):
    model = tiny_policy()
    controller = PolicyController(model.policy, {"role_control": name})
    scene = TINY.with_options(horizon=30, early_stop_patience=4)
    records = run_episodes(controller, scene, 20, seed=0)
    assert records.length.min() < 30
    for row, length in enumerate(records.length):
        assert np.all(records.roles[row, :length] == ["explore", "cover"].index(name))
        assert np.all(records.roles[row, length:] == -1)


@pytest.mark.parametrize("control", ["learned", "random"])
def test_roles_last_as_long_as_they_were_trained_to(control):
    controller = PolicyController(tiny_policy(role_every=4, role_control=control))
    assert controller.role_every == 4
    roles = run_episodes(controller, TINY, 40, seed=0).roles
    switches = (roles[:, 1:] != roles[:, :-1]).any(axis=(0, 2))
    assert np.flatnonzero(switches).tolist() == [3]
    if control == "random":
        assert abs(roles.mean() - 0.5) < 0.15


def test_messages_can_be_switched_off():
    model = tiny_policy()
    whole = run_episodes(PolicyController(model), TINY, 30, seed=0)
    silent = run_episodes(PolicyController(model, communicate=False), TINY, 30, seed=0)
    assert not np.array_equal(whole.roles, silent.roles)
    assert model.policy.communicate


@pytest.mark.parametrize("sub_goal", ["none", "nearest", "assigned"])
def test_the_sub_goal_is_that_of_the_training(sub_goal):
    controller = PolicyController(tiny_policy(sub_goal))
    assert controller.sub_goal == sub_goal
    run_episodes(controller, TINY, 2, seed=0)
    if sub_goal != "none":
        with pytest.raises(ValueError, match=f"this policy needs '{sub_goal}'"):
            run_episodes(controller, TINY, 2, seed=0, sub_goal="none")


def test_wrong_roles_are_refused():
    policy = tiny_policy().policy
    with pytest.raises(ValueError, match="did you mean 'cover'"):
        PolicyController(policy, {"role_control": "covr"})
    with pytest.raises(ValueError, match="has 2 roles, but 1 are named"):
        PolicyController(policy, {"roles": ["cover"]})


def test_held_out_episodes_are_scored_as_the_records_say():
    model = tiny_policy()
    scores = SceneEvaluator(TINY, 25, seed=2)(model)
    records = run_episodes(PolicyController(model), TINY, 25, 2**32 + 2)
    assert scores["cover"] == pytest.approx(summarize(records)["cover"]["mean"] / 100)
    assert scores["n_episodes"] == 25
    # No training team has such a seed.
    assert max(team_seeds(0, 1000)) < 2**32 == held_out_seed(0)
