"""The command line, as a user meets it; in a process of its own where that is what is tested."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sb3_roles.baselines import CONTROLLER_NAMES
from sb3_roles.zoo import bench_env, env_cases, machine
from sb3_roles.zoo.bench_env import case_name
from sb3_roles.zoo.bench_report import log_log_slope
from sb3_roles.zoo.options import key_value, parse_value

ROOT = Path(__file__).resolve().parents[1]
COMMAND = [sys.executable, "-m", "sb3_roles"]
# OR-Tools is an extra, and the oracle plans for seconds: see test_vrpc.py.
SLOW = ("vrpc", "oracle")
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "envs"), str(ROOT)])}


def sb3_roles(*args: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*COMMAND, *args], env=ENVIRONMENT, capture_output=True, text=True, timeout=300
    )


@pytest.fixture
def printed(tell):
    """Run a command in this process; what it prints."""

    def run(*args: str) -> str:
        code, out, err = tell(*args)
        assert (code, err) == (0, "")
        return out

    return run


@pytest.mark.parametrize(
    "args", [["--help"], ["simulate", "--help"], ["bench", "--help"], ["bench", "env", "--help"]]
)
def test_help(printed, args):
    assert printed(*args).startswith("usage: sb3-roles")


def test_a_process_prints_the_same(tell):
    for args in (["simulate", "--help"], ["simulate", "--episodes", "9" * 5000]):
        result = sb3_roles(*args)
        assert (result.returncode, result.stdout, result.stderr) == tell(*args)


WRONG = [
    ([], "sb3-roles: error", "command"),
    (["simulat"], "sb3-roles: error", "did you mean 'simulate'?"),
    (["--sed", "3", "simulate"], "sb3-roles: error", "--sed"),
    (["simulate", "--epsiodes", "5"], "sb3-roles simulate: error", "did you mean '--episodes'?"),
    (["simulate", "extra"], "sb3-roles simulate: error", "'extra'"),
    (["simulate", "--controller", "randm"], "sb3-roles simulate: error", "mean 'random'?"),
    (["simulate", "--scene", "hrad"], "sb3-roles simulate: error", "did you mean 'hard'?"),
    (["simulate", "--n-agents", "0"], "sb3-roles simulate: error", "from 1 to 1024, got 0"),
    (["simulate", "--n-agents", "four"], "sb3-roles simulate: error", "got 'four'"),
    (["simulate", "--n-agents", "2.5"], "sb3-roles simulate: error", "got '2.5'"),
    (["simulate", "--episodes", "0"], "sb3-roles simulate: error", "--episodes: must be a whole"),
    (["simulate", "--episodes", "many"], "sb3-roles simulate: error", "got 'many'"),
    (["simulate", "--episodes", "9" * 5000], "sb3-roles simulate: error", "--episodes"),
    (["simulate", "--episodes"], "sb3-roles simulate: error", "expected one argument"),
    (["simulate", "--seed", "-1"], "sb3-roles simulate: error", "from 0 to"),
    (["simulate", "--seed", "1\n2"], "sb3-roles simulate: error", "--seed"),
    (["simulate", "--batch-size", "0"], "sb3-roles simulate: error", "--batch-size"),
    (["simulate", "--first-episode", "-3"], "sb3-roles simulate: error", "--first-episode"),
    (["simulate", "--scene-options", "horizn:9"], "sb3-roles simulate: error", "'horizon'?"),
    (["simulate", "--scene-options", "horizon"], "sb3-roles simulate: error", "key:value"),
    (["simulate", "--scene-options", "horizon:"], "sb3-roles simulate: error", "key:value"),
    (["simulate", "--scene-options", "horizon:x"], "sb3-roles simulate: error", "got 'x'"),
    (["simulate", "--scene-options", "free_fraction:nan"], "sb3-roles simulate: error", "'nan'"),
    (["simulate", "--scene-options", "width:9", "width:8"], "sb3-roles simulate: error", "twice"),
    (
        ["simulate", "--n-agents", "3", "--scene-options", "n_agents:4"],
        "sb3-roles simulate: error",
        "not both",
    ),
    (["simulate", "--controller", "random,"], "sb3-roles simulate: error", "controller ''"),
    (["simulate", "--stream", "training"], "sb3-roles simulate: error", "held_out, raw"),
    (["simulate", "--out", "x.csv"], "sb3-roles simulate: error", ".parquet"),
    (["simulate", "--out", "nowhere/x.parquet"], "sb3-roles simulate: error", "'nowhere'"),
    (["simulate", "--render", "x.bmp"], "sb3-roles simulate: error", ".png"),
    (["simulate", "--render", "nowhere/x.png"], "sb3-roles simulate: error", "'nowhere'"),
    (["bench", "evn"], "sb3-roles bench: error", "did you mean 'env'?"),
    (["bench", "env", "--seconds-per-case", "0"], "sb3-roles bench env: error", "above 0"),
    (["bench", "env", "--seconds-per-case", "inf"], "sb3-roles bench env: error", "'inf'"),
    (["bench", "env", "--repeats", "-5"], "sb3-roles bench env: error", "--repeats"),
]


@pytest.mark.parametrize(("args", "start", "part"), WRONG)
def test_wrong_command_line(tell, args, start, part):
    code, out, err = tell(*args)
    assert code == 2
    assert out == ""
    assert err.startswith(start)
    assert part in err
    assert err.count("\n") == 1


def test_nothing_heavy_is_imported_before_the_arguments_are_right():
    code = (
        "import sys\n"
        "from sb3_roles.zoo.cli import main\n"
        "try: main(['simulate', '--scene', 'nowhere'])\n"
        "except SystemExit as end: assert end.code == 2\n"
        "heavy = {'torch', 'numba', 'numpy', 'pettingzoo', 'gymnasium', 'pygame'}\n"
        "print(sorted(heavy & set(sys.modules)))\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True
    )
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize("controller", [n for n in CONTROLLER_NAMES if n not in SLOW])
def test_simulate_json(printed, controller):
    args = ("simulate", "--json", "--controller", controller, "--scene", "easy")
    args += ("--n-agents", "3", "--episodes", "30", "--seed", "5")
    report = json.loads(printed(*args, "--scene-options", "horizon:20", "free_fraction:0.7"))
    config = report["config"]
    assert config["controller"] == controller
    assert (config["episodes"], config["seed"], config["first_episode"]) == (30, 5, 0)
    assert config["stream"] == {"kind": "held_out", "seed": 2**32 + 5}
    assert config["version"]
    assert len(config["config_hash"]) == 64
    scene = config["scene"]
    assert (scene["name"], scene["n_agents"], scene["horizon"]) == ("easy", 3, 20)
    assert scene["free_fraction"] == 0.7
    metrics = report["metrics"]
    for name in ("explo_paper", "explo_true", "cover"):
        low, high = metrics[name]["ci95"]
        assert metrics[name]["unit"] == "%"
        assert 0 < low < metrics[name]["mean"] < high < 100
        assert 0 < metrics[name]["se"] < 10
    assert set(metrics["time_e_paper"]) == {"mean", "se", "ci95", "unit"}
    assert set(metrics["t90_true"]) == {"mean", "se", "ci95", "unit", "share"}
    steps = {"mean": 20.0, "se": 0.0, "ci95": [20.0, 20.0], "unit": "steps"}
    assert metrics["length"] == steps
    assert 0 < metrics["path_length"]["mean"] <= 20
    assert report["joint_steps"] == 600
    timing = report["timing"]
    assert timing["batch_size"] == 256
    assert 0 < timing["decision"]["median"] <= timing["decision"]["p95"]
    assert timing["decision"]["mean"] * 600 < timing["seconds"]
    assert timing["episodes_per_second"] > 0


def test_batch_size_changes_no_metric(printed):
    args = ("simulate", "--json", "--episodes", "40", "--scene-options", "horizon:15")
    one = json.loads(printed(*args, "--batch-size", "1"))
    many = json.loads(printed(*args, "--batch-size", "500"))
    assert one["metrics"] == many["metrics"]


def test_simulate_table_and_frame(tmp_path):
    frame = tmp_path / "frame.png"
    result = sb3_roles("simulate", "--episodes", "5", "--render", str(frame))
    assert result.returncode == 0
    assert result.stderr == ""
    assert "explo_paper" in result.stdout
    assert "±" in result.stdout
    assert "95 % confidence interval" in result.stdout
    assert "held-out seed 0" in result.stdout
    assert "decision time" in result.stdout
    assert frame.read_bytes().startswith(b"\x89PNG")


SMALL = ("--scene-options", "height:7", "width:7", "n_targets:8", "horizon:6")


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A run folder as ``train.py`` leaves it, with a comma in its name."""
    from sb3_roles.common.checkpoint import CheckpointFolder
    from sb3_roles.zoo.config import resolve, write_yaml
    from sb3_roles.zoo.models import make_env, make_model
    from sb3_roles.zoo.run_folder import CHECKPOINTS

    run = tmp_path_factory.mktemp("a,b")
    scene = {"height": 7, "width": 7, "n_targets": 8, "horizon": 6}
    settings = {"n_timesteps": 8, "n_envs": 2, "n_steps": 2, "batch_size": 2, "env_kwargs": scene}
    config = resolve("mappo", "area-search-v0", settings, 0)
    model = make_model(config, make_env(config), "cpu")
    write_yaml(run / "config.yml", config)
    CheckpointFolder(run / CHECKPOINTS).prepare()
    CheckpointFolder(run / CHECKPOINTS).save(0, manifest={}, policy=model.policy.state_dict())
    return run


