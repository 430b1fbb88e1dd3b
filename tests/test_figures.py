"""Figures: the numbers behind them, and the files."""

from __future__ import annotations

import csv
import io
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from helpers import one_line

from sb3_roles.evaluation.figures.data import (
    Bar,
    Curve,
    Logs,
    collect,
    common_curves,
    csv_of,
    mean_band,
)
from sb3_roles.evaluation.figures.draw import caption, draw_figures
from sb3_roles.evaluation.figures.looks import looks
from sb3_roles.evaluation.figures.role_curves import role_shares, role_switches
from sb3_roles.evaluation.figures.training_logs import (
    TrainingLog,
    TrainingLogError,
    read_training_log,
    smoothed,
)
from sb3_roles.evaluation.grid.entrants import Entrant, Played, Results
from sb3_roles.evaluation.grid.plan import Column, Plan, PlanError
from sb3_roles.evaluation.grid.plan_file import parse_plan
from sb3_roles.evaluation.intervals import estimate_mean
from sb3_roles.evaluation.records import EpisodeRecords
from sb3_roles.evaluation.tables.aggregate import interval_over_runs
from sb3_roles.evaluation.tables.scores import score_cell

ROOT = Path(__file__).resolve().parent.parent
HARD, EASY = Column("hard", 4), Column("easy", 4)
PLACES = {"n_agents": [4], "scenes": {"hard": "Hard", "easy": "Easy"}}
PLAN = {
    "episodes": 500,
    "quick_episodes": 20,
    "seed": 1000,
    "rows": {
        "greedy": {"label": "Greedy <&> $1$", "controller": "greedy"},
        "oracle": {"label": "Oracle", "controller": "oracle", "bound": True},
        "mappo": {"label": "MAPPO", "algo": "mappo"},
        "hmappo": {"label": "HMAPPO", "algo": "hmappo"},
    },
    "tables": {},
    "figures": {
        "train": {
            "caption": "Rewards",
            "kind": "training",
            "rows": ["mappo", "hmappo"],
            "metrics": ["explore_reward", "cover_reward"],
        },
        "curves": {
            "caption": "Curves",
            "kind": "episode",
            "rows": ["greedy", "oracle", "mappo", "hmappo"],
            "metrics": ["explo_paper", "cover"],
            "n_agents": [4],
            "scenes": {"hard": "Hard"},
        },
        "shares": {
            "caption": "Roles",
            "kind": "roles",
            "rows": ["hmappo"],
            "metrics": ["cover", "explore"],
            **PLACES,
        },
        "switches": {
            "caption": "Switching",
            "kind": "switching",
            "rows": ["hmappo"],
            "metrics": ["switched"],
            **PLACES,
        },
        "times": {
            "caption": "Times",
            "kind": "time_e",
            "rows": ["greedy", "hmappo"],
            "metrics": ["time_e_paper", "t90_true"],
            **PLACES,
        },
    },
}


