"""``sb3-roles ablations``: which runs count, what intervals say, what is trained and written."""

from __future__ import annotations

import csv
import shlex
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from grids import TINY, make_run

from sb3_roles.baselines import controller_class
from sb3_roles.common.checkpoint import CheckpointFolder
from sb3_roles.evaluation.episodes import held_out_seed, run_episodes
from sb3_roles.evaluation.grid.entrants import Entrant, Played
from sb3_roles.evaluation.grid.plan import Column, PlanError, Row
from sb3_roles.evaluation.intervals import estimate_mean, t_quantile
from sb3_roles.evaluation.records import read_records
from sb3_roles.evaluation.tables.ablations import About, compare, to_csv, to_markdown
from sb3_roles.evaluation.tables.differences import ALIKE, BETTER, WORSE, Difference, difference
from sb3_roles.zoo.ablation_file import Ablations, parse_ablations
from sb3_roles.zoo.ablation_runs import (
    Found,
    changes_of,
    commands_of,
    find_runs,
    missing_lines,
    train_missing,
)
from sb3_roles.zoo.cli import make_parser
from sb3_roles.zoo.config import config_file, read_yaml
from sb3_roles.zoo.models import make_env, make_model, small_config
from sb3_roles.zoo.row_configs import config_of_row, method_of_row
from sb3_roles.zoo.train_jobs import GIVEN, new_jobs

SMALL = {key: value for key, value in TINY.items() if key != "n_timesteps"}


def data(**changes: Any) -> dict[str, Any]:
    """Return what a small file says."""
    return {
        "episodes": 4,
        "seed": 2000,
        "n_timesteps": 8,
        "seeds": [0, 1],
        "scenes": {"easy": "Easy"},
        "n_agents": [2],
        "variants": {
            "base": {"label": "Base", "algo": "hmappo", "params": SMALL},
            "flat": {"label": "Flat", "of": "base", "params": {"gamma": 0.5}, "note": "short"},
        },
        "studies": {"one": {"caption": "One", "reference": "base", "variants": ["flat"]}},
    } | changes


# Differences


def test_the_difference_of_single_runs_is_that_of_their_episodes():
    rng = np.random.default_rng(0)
    ours, theirs = rng.normal(1, 1, (1, 30)), rng.normal(0, 1, (1, 30))
    found = difference(ours, theirs)
    mean, _, low, high = estimate_mean((ours - theirs)[0])
    assert found == pytest.approx((mean, low, high, False))
    # Of a single episode nothing is known.
    assert difference(ours[:, :1], theirs[:, :1])[1:] == (None, None, False)
    with pytest.raises(ValueError, match="no pairs"):
        difference(ours, theirs[:, :-1])


def test_trainings_are_two_samples_and_the_same_runs_are_pairs():
    # No noise of episodes: what is left are the textbook's t intervals.
    ours, theirs = np.array([3.0, 5.0, 7.0]), np.array([1.0, 2.0, 6.0])
    values = [np.repeat(each[:, None], 4, axis=1) for each in (ours, theirs)]
    pooled = (8.0 + 14.0) / 4
    reach = t_quantile(4) * np.sqrt(pooled * (1 / 3 + 1 / 3))
    assert difference(*values) == pytest.approx((2.0, 2.0 - reach, 2.0 + reach, True))
    _, _, low, high = estimate_mean(ours - theirs)
    assert difference(*values, same_runs=True) == pytest.approx((2.0, low, high, True))
    # One run has the variance of the others.
    one = np.full((1, 4), 9.0)
    reach = t_quantile(2) * np.sqrt(14.0 / 2 * (1 + 1 / 3))
    assert difference(one, values[1]) == pytest.approx((6.0, 6.0 - reach, 6.0 + reach, True))
    assert difference(values[0], values[0], same_runs=True)[:3] == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("n_runs", [2, 3])