def test_evaluate_compares_on_the_same_episodes(trained, tmp_path, printed):
    from sb3_roles.evaluation.metrics import paired_differences, summarize
    from sb3_roles.evaluation.records import read_records

    controllers = ("--controller", "random", "--controller", str(trained))
    common = ("evaluate", *controllers, "--episodes", "20", "--seed", "4", *SMALL)
    out = tmp_path / "x.parquet"
    report = json.loads(printed(*common, "--json", "--stochastic", "--out", str(out)))
    first, second = report["controllers"]
    (difference,) = report["differences"]
    assert first["config"]["stream"] == second["config"]["stream"]
    assert (first["config"]["controller"], first["config"]["deterministic"]) == ("random", None)
    assert second["config"]["controller"] == difference["controller"] == str(trained)
    assert second["config"]["deterministic"] is False
    assert second["config"]["communication"] is True
    assert difference["against"] == "random"

    files = sorted(tmp_path.iterdir())
    assert len(files) == 2
    assert files[0].name == "x-random.parquet" or files[1].name == "x-random.parquet"
    random = read_records(tmp_path / "x-random.parquet")
    (learned,) = (read_records(file) for file in files if file.name != "x-random.parquet")
    assert json.loads(json.dumps(summarize(learned))) == second["metrics"]
    assert difference["metrics"] == json.loads(json.dumps(paired_differences(learned, random)))
    assert difference["metrics"]["cover"]["mean"] == pytest.approx(
        second["metrics"]["cover"]["mean"] - first["metrics"]["cover"]["mean"]
    )

    table = printed(*common, "--no-communication", "--out", str(out))
    assert f"wrote {tmp_path / 'x-random.parquet'}" in table.splitlines()
    assert "differences to random on the same episodes" in table
    assert sum(line.startswith(str(trained)) for line in table.splitlines()) == 3


