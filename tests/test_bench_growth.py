"""``sb3-roles bench growth``, ``bench options`` and the short form: reports, not speed."""

from __future__ import annotations

import json
import sys
from typing import Any

import pytest

from sb3_roles.zoo import bench, bench_growth, bench_options
from sb3_roles.zoo.bench_case import configure, training_case
from sb3_roles.zoo.bench_compare import RIVALS
from sb3_roles.zoo.bench_growth import observation_bytes
from sb3_roles.zoo.bench_options import Change
from sb3_roles.zoo.cli import main

SHORT = ["--n-envs", "2", "--iterations", "1", "--repeats", "2"]
N_STEPS = 5


@pytest.fixture
def brief(monkeypatch):
    """Short rollouts."""

    def configured(changes: dict[str, Any] | None = None, n_envs: int | None = None) -> Any:
        return configure(changes={"n_steps": N_STEPS, **(changes or {})}, n_envs=n_envs)

    for module in (bench_growth, bench_options):
        monkeypatch.setattr(module, "configure", configured)


def test_growth_is_reported_and_drawn(capsys, tmp_path, brief):
    plot = tmp_path / "growth.svg"
    options = ["--robots", "3,2", "--sides", "25,11,27", "--plot", str(plot), "--json"]
    assert main(["bench", "growth", *SHORT, *options]) == 0
    report = json.loads(capsys.readouterr().out)
    sizes = [(case["n_agents"], case["side"]) for case in report["cases"]]
    assert sizes == [(2, 11), (3, 11), (2, 25), (2, 27)]
    for case in report["cases"]:
        assert case["n_teams"] == 2
        assert case["work"]["joint_steps"] == 2 * 2 * N_STEPS
        for cost in case["microseconds"].values():
            assert 0 < cost["min"] <= cost["median"] <= cost["max"]
        # What update and rollout cost is what a joint step costs.
        total = sum(case["microseconds"][part]["min"] for part in ("update", "rollout"))
        assert total <= 1e6 / case["joint_steps_per_second"]["min"]
        # Maps once per team, as bits: patches add what fills them up.
        bits = 7 * case["side"] ** 2 + 4 * 81 * case["n_agents"]
        assert case["observation_bytes_per_joint_step"] >= bits / 8
    lines = {(one["along"], one["part"]): one["sizes"] for one in report["growth"]}
    assert lines == {
        (along, part): found
        for along, found in (("robots", [2, 3]), ("cells", [121, 625, 729]))
        for part in ("update", "rollout", "environment")
    }
    drawn = plot.read_text(encoding="utf-8")
    for text in ("robots", "cells", "environment by itself", "microseconds per joint step"):
        assert text in drawn


def test_growth_tables(capsys, brief):
    options = ["--robots", "2,3", "--sides", "11,12", "--markdown"]
    assert main(["bench", "growth", *SHORT, *options]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("| 3 robots, 11 x 11 | 2 |") for line in lines)
    assert any(line.startswith("| cells 121 144 |") for line in lines)


def test_rollouts_that_do_not_fit_have_fewer_teams(monkeypatch):
    config = configure(n_envs=16)
    one_team = observation_bytes(config) * config["n_steps"]
    case = training_case("case", configure(n_envs=2))
    # At most: the buffer keeps flags as bits.
    assert 2 * one_team / 8 < case.buffer_bytes() <= 2 * one_team
    case.close()
    for room, teams in ((16.5, 16), (15.5, 8), (5.0, 4), (0.5, 1)):
        available = int(room * one_team * 2 / bench_growth._SHARE)
        monkeypatch.setattr(bench_growth, "available_memory", lambda size=available: size)
        fitted = bench_growth._fitted(config, (4, 25), 2)
        assert fitted["n_envs"] == teams
        assert fitted["batch_size"] == min(config["batch_size"], teams * config["n_steps"])


def test_options_are_compared_with_what_differs_in_them_alone(capsys, monkeypatch, brief):
    names = ["norm_layer frozen_batch", "n_epochs 1", "num_threads 1", "the same"]
    default = configure()
    monkeypatch.setitem(bench_options.CHANGES, "the same", Change({"gamma": default["gamma"]}))
    options = ["--changes", ",".join(names), "--json"]
    assert main(["bench", "options", *SHORT, *options]) == 0
    report = json.loads(capsys.readouterr().out)
    against = {one["change"]: one["against"] for one in report["changes"]}
    assert against == {
        "encoder convolutions": "default",
        "norm_layer frozen_batch": "encoder convolutions",
        "n_epochs 1": "default",
        "num_threads 1": "default",
    }
    assert report["same_as_default"] == ["the same"]
    by_name = {one["change"]: one for one in report["changes"]}
    steps = {name: one["work"]["optimizer_steps"] for name, one in by_name.items()}
    # Once in each of two rounds; convolutions also before what is compared with them.
    assert steps["n_epochs 1"] == 2
    assert steps["num_threads 1"] == 2 * default["n_epochs"]
    assert steps["encoder convolutions"] == 2 * 2 * default["n_epochs"]
    assert report["default"]["work"]["optimizer_steps"] == 2 * 3 * default["n_epochs"]
    for one in report["changes"]:
        assert 0 < one["ratio"]["min"] <= one["ratio"]["median"] <= one["ratio"]["max"]


def test_the_short_form_is_one_table(capsys, monkeypatch):
    monkeypatch.setattr(bench, "_SECONDS_PER_CASE", 0.001)
    short = ["--n-envs", "2", "--iterations", "1", "--repeats", "1"]
    assert main(["bench", *short, "--markdown"]) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = [line for line in lines if line.startswith("| ")]
    assert rows[0] == "| 4 robots, 25 x 25 | median | range | target |"
    assert sum("environment, joint steps/s" in row for row in rows) == len(bench._CASES)
    assert sum(row.startswith("| times as fast as:") for row in rows) == len(RIVALS)
    (rate,) = [row for row in rows if row.startswith("| training, joint steps/s")]
    assert ">= 2,500" in rate


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--json", "train"], "--json stands before 'train'"),
        (["--repeats", "0"], "from 1"),
        (["groth"], "did you mean 'growth'?"),
        (["growth", "--robots", "4"], "two different numbers or more"),
        (["growth", "--robots", "4,x"], "whole number from 1"),
        (["growth", "--robots", "4,2000"], "whole number from 1 to 1024"),
        (["growth", "--sides", "25,2000"], "whole number from 9 to 1024"),
        (["growth", "--plot", "growth.txt"], "must end in .png or .svg or .pdf"),
        (["options", "--changes", "precision bf1"], "did you mean 'precision bf16'?"),
    ],
)
def test_wrong_options_are_one_line(capsys, options, message):
    with pytest.raises(SystemExit) as stop:
        main(["bench", *options])
    captured = capsys.readouterr()
    assert stop.value.code == 2
    assert message in captured.err and captured.err.count("\n") == 1
    assert captured.out == ""


def test_a_plot_needs_matplotlib(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(SystemExit) as stop:
        main(["bench", "growth", "--plot", "growth.png"])
    assert stop.value.code == 2
    assert "argument --plot" in capsys.readouterr().err
