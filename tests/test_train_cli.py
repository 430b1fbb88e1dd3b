"""``train.py``, as a user meets it: in a process of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from sb3_roles.common.checkpoint import CheckpointFolder
from sb3_roles.mappo import MAPPO
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.run_folder import RunLock
from sb3_roles.zoo.train import main

ROOT = Path(__file__).resolve().parents[1]
PATHS = [str(ROOT / "envs"), str(ROOT), str(ROOT / "tests")]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(PATHS)}
TINY = ["--env-kwargs", "height:7", "width:7", "n_targets:5", "n_agents:2", "horizon:6"]
SMALL = ["-params", "n_envs:4", "n_steps:8", "batch_size:16", "n_epochs:1"]
FAST = ["--num-threads", "1", "--eval-freq", "0", "--eval-episodes", "4", "--device", "cpu"]


def start(*args: object) -> subprocess.Popen[str]:
    command = [sys.executable, str(ROOT / "train.py"), *map(str, args)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, env=ENVIRONMENT, stdout=pipe, stderr=pipe, text=True)


def train(*args: object) -> subprocess.CompletedProcess[str]:
    process = start(*args)
    out, err = process.communicate(timeout=120)
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


WRONG = [
    (["--algo", "hmapo"], "did you mean 'hmappo'?"),
    (["--env", "area-serch-v0"], "did you mean 'area-search-v0'"),
    (["--sed", "1"], "did you mean '--seed'?"),
    (["-n", "0"], "from 1 to"),
    (["-n", "1e999"], "from 1 to"),
    (["-n", "many"], "joint steps, got 'many'"),
    (["--scene", "hrad"], "did you mean 'hard'?"),
    (["--n-agents", "0"], "from 1 to 1024, got 0"),
    (["--scene", "hard", "--env-kwargs", "scene:easy"], "not both"),
    (["--env-kwargs", "horizn:5"], "did you mean 'horizon'?"),
    (["-params", "gama:0.9"], "did you mean 'gamma'?"),
    (["-params", "gamma:2"], "gamma must be a number in [0, 1], got 2"),
    (["-params", "policy_kwargs:{grph: true}"], "did you mean 'graph'?"),
    (["-conf", "/no/such/file.yml"], "No such file"),
    (["--vec-env", "nativ"], "did you mean 'native'?"),
    (["--device", "gpu"], "allowed are auto, cpu, cuda"),
    (["--num-threads", "0"], "from 1 to 1024"),
    (["--resume", "/no/such/run"], "no such run folder"),
    (["--resume", "x", "--seed", "3"], "leave --seed out"),
]


@pytest.mark.parametrize(("args", "expected"), WRONG, ids=lambda value: " ".join(value)[:40])
def test_wrong_arguments(tmp_path, args, expected):
    where = [] if "--resume" in args else ["-f", tmp_path]
    result = train(*args, *where)
    assert result.returncode == 2, result.stderr
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1, result.stderr
    assert result.stderr.startswith("train.py: error: ")
    assert expected in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_all_problems_at_once(tmp_path):
    result = train("-params", "gama:0.9", "n_steps:0", "--scene", "hrad", "-f", tmp_path)
    assert result.returncode == 2
    assert result.stderr.count("\n") == 3
    assert result.stderr.count("train.py: error: ") == 3


@pytest.mark.parametrize(
    ("env", "expected"),
    [("no_such_module_:make", "ModuleNotFoundError"), ("builtins:dict", "ParallelEnv")],
)
def test_bad_factory(tmp_path, env, expected):
    result = train("--env", env, "-f", tmp_path)
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert expected in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_help():
    result = train("--help")
    assert result.returncode == 0
    assert "--resume" in result.stdout
    assert "(default: hmappo)" in result.stdout


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    options = ["--seed", 5, "--n-seeds", 2, "-n", 320, "--save-freq", 160, "-f", folder]
    result = train("--algo", "mappo", *TINY, *SMALL, *FAST, *options)
    assert result.returncode == 0, result.stderr
    return folder, result.stdout


def test_run_folder(logs):
    folder, output = logs
    run = folder / "mappo" / "area-search-v0_1"
    assert {"config.yml", "args.yml", "command.txt", "progress.csv", "evaluation.yml"} <= {
        path.name for path in run.iterdir()
    }
    config = yaml.safe_load((run / "config.yml").read_text())
    assert config["seed"] == 5
    assert config["n_timesteps"] == 320
    assert config["env_kwargs"]["height"] == 7
    assert config["kl_target"] == 0.01
    command = (run / "command.txt").read_text()
    assert command.startswith("train.py --algo mappo")
    assert "torch" in command
    assert len((run / "progress.csv").read_text().splitlines()) == 11
    names = [path.name for path in (run / "checkpoints").iterdir()]
    assert sorted(names) == ["step_000000000160.ckpt", "step_000000000320.ckpt"]
    for text in ("OMP_WAIT_POLICY=PASSIVE", "1 threads", "explo_paper", "explo_true", "cover"):
        assert text in output
    second = yaml.safe_load((folder / "mappo" / "area-search-v0_2" / "config.yml").read_text())
    assert second["seed"] == 6


def test_config_of_a_run_repeats_it(logs, tmp_path):
    folder, _ = logs
    run = folder / "mappo" / "area-search-v0_1"
    result = train("--algo", "mappo", "-conf", run / "config.yml", "--seed", 5, "-f", tmp_path,
                   "--tensorboard-log", tmp_path / "tb", "--vec-env", "supersuit",
                   *FAST)  # fmt: skip
    assert result.returncode == 0, result.stderr
    again = tmp_path / "mappo" / "area-search-v0_1"
    first, second = (CheckpointFolder(r / "checkpoints").newest()[1] for r in (run, again))
    for name, tensor in first.policy.items():
        assert tensor.equal(second.policy[name])
    assert list((tmp_path / "tb").rglob("events*"))


def test_lock(tmp_path):
    lock = RunLock(tmp_path)
    with pytest.raises(UsageError, match=f"process {os.getpid()} is training this run"):
        RunLock(tmp_path)
    lock.release()
    RunLock(tmp_path).release()


def wait_for(path: Path, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 100
    while not path.exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_signal_then_resume(logs, tmp_path, number, code):
    options = ["-n", 320, "--seed", 5, "--save-freq", 0, "--verbose", 0]
    process = start("--algo", "mappo", *TINY, *SMALL, *FAST, *options, "-f", tmp_path)
    run = tmp_path / "mappo" / "area-search-v0_1"
    wait_for(run / "progress.csv", process)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    if process.returncode == 0:
        pytest.skip("it was done before the signal came")
    assert process.returncode == code, err
    assert "--resume" in out
    assert not list((run / "checkpoints").glob(".*"))
    if number == signal.SIGINT:
        return
    result = train("--resume", run)
    assert result.returncode == 0, result.stderr
    assert "not bit-exact" not in result.stdout
    straight = logs[0] / "mappo" / "area-search-v0_1"
    first, second = (CheckpointFolder(r / "checkpoints").newest()[1] for r in (run, straight))
    assert first.manifest["env_steps"] == second.manifest["env_steps"] == 320
    for name, tensor in first.policy.items():
        assert tensor.equal(second.policy[name])


@pytest.mark.parametrize("error", [FloatingPointError, ValueError])
def test_numbers_that_are_not_finite(tmp_path, monkeypatch, capsys, error):
    def diverge(self):
        raise error("the loss is nan:\nno step was taken")

    monkeypatch.setattr(MAPPO, "train", diverge)
    code = main(["--algo", "mappo", "-n", "32", "-f", str(tmp_path), *TINY, *SMALL, *FAST])
    assert code == 3
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert message.endswith("the loss is nan: no step was taken\n")


def test_a_foreign_environment(tmp_path):
    env = ["--env", "toy_envs:PlainEnv", "--algo", "hmappo", "-f", tmp_path, "-n", 64]
    result = train(*env, *SMALL, *FAST)
    assert result.returncode == 0, result.stderr
    assert "return" in result.stdout
    run = tmp_path / "hmappo" / "toy_envs-PlainEnv_1"
    assert (run / "evaluation.yml").exists()
    result = train("--resume", run, "-n", 96)
    assert result.returncode == 0, result.stderr
    assert "not bit-exact: environment of this run offers no get_state" in result.stdout
    assert yaml.safe_load((run / "config.yml").read_text())["n_timesteps"] == 96