def test_of_equal_variants_one_in_twenty_is_told_apart(n_runs):
    rng = np.random.default_rng(n_runs)
    wrong = 0
    for _ in range(1000):
        # Maps that are hard for all, maps that one variant likes, seeds, and the rest.
        maps, tastes = rng.normal(0, 5, 60), rng.normal(0, 2, (2, 60))
        seeds, rest = rng.normal(0, 0.5, (2, n_runs, 1)), rng.normal(0, 3, (2, n_runs, 60))
        values = maps + tastes[:, None] + seeds + rest
        wrong += difference(values[0], values[1]).verdict != ALIKE
    assert 0.01 < wrong / 1000 < 0.07


def test_verdicts_are_those_of_the_interval():
    assert Difference(1.0, 0.1, 2.0, True).verdict == BETTER
    assert Difference(-1.0, -2.0, -0.1, True).verdict == WORSE
    assert Difference(1.0, -0.1, 2.0, True).verdict == ALIKE
    assert Difference(1.0, None, None, False).verdict == ALIKE


# The file


def test_a_change_takes_over_the_rest():
    variants = data()["variants"]
    variants["both"] = {"label": "x", "of": "flat", "params": {"env_kwargs": {"horizon": 5}}}
    variants["both"] |= {"seeds": [4, 2], "n_timesteps": 20, "drawn": True}
    found = parse_ablations(data(variants=variants)).variants
    assert found["both"].row.params == {
        **SMALL,
        "gamma": 0.5,
        "env_kwargs": {"horizon": 5, "n_agents": 2},
    }
    assert (found["both"].seeds, found["both"].n_timesteps) == ((2, 4), 20)
    assert (found["both"].row.drawn, found["both"].row.about) == (True, "")
    assert (found["flat"].seeds, found["flat"].n_timesteps) == ((0, 1), 8)
    assert changes_of(found["flat"], found["base"]) == "gamma 0.95 -> 0.5"
    assert changes_of(found["both"], found["flat"]) == (
        "horizon 4 -> 5, n_timesteps 8 -> 20, drawn false -> true"
    )
    assert changes_of(found["base"], found["base"]) == ""


def test_the_reference_plays_with_roles_that_are_not_its_own():
    study = {"caption": "x", "reference": "base", "played": ["explore", "nearest"]}
    found = parse_ablations(data(studies={"roles": study}))
    assert found.studies["roles"].variants == ("base", "base_plays_explore", "base_plays_nearest")
    one = found.variants["base_plays_explore"]
    assert (one.runs_of, one.row.role_control) == ("base", "explore")
    assert changes_of(one, found.variants["base"]) == "roles while playing: explore"


@cache
def shipped() -> Ablations:
    return parse_ablations(read_yaml(config_file("ablations")))


def test_the_variants_of_the_repository_can_be_trained_and_differ():
    found = shipped()
    trained = {name: one for name, one in found.variants.items() if one.runs_of == name}
    assert len(trained) > 40
    keys = [(method_of_row(one.row), one.n_timesteps) for one in trained.values()]
    assert all(keys.count(key) == 1 for key in keys)
    for study in found.studies.values():
        reference = found.variants[study.reference]
        for name in study.variants[1:]:
            assert changes_of(found.variants[name], reference), name
    used = {name for study in found.studies.values() for name in study.variants}
    assert used == set(found.variants)
    assert found.seed != read_yaml(config_file("tables"))["seed"]


# Of the others, only numbers of the training differ.
BUILT = [
    name
    for name, one in shipped().variants.items()
    if one.runs_of == name and any(key.endswith("_kwargs") for key in one.row.params)
]


@pytest.mark.parametrize("name", BUILT)
def test_a_model_can_be_made_of_each_variant(name):
    config = small_config(config_of_row(shipped().variants[name].row), 1)
    env = make_env(config)
    try:
        assert make_model(config, env).policy.action_space == env.action_space
    finally:
        env.close()


def test_mappo_can_have_as_many_parameters_as_hmappo():
    sizes = []
    for name in ("hmappo", "mappo_wide"):
        config = small_config(config_of_row(shipped().variants[name].row), 1)
        policy = make_model(config, make_env(config)).policy
        sizes.append(sum(one.numel() for one in policy.parameters()))
    assert abs(sizes[0] - sizes[1]) < 100