def records_of(
    seen: Any, n_free: int = 10, roles: Any = None, role_names: Sequence[str] = ()
) -> EpisodeRecords:
    """Records of two robots; half as many targets are covered as cells are seen."""
    counts = np.array(seen, np.int32)
    shape = (*counts.shape, 2)
    return EpisodeRecords(
        metadata={"role_names": list(role_names)},
        episode=np.arange(len(counts)),
        length=np.full(len(counts), counts.shape[1]),
        counts={"seen": counts, "seen_free": counts, "covered": counts // 2},
        n_free=np.full(len(counts), n_free, np.int32),
        n_targets=np.full(len(counts), n_free, np.int32),
        distance=np.zeros(shape, np.int16),
        roles=np.full(shape, -1, np.int8) if roles is None else np.array(roles, np.int8),
        decision_seconds=np.zeros(counts.shape, np.float32),
        timing={"seconds": 1.0, "batch_size": 1},
        bounds=np.full(len(counts), np.nan),
    )


def drawn_records(seed: int, episodes: int = 8, horizon: int = 12) -> EpisodeRecords:
    """Records of random episodes, of which most see all of the map."""
    rng = np.random.default_rng(seed)
    seen = np.minimum(rng.integers(0, 25, (episodes, horizon)).cumsum(axis=1), 100)
    roles = rng.integers(0, 2, (episodes, horizon, 2))
    return records_of(seen, 100, roles, ["explore", "cover"])


def entrant(row: str, seed: int | None = None) -> Entrant:
    if seed is None:
        return Entrant(row, row)
    return Entrant(row, f"logs/{row}_{seed}", True, training_seed=seed, env_steps=500_000)


def results_of() -> Results:
    played: dict[Any, list[Played]] = {}
    for k, column in enumerate((HARD, EASY)):
        played["greedy", column] = [Played(entrant("greedy"), drawn_records(k))]
        played["oracle", column] = [Played(entrant("oracle"), drawn_records(10 + k))]
        played["hmappo", column] = [
            Played(entrant("hmappo", seed), drawn_records(20 + 5 * k + seed)) for seed in (1, 2, 3)
        ]
    return played


def make_run(
    folder: Path, rows: Sequence[tuple[object, object, object]], config: str | None = None
) -> Path:
    folder.mkdir(parents=True)
    text = "env: area-search-v0\nenv_kwargs: {scene: easy, sub_goal: assigned, known_map: true}\n"
    (folder / "config.yml").write_text(text if config is None else config)
    lines = ["time/env_steps,train/loss,rollout/explo_paper,rollout/cover"]
    lines += [f"{step},0.5,{explored},{covered}" for step, explored, covered in rows]
    (folder / "progress.csv").write_text("\n".join(lines) + "\n")
    return folder


def logs_of(folder: Path) -> Logs:
    rows = [(1000 * k, 0.1 * k, 0.05 * k) for k in range(1, 11)]
    more = [(step, 0.9 * explored, covered) for step, explored, covered in rows[:8]]
    return {"hmappo": [make_run(folder / "a", rows), make_run(folder / "b", more)]}


# The numbers.


def test_a_band_is_the_interval_of_each_step() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=(6, 5))
    values[rng.random((6, 5)) < 0.3] = np.nan
    values[:, 3] = np.nan
    values[1:, 4] = np.nan
    values[0, 4] = 7.0
    found = np.array(mean_band(values)).T
    for step in range(5):
        known = values[~np.isnan(values[:, step]), step]
        mean, _, low, high = estimate_mean(known)
        expected = [np.nan if one is None else one for one in (mean, low, high)]
        np.testing.assert_allclose(found[step], expected, rtol=1e-12)
    assert np.isnan(found[3]).all()
    assert found[4, 0] == 7.0


def test_curves_of_one_entrant_are_means_over_episodes() -> None:
    figure = parse_plan(PLAN).figures["curves"]
    played = [Played(entrant("greedy"), records_of([[2, 6], [4, 12]]))]
    explored, covered = collect(figure, {("greedy", HARD): played}, {}, pytest.fail)
    assert isinstance(explored, Curve) and isinstance(covered, Curve)
    assert (explored.row, explored.column, explored.metric) == ("greedy", HARD, "explo_paper")
    assert explored.x.tolist() == [1, 2]
    np.testing.assert_allclose(explored.mean, [30.0, 90.0])
    np.testing.assert_allclose(covered.mean, [15.0, 45.0])
    # Two values, 10 % from their mean; Student's t for one degree of freedom is 12.706.
    np.testing.assert_allclose(explored.high - explored.mean, [127.06, 381.19], rtol=1e-4)
    assert explored.origin == (0, 2, None)


