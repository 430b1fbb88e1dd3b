"""Statistics over training runs, and paired comparisons, against closed forms and slow loops."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_roles.evaluation.tables.aggregate import (
    MIN_EPISODES,
    Comparison,
    interquartile_mean,
    interval_over_runs,
    mean_of_tasks,
    resample_runs,
    time_above,
)


@pytest.mark.parametrize(
    ("values", "mean"),
    [
        ([7.0], 7.0),
        ([1.0, 3.0], 2.0),
        ([0.0, 1.0, 8.0], 3.0),
        ([100.0, 1.0, 3.0, -50.0], 2.0),
        ([9.0, 1.0, 2.0, 3.0, -9.0], 2.0),
        ([0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 99.0, 99.0], 2.5),
    ],
)
def test_interquartile_means_in_closed_form(values, mean):
    assert interquartile_mean(np.array(values)) == pytest.approx(mean)


def slow_interquartile_mean(values):
    values = sorted(values)
    cut = int(0.25 * len(values))
    kept = values[cut : len(values) - cut]
    return sum(kept) / len(kept)


def test_interquartile_means_along_axes():
    scores = np.random.default_rng(0).normal(size=(7, 5, 3))
    assert interquartile_mean(scores) == pytest.approx(slow_interquartile_mean(scores.ravel()))
    expected = [
        [slow_interquartile_mean(scores[:, i, j]) for j in range(3)] for i in range(scores.shape[1])
    ]
    np.testing.assert_allclose(interquartile_mean(scores, axis=0), expected)
    tasks = [np.mean([slow_interquartile_mean(one[:, j]) for j in range(3)]) for one in scores]
    np.testing.assert_allclose(mean_of_tasks(scores), tasks)


def test_a_hard_task_is_not_dropped():
    scores = np.array([[0.0, 10.0, 11.0, 100.0]] * 4)
    assert mean_of_tasks(scores) == pytest.approx(121 / 4)
    assert interquartile_mean(scores) == pytest.approx(10.5)


def flat(scores):
    return np.array([interquartile_mean(one) for one in scores])


def test_runs_are_drawn_for_each_task_by_itself():
    """The slow reference of the stratified bootstrap: every draw is a run of the same task."""
    scores = np.arange(12.0).reshape(4, 3)
    drawn = []
    resample_runs(scores, lambda all_: drawn.append(all_) or flat(all_), seed=3)
    resamples = drawn[0]
    assert resamples.shape == (2000, 4, 3)
    for task in range(3):
        assert set(np.unique(resamples[:, :, task])) == set(scores[:, task])
        shares = [(resamples[:, :, task] == value).mean() for value in scores[:, task]]
        np.testing.assert_allclose(shares, 0.25, atol=0.02)
    # One run in all tasks comes about by chance only.
    together = (np.diff(resamples, axis=2) == 1).all(axis=2)
    assert together.mean() == pytest.approx(1 / 16, abs=0.02)
    rng = np.random.default_rng(0)
    reference = []
    for _ in range(2000):
        columns = [[scores[rng.integers(4), task] for _ in range(4)] for task in range(3)]
        reference.append(slow_interquartile_mean([value for one in columns for value in one]))
    fast = resample_runs(scores, flat, seed=3)
    assert np.mean(fast) == pytest.approx(np.mean(reference), abs=0.15)
    assert np.std(fast) == pytest.approx(np.std(reference), rel=0.1)


def test_whole_runs_stay_together():
    scores = np.arange(12.0).reshape(4, 3)
    drawn = []
    resample_runs(scores, lambda all_: drawn.append(all_) or flat(all_), whole=True)
    assert (np.diff(drawn[0], axis=2) == 1).all()


def test_rliable_agrees():
    metrics = pytest.importorskip("rliable.metrics", reason="rliable is not installed")
    library = pytest.importorskip("rliable.library", reason="rliable is not installed")
    scores = np.random.default_rng(1).normal(size=(10, 4))
    theirs, intervals = library.get_interval_estimates(
        {"x": scores}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=4000
    )
    assert interquartile_mean(scores) == pytest.approx(theirs["x"][0])
    ours = np.quantile(resample_runs(scores, flat, n_resamples=4000), [0.025, 0.975])
    np.testing.assert_allclose(ours, intervals["x"][:, 0], atol=0.05)


@pytest.mark.parametrize("n_runs", [2, 3, 4])
def test_few_runs_span_their_interval(n_runs):
    scores = np.random.default_rng(n_runs).normal(size=(n_runs, 1))
    low, high = interval_over_runs(scores)
    ordered = np.sort(scores[:, 0])
    if n_runs < 4:
        assert (low, high) == (ordered[0], ordered[-1])
    assert ordered[0] <= low < ordered[1]
    assert ordered[-2] < high <= ordered[-1]


def coverage(draw, interval, true_value, repeats=400):
    rng = np.random.default_rng(0)
    ends = [interval(draw(rng), seed) for seed in range(repeats)]
    return np.mean([low <= true_value <= high for low, high in ends])


@pytest.mark.parametrize(("n_runs", "low", "high"), [(3, 0.70, 0.80), (15, 0.89, 0.97)])
def test_coverage_of_the_interval_over_runs(n_runs, low, high):
    """As the notes of the tables say: 3 of 4 with three runs, near 95 % with many."""
    share = coverage(lambda rng: rng.normal(5, 2, (n_runs, 1)), interval_over_runs, 5)
    assert low <= share <= high


def test_runs_that_play_all_tasks_must_be_drawn_whole():
    """A good run is good in all scenes: drawing runs by scene takes that for four chances."""

    def draw(rng):
        return rng.normal(5, 2, (10, 1)) + rng.normal(0, 0.3, (10, 4))

    def by_task(scores, seed):
        resampled = resample_runs(scores, mean_of_tasks, seed=seed, n_resamples=500)
        return np.quantile(resampled, [0.025, 0.975])

    assert coverage(draw, interval_over_runs, 5) > 0.86
    assert coverage(draw, by_task, 5, repeats=200) < 0.75


def row(values):
    """One run, one task."""
    return np.asarray(values, float)[None, None, :, None]


def test_the_planted_winner_is_best():
    rng = np.random.default_rng(0)
    # Episodes differ much more than the rows do.
    episodes = rng.normal(50, 20, 100)
    rows = {name: row(episodes + rng.normal(k, 2, 100)) for k, name in enumerate("abc")}
    assert Comparison().best(rows) == "c"
    assert Comparison().best(dict(reversed(rows.items()))) == "c"
    assert Comparison().best(rows, larger_is_better=False) == "a"
    # Without the pairing the difference would be lost.
    rows["c"] = rows["c"][:, :, ::-1]
    assert Comparison().best(rows) is None


def test_ties_single_rows_and_few_episodes_have_no_best():
    values = np.random.default_rng(0).normal(size=40)
    assert Comparison().best({"a": row(values), "b": row(values)}) is None
    assert Comparison().best({"a": row(values)}) is None
    assert Comparison().best({}) is None
    few, enough = values[: MIN_EPISODES - 1], values[:MIN_EPISODES]
    assert Comparison().best({"a": row(few + 1), "b": row(values)}) is None
    assert Comparison().best({"a": row(enough + 1), "b": row(values)}) == "a"


def test_rows_are_compared_on_the_episodes_that_both_played():
    values = np.random.default_rng(0).normal(size=40)
    # Over all of its episodes b is far ahead.
    rows = {"a": row(values[:20] + 1), "b": row(np.r_[values[:20], values[20:] + 100])}
    assert Comparison().best(rows) == "a"


def test_equal_rows_are_seldom_told_apart():
    rng = np.random.default_rng(0)
    comparison = Comparison(n_resamples=500)
    found = 0
    for _ in range(300):
        episodes = rng.normal(0, 5, 40)
        rows = {name: row(episodes + rng.normal(size=40)) for name in "ab"}
        found += comparison.best(rows) is not None
    assert 0.02 <= found / 300 <= 0.09


def test_training_runs_are_noise_too():
    rng = np.random.default_rng(0)
    episodes = rng.normal(50, 20, 200)
    rival = row(episodes)
    spread = episodes[None, None, :, None] + np.array([-6.0, 1, 11])[:, None, None, None]
    assert Comparison().best({"runs": spread, "rival": rival}) is None
    steady = episodes[None, None, :, None] + np.array([1.5, 2, 2.5])[:, None, None, None]
    assert Comparison().best({"runs": steady, "rival": rival}) == "runs"
    # One policy that is as good on the mean has no such noise.
    assert Comparison().best({"one": rival + 2, "rival": rival}) == "one"


def test_resampled_scores_have_the_noise_of_episodes_and_runs():
    rng = np.random.default_rng(1)
    episodes = rng.normal(0, 3, 200)
    runs = rng.normal(0, 1, 3)
    values = episodes[None, None, :, None] + runs[:, None, None, None]
    resampled = Comparison()._resampled("x", values, lambda means: means[..., -1])
    variance = np.var(episodes) / 200 + np.var(runs) / 3
    assert resampled.mean() == pytest.approx(values.mean(), abs=0.05)
    assert resampled.var() == pytest.approx(variance, rel=0.1)


def test_times_are_those_of_resampled_mean_curves():
    def curves(time):
        jitter = np.random.default_rng(time).integers(-2, 3, size=60)
        reached = np.arange(50) >= (time + jitter)[:, None]
        return reached.astype(float)[None, None]

    rows = {"early": curves(20), "late": curves(30), "never": np.zeros((1, 1, 60, 50))}
    assert Comparison().best(rows, time_above, larger_is_better=False) == "early"
    # Who never gets there is later than all, and no better than another who never does.
    del rows["early"]
    assert Comparison().best(rows, time_above, larger_is_better=False) == "late"
    nobody = {"never": rows["never"], "neither": rows["never"]}
    assert Comparison().best(nobody, time_above, larger_is_better=False) is None
    np.testing.assert_array_equal(time_above(np.array([[[0.0, 0.9, 0.91], [0.0] * 3]])), [[2, 3]])