def test_evaluate_plays_what_run_episodes_plays(printed):
    from area_search import get_scene
    from sb3_roles.baselines.random import RandomController
    from sb3_roles.evaluation.episodes import held_out_seed, run_episodes
    from sb3_roles.evaluation.metrics import summarize

    args = ("evaluate", "--controller", "random", "--episodes", "9", "--seed", "2", "--json")
    for stream, seed in (("held_out", held_out_seed(2)), ("raw", 2)):
        report = json.loads(printed(*args, "--stream", stream, "--first-episode", "3"))
        records = run_episodes(RandomController(), get_scene("hard"), 9, seed, first_episode=3)
        assert report["metrics"] == summarize(records)
        assert report["config"]["seed"] == 2
        assert report["config"]["stream"] == {"kind": stream, "seed": seed}


def test_records_prints_what_simulate_printed(tmp_path, printed):
    out = tmp_path / "x.parquet"
    args = ("simulate", "--episodes", "5", "--seed", "3", "--out", str(out))
    simulated = json.loads(printed(*args, "--json"))
    assert json.loads(printed("records", str(out), "--json")) == simulated
    table = printed("records", str(out))
    assert "random on hard: 4 robots, 5 episodes, held-out seed 3" in table
    assert simulated["config"]["config_hash"][:16] in table


def test_wrong_evaluations(trained, tmp_path, tell):
    broken = tmp_path / "broken.parquet"
    broken.write_bytes(b"PAR1")
    run = str(trained)
    for args, part in [
        (["evaluate"], "--controller"),
        (["evaluate", "--controller", "randm"], "did you mean 'random'"),
        (["evaluate", "--controller", "random,random"], "'random' is given twice"),
        (["evaluate", "--controller", "random", "--controller", "random"], "given twice"),
        (["evaluate", "--controller", "random,"], "unknown controller or run folder ''"),
        (["evaluate", "--controller", f"random,{tmp_path}"], "config.yml"),
        (["evaluate", "--controller", run, "--deterministic", "--stochastic"], "not allowed"),
        (["evaluate", "--controller", run, "--load-best"], "best"),
        (["records", str(broken)], "no Parquet file"),
        (["records", str(tmp_path / "none.parquet")], "No such file"),
        (["records"], "FILE"),
    ]:
        code, out, err = tell(*args)
        assert (code, out) == (2, "")
        assert err.startswith(f"sb3-roles {args[0]}: error: ")
        assert part in err, err
        assert err.count("\n") == 1