def test_curves_of_several_seeds_end_where_the_tables_are() -> None:
    figure = parse_plan(PLAN).figures["curves"]
    results = results_of()
    curves = collect(figure, results, {}, pytest.fail)
    (curve,) = [
        one for one in curves if (one.row, one.column, one.metric) == ("hmappo", HARD, "cover")
    ]
    assert isinstance(curve, Curve)
    means = np.array(
        [100 * one.records.curves["cover"].mean(axis=0) for one in results["hmappo", HARD]]
    )
    np.testing.assert_allclose(curve.mean, means.mean(axis=0))
    for step in (0, 5, 11):
        low, high = interval_over_runs(means[:, [step]])
        np.testing.assert_allclose([curve.low[step], curve.high[step]], [low, high])
    score = score_cell(results["hmappo", HARD])["cover"]
    np.testing.assert_allclose(
        [curve.mean[-1], curve.low[-1], curve.high[-1]], [score.mean, score.low, score.high]
    )
    assert curve.origin == (3, 8, 500_000)


def test_role_shares_are_of_the_robots_that_act() -> None:
    roles = [[[0, 1], [1, 1], [-1, -1]], [[0, 0], [1, 0], [1, 1]]]
    records = records_of([[0, 0, 0]] * 2, roles=roles, role_names=["explore", "cover"])
    shares = role_shares(records, "cover")
    np.testing.assert_array_equal(shares, [[0.5, 1.0, np.nan], [0.0, 0.5, 1.0]])
    np.testing.assert_array_equal(
        role_shares(records, "explore"), 1.0 - np.array(shares, np.float64)
    )
    assert role_shares(records, "guard") is None


def test_switches_are_changes_from_the_step_before() -> None:
    roles = [[[0, 1], [1, 1], [-1, -1]], [[0, 0], [0, 0], [1, 0]]]
    records = records_of([[0, 0, 0]] * 2, roles=roles, role_names=["explore", "cover"])
    np.testing.assert_array_equal(role_switches(records), [[0.5, np.nan], [0.0, 0.5]])
    assert role_switches(records_of([[1, 2]])) is None


def test_curves_of_switching_begin_at_the_second_step() -> None:
    figure = replace(parse_plan(PLAN).figures["switches"], rows=("mappo", "hmappo"))
    played = [Played(entrant("hmappo", seed), drawn_records(seed)) for seed in (1, 2)]
    results = {
        ("hmappo", HARD): played,
        ("mappo", HARD): [Played(entrant("mappo", 1), records_of([[1, 2]]))],
    }
    lines: list[str] = []
    (curve,) = collect(figure, results, {}, lines.append)
    assert lines == ["figure switches: mappo has no roles, it is left out"]
    assert isinstance(curve, Curve)
    assert curve.x.tolist() == list(range(2, 13))
    expected = np.mean(
        [
            (one.records.roles[:, 1:] != one.records.roles[:, :-1]).mean(axis=(0, 2))
            for one in played
        ],
        axis=0,
    )
    np.testing.assert_allclose(curve.mean, 100 * expected)
    assert (curve.low <= curve.mean).all() and (curve.mean <= curve.high).all()
    (first, *_) = csv_of([curve]).decode().splitlines()[1:]
    assert first.startswith("hmappo,hard,4,switched,2,")


def test_rows_without_the_role_are_left_out_with_a_line() -> None:
    figure = replace(parse_plan(PLAN).figures["shares"], rows=("mappo", "hmappo"))
    results = {
        (row, column): [Played(entrant(row, 1), drawn_records(1))]
        for row in figure.rows
        for column in figure.columns
    }
    for column in figure.columns:
        results["mappo", column] = [Played(entrant("mappo", 1), records_of([[1, 2]]))]
    lines: list[str] = []
    curves = collect(figure, results, {}, lines.append)
    assert {curve.row for curve in curves} == {"hmappo"}
    assert lines == [
        "figure shares: mappo has no role cover, it is left out",
        "figure shares: mappo has no role explore, it is left out",
    ]