def test_studies_are_played_elsewhere():
    found = parse_ablations(data()).select(None, ["hard", "easy"], [2, 3])
    study = found.studies["one"]
    assert study.scenes == {"hard": "hard", "easy": "Easy"}
    assert study.columns == tuple(Column(s, n) for n in (2, 3) for s in ("hard", "easy"))
    assert len(found.plan().cells()) == 2 * 4
    with pytest.raises(PlanError, match="did you mean 'one'"):
        found.select(["on"])


# Runs


def numbers(runs: Any) -> dict[int, str]:
    return {seed: run.folder.name.rpartition("_")[2] for seed, run in runs.items()}


def test_runs_are_found_by_configuration_budget_and_seed(tmp_path):
    ablations = parse_ablations(data(seeds=[0, 1, 2, 3, 4]))
    row = ablations.variants["flat"].row
    logs, others = tmp_path / "logs", tmp_path / "others"
    make_run(logs, row, 1, 8, seed=0, n_timesteps=8)
    make_run(logs, row, 2, 12, seed=0, n_timesteps=8)  # Newer, and a whole rollout longer.
    make_run(logs, row, 3, 16, seed=1, n_timesteps=16)  # Another budget: schedules differ.
    make_run(logs, row, 4, 4, seed=2, n_timesteps=8)  # Not at its end.
    make_run(logs, row, 5, 8, seed=7, n_timesteps=8)  # Not asked for.
    make_run(logs, row, 6, 8, seed=3, n_timesteps=8, gamma=0.6)
    make_run(others, row, 1, 8, seed=0, n_timesteps=8)
    make_run(others, row, 2, 8, seed=4, n_timesteps=8)
    make_run(others, row, 3, 4, seed=3, n_timesteps=8)
    lines: list[str] = []
    found = find_runs(ablations, [logs, others], lines.append)
    assert numbers(found["flat"].runs) == {0: "2", 4: "2"}
    assert found["flat"].runs[4].folder.parent.parent == others
    assert numbers(found["flat"].begun) == {2: "4"}
    assert found["flat"].missing == (1, 3)
    assert found["base"].missing == (0, 1, 2, 3, 4)
    assert lines == [f"not taken: {others}/hmappo/area-search-v0_3 is at 4 joint steps"]
    told = missing_lines(ablations.variants["flat"], found["flat"], Path("logs"))
    begun = logs / "hmappo" / "area-search-v0_4"
    assert told[0] == (f"flat, seed 2, is at 4 of 8 joint steps: sb3-roles train --resume {begun}")
    assert [line.split(": sb3-roles")[0] for line in told[1:]] == [
        "flat, seed 1: no run",
        "flat, seed 3: no run",
    ]


def jobs_of(command: Sequence[str]) -> list[dict[str, Any]]:
    """Return what ``sb3-roles train`` would do."""
    words = vars(make_parser().parse_args(command[1:]))
    return new_jobs({k: v for k, v in words.items() if k in GIVEN and v is not None})[1]


def test_commands_are_those_of_the_variant():
    variants = data()["variants"]
    variants["flat"]["seeds"] = [3, 4, 8]
    variant = parse_ablations(data(variants=variants)).variants["flat"]
    commands = commands_of(variant, Path("logs"))
    assert len(commands) == 2
    jobs = [job for command in commands for job in jobs_of(shlex.split(command))]
    assert [job["config"]["seed"] for job in jobs] == [3, 4, 8]
    for job in jobs:
        assert {**job["config"], "seed": 0} == {**config_of_row(variant.row), "n_timesteps": 8}


