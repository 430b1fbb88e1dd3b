"""``sb3-roles tables``: what it writes, what it refuses, and what a kill at any moment leaves."""

from __future__ import annotations

import csv
import multiprocessing
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from grids import TINY, assert_same, make_run, plan_data

from sb3_roles.common.checkpoint import CheckpointFolder
from sb3_roles.evaluation.grid.plan_file import parse_plan
from sb3_roles.evaluation.records import read_records
from sb3_roles.zoo import tables
from sb3_roles.zoo.cli import main
from sb3_roles.zoo.config import config_file, read_yaml, write_yaml
from sb3_roles.zoo.entrants import pack
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.row_configs import config_of_row, training_command
from sb3_roles.zoo.row_runs import RunFinder

ROOT = Path(__file__).resolve().parents[1]
PATHS = [str(ROOT / "envs"), str(ROOT), str(ROOT / "tests")]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(PATHS)}


def write_plan(folder: Path, **changes: Any) -> str:
    path = folder / "plan.yml"
    path.write_text(yaml.safe_dump(plan_data(**changes)))
    return str(path)


@pytest.fixture
def plan(tmp_path) -> str:
    return write_plan(tmp_path)


@pytest.fixture
def tell(tell, tmp_path, monkeypatch):
    """Run the command in an empty folder: exit code, and the lines of its two outputs."""
    monkeypatch.chdir(tmp_path)

    def run(*args: str, command: str = "tables") -> tuple[int, list[str], list[str]]:
        code, out, err = tell(command, *args)
        return code, out.splitlines(), err.splitlines()

    return run


def records_below(folder: Path) -> dict[str, Any]:
    paths = sorted((folder / "records").rglob("*.parquet"))
    return {str(path.relative_to(folder)): read_records(path) for path in paths}