def test_bars_are_the_tables_numbers() -> None:
    figure = parse_plan(PLAN).figures["times"]
    slow = records_of([[1, 2, 3], [2, 3, 9]])
    fast = records_of([[5, 10, 10]] * 4)
    edge = records_of([[0, 0, 10], *[[0, 0, 9]] * 4])
    results = {
        ("greedy", HARD): [Played(entrant("greedy"), slow)],
        ("greedy", EASY): [Played(entrant("greedy"), fast)],
        ("hmappo", HARD): [Played(entrant("hmappo", 1), edge)],
        ("hmappo", EASY): [Played(entrant("hmappo", seed), fast) for seed in (1, 2)],
    }
    bars = collect(figure, results, {}, pytest.fail)
    by_place = {(one.row, one.column, one.metric): one for one in bars if isinstance(one, Bar)}
    assert len(by_place) == 8
    never = by_place["greedy", HARD, "time_e_paper"]
    assert never.score.mean is None
    one_of_two = by_place["greedy", HARD, "t90_true"].score
    assert (one_of_two.mean, one_of_two.low, one_of_two.share) == (2.0, None, 0.5)
    for row in ("greedy", "hmappo"):
        for metric in figure.metrics:
            score = by_place[row, EASY, metric].score
            assert (score.mean, score.low, score.high) == (1.0, 1.0, 1.0)
    # Of resamples of these episodes, some do not get above 90 % within the three steps.
    late = by_place["hmappo", HARD, "time_e_paper"]
    assert late.score.mean == 2.0
    assert late.open_ended
    assert not never.open_ended
    # That of the free cells is Student's, whose end is one wherever it is.
    assert not any(one.open_ended for one in by_place.values() if one.metric == "t90_true")
    assert late.origin == (1, 5, 500_000)


# The logs of trainings.


def test_rewards_are_counts_over_their_normalizers(tmp_path: Path) -> None:
    config = "env_kwargs: {scene: easy, explore_normalizer: 5.0, sub_goal: assigned}\n"
    rows = [(100, "", ""), (200, 0.5, 0.1), (300, 0.8, 0.25), (200, 0.6, 0.2)]
    log = read_training_log(make_run(tmp_path / "run", rows, config))
    assert log.steps.tolist() == [200, 300]
    # 375 free cells, 350 targets; after a crash, a run was resumed at step 200.
    np.testing.assert_allclose(log.rewards["explore_reward"], [0.6 * 75, 0.8 * 75])
    np.testing.assert_allclose(log.rewards["cover_reward"], [70.0, 87.5])


def test_the_scene_is_the_default_one_without_another(tmp_path: Path) -> None:
    log = read_training_log(make_run(tmp_path / "run", [(100, 1.0, 1.0)], "env_kwargs:\n"))
    assert log.rewards["explore_reward"] == [125.0]
    assert log.rewards["cover_reward"] == [100.0]


@pytest.mark.parametrize("window", [1, 3, 5])
def test_smoothing_is_a_rolling_mean(window: int) -> None:
    values = np.random.default_rng(3).normal(size=9)
    reach = window // 2
    slow = [np.mean(values[max(0, k - reach) : k + reach + 1]) for k in range(9)]
    np.testing.assert_allclose(smoothed(values, window), slow)
    np.testing.assert_allclose(
        smoothed(values[:2], window)[0], np.mean(values[: 1 + min(reach, 1)])
    )


def test_runs_of_different_lengths_are_compared_while_all_run() -> None:
    def run(first: int, last: int, every: int, slope: float) -> TrainingLog:
        steps = np.arange(first, last + 1, every)
        return TrainingLog(steps, {"cover_reward": slope * steps})

    steps, values = common_curves([run(0, 100, 10, 1.0), run(5, 75, 10, 3.0)], "cover_reward")
    assert steps.tolist() == list(range(5, 76, 5))
    # Smoothing leaves straight lines as they are, but near their ends.
    inner = (steps >= 25) & (steps <= 55)
    np.testing.assert_allclose(values[0, inner], steps[inner])
    np.testing.assert_allclose(values[1, inner], 3.0 * steps[inner])


