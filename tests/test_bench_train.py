"""``sb3-roles bench train``: what it counts and reports, not how fast it is."""

from __future__ import annotations

import json
import time

import pytest

from sb3_roles.zoo.bench_case import PARTS, Stopwatch, configure
from sb3_roles.zoo.bench_report import Table, against, cells, page, spread
from sb3_roles.zoo.cli import main

SHORT = ["--n-envs", "2", "--iterations", "1", "--repeats", "1"]


def test_every_case_does_the_same_counted_work(capsys):
    options = ["--algo", "hmappo,ppo", "--iterations", "1", "--repeats", "2", "--num-threads", "1"]
    assert main(["bench", "train", *options, "--n-envs", "16", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["machine"]["torch_threads"] == 1
    hmappo, ppo = report["cases"]
    assert (hmappo["name"], ppo["name"]) == ("hmappo native", "ppo native")
    for case in (hmappo, ppo):
        config = configure(case["name"].split()[0], n_envs=16)
        steps = 2 * 16 * config["n_steps"]
        assert case["work"]["joint_steps"] == steps
        assert case["work"]["robot_steps"] == 4 * steps
        # Counted where it is done: every robot's row once per epoch.
        epochs, batches = config["n_epochs"], -(-16 * config["n_steps"] // config["batch_size"])
        assert case["work"]["samples_times_epochs"] == 4 * epochs * steps
        assert case["work"]["optimizer_steps"] == 2 * epochs * batches
        shares = case["share_of_time"]
        assert set(shares) == {*PARTS, "rest"}
        assert sum(shares.values()) == pytest.approx(1.0, abs=0.02)
        assert all(0.0 < shares[part] < 1.0 for part in PARTS)
        assert case["cpu_share"] > 0.0
        rate = case["joint_steps_per_second"]
        assert 0.0 < rate["min"] <= rate["median"] <= rate["max"]
    # Bits of the team's maps (2 and 5 channels of 625 cells) once per team, of the local ones (4 of
    # 81) per robot, and 40 numbers of each robot.
    bits, numbers = 7 * 625 + 4 * 4 * 81, 4 * 40 * 4
    assert bits / 8 <= hmappo["observation_bytes_per_joint_step"] - numbers < bits / 8 + 64
    assert hmappo["joint_steps_per_second"]["target"] == 2500
    assert hmappo["aim"]["target"] == 4000
    assert ppo["joint_steps_per_second"]["target"] is None
    assert report["comparisons"] == []


def test_memory_is_compared_with_a_stock_buffer(capsys):
    assert main(["bench", "train", *SHORT, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    (case,) = report["cases"]
    n_steps = configure()["n_steps"]
    memory = case["memory"]
    per_step = case["observation_bytes_per_joint_step"]
    assert memory["observation_bytes"] == 2 * n_steps * per_step
    # All maps and 40 numbers, for each of 8 robots at each step.
    cells_of_maps, rows = 7 * 625 + 4 * 81, 8 * n_steps
    float32, installed = (memory[f"dict_rollout_buffer_{x}"] for x in ("float32", "installed"))
    assert float32["bytes"] == rows * 4 * (cells_of_maps + 40)
    assert installed["bytes"] == rows * (cells_of_maps + 4 * 40)
    for rival in (float32, installed):
        assert rival["ratio"] == pytest.approx(rival["bytes"] / memory["observation_bytes"])
        assert rival["met"] is (rival["ratio"] >= 10)
    assert report["peak_resident_bytes"] > memory["observation_bytes"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--algo", "hmapo"], "did you mean 'hmappo'?"),
        (["--algo", "hmappo,"], "''"),
        (["--algo", "gnn"], "allowed are hmappo, mappo, ecc, h2gnn"),
        (["--vec-env", "nativ"], "did you mean 'native'?"),
        (["--repeats", "0"], "from 1"),
        (["--scene", "hart"], "did you mean 'hard'?"),
        (["--n-agents", "0"], "n_agents"),
        (["--compare", "stock-nativ"], "did you mean 'stock-native'?"),
        (["--compare", "--algo", "ppo"], "--compare is for the tuned default"),
        (["--compare", "--vec-env", "native,supersuit"], "--compare is for the tuned default"),
        (["--json", "--markdown"], "not allowed with"),
    ],
)
def test_wrong_options_are_one_line(tell, options, message):
    code, printed, error = tell("bench", "train", *options)
    assert code == 2
    assert message in error and "Traceback" not in error
    assert printed == ""


def test_markdown_has_every_table(capsys):
    assert main(["bench", "train", *SHORT, "--markdown"]) == 0
    lines = capsys.readouterr().out.splitlines()
    heads = [lines[k - 1] for k, line in enumerate(lines) if line.startswith("| ---")]
    assert [head.split("|")[1].strip() for head in heads] == [
        "joint steps per second of training",
        "share of the time, %",
        "observations of a rollout",
        "work",
    ]
    (row,) = [line for line in lines if line.startswith("| hmappo native, 2 teams of 4 |")]
    assert ">= 2,500" in row and ">= 4,000" in row
    # One minibatch of all joint steps in each epoch.
    config = configure()
    steps, epochs = 2 * config["n_steps"], config["n_epochs"]
    assert f"| hmappo native | {steps} | {epochs} | {4 * epochs * steps:,} |" in lines


def test_tables_are_set_in_columns():
    table = Table(("what", "much"))
    table.add("a|b", "1")
    table.add("c", "10,000")
    assert table.lines() == ["what    much", "a|b        1", "c     10,000"]
    expected = ["| what | much |", "| --- | ---: |", "| a\\|b | 1 |", "| c | 10,000 |"]
    assert table.lines(markdown=True) == expected
    assert page(["head"], [table]) == "\n".join(["head", "", *table.lines()])
    with pytest.raises(ValueError, match="2 columns, got 1 cells"):
        table.add("d")


def test_nested_methods_count_once():
    class Work:
        def outer(self):
            time.sleep(0.02)
            self.inner()

        def inner(self):
            time.sleep(0.02)

    work, watch = Work(), Stopwatch()
    watch.watch("outer", work, "outer")
    watch.watch("inner", work, "inner")
    work.outer()
    assert watch.seconds["inner"] == 0.0
    assert watch.seconds["outer"] >= 0.04
    work.inner()
    assert watch.seconds["inner"] >= 0.02


def test_targets_are_reported_as_they_come_out():
    found = spread([3.0, 1.0, 2.0])
    assert (found["median"], found["min"], found["max"]) == (2.0, 1.0, 3.0)
    assert against(found, 2.0)["met"] is True
    assert against(found, 2.5)["met"] is False
    assert cells(against(found, 2.5), ".1f") == ("2.0", "1.0 .. 3.0", ">= 2 MISSED")
    assert cells(against(found, None), ".0f") == ("2", "1 .. 3", "")
