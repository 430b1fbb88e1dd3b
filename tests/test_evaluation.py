"""Episodes are recorded the same in any batch, and metrics have their closed forms."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch as th

from area_search import AreaSearchEnv, BatchedAreaSearch, get_scene
from area_search import cells as layout
from sb3_roles import HMAPPO, MAPPO, RoleWrapper, TeamWrapper, make_team_vec_env
from sb3_roles.baselines import CONTROLLER_NAMES, CONTROLLERS, controller_class
from sb3_roles.baselines.random import RandomController
from sb3_roles.common.team_vec_env import team_seeds
from sb3_roles.evaluation.episodes import (
    STREAMS,
    Player,
    describe,
    held_out_seed,
    run_episodes,
    selection_seed,
    stream_of,
)
from sb3_roles.evaluation.evaluators import SceneEvaluator
from sb3_roles.evaluation.intervals import estimate_mean, t_quantile, t_within
from sb3_roles.evaluation.metrics import (
    decision_time,
    paired_differences,
    summarize,
    t90,
    time_e_paper,
)
from sb3_roles.evaluation.policies import PolicyController
from sb3_roles.evaluation.records import TIMINGS, EpisodeRecords
from sb3_roles.zoo.cli import main
from sb3_roles.zoo.options import MAX_SEED
from sb3_roles.zoo.summaries import comparison_of, report_of, table_of

PLAIN = get_scene("hard", horizon=12)
STOPPING = get_scene("hard", horizon=40, early_stop_patience=6)


def assert_same(first: EpisodeRecords, second: EpisodeRecords) -> None:
    """All that was recorded is equal, but for the times that it took."""
    for field in fields(EpisodeRecords):
        if field.name in TIMINGS:
            continue
        one, other = getattr(first, field.name), getattr(second, field.name)
        if isinstance(one, np.ndarray):
            assert one.dtype == other.dtype, field.name
            # Bounds that are not known are NaN.
            assert np.array_equal(one, other, equal_nan=one.dtype.kind == "f"), field.name
        elif field.name == "counts":
            assert one.keys() == other.keys()
            assert all(np.array_equal(one[name], other[name]) for name in one)
        else:
            assert one == other


# Planners are slow: see test_vrpc.py.
QUICK = [name for name in CONTROLLER_NAMES if name not in ("vrpc", "planner", "oracle")]


@pytest.mark.parametrize("name", QUICK)
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


def test_a_model_that_knows_no_teams_is_refused():
    class Model:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return np.zeros(8, np.int64), None

    with pytest.raises(ValueError, match=r"Model has no begin\(batch\).*PolicyController makes"):
        run_episodes(Model(), PLAIN, 2, 0)


class Constant:
    """Every robot does the same all the time, and has a role."""

    role_names = ("explore", "cover")

    def __init__(self, action=0, role=1):
        self.action, self.role = action, role

    def begin(self, batch):
        self.batch = batch

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        batch = self.batch
        self.roles = np.full((batch.n_teams, batch.n_agents), self.role, np.int8)
        return np.full(batch.n_teams * batch.n_agents, self.action), None


@pytest.mark.parametrize("scene", [PLAIN, STOPPING], ids=["horizon", "early_stop"])
def test_counts_and_distances_are_those_of_the_episode(scene):
    records = run_episodes(RandomController(), scene, 30, seed=1)
    assert records.distance.dtype == np.int16
    assert records.decision_seconds.dtype == np.float32
    for row, length in enumerate(records.length):
        batch, controller = BatchedAreaSearch(scene), RandomController()
        batch.reset([1], row)
        controller.begin(batch)
        seen = covered = 0
        start = batch.position[0].copy()
        walked = np.zeros(scene.n_agents, int)
        for t in range(length):
            batch.step(controller.act(batch))
            seen, covered = seen + batch.new_cells.sum(), covered + batch.new_targets.sum()
            walked += np.abs(batch.position[0] - start).sum(axis=1)
            start = batch.position[0].copy()
            assert records.counts["seen"][row, t] == seen
            assert records.counts["covered"][row, t] == covered
            explored = batch.cells[0] & layout.EXPLORED > 0
            free = explored & (batch.cells[0] & layout.OBSTACLE == 0)
            assert records.counts["seen_free"][row, t] == free.sum()
            assert records.distance[row, t].tolist() == walked.tolist()
        # The distances stay as they are; of times that nothing was decided in, there is none.
        assert np.all(records.distance[row, length:] == walked)
        assert records.path_length[row] == walked.mean()
        assert np.isfinite(records.decision_seconds[row]).sum() == length
        assert np.all(records.decision_seconds[row, :length] > 0)


def test_a_blocked_move_is_no_distance():
    assert not run_episodes(Constant(action=0), PLAIN, 5, 0).distance.any()
    up = run_episodes(Constant(action=1), get_scene("hard", horizon=60), 5, 0)
    steps = np.diff(up.distance, axis=1, prepend=0)
    assert set(np.unique(steps)) == {0, 1}
    # Whoever was stopped by an obstacle or the border stays there.
    assert np.all(np.diff(steps, axis=1) <= 0)
    assert up.distance.max() < 25


def test_the_decision_is_shared_by_the_teams_that_play(monkeypatch):
    clock = iter(range(10**6))
    monkeypatch.setattr("time.perf_counter", lambda: float(next(clock)))
    records = run_episodes(Constant(), STOPPING, 6, 0, batch_size=4)
    # Nobody covers anything: all teams stop after the patience, and a reading takes a second.
    assert records.length.tolist() == [6] * 6
    assert np.all(records.decision_seconds[:4, :6] == 0.25)
    assert np.all(records.decision_seconds[4:, :6] == 0.5)
    times = decision_time(records)
    assert times["median"] == 0.25
    assert times["mean"] == pytest.approx(2 / 6)
    assert times["p95"] == 0.5
    records = run_episodes(RandomController(), STOPPING, 20, 0, n_agents=1)
    playing = (np.arange(40) < records.length[:, None]).sum(axis=0)
    assert len(set(playing)) > 2
    for t in range(records.length.max()):
        # The last team that plays bears the whole decision.
        assert np.nanmax(records.decision_seconds[:, t]) == np.float32(1 / playing[t])


def test_teams_of_another_size():
    records = run_episodes(RandomController(), "hard", 3, 0, n_agents=7)
    assert records.distance.shape == (3, 50, 7)
    assert records.metadata["scene"]["n_agents"] == 7
    with pytest.raises(ValueError, match="n_agents must be a whole number"):
        run_episodes(RandomController(), "hard", 3, 0, n_agents=0)


def test_records_say_who_played():
    records = run_episodes(RandomController(), PLAIN, 2, seed=5, name="chance")
    about = records.metadata
    assert (about["name"], about["controller"], about["seed"]) == ("chance", "RandomController", 5)
    assert about["deterministic"] is about["communication"] is None
    assert about["role_names"] == []
    assert about["versions"]["numpy"] == np.__version__
    assert get_scene("hard").with_options(**about["scene"]) == PLAIN
    assert run_episodes(Constant(), PLAIN, 2, 0).metadata["role_names"] == ["explore", "cover"]


def test_the_config_hash_tells_configurations_apart():
    class Optional(RandomController):
        def __init__(self, **description):
            self.description = description
            self.deterministic = self.communicate = True

    def hash_of(controller, scene=PLAIN, name=None):
        return describe(controller, scene, name)["config_hash"]

    first = hash_of(Optional(limit=1.0, order=(1, 2)))
    assert len(first) == 64
    assert first == hash_of(Optional(order=[1, 2], limit=1.0), name="another label")
    silent, drawn = Optional(limit=1.0, order=(1, 2)), Optional(limit=1.0, order=(1, 2))
    silent.communicate = drawn.deterministic = False
    others = [
        hash_of(silent),
        hash_of(drawn),
        hash_of(Optional(limit=2.0, order=(1, 2))),
        hash_of(Optional(limit=1.0, order=(1, 2)), STOPPING),
        hash_of(RandomController()),
    ]
    assert len({first, *others}) == 6
    with pytest.raises(ValueError, match="the description of Optional is no JSON"):
        hash_of(Optional(limit=np.zeros(2)))
    with pytest.raises(ValueError, match="the description of Optional is no JSON"):
        hash_of(Optional(limit=float("nan")))


def test_a_wrong_number_of_actions_is_refused():
    class Wrong:
        def begin(self, batch):
            pass

        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return np.zeros(3, np.int64), None

    with pytest.raises(ValueError, match=r"Wrong.predict returned .* expected \(4,\)"):
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


@pytest.mark.parametrize(
    ("df", "t"),
    # Two-sided 95 % points: tan(0.475 pi), sqrt(2) * 0.95 / sqrt(1 - 0.95 ** 2), and tables.
    [
        (1, np.tan(0.475 * np.pi)),
        (2, np.sqrt(2) * 0.95 / np.sqrt(1 - 0.95**2)),
        (9, 2.262157163),
        (10, 2.228138852),
        (30, 2.042272456),
        (100, 1.983971519),
        (101, 1.983731003),
        (499, 1.964729391),
        (10**7, 1.959964222),
    ],
)
def test_students_t(df, t):
    assert t_quantile(df) == pytest.approx(t, rel=1e-7)


def test_students_t_in_closed_form():
    assert t_within(1.0, 1) == pytest.approx(0.5)
    assert t_within(1.0, 2) == pytest.approx(1 / np.sqrt(3))
    # For 3 degrees of freedom: 2 / pi (x / (1 + x^2) + atan x) with x = t / sqrt(3).
    assert t_within(3.0, 3) == pytest.approx(2 / np.pi * (np.sqrt(3) / 4 + np.pi / 3))
    assert t_quantile(1, 0.5) == pytest.approx(1.0)


def test_an_estimate_of_a_mean():
    mean, error, low, high = estimate_mean(np.array([1.0, 3.0]))
    assert (mean, error) == (2.0, 1.0)
    assert high - mean == mean - low == pytest.approx(np.tan(0.475 * np.pi))
    mean, error, low, high = estimate_mean(np.arange(5.0))
    assert mean == 2.0
    assert error == pytest.approx(np.sqrt(2.5 / 5))
    assert high - mean == pytest.approx(2.776445105 * error)
    assert estimate_mean(np.array([4.0])) == (4.0, None, None, None)
    assert estimate_mean(np.array([])) == (None, None, None, None)
    assert estimate_mean(np.full(3, 7)) == (7.0, 0.0, 7.0, 7.0)


def test_intervals_cover_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(0)
    samples = rng.normal(3.0, 2.0, (4000, 4))
    hits = [low <= 3.0 <= high for _, _, low, high in map(estimate_mean, samples)]
    # The normal interval, 1.96 standard errors, would hit in 85.5 % of samples of four.
    assert abs(np.mean(hits) - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 4000)


def ramps(n: int, ends: list[float], horizon: int = 10) -> np.ndarray:
    """Curves that jump from 0 to the given values at the given steps."""
    return np.array([[end if t >= 4 else 0.0 for t in range(horizon)] for end in ends * n])


def test_time_e_paper_of_the_mean_curve():
    # All equal: no spread.
    assert time_e_paper(ramps(20, [1.0])) == (4, 0.0, 4, 4)
    # The mean of a slow and a fast half crosses where the halves' mean does.
    curves = np.repeat([np.linspace(0.1, 1.0, 10), np.linspace(0.2, 2.0, 10)], 50, axis=0)
    # 0.15 (t + 1) > 0.9 first at t = 6: it equals 0.9 at t = 5.
    estimate = time_e_paper(curves)
    assert estimate.mean == 6
    # Half of the resampled means are above 0.9 at t = 5, the others are not before t = 6.
    assert estimate.se == pytest.approx(0.5, abs=0.05)
    assert (estimate.low, estimate.high) == (5, 6)
    assert time_e_paper(curves) == estimate


@pytest.mark.parametrize("top", [0.0, 0.5, 0.9])
def test_time_e_paper_is_a_dash_when_the_mean_never_exceeds(top):
    assert time_e_paper(ramps(30, [top])) == (None, None, None, None)


def test_time_e_paper_counts_resamples_that_never_get_there_as_the_horizon():
    # Two episodes with final values 0 and 2: the mean is 1, from step 4 on. Of the resamples a
    # quarter has a mean of 0 and counts as 10, the others get there at 4.
    time, error, low, high = time_e_paper(ramps(1, [0.0, 2.0]), n_resamples=20_000)
    assert time == 4
    assert error == pytest.approx(6 * np.sqrt(0.25 * 0.75), rel=0.03)
    assert (low, high) == (4, 10)


def test_time_e_paper_of_one_episode_has_no_error():
    assert time_e_paper(ramps(1, [1.0])) == (4, None, None, None)


def test_t90_is_over_the_episodes_that_get_there():
    assert t90(np.array([10, -1, 14, -1])) == (12.0, 2.0, 0.5)
    assert t90(np.array([-1, -1])) == (None, None, 0.0)


def recorded(seen, covered, **changes) -> EpisodeRecords:
    """Records with the given counts of maps with 10 free cells and 5 targets."""
    seen, covered = np.array(seen, np.int32), np.array(covered, np.int32)
    n, horizon = seen.shape
    values = {
        "metadata": {"name": "x", "seed": 0, "scene": {}},
        "episode": np.arange(n),
        "length": np.full(n, horizon),
        "counts": {"seen": seen, "seen_free": seen + 1, "covered": covered},
        "n_free": np.full(n, 10),
        "n_targets": np.full(n, 5),
        "distance": np.zeros((n, horizon, 2), np.int16),
        "roles": np.full((n, horizon, 2), -1, np.int8),
        "decision_seconds": np.ones((n, horizon), np.float32),
        "timing": {"seconds": 1.0, "batch_size": n},
        "bounds": np.full(n, np.nan),
    }
    return EpisodeRecords(**{**values, **changes})


def test_summary_is_in_percent_and_steps():
    distance = np.array([[[1, 1], [2, 1]], [[0, 1], [1, 2]]], np.int16)
    records = recorded([[2, 9], [3, 7]], [[1, 2], [1, 3]], distance=distance)
    assert records.curves["explo_true"].tolist() == [[0.3, 1.0], [0.4, 0.8]]
    summary = summarize(records)
    reach = np.tan(0.475 * np.pi)
    assert summary["cover"]["mean"] == pytest.approx(50.0)
    assert summary["cover"]["se"] == pytest.approx(10.0)
    assert summary["cover"]["ci95"] == pytest.approx([50 - 10 * reach, 50 + 10 * reach])
    assert summary["explo_paper"]["mean"] == pytest.approx(80.0)
    # 0.9 is 90 % for explo_true, and not above 90 % for explo_paper.
    assert summary["t90_true"] == {
        **{"mean": 1.0, "se": None, "ci95": None},
        **{"unit": "steps", "share": 0.5},
    }
    assert summary["t90_paper"]["share"] == 0.0
    nothing = {"mean": None, "se": None, "ci95": None}
    assert summary["time_e_paper"] == {**nothing, "unit": "steps"}
    assert summary["path_length"] == {
        **{"mean": 1.5, "se": 0.0},
        **{"ci95": [1.5, 1.5], "unit": "cells"},
    }


def test_paired_differences_of_hand_made_episodes():
    ours = recorded([[5, 9], [9, 15], [0, 18]], [[0, 2], [1, 4], [0, 5]])
    theirs = recorded([[9, 8], [0, 13], [0, 15]], [[0, 1], [0, 3], [0, 4]])
    differences = paired_differences(ours, theirs)
    # One target more in each episode: no spread, though the episodes differ.
    cover = differences["cover"]
    assert cover["mean"] == pytest.approx(20.0)
    assert cover["se"] == pytest.approx(0.0, abs=1e-9)
    assert summarize(ours)["cover"]["se"] > 10
    # 1, 2 and 3 cells of 10 more: mean 20 points, deviation 10, two degrees of freedom.
    explored = differences["explo_paper"]
    assert explored["mean"] == pytest.approx(20.0)
    assert explored["se"] == pytest.approx(10 / np.sqrt(3))
    reach = np.sqrt(2) * 0.95 / np.sqrt(1 - 0.95**2) * 10 / np.sqrt(3)
    assert explored["ci95"] == pytest.approx([20 - reach, 20 + reach])
    assert explored["unit"] == "pp"
    # Both mean curves exceed 0.9 at step 1 only.
    assert differences["time_e_paper"]["mean"] == 0
    assert not {"t90_true", "t90_paper"} & set(differences)
    back = paired_differences(theirs, ours)
    assert back["explo_paper"]["mean"] == -explored["mean"]


def test_paired_times_are_resampled_alike():
    # Half of the episodes are slow, for both; ours is always two steps earlier.
    rows = [[0, 0, 5, 9, 10, 10, 10, 10], [0, 0, 0, 0, 0, 8, 11, 12]] * 10
    late = [[0, 0, *row[:-2]] for row in rows]
    nothing = np.zeros((20, 8))
    ours, theirs = recorded(rows, nothing), recorded(late, nothing)
    assert summarize(ours)["time_e_paper"]["mean"] == 6
    assert summarize(theirs)["time_e_paper"]["mean"] is None
    assert paired_differences(ours, theirs)["time_e_paper"]["mean"] is None
    longer = [[*row, 12, 12, 12, 12] for row in rows]
    late = [[0, 0, *row[:-2]] for row in longer]
    nothing = np.zeros((20, 12))
    ours, theirs = recorded(longer, nothing), recorded(late, nothing)
    assert time_e_paper(ours.curves["explo_paper"]).se > 0
    found = paired_differences(ours, theirs)["time_e_paper"]
    assert (found["mean"], found["se"], found["ci95"]) == (-2, 0.0, [-2, -2])


def test_only_the_same_episodes_are_paired():
    one = run_episodes(RandomController(), PLAIN, 3, 0)
    with pytest.raises(ValueError, match="the seed is another one"):
        paired_differences(one, run_episodes(RandomController(), PLAIN, 3, 1))
    with pytest.raises(ValueError, match="the scene is another one"):
        paired_differences(one, run_episodes(RandomController(), STOPPING, 3, 0))
    with pytest.raises(ValueError, match="their numbers are other ones"):
        paired_differences(one, run_episodes(RandomController(), PLAIN, 3, 0, 1))
    again = paired_differences(one, run_episodes(RandomController(), PLAIN, 3, 0))
    assert again["explo_true"]["ci95"] == [0.0, 0.0]


SMALL = {
    "local_channels": [4] * 3,
    "joint_channels": [4] * 4,
    "state_channels": [4] * 3,
    "graph_width": 8,
}
TINY = get_scene("hard", height=9, width=9, n_targets=10, horizon=8, n_agents=3)


def tiny_policy(sub_goal="assigned", algo=HMAPPO, scene=TINY, graph=True, **wrapper):
    """An untrained policy, with outputs large enough to tell one observation from another."""
    venv = make_team_vec_env(lambda: AreaSearchEnv(scene, sub_goal=sub_goal), 2, seed=0)
    options = {"n_steps": 2, "batch_size": 4, "device": "cpu", "seed": 1}
    options["policy_kwargs"] = {**SMALL, "graph": graph}
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
    whole = run_episodes(controller, TINY, 15, seed=3)
    for batch_size in (1, 7):
        again = run_episodes(controller, TINY, 15, seed=3, batch_size=batch_size)
        assert_same(whole, again)
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

    blind = run_episodes(Blinded(tiny_policy()), TINY, 10, seed=0)
    assert np.array_equal(whole.distance, blind.distance)
    assert np.array_equal(whole.curves["cover"], blind.curves["cover"])


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


@pytest.mark.parametrize("sub_goal", ["none", "nearest", "assigned", "routes", "role_routes"])
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


def test_a_policy_is_selected_on_episodes_that_no_seed_of_the_commands_plays():
    model = tiny_policy()
    scores = SceneEvaluator(TINY, 25, seed=2, stream="selection")(model)
    records = run_episodes(PolicyController(model), TINY, 25, selection_seed(2))
    assert scores["cover"] == pytest.approx(summarize(records)["cover"]["mean"] / 100)
    assert held_out_seed(MAX_SEED) < selection_seed(0) < 2**64
    for kind, make in STREAMS.items():
        assert stream_of(make(5)) == (kind, 5)
    assert stream_of(5) == ("raw", 5)
    with pytest.raises(ValueError, match="did you mean 'selection'"):
        SceneEvaluator(TINY, 25, stream="selektion")


class Knowing(RandomController):
    """Says of even episodes that no team covers more than their number."""

    def begin(self, batch):
        super().begin(batch)
        self.bounds = np.where(batch.episodes % 2 == 0, batch.episodes.astype(float), np.nan)


def test_bounds_that_a_controller_knows_are_kept_and_summarized():
    records = run_episodes(Knowing(), PLAIN, 9, seed=0, first_episode=10, batch_size=4)
    known = np.array([10.0, 12.0, 14.0, 16.0, 18.0])
    assert records.bounds[::2].tolist() == known.tolist()
    assert np.isnan(records.bounds[1::2]).all()
    bound = summarize(records)["cover_bound"]
    assert bound["mean"] == pytest.approx(known.mean())  # Of 100 targets.
    assert bound["se"] == pytest.approx(known.std(ddof=1) / np.sqrt(5))
    assert bound["ci95"][0] < bound["mean"] < bound["ci95"][1] and bound["unit"] == "%"
    blind = run_episodes(RandomController(), PLAIN, 9, seed=0, first_episode=10)
    assert "cover_bound" not in summarize(blind)
    for one, other in ((records, blind), (blind, records), (records, records)):
        assert "cover_bound" not in paired_differences(one, other)
    reports = [report_of(each) for each in (blind, records)]
    assert "cover_bound  " in table_of(reports[1]) and "cover_bound" not in table_of(reports[0])
    lines = comparison_of(
        reports,
        [
            {
                "controller": "Knowing",
                "against": "RandomController",
                "metrics": paired_differences(records, blind),
            }
        ],
    ).split("\n")
    heads = [k for k, line in enumerate(lines) if "path_length" in line]
    assert "cover_bound, %" in lines[heads[0]] and "cover_bound" not in lines[heads[1]]
    assert "14.00 [" in lines[heads[0] + 2] and "  -  " in lines[heads[0] + 1]


@pytest.mark.parametrize("graph", [True, False])
def test_a_policy_without_messages_has_none_to_switch_off(graph):
    model = tiny_policy(graph=graph)
    assert PolicyController(model).communicate is (True if graph else None)
    assert describe(PolicyController(model), TINY)["communication"] is (True if graph else None)
    if graph:
        assert PolicyController(model, communicate=False).communicate is False
    else:
        with pytest.raises(ValueError, match="no messages that could be switched off"):
            PolicyController(model, communicate=False)


@pytest.mark.parametrize("option", ["--stochastic", "--no-communication", "--load-best"])
def test_options_of_policies_are_refused_for_scripted_controllers(option, capsys):
    with pytest.raises(SystemExit) as end:
        main(["evaluate", "--controller", "random,greedy", "--episodes", "2", option])
    assert end.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.splitlines()[-1] == (
        f"sb3-roles evaluate: error: argument {option}: only policies of runs heed it, and only "
        "scripted controllers are named"
    )