def test_training_curves_have_the_band_of_their_seeds(tmp_path: Path) -> None:
    figure = parse_plan(PLAN).figures["train"]
    logs = logs_of(tmp_path)
    explore, cover = collect(figure, {}, logs, pytest.fail)
    assert isinstance(explore, Curve) and isinstance(cover, Curve)
    assert explore.x.tolist() == [1000 * k for k in range(1, 9)]
    np.testing.assert_allclose(explore.high[3], 125 * 0.4)
    np.testing.assert_allclose(explore.low[3], 0.9 * 125 * 0.4)
    np.testing.assert_allclose(explore.mean, (explore.low + explore.high) / 2)
    assert explore.origin == (2, None, 8000)
    (one, _) = collect(figure, {}, {"hmappo": logs["hmappo"][:1]}, pytest.fail)
    assert isinstance(one, Curve)
    assert np.isnan(one.low).all()


ROWS = [(1000, 0.1, 0.1), (2000, 0.2, 0.2)]


def test_runs_without_a_common_step_are_left_out_with_a_line(tmp_path: Path) -> None:
    early = make_run(tmp_path / "early", ROWS)
    late = make_run(tmp_path / "late", [(3000, 0.1, 0.1), (4000, 0.2, 0.2)])
    lines: list[str] = []
    figure = parse_plan(PLAN).figures["train"]
    assert not collect(figure, {}, {"hmappo": [early, late]}, lines.append)
    assert lines == ["figure train: hmappo is left out: its runs share no joint steps"]


@pytest.mark.parametrize(
    ("rows", "config", "says"),
    [
        ([], None, "no rewards yet"),
        ([(1000, "", "")], None, "no rewards yet"),
        ([*ROWS, (3000, "nan", 0.1)], None, "no numbers"),
        ([*ROWS, (3000, "0.1", "what")], None, "damaged: could not convert"),
        ([*ROWS, ("3000,1", 0.1, 0.1)], None, "damaged: a row has not as many"),
        ([*ROWS, ("\0", 0.1, 0.1)], None, "damaged"),
        (ROWS, "env_kwargs: {scene: hart}", "unknown scene 'hart'"),
        (ROWS, "env_kwargs: {n_targets: 999}", "n_targets must be"),
        (ROWS, "env_kwargs: {scene: [hard]}", "names no scene"),
        (ROWS, "env_kwargs: 3", "names no scene"),
        (ROWS, "- a list", "names no scene"),
        (ROWS, "{", "names no scene"),
    ],
)
def test_a_damaged_run_is_left_out_with_a_line(
    tmp_path: Path, rows: list[tuple[Any, Any, Any]], config: str | None, says: str
) -> None:
    bad = make_run(tmp_path / "bad", rows, config)
    with pytest.raises(TrainingLogError, match=re.escape(says)) as error:
        read_training_log(bad)
    assert str(bad) in one_line(error.value)
    logs = logs_of(tmp_path)
    lines: list[str] = []
    figure = parse_plan(PLAN).figures["train"]
    curves = collect(figure, {}, {"hmappo": [bad, *logs["hmappo"]]}, lines.append)
    assert [curve.origin.seeds for curve in curves] == [2, 2]
    (line,) = lines
    assert line == f"figure train: hmappo: a run is left out: {error.value}"


@pytest.mark.parametrize("name", ["progress.csv", "config.yml"])
def test_missing_files_and_columns_and_cut_rows(tmp_path: Path, name: str) -> None:
    run = make_run(tmp_path / "run", ROWS)
    content = (run / name).read_text()
    (run / name).unlink()
    with pytest.raises(TrainingLogError, match=f"{name}: No such file"):
        read_training_log(run)
    (run / name).write_bytes(b"\xff\xfe\x00")
    with pytest.raises(TrainingLogError, match=name):
        read_training_log(run)
    (run / name).write_text(content)
    if name == "progress.csv":
        (run / name).write_text(content.replace("rollout/cover", "rollout/other"))
        with pytest.raises(TrainingLogError, match="no column 'rollout/cover'"):
            read_training_log(run)
        (run / name).write_text(content)
        whole = read_training_log(run)
        # What a training has half written is not there yet; a whole line is, however short.
        for part in ("3000,0.5,0", "3000,0.5,0.4", "3", '"'):
            (run / name).write_text(content + part)
            assert read_training_log(run).steps.tolist() == whole.steps.tolist() == [1000, 2000]
        (run / name).write_text(content + "3000,0.5\n")
        with pytest.raises(TrainingLogError, match="not as many entries"):
            read_training_log(run)