def numbers_of(folder: Path) -> list[dict[str, str]]:
    with open(folder / "tables.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert rows
    return [{key: row[key] for key in row if key != "decision_us"} for row in rows]


def assert_same_outputs(first: Path, second: Path) -> None:
    one, other = records_below(first), records_below(second)
    assert list(one) == list(other)
    for name in one:
        assert_same(one[name], other[name])
    assert numbers_of(first) == numbers_of(second)


def test_tables_are_written_and_played_once(tell, plan, tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    # A killed writer, one that is at work, and somebody else's file.
    stale, *kept = (folder / f"{name}.partial" for name in ("tables.md.7", "tables.md.8", "mine"))
    for path in (stale, *kept):
        path.write_bytes(b"half")
    for path in (stale, kept[1]):
        os.utime(path, (1e9, 1e9))
    code, out, err = tell("--plan", plan, "-o", "out", "--jobs", "1")
    assert code == 0
    assert [line for line in out if line.startswith("wrote ")] == [
        f"wrote out/tables.{suffix}" for suffix in ("md", "tex", "csv")
    ]
    # There is one table, and it is shown.
    assert (tmp_path / "out" / "tables.md").read_text().splitlines() == out[4:]
    assert err[-1].startswith("greedy, ") or err[-1].startswith("random, ")
    assert err[-1].endswith("4 of 4 cells")
    found = records_below(tmp_path / "out")
    assert len(found) == 2 * 2 * 3
    assert not stale.exists()
    assert all(path.exists() for path in kept)
    cover = {
        (row["row"], row["scene"]): float(row["mean"])
        for row in numbers_of(tmp_path / "out")
        if row["metric"] == "cover" and row["scene"] != "all"
    }
    assert len(cover) == 4
    for (row, scene), mean in cover.items():
        one = [v for k, v in found.items() if k.startswith(f"records/{row}/{scene}-2/")]
        values = np.concatenate([records.curves["cover"][:, -1] for records in one])
        assert len(values) == 8
        assert mean == pytest.approx(100 * values.mean())
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.parquet")}
    code, again, err = tell("--plan", plan, "-o", "out", "--jobs", "1")
    assert (code, err) == (0, [])
    assert again == out
    assert before == {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.parquet")}


# (row, scene, robots) -> explo_paper and cover in %, of 500 episodes of another stream
# (docs/baselines.md); the random team's are the paper's.
KNOWN = {
    ("random", "hard", 4): (22.2, 11.2),
    ("random", "obstacles_16", 4): (18.8, 9.6),
    ("greedy", "hard", 4): (92.8, 65.3),
    ("greedy", "super_hard", 4): (97.1, 70.4),
    ("greedy", "hard", 8): (112.8, 85.0),
    ("greedy_assigned", "hard", 4): (96.3, 72.4),
    ("greedy_assigned", "super_hard", 4): (103.4, 80.0),
    ("greedy_assigned", "hard", 8): (119.2, 92.2),
}


def test_the_quick_form_of_the_papers_tables_is_plausible(tell, tmp_path):
    code, _, _ = tell(
        *("--quick", "--tables", "I,II,IV", "--rows", "random,greedy,greedy_assigned"),
        *("--jobs", "1", "--out", str(tmp_path / "out")),
    )
    assert code == 0
    found = {
        (line["row"], line["scene"], int(line["n_agents"]), line["metric"]): line
        for line in numbers_of(tmp_path / "out")
    }
    for (row, scene, n_agents), known in KNOWN.items():
        for metric, value in zip(("explo_paper", "cover"), known, strict=True):
            line = found[row, scene, n_agents, metric]
            # Half of a 95 % interval is about two standard errors: five of them.
            reach = 2.5 * (float(line["high"]) - float(line["low"])) / 2
            assert abs(float(line["mean"]) - value) < reach, (row, scene, n_agents, metric)
            assert line["n_episodes"] == "20"
    for scene in ("easy", "medium", "hard", "super_hard", "obstacles_16", "obstacles_52"):
        covers = [
            float(found[row, scene, 4, "cover"]["mean"])
            for row in ("random", "greedy", "greedy_assigned")
        ]
        assert covers == sorted(covers), scene
    assert "quick form" in (tmp_path / "out" / "tables.md").read_text().lower()


def test_a_dry_run_counts_and_writes_nothing(tell, plan, tmp_path):
    code, out, err = tell("--plan", plan, "--dry-run", "--jobs", "2", "--rows", "random")
    assert (code, err) == (0, [])
    assert out == [
        "random: 0 blocks are there, 6 are missing, time not known yet",
        "time not known yet with --jobs 2",
    ]
    assert os.listdir(tmp_path) == ["plan.yml"]
    tell("--plan", plan, "--rows", "random", "--episodes", "3", "--jobs", "1")
    (cut, _) = tmp_path.rglob("*.parquet")
    cut.write_bytes(cut.read_bytes()[:-1])
    code, out, err = tell("--plan", plan, "--dry-run", "--rows", "random", "--episodes", "3")
    assert out[0].startswith("random: 1 blocks are there, 1 are missing, about ")
    assert out[0].endswith(" on one CPU")
    assert out[1].startswith("about ")
    assert len(err) == 1
    assert cut.is_file()
    # Of greedy nothing is known.
    _, out, _ = tell("--plan", plan, "--dry-run", "--episodes", "3")
    assert out[1] == "greedy: 0 blocks are there, 2 are missing, time not known yet"
    assert out[2].startswith("more than ")
    for wrong in ("plan.yml", "plan.yml/below"):
        code, out, err = tell("--plan", plan, "--dry-run", "-o", wrong)
        assert (code, out) == (2, [])
        assert "plan.yml is no folder" in err[0]


WRONG = [
    (["--tables", "VI"], "unknown table 'VI': allowed are I"),
    (["--rows", "rndom"], "did you mean 'random'?"),
    (["--rows", ""], "unknown row ''"),
    (["--scenes", "hrad,easy"], "did you mean 'hard'?"),
    (["--figures", "x"], "unknown figure 'x'"),
    (["--plan", "no.yml"], "no.yml: No such file"),
    (["--plan", "wrong.yml"], "wrong.yml: row random: "),
    (["--plan", "algo.yml"], "algo.yml: row x: unknown algorithm 'gnm'"),
    (["--plan", "algo.yml"], "did you mean 'gnn'?"),
    (["--plan", "conf.yml"], "conf.yml: row x: unknown conf 'ecc_covrage'"),
    (["--plan", "conf.yml"], "did you mean 'ecc_coverage'?"),
    (["--plan", "params.yml"], "params.yml: row x: unknown key 'gama'"),
    (["--episodes", "0"], "from 1 to"),
    (["--jobs", "0"], "from 1 to"),
    (["--jobs", "2", "--ray", "local"], "not allowed with"),
    (["--runs", "hmapo=x"], "did you mean 'hmappo'?"),
    (["--runs", "hmappo"], "must be ROW=RUN"),
    (["--runs", "hmappo=x"], "x: no such run folder"),
    (["--runs", "hmappo=."], "no run folder, without config.yml"),
    (["--runs", "random=."], "unknown learned row 'random'"),
    (["-o", "/proc/none"], "/proc/none"),
    (["-o", "plan.yml"], "--out: plan.yml is no folder"),
    (["--tabels", "I"], "did you mean '--tables'?"),
]


@pytest.mark.parametrize(("args", "said"), WRONG)
def test_bad_input_is_one_line_before_anything_is_played(args, said, tell, tmp_path):
    rows = {**plan_data()["rows"], "hmappo": {"label": "x", "algo": "hmappo"}}
    # No table needs the rows x: they are checked all the same.
    for name, row in {
        "wrong": {"random": {}},
        "algo": {**rows, "x": {"label": "x", "algo": "gnm"}},
        "conf": {**rows, "x": {"label": "x", "algo": "ecc", "conf": "ecc_covrage"}},
        "params": {**rows, "x": {"label": "x", "algo": "ecc", "params": {"gama": 1}}},
    }.items():
        (tmp_path / f"{name}.yml").write_text(yaml.safe_dump(plan_data(rows=row)))
    plan = write_plan(tmp_path, rows=rows)
    code, out, err = tell(*([] if "--plan" in args else ["--plan", plan]), *args)
    assert (code, out) == (2, [])
    assert len(err) == 1
    assert err[0].startswith("sb3-roles tables: error: ")
    assert said in err[0]
    assert not list(tmp_path.rglob("*.parquet"))


def test_a_row_that_can_not_play_is_left_out(tell, tmp_path, monkeypatch):
    from sb3_roles.baselines import vrpc

    def refuse(*_):
        raise ImportError("install sb3_roles[vrp] for vrpc")

    monkeypatch.setattr(vrpc.VRPController, "__init__", refuse)
    plan = write_plan(
        tmp_path, **{key: plan_data(("random", "vrpc"))[key] for key in ("rows", "tables")}
    )
    code, _, err = tell("--plan", plan, "--jobs", "1")
    assert code == tables.EXIT_ROWS_FAILED == 3
    assert err[0] == "vrpc is left out: install sb3_roles[vrp] for vrpc"
    assert err[-1] == "left out: vrpc"
    code, _, err = tell("--plan", plan, "--dry-run")
    assert code == tables.EXIT_ROWS_FAILED
    assert err == ["vrpc is left out: install sb3_roles[vrp] for vrpc"]
    assert {row["row"] for row in numbers_of(tmp_path / "results") if row["mean"]} == {"random"}


def test_without_matplotlib_there_are_tables_all_the_same(tell, tmp_path, monkeypatch):
    figure = {
        "caption": "Cover",
        "kind": "episode",
        "n_agents": [2],
        "scenes": {"easy": "Easy"},
        "metrics": ["cover"],
        "rows": ["random"],
    }
    plan = write_plan(tmp_path, figures={"episode": figure})
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    for name in [name for name in sys.modules if name.startswith("sb3_roles.evaluation.figure")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    code, _, err = tell("--plan", plan, "--jobs", "1")
    assert code == 0
    assert err[-1] == "no figures: install sb3_roles[plots] to draw them"
    assert (tmp_path / "results" / "tables.csv").is_file()
    monkeypatch.setattr(tables, "find_spec", lambda name: None)
    code, _, err = tell("--plan", plan, "--figures", "episode")
    assert code == 2
    assert "install sb3_roles[plots]" in err[0]


# Learned rows


def row_of(algo: str, **changes: Any) -> Any:
    rows = {"learned": {"label": "Learned", "algo": algo, **changes}, **plan_data()["rows"]}
    return parse_plan(plan_data(rows=rows)).rows["learned"]


def numbers(runs: list[Any]) -> list[int]:
    return [int(run.folder.name.rpartition("_")[2]) for run in runs]


def test_runs_are_found_by_their_configuration(tmp_path):
    row = row_of("mappo")
    make_run(tmp_path, row, 1, 500, seed=4)
    make_run(tmp_path, row, 2, 500, seed=5, gamma=0.5)
    make_run(tmp_path, row, 3, 500, seed=3)
    make_run(tmp_path, row, 4, 500, seed=6, policy_kwargs={})
    lines: list[str] = []
    finder = RunFinder(tmp_path, lines.append)
    assert numbers(finder.find(row)) == [3, 1]
    assert numbers(finder.find(row_of("mappo", params={"gamma": 0.5}))) == [2]
    assert finder.find(row_of("hmappo")) == []
    assert lines[0] == "learned: 2 runs of 500 joint steps, seeds 3, 4"
    assert finder.find(row_of("mappo", params={"gamma": 0.6})) == []


def test_runs_of_one_row_have_the_same_length(tmp_path):
    row = row_of("mappo")
    lines: list[str] = []

    def found() -> list[int]:
        return numbers(RunFinder(tmp_path, lines.append).find(row))

    make_run(tmp_path, row, 1, 500, seed=1)
    make_run(tmp_path, row, 2, 600, seed=2)
    assert found() == [2]  # The longer one of two single runs.
    make_run(tmp_path, row, 3, 500, seed=3)
    assert found() == [1, 3]  # More seeds.
    make_run(tmp_path, row, 10, 500, seed=1)
    assert found() == [10, 3]  # The newest of a seed, by number.
    make_run(tmp_path, row, 11, 500, seed=4, n_timesteps=10**6)
    assert found() == [10, 3]  # Schedules depend on the planned length.
    assert lines[-1] == (
        "learned: 2 runs of 500 joint steps, seeds 1, 3; not area-search-v0_1, area-search-v0_2, "
        "area-search-v0_11: of another length, or not the newest"
    )


def test_a_run_of_another_algorithm_plays_for_no_row(tell, tmp_path):
    row = row_of("mappo")
    rows = {"learned": {"label": "Learned", "algo": "hmappo"}, **plan_data()["rows"]}
    run = make_run(tmp_path / "logs", row, 1, 500, seed=1)
    plan = write_plan(tmp_path, rows=rows)
    code, _, err = tell("--plan", plan, "--runs", f"learned={run}")
    assert code == 2
    assert err == [
        f"sb3-roles tables: error: argument --runs: {run} is a run of mappo, the row learned is of "
        "hmappo"
    ]


def test_the_budget_is_that_of_the_weights_that_play(tmp_path):
    row = row_of("mappo")
    run = make_run(tmp_path, row, 1, 500, seed=1)
    (found,) = RunFinder(tmp_path, lambda _: None).find(row)
    entrant = found.entrant(row)
    # The training goes on meanwhile.
    CheckpointFolder(run / "checkpoints").save(700, manifest={"env_steps": 700}, policy={})
    parcel = pack(entrant)
    assert (entrant.env_steps, parcel.entrant.env_steps) == (500, 700)
    assert sorted(parcel.files) == ["checkpoints/step_000000000700.ckpt", "config.yml"]


def test_a_run_that_can_not_be_read_stops_nothing(tmp_path):
    row = row_of("mappo")
    make_run(tmp_path, row, 1, 500, seed=1)
    (make_run(tmp_path, row, 2, 500, seed=2) / "config.yml").write_text("algo: [")
    shutil.rmtree(make_run(tmp_path, row, 3, 500, seed=3) / "checkpoints")
    lines: list[str] = []
    assert numbers(RunFinder(tmp_path, lines.append).find(row)) == [1]
    assert sum(line.startswith("not taken: ") for line in lines) == 2
    assert any("no checkpoint" in line for line in lines)


def test_unfinished_runs_count_with_the_steps_that_they_have(tmp_path):
    row = row_of("mappo")
    make_run(tmp_path, row, 1, 1500, seed=1, n_timesteps=20_000)
    lines: list[str] = []
    (run,) = RunFinder(tmp_path, lines.append).find(row)
    assert run.entrant(row).env_steps == 1500
    assert lines == ["learned: 1 run of 1,500 of 20,000 joint steps, seed 1"]


def test_cloned_policies_may_differ_in_length(tmp_path):
    row = row_of("gnn")
    for number, steps in enumerate((900, 1100, 1000), 1):
        make_run(tmp_path, row, number, steps, seed=number)
    assert numbers(RunFinder(tmp_path, lambda _: None).find(row)) == [1, 2, 3]


def test_the_rows_of_the_paper_have_configurations():
    plan = parse_plan(read_yaml(config_file("tables")))
    methods = [config_of_row(row) for row in plan.rows.values() if row.learned]
    assert len(methods) >= 8
    assert all(methods.count(method) == 1 for method in methods)


def test_a_row_without_a_run_says_how_to_train_it_and_then_plays(tell, tmp_path):
    plan_of_row = {
        "rows": {
            "learned": {"label": "Learned", "algo": "hmappo", "params": TINY, "drawn": True},
            **plan_data()["rows"],
        }
    }
    plan_of_row["tables"] = {"I": {**plan_data()["tables"]["I"], "rows": ["learned", "random"]}}
    plan = write_plan(tmp_path, **plan_of_row)
    options = ["--plan", plan, "--quick", "--jobs", "1", "-f", "runs of mine"]
    code, _, err = tell(*options)
    assert code == 2 and err == [
        "sb3-roles tables: error: argument --log-folder: 'runs of mine' is no folder"
    ]
    (tmp_path / "runs of mine").mkdir()
    code, _, err = tell(*options)
    assert code == 0
    (line,) = [line for line in err if line.startswith("learned has no run in runs of mine: ")]
    program, command, *words = shlex.split(line.split(": ", 1)[1])
    assert (program, command) == ("sb3-roles", "train")
    words += ["--num-threads", "1", "--eval-freq", "0", "--eval-episodes", "1", "--verbose", "0"]
    assert tell(*words, command="train")[0] == 0
    code, _, err = tell(*options)
    assert code == 0
    assert err[0] == "learned: 3 runs of 8 joint steps, seeds 0, 1, 2"
    played = [path for path in records_below(tmp_path / "results") if "learned" in path]
    assert len(played) == 3 * 2
    seeds = {row["n_seeds"] for row in numbers_of(tmp_path / "results") if row["row"] == "learned"}
    assert seeds == {"3"}
    # The weights, and nothing else of the folder, decide.
    kept = records_below(tmp_path / "results")
    moved = tmp_path / "elsewhere"
    (tmp_path / "runs of mine").rename(moved)
    options[-1] = str(moved)
    assert tell(*options)[0] == 0
    assert set(records_below(tmp_path / "results")) == set(kept)
    # A run may be named, too.
    code, _, err = tell(*options, "--runs", f"learned={moved}/hmappo/*_2")
    assert err[0] == "learned: 1 run of 8 joint steps, seed 1"
    seeds = {row["n_seeds"] for row in numbers_of(tmp_path / "results") if row["row"] == "learned"}
    assert seeds == {"1"}
    # Of another configuration, or twice.
    other = moved / "hmappo" / "area-search-v0_7"
    shutil.copytree(moved / "hmappo" / "area-search-v0_2", other)
    code, _, err = tell(*options, "--runs", f"learned={moved}/hmappo/*_[27]")
    assert code == 2
    assert err[-1].endswith(f"argument --runs: {other}: training seed 1 is there already")
    config = read_yaml(other / "config.yml")
    write_yaml(other / "config.yml", {**config, "gamma": 0.5})
    code, _, err = tell(*options, "--runs", f"learned={other}", "--dry-run")
    assert code == 0
    assert err[:2] == [
        "learned: 1 run of 8 joint steps, seed 1",
        "learned: named by hand, its configuration is not the row's",
    ]
    # It is damaged: the others are played all the same.
    for path in (moved / "hmappo" / "area-search-v0_2" / "checkpoints").iterdir():
        path.write_bytes(b"")
    code, _, err = tell(*options, "--runs", f"learned={moved}/hmappo/*_2")
    assert code == 2
    assert "damaged" in err[-1]


def test_commands_for_parameters_come_back_as_they_were(tmp_path):
    row = row_of("hmappo", params={**TINY, "kl_coef": 0.25, "learning_rate": "lin_1.0e-3"})
    words = shlex.split(training_command(row, tmp_path))[1:]
    from sb3_roles.zoo.cli import make_parser
    from sb3_roles.zoo.train_jobs import GIVEN, new_jobs

    given = {k: v for k, v in vars(make_parser().parse_args(words)).items() if k in GIVEN}
    given = {key: value for key, value in given.items() if value is not None}
    _, jobs = new_jobs(given)
    assert [job["config"]["seed"] for job in jobs] == [0, 1, 2]
    assert jobs[0]["config"] == config_of_row(row)
    assert given["n_seeds"] == 3


# Kills


def forked(*args: str) -> Any:
    """Start the command in a copy of this process, which has imported everything."""

    def child() -> None:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        os._exit(main(["tables", *args]))

    process = multiprocessing.get_context("fork").Process(target=child)
    process.start()
    return process


def test_killed_ten_times_and_finished_is_as_if_nothing_had_happened(tmp_path):
    data = plan_data(episodes=30)
    for row in data["rows"].values():
        row["block"] = 2
    (tmp_path / "plan.yml").write_text(yaml.safe_dump(data))
    plan = str(tmp_path / "plan.yml")
    args = ("--plan", plan, "--jobs", "1", "-o")
    # Once to compile, and once for the time.
    for name in ("first", "whole"):
        started = time.monotonic()
        process = forked(*args, str(tmp_path / name))
        process.join()
        assert process.exitcode == 0
    seconds = time.monotonic() - started
    rng = random.Random(1)
    counts = []
    for _ in range(10):
        process = forked(*args, str(tmp_path / "killed"))
        # What was kept need not be played again: a later kill meets a shorter run.
        time.sleep(rng.uniform(0.0, 0.6) * seconds)
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        counts.append(len(list((tmp_path / "killed").rglob("*-*.parquet"))))
    assert counts == sorted(counts)
    assert counts[-1] > 0
    process = forked(*args, str(tmp_path / "killed"))
    process.join()
    assert process.exitcode == 0
    assert len(records_below(tmp_path / "killed")) == 60
    assert_same_outputs(tmp_path / "whole", tmp_path / "killed")


def start(*args: str) -> subprocess.Popen[str]:
    code = "import sys; from sb3_roles.zoo.cli import main; sys.exit(main())"
    return subprocess.Popen(
        [sys.executable, "-c", code, "tables", *args],
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def wait_for_records(folder: Path, process: subprocess.Popen[str]) -> None:
    for _ in range(3000):
        if process.poll() is not None or list(folder.rglob("*-*.parquet")):
            return
        time.sleep(0.02)
    raise AssertionError("nothing was played")


def members_of(session: int) -> list[int]:
    """Return the processes of a session; its leader is one, as long as it was not waited for."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            _, _, after = path.read_text().rpartition(")")
        except OSError:
            continue
        state, _, _, number = after.split()[:4]
        if int(number) == session and state != "Z":
            found.append(int(path.parent.name))
    return found


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads the processes of Linux")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_its_processes_end_with_it(how, tmp_path):
    """Ctrl-C reaches all processes of a terminal, a kill only the first."""
    data = plan_data(episodes=10_000)
    for row in data["rows"].values():
        row["block"] = 20
    (tmp_path / "plan.yml").write_text(yaml.safe_dump(data))
    out = tmp_path / "out"
    process = start("--plan", str(tmp_path / "plan.yml"), "-o", str(out), "--jobs", "2")
    wait_for_records(out, process)
    if how == signal.SIGINT:
        os.killpg(process.pid, how)
    else:
        process.kill()
    process.wait()
    # Not before: the pipes are open as long as one of them lives.
    stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == (130 if how == signal.SIGINT else -how)
    assert stdout == ""
    assert "Traceback" not in stderr
    if how == signal.SIGINT:
        assert stderr.splitlines()[-1].endswith("the same command goes on")
    for _ in range(500):  # The process that tracks their semaphores takes its time.
        if not members_of(process.pid):
            break
        time.sleep(0.02)
    assert members_of(process.pid) == []
    found = records_below(out)
    assert found
    assert all(len(records.episode) == 20 for records in found.values())


def test_ray_is_asked_for_by_name(tell, plan, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    for module in ("evaluation.grid.ray_crew", "common.ray_cluster"):
        monkeypatch.delitem(sys.modules, f"sb3_roles.{module}", raising=False)
    code, _, err = tell("--plan", plan, "--ray", "local")
    assert code == 2
    assert err == ["sb3-roles tables: error: argument --ray: install sb3_roles[ray] to use it"]


def test_a_plan_is_read_in_parts(tmp_path):
    args = tables.Namespace(
        plan=None, tables=["V"], rows=["planner", "oracle"], scenes=["easy"], figures=None
    )
    plan = tables.read_plan(args)
    assert list(plan.tables) == ["V"]
    assert {(row, column.scene) for row, column in plan.cells()} == {
        ("planner", "easy"),
        ("oracle", "easy"),
    }
    args.tables = args.rows = args.scenes = None
    args.figures = ["time_e"]
    plan = tables.read_plan(args)
    assert (list(plan.tables), list(plan.figures)) == ([], ["time_e"])
    args.tables = ["I"]
    plan = tables.read_plan(args)
    assert (list(plan.tables), list(plan.figures)) == (["I"], ["time_e"])
    args.tables, args.rows, args.scenes, args.figures = ["V"], ["random"], ["easy"], None
    with pytest.raises(UsageError, match="no table or figure has any"):
        tables.read_plan(args)