def test_closed_pipe_ends_quietly():
    read, write = os.pipe()
    os.close(read)
    result = subprocess.run(
        [*COMMAND, "simulate", "--episodes", "2"],
        env=ENVIRONMENT,
        stdout=write,
        stderr=subprocess.PIPE,
        text=True,
    )
    os.close(write)
    assert (result.returncode, result.stderr) == (141, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_full_disk_is_one_line():
    with open("/dev/full", "w") as full:
        result = subprocess.run(
            [*COMMAND, "simulate", "--episodes", "2"],
            env=ENVIRONMENT,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert result.returncode == 2
    assert result.stderr == "sb3-roles simulate: error: No space left on device\n"


@pytest.mark.parametrize("n_signals", [1, 2, 3])
def test_interrupt_ends_quietly(n_signals):
    process = subprocess.Popen(
        [*COMMAND, "simulate", "--episodes", "400000"],
        env=ENVIRONMENT,
        # A job in the background of a script ignores the signal, and so would its children.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    time.sleep(3)
    for _ in range(n_signals):
        process.send_signal(signal.SIGINT)
        time.sleep(0.01)
    stdout, stderr = process.communicate(timeout=30)
    assert (process.returncode, stdout, stderr) == (130, "", "")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3", 3),
        ("-3", -3),
        ("0.5", 0.5),
        ("5e-4", 5e-4),
        ("1e6", 1e6),
        ("true", True),
        ("None", None),
        ("none", "none"),
        ("True", True),
        ("null", None),
        ("same_role", "same_role"),
        ("no", "no"),
        ("12:30", "12:30"),
    ],
)
def test_values(text, value):
    parsed = parse_value(text)
    assert parsed == value
    assert type(parsed) is type(value)


def test_yaml_values():
    pytest.importorskip("yaml")
    assert parse_value("[1, 2]") == [1, 2]
    assert parse_value("'7'") == "7"
    with pytest.raises(ValueError, match="not valid YAML"):
        parse_value("[1, 2")


@pytest.mark.parametrize("text", ["", ":", "a", ":1", "a:", "a b:1", "3:4"])
def test_key_value_needs_both(text):
    with pytest.raises(argparse.ArgumentTypeError, match="key:value"):
        key_value(text)


def test_log_log_slope_of_a_power_law():
    sizes = (1, 4, 15, 50)
    assert log_log_slope(sizes, [3 * size**1.5 for size in sizes]) == pytest.approx(1.5)


@pytest.fixture
def brief(monkeypatch):
    """Let ``bench env`` prepare few teams and short episodes, and compile nothing anew."""
    make_scene, empty = env_cases.make_scene, []

    def fresh_python(code: str, **variables: str) -> list[float]:
        empty.extend(not any(Path(folder).iterdir()) for folder in variables.values())
        return machine.fresh_python(code)

    monkeypatch.setattr(env_cases, "N_TEAMS", 32)
    monkeypatch.setattr(env_cases, "N_TEAMS_ROUTES", 4)
    monkeypatch.setattr(
        env_cases, "make_scene", lambda *size: make_scene(*size).with_options(horizon=10)
    )
    monkeypatch.setattr(bench_env, "fresh_python", fresh_python)
    yield
    assert empty == [True]  # The cache of what would have been compiled.


def test_bench_env_measures_everything(printed, brief):
    args = ("bench", "env", "--json", "--seconds-per-case", "0.001", "--repeats", "2")
    report = json.loads(printed(*args))
    assert report["config"] == {"seconds_per_case": 0.001, "repeats": 2}
    assert set(report["machine"]) >= {"cpu", "cores", "load_before", "python", "numpy", "numba"}
    cases = {case["name"]: case for case in report["cases"]}
    for sub_goal in ("none", "nearest", "assigned", "routes"):
        for n_agents in (4, 15):
            for side in (25, 100):
                assert case_name("native", sub_goal, n_agents, side) in cases
    for api in ("native_vec_env", "supersuit_vec_env", "pettingzoo", "reference"):
        assert case_name(api, "none", 4, 25) in cases
        assert report["ratios"][f"native / {api}"]["median"] > 1
    for case in cases.values():
        rate = case["joint_steps_per_second"]
        assert 0 < rate["min"] <= rate["median"] <= rate["max"]
        assert case["joint_steps"] >= 2 * case["n_teams"]
        assert (rate["met"] is None) == (rate["target"] is None)
    assert sum(case["joint_steps_per_second"]["met"] is not None for case in cases.values()) == 4
    assert {(line["sub_goal"], line["along"]) for line in report["growth"]} == {
        (sub_goal, along)
        for sub_goal in ("none", "nearest", "assigned", "routes")
        for along in ("robots", "cells")
    }
    for line in report["growth"]:
        assert len(line["sizes"]) == len(line["microseconds"]) == 4
        assert isinstance(line["exponent"]["met"], bool)
    assert set(report["compile"]["added"]) == {"none", "nearest", "assigned", "routes"}
    total = report["compile"]["total"]
    assert total["seconds"] == pytest.approx(sum(report["compile"]["added"].values()))
    assert all(times["median"] > 0 for times in report["imports"].values())