def test_what_is_trained_is_what_the_command_says(monkeypatch, tmp_path):
    trained: list[dict[str, Any]] = []
    monkeypatch.setattr("sb3_roles.zoo.job.run_job", lambda job: trained.append(job) or 0)
    variants = data()["variants"]
    variants["letter"] = {"label": "x", "algo": "hmappo", "conf": "hmappo_paper", "seeds": [5]}
    own = parse_ablations(data(variants=variants)).variants["letter"]
    for one in (own, *shipped().variants.values()):
        variant = replace(one, seeds=one.seeds[-1:])
        trained.clear()
        nothing = Found({}, {}, variant.seeds)
        told: list[str] = []
        options = {"device": "cpu", "verbose": 0}
        assert train_missing(variant, nothing, tmp_path, options, told.append) == (0, False)
        assert len(trained) == len(told) == 1
        for job, command in zip(trained, told, strict=True):
            assert job["command"] == shlex.split(command)
            (wanted,) = jobs_of(job["command"])
            assert job["config"] == wanted["config"]
            assert job["options"]["log_folder"] == wanted["options"]["log_folder"]


# The command


@pytest.fixture
def tell(tell, tmp_path, monkeypatch):
    """Run the command in an empty folder: exit code, and the lines of its two outputs."""
    monkeypatch.chdir(tmp_path)

    def run(*args: str, **changes: Any) -> tuple[int, list[str], list[str]]:
        (tmp_path / "plan.yml").write_text(yaml.safe_dump(data(**changes)))
        plan = () if "--plan" in args else ("--plan", "plan.yml")
        code, out, err = tell("ablations", *plan, *args)
        return code, out.splitlines(), err.splitlines()

    return run


STUDY = data()["studies"]["one"]
BASE = data()["variants"]["base"]
WRONG: list[tuple[list[str], dict[str, Any], str]] = [
    (["--studies", "two"], {}, "unknown study 'two': allowed are one"),
    (["--scenes", "hrad"], {}, "did you mean 'hard'?"),
    (["--n-agents", "two"], {}, "numbers of robots with commas between, got 'two'"),
    (["--runs", "nowhere"], {}, "--runs: 'nowhere' is no folder"),
    (["-f", "nowhere"], {}, "--log-folder: 'nowhere' is no folder"),
    (["-o", "plan.yml"], {}, "--out: plan.yml is no folder"),
    (["--train", "--dry-run"], {}, "not both"),
    (["--plan", "no.yml"], {}, "no.yml: No such file"),
    ([], {"seed": 1000}, "seed must not be 1000, that of tables.yml"),
    ([], {"seeds": [1, 1]}, "seeds must be a list of whole numbers, each once"),
    ([], {"seeds": [-1]}, "seeds must be a whole number of at least 0"),
    ([], {"scenes": {"hrad": "x"}}, "did you mean 'hard'?"),
    ([], {"variants": {"x": {}}}, "variant x: label is missing"),
    ([], {"variants": {"x": {"label": "x"}}}, "variant x: give either algo, or of"),
    ([], {"variants": {"x": {"label": "x", "algo": "hmapo"}}, "studies": {}}, "'hmappo'?"),
    ([], {"variants": {"x": {"label": "x", "of": "y"}}}, "unknown variant above 'y'"),
    ([], {"variants": {"x": {**BASE, "params": TINY}}}, "n_timesteps belongs beside params"),
    ([], {"variants": {"x": {**BASE, "params": {"gama": 1}}}, "studies": {}}, "variant x: unkn"),
    ([], {"variants": {"x": {**BASE, "conf": "ablations"}}, "studies": {}}, "unknown conf"),
    ([], {"studies": {"one": {**STUDY, "reference": "bse"}}}, "did you mean 'base'?"),
    ([], {"studies": {"one": {**STUDY, "variants": ["base"]}}}, "no variant of itself"),
    ([], {"studies": {"one": {**STUDY, "played": ["cver"]}}}, "did you mean 'cover'?"),
    ([], {"studies": {"one": {**STUDY, "n_agents": [0]}}}, "n_agents must be"),
    ([], {"studies": {"one": {"caption": "x", "reference": "base"}}}, "give variants, or played"),
    (
        [],
        {
            "variants": {"x": {"label": "x", "algo": "mappo"}},
            "studies": {"one": {"caption": "x", "reference": "x", "played": ["cover"]}},
        },
        "played: mappo has no roles",
    ),
]