# Captions and tables of the drawn numbers: without matplotlib.


def test_a_caption_says_what_is_shown(tmp_path: Path) -> None:
    plan, results, logs = parse_plan(PLAN), results_of(), logs_of(tmp_path)

    def text(name: str, quick: bool = False) -> str:
        return caption(plan.figures[name], quick, plan, results, logs)

    curves = text("curves")
    assert curves.startswith("Curves. ")
    assert "8 episodes of each row and seed." in curves
    assert "Trained: HMAPPO, 3 seeds of 500,000 joint steps." in curves
    assert "Not there: MAPPO." in curves
    assert "95 % intervals over the episodes, for rows with several seeds over the seeds" in curves
    assert "uick form" not in curves
    assert text("curves", quick=True) == f"{curves} Quick form: 8 episodes."
    train = text("train")
    assert "rolling mean over 5 rollouts" in train
    assert "Bands: lowest to highest seed." in train
    assert "HMAPPO, 2 seeds of 8,000 joint steps" in train
    assert "uick form" in text("train", quick=True)
    assert "cover solid, explore dashed" in text("shares")
    assert "whose role is another one than in the step before, in %." in text("switches")
    assert "counted from 0" in text("times")


def test_a_caption_tells_which_rows_played_less() -> None:
    plan, results = parse_plan(PLAN), dict(results_of())
    for column in (HARD, EASY):
        results["oracle", column] = [Played(entrant("oracle"), drawn_records(1, episodes=4))]
    text = caption(plan.figures["curves"], True, plan, results, {})
    assert "8 episodes of each row and seed (Oracle: 4)." in text
    assert text.endswith("Quick form: 4 to 8 episodes.")


def test_a_caption_of_nothing_says_so() -> None:
    plan = parse_plan(PLAN)
    for figure in plan.figures.values():
        text = caption(figure, True, plan, {}, {})
        assert text.endswith(
            f"Not there: {', '.join(plan.rows[row].label for row in figure.rows)}."
        )


def test_the_csv_has_the_drawn_numbers() -> None:
    plan, results = parse_plan(PLAN), results_of()
    curves = collect(plan.figures["curves"], results, {}, pytest.fail)
    table = list(csv.DictReader(io.StringIO(csv_of(curves).decode())))
    assert len(table) == 12 * len(curves) == 12 * 3 * 2
    first, curve = table[0], curves[0]
    assert isinstance(curve, Curve)
    assert first["row"] == "greedy" and first["scene"] == "hard" and first["n_agents"] == "4"
    assert (first["metric"], first["step"], first["seeds"]) == ("explo_paper", "1", "0")
    for key in ("mean", "low", "high"):
        assert float(first[key]) == pytest.approx(getattr(curve, key)[0], rel=1e-5)
    bars = collect(plan.figures["times"], results, {}, pytest.fail)
    table = list(csv.DictReader(io.StringIO(csv_of(bars).decode())))
    assert [one["share"] == "" for one in table] == [one.metric != "t90_true" for one in bars]
    means = [one.score.mean for one in bars if isinstance(one, Bar)]
    assert [float(one["mean"]) if one["mean"] else None for one in table] == pytest.approx(
        means, rel=1e-5
    )


def test_rows_of_the_shipped_plan_differ_in_grey_and_in_color() -> None:
    plan = parse_plan(yaml.safe_load((ROOT / "zoo_configs" / "tables.yml").read_text()))
    styles = looks(plan)
    assert len({(str(one.dashes), one.marker, one.filled) for one in styles.values()}) == len(
        styles
    )
    for figure in plan.figures.values():
        shown = [styles[row] for row in figure.rows]
        assert len({(one.marker, one.filled) for one in shown}) == len(shown)
        assert len({(one.color, one.filled) for one in shown}) == len(shown)
        if figure.kind == "time_e":
            assert len({one.hatch for one in shown}) == len(shown)