@pytest.mark.parametrize(("args", "changes", "said"), WRONG)
def test_bad_input_is_one_line_before_anything_is_done(args, changes, said, tell, tmp_path):
    code, out, err = tell(*args, **changes)
    assert (code, out) == (2, [])
    assert len(err) == 1
    assert err[0].startswith("sb3-roles ablations: error: ")
    assert said in err[0]
    assert [path.name for path in tmp_path.iterdir()] == ["plan.yml"]


def rows_of(folder: Path) -> list[dict[str, str]]:
    with open(folder / "ablations.csv", newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_what_is_missing_is_listed_or_trained_and_then_played_once(tell, tmp_path):
    roles = {"caption": "Roles", "reference": "base", "played": ["explore", "random"]}
    studies = {**data()["studies"], "roles": {**roles, "note": "By others"}}
    out = tmp_path / "results" / "ablations"
    code, lines, err = tell("--dry-run", studies=studies)
    assert code == 0
    assert lines[:2] == ["base: 0 of 2 runs of 8 joint steps", "flat: 0 of 2 runs of 8 joint steps"]
    assert err[0].startswith("base, seeds 0 to 1: no run: sb3-roles train --algo hmappo -n 8 ")
    assert len(err) == 2
    assert not out.exists()
    # Without --train, what is not there is left out.
    code, lines, err = tell("--jobs", "1", studies=studies)
    assert (code, len(err)) == (0, 2)
    assert {row["mean"] for row in rows_of(out)} == {""}
    code, _, err = tell("--train", "--jobs", "1", "--num-threads", "1", studies=studies)
    assert code == 0
    runs = sorted(tmp_path.glob("logs/hmappo/*"))
    assert len(runs) == 4
    # A run tells the command that repeats it, not this one.
    assert (
        (runs[1] / "command.txt")
        .read_text()
        .startswith("sb3-roles train --algo hmappo -n 8 --seed 1 --n-seeds 1 -params ")
    )
    played = {path: read_records(path) for path in out.rglob("*.parquet")}
    assert len(played) == 2 * (1 + 1 + 2)
    assert {records.metadata["seed"] for records in played.values()} == {held_out_seed(2000)}
    fixed = [one for path, one in played.items() if "base_plays_explore" in str(path)]
    assert len(fixed) == 2
    for records in fixed:
        assert records.metadata["controller_options"]["role_control"] == "explore"
        assert (records.roles[:, 0] == 0).all()
    rows = rows_of(out)
    covers = {row["variant"]: row for row in rows if row["metric"] == "cover"}
    finals = [100 * one.curves["cover"][:, -1].mean() for one in fixed]
    assert float(covers["base_plays_explore"]["mean"]) == pytest.approx(np.mean(finals), rel=1e-5)
    assert float(covers["base_plays_explore"]["lowest"]) == pytest.approx(min(finals), rel=1e-5)
    assert covers["base_plays_explore"]["over_seeds"] == "True"
    assert covers["flat"]["seeds"] == "0 1"
    text = (out / "ablations.md").read_text()
    for said in ("gamma 0.95 -> 0.5", "* Flat: short.", "By others", "fixed explore roles"):
        assert said in text
    # Nothing is trained or played again, and the outputs are the same.
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.parquet")}
    kept = (out / "ablations.csv").read_bytes()
    code, _, err = tell("--train", "--jobs", "1", studies=studies)
    assert (code, err) == (0, [])
    assert before == {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.parquet")}
    assert (out / "ablations.csv").read_bytes() == kept
    # Elsewhere, from another folder of runs, fewer episodes.
    (tmp_path / "logs").rename(tmp_path / "moved")
    args = ("--runs", "moved", "--scenes", "hard", "--n-agents", "1", "--episodes", "2")
    code, _, err = tell("--studies", "one", *args, "--jobs", "1", studies=studies)
    assert code == 0
    keys = ("scene", "n_agents", "n_episodes", "study")
    found = {tuple(row[key] for key in keys) for row in rows_of(out)}
    assert found == {("hard", "1", "2", "one")}


def test_training_goes_on_where_a_run_stopped(tell, tmp_path):
    code, *_ = tell("--train", "--jobs", "1", seeds=[0])
    assert code == 0
    (run,) = [
        path
        for path in tmp_path.glob("logs/hmappo/*")
        if read_yaml(path / "config.yml")["gamma"] == 0.5
    ]
    folder = CheckpointFolder(run / "checkpoints")
    whole = folder.newest()[0]
    # It was stopped after its first rollout: the weights are others, but the steps count.
    checkpoint = folder.newest()[1]
    whole.unlink()
    folder.save(4, manifest={**checkpoint.manifest, "env_steps": 4}, policy=checkpoint.policy)
    err = tell("--dry-run", seeds=[0])[2]
    assert err == [
        "flat, seed 0, is at 4 of 8 joint steps: sb3-roles train --resume "
        f"{run.relative_to(tmp_path)}"
    ]
    # What was saved so is no state to go on from; the other variant plays all the same.
    code, _, err = tell("--train", "--jobs", "1", seeds=[0])
    assert code == 3
    assert err[1].startswith("flat: ")
    rows = rows_of(tmp_path / "results" / "ablations")
    assert {row["variant"] for row in rows if row["mean"]} == {"base"}


# Tables


def test_tables_say_what_was_played():
    names = ("greedy", "random")
    rows = {
        name: Row(name, label, algo="mappo", drawn=name == "worse", about=about)
        for name, label, about in (
            ("ref", "Ref", ""),
            ("worse", "Worse | x", "drawn"),
            ("same", "Same", ""),
            ("gone", "Gone", ""),
        )
    }
    text = data()
    text["variants"] = {name: {"label": "x", "algo": "mappo"} for name in rows}
    text["studies"]["one"] |= {"reference": "ref", "variants": ["worse", "same", "gone"]}
    plan = replace(parse_ablations(text).plan(), rows=rows)
    column = Column("easy", 2)
    seed = held_out_seed(2000)
    best, worst = (
        run_episodes(controller_class(name)(), "easy", 30, seed, n_agents=2) for name in names
    )
    results = {
        ("ref", column): [Played(Entrant("ref", "a", True, training_seed=0), best)],
        ("worse", column): [Played(Entrant("worse", "b", True, training_seed=0), worst)],
        ("same", column): [
            Played(Entrant("same", f"c{k}", True, training_seed=k), best) for k in range(2)
        ],
    }
    about = {name: About("" if name == "ref" else f"of {name}", 8, 2) for name in rows}
    (table,) = compare(plan.tables["one"], "", about, results)
    ref, worse, same, gone = table.lines
    assert (ref.verdict, gone.verdict) == ("", "")
    assert worse.verdict == "worse \N{DAGGER}"
    assert same.verdict == ALIKE
    assert same.differences["cover"] == (0.0, 0.0, 0.0, True)
    cover = 100 * best.curves["cover"][:, -1]
    assert ref.scores["cover"] == pytest.approx([cover.mean()] * 3)
    assert worse.scores["time_e_paper"] == (None, None, None)
    markdown = to_markdown([table], plan, ["train it"], "sb3-roles ablations")
    lines = [line for line in markdown.splitlines() if line.startswith("| ")]
    assert len({len(line) for line in lines}) == 1
    labels = [line.split(" | ")[0].strip("| ") for line in lines[2:]]
    assert labels == ["Ref", "Worse \\| x", "Same", "Gone"]
    assert "1 of 2" in lines[2] and "0 of 2" in lines[5]
    assert "* Worse \\| x: drawn; its actions are drawn." in markdown
    assert "```\ntrain it\n```" in markdown
    (line,) = [
        line
        for line in csv.DictReader(to_csv([table], plan).decode().splitlines())
        if (line["variant"], line["metric"]) == ("worse", "cover")
    ]
    assert line["verdict"] == WORSE
    assert float(line["high"]) < 0
    assert line["label"] == "Worse | x"