# The files.


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> tuple[Plan, Results, Logs, list[Path]]:
    pytest.importorskip("matplotlib")
    folder = tmp_path_factory.mktemp("figures")
    plan, results, logs = parse_plan(PLAN), results_of(), logs_of(folder)
    with pytest.MonkeyPatch.context() as patch:
        # Nothing may import it: it would choose a backend for the whole process.
        patch.setitem(sys.modules, "matplotlib.pyplot", None)
        paths = draw_figures(plan, results, logs, folder / "new" / "drawn", True, pytest.fail)
    return plan, results, logs, paths


def texts(path: Path) -> list[str]:
    return [one.text or "" for one in ElementTree.parse(path).iter() if one.tag.endswith("}text")]


def test_every_figure_has_four_files(drawn: tuple[Plan, Results, Logs, list[Path]]) -> None:
    plan, _, _, paths = drawn
    assert [path.name for path in paths] == [
        f"{name}.{suffix}" for name in plan.figures for suffix in ("svg", "pdf", "png", "csv")
    ]
    assert sorted(paths) == sorted(paths[0].parent.iterdir())
    for path in paths:
        content = path.read_bytes()
        if path.suffix == ".svg":
            root = ElementTree.fromstring(content)
            assert root.tag == "{http://www.w3.org/2000/svg}svg"
            assert root.get("aria-label") == f"{plan.figures[path.stem].caption}."
            assert not any(one.tag.endswith("}style") for one in root.iter())
        elif path.suffix == ".png":
            assert content.startswith(b"\x89PNG\r\n\x1a\n")
            assert content.endswith(b"IEND\xaeB`\x82")
        elif path.suffix == ".pdf":
            assert content.startswith(b"%PDF-")


def test_pictures_have_labels_units_and_the_quick_form(
    drawn: tuple[Plan, Results, Logs, list[Path]],
) -> None:
    found = {path.stem: texts(path) for path in drawn[3] if path.suffix == ".svg"}
    for name, said in found.items():
        assert any(text.startswith("quick form") for text in said), name
    assert "quick form: 8 episodes" in found["curves"]
    assert {"Greedy <&> $1$", "Oracle", "HMAPPO"} < set(found["curves"])
    assert {"step", "newly seen / free cells (%)", "Hard, 4 robots"} < set(found["curves"])
    assert "MAPPO" not in found["curves"]
    assert "joint steps of the training (thousands)" in found["train"]
    assert {"role cover", "role explore", "Easy"} < set(found["shares"])
    assert "4 robots: step" in found["times"]


def test_several_figures_can_be_part_of_one_page(
    drawn: tuple[Plan, Results, Logs, list[Path]],
) -> None:
    seen: set[str] = set()
    for path in drawn[3]:
        if path.suffix == ".svg":
            text = path.read_text(encoding="utf-8")
            ids = re.findall(r'\bid="([^"]+)"', text)
            assert len(ids) == len(set(ids))
            assert not seen & set(ids)
            seen |= set(ids)
            used = re.findall(r'href="#([^"]+)"', text) + re.findall(r"url\(#([^)]+)\)", text)
            assert used
            assert set(used) <= set(ids)
            assert "<?xml" not in text


def test_the_same_numbers_give_the_same_files(
    drawn: tuple[Plan, Results, Logs, list[Path]], tmp_path: Path
) -> None:
    import matplotlib

    plan, results, logs, paths = drawn
    part = replace(plan, figures={name: plan.figures[name] for name in ("train", "times")})
    with matplotlib.rc_context({"font.size": 20.0, "axes.grid": False, "svg.hashsalt": "mine"}):
        before = dict(matplotlib.rcParams)
        again = draw_figures(part, results, logs, tmp_path, True, pytest.fail)
        assert dict(matplotlib.rcParams) == before
    first = {path.name: path.read_bytes() for path in paths}
    assert len(again) == 8
    for path in again:
        assert path.read_bytes() == first[path.name], path.name


def test_the_full_form_does_not_speak_of_another(
    drawn: tuple[Plan, Results, Logs, list[Path]], tmp_path: Path
) -> None:
    plan, results, *_ = drawn
    part = replace(plan, figures={"shares": plan.figures["shares"]})
    paths = draw_figures(part, results, {}, tmp_path)
    assert not any("quick" in text for text in texts(paths[0]))


def with_points(**points: Any) -> dict[str, Any]:
    """Return the plan with what the paper's figure of the curves shows."""
    curves = {**PLAN["figures"]["curves"], "paper": points}
    return {**PLAN, "figures": {**PLAN["figures"], "curves": curves}}


def test_what_the_paper_shows_is_drawn_and_said(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    shown = {"hmappo": {"hard": {"cover": {12: 64.1, 1: 3}}}, "mappo": {"hard": {"cover": {9: 1}}}}
    plan, results = parse_plan(with_points(**shown)), results_of()
    figure = plan.figures["curves"]
    assert figure.paper["hmappo", "hard", "cover"] == ((1, 3), (12, 64.1))
    assert "Stars: what the paper's figure shows." in caption(figure, False, plan, results, {})
    only = replace(plan, figures={"curves": figure})
    draw_figures(only, results, {}, tmp_path, warn=pytest.fail)
    without = replace(only, figures={"curves": parse_plan(PLAN).figures["curves"]})
    draw_figures(without, results, {}, tmp_path / "without", warn=pytest.fail)
    assert "the paper" in texts(tmp_path / "curves.svg")
    assert "the paper" not in texts(tmp_path / "without" / "curves.svg")


@pytest.mark.parametrize(
    ("points", "said"),
    [
        ({"planer": {}}, "unknown row 'planer'"),
        ({"hmappo": {"easy": {}}}, "unknown key 'easy'"),
        ({"hmappo": {"hard": {"time": {}}}}, "unknown key 'time'"),
        ({"hmappo": {"hard": {"cover": {0: 1}}}}, "steps from 1 on"),
        ({"hmappo": {"hard": {"cover": {1: float("nan")}}}}, "numbers from 0"),
        ({"hmappo": {"hard": {"cover": [1]}}}, "keys and values"),
    ],
)
def test_points_that_can_not_be_drawn_are_refused(points: dict[str, Any], said: str) -> None:
    with pytest.raises(PlanError, match=said):
        parse_plan(with_points(**points))


def test_figures_of_nothing_are_not_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    plan = parse_plan(PLAN)
    lines: list[str] = []
    assert draw_figures(plan, {}, {}, tmp_path / "none", warn=lines.append) == []
    assert lines == [f"figure {name}: there is nothing to draw" for name in plan.figures]
    assert not (tmp_path / "none").exists()
    part = replace(plan, figures={"times": plan.figures["times"]})
    with pytest.warns(UserWarning, match="figure times: there is nothing to draw"):
        draw_figures(part, {}, {}, tmp_path)


def test_bars_that_are_all_missing_are_dashes(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    plan = parse_plan(PLAN)
    part = replace(plan, figures={"times": plan.figures["times"]})
    slow = [Played(entrant("greedy"), records_of([[1, 2, 3], [2, 3, 4]]))]
    paths = draw_figures(part, {("greedy", HARD): slow}, {}, tmp_path, warn=pytest.fail)
    assert texts(paths[0]).count("\N{EN DASH}") == 2
    assert "A dash: never." in caption(
        part.figures["times"], False, part, {("greedy", HARD): slow}, {}
    )


def test_without_matplotlib_it_is_said_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    plan = parse_plan(PLAN)
    with pytest.raises(ImportError, match=r"pip install sb3_roles\[plots\]") as error:
        draw_figures(plan, results_of(), {}, tmp_path, warn=lambda line: None)
    assert one_line(error.value)
