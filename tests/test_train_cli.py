"""``train.py``, as a user meets it: in a process of its own."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import toy_envs
import yaml

from sb3_roles.common.checkpoint import CheckpointFolder
from sb3_roles.mappo import MAPPO
from sb3_roles.zoo import job
from sb3_roles.zoo.cli import main
from sb3_roles.zoo.config import write_yaml
from sb3_roles.zoo.models import make_env
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.run_folder import RunLock, source_commit

ROOT = Path(__file__).resolve().parents[1]
PATHS = [str(ROOT / "envs"), str(ROOT), str(ROOT / "tests")]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(PATHS)}
TINY = ["--env-kwargs", "height:7", "width:7", "n_targets:5", "n_agents:2", "horizon:6"]
SMALL = ["-params", "n_envs:4", "n_steps:8", "batch_size:16", "n_epochs:1"]
FAST = ["--num-threads", "1", "--eval-freq", "0", "--eval-episodes", "4", "--device", "cpu"]


def start(*args: object, **options: Any) -> subprocess.Popen[str]:
    command = [sys.executable, str(ROOT / "train.py"), *map(str, args)]
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command, env=ENVIRONMENT, stdout=pipe, stderr=pipe, text=True, **options
    )


def train(*args: object, **options: Any) -> subprocess.CompletedProcess[str]:
    process = start(*args, **options)
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
    (["--resume", ""], "argument --resume: must name a folder, got ''"),
    (["-f", ""], "argument -f/--log-folder: must name a folder, got ''"),
    (["--resume", "x", "--seed", "3"], "leave --seed out"),
    (["--seed", str(2**32)], "from 0 to 4294967295"),
    (["--seed", str(2**32 - 1), "--n-seeds", "2"], "seed must be"),
    (["-n", "5", "-params", "env:subprocess:Popen"], "env is no hyperparameter: give --env"),
    (["-n5x"], "joint steps, got '5x'"),
    (["-xn5"], "unknown option '-xn5'"),
    (["extra"], "unexpected argument 'extra'"),
    (["--n-agents", "2", "-f", "/proc/none/logs"], "/proc/none"),
    (["-tb", "/dev/null"], "/dev/null is no folder"),
    (["-params", "policy_kwargs:{optimizer_kwargs: null}"], "keys and values, got None"),
    (["--env-kwargs", "sub_goal:none", "-params", "gama:1"], "did you mean 'gamma'?"),
    (["-conf", str(ROOT / "zoo_configs")], "zoo_configs: Is a directory"),
    (
        [
            "--env-kwargs",
            "communication_radius:5",
            "-params",
            "policy_kwargs:{communication_radius: 4}",
        ],
        "must be the environment's, 5, got 4",
    ),
    (["--env-kwargs", "reward_sharing:same_role"], "wrapper_kwargs.reward_sharing"),
    (
        ["-params", "rollout_groups:129"],
        "rollout_groups must be at most n_envs = 128 teams, got 129",
    ),
    (["--rollout-workers", "2"], "--rollout-workers needs --ray ADDRESS"),
    (["--ray", "local"], "--ray needs several runs"),
    (["--ray", "local", "--n-seeds", "2", "--rollout-workers", "2"], "not both"),
    (["--ray", "local", "--vary", "gamma:0.9", "gamma:0.8", "--rollout-workers", "2"], "not both"),
    (["--vary", "gamma"], "must be key:value"),
    (["--vary", "gama:0.9"], "did you mean 'gamma'?"),
    (["--vary", "gamma:0.9", "-params", "gamma:0.8"], "gamma is given in --vary and in"),
    (["--algo", "hmappo,mapo"], "did you mean 'mappo'?"),
    (["--algo", "hmappo,mappo", "-conf", "zoo_configs/hmappo.yml"], "of one algorithm"),
    (
        ["--ray", "local", "--rollout-workers", "3"],
        "--rollout-workers 3: the configuration's rollout_groups is 2",
    ),
    (
        ["--algo", "ppo", "--ray", "local", "--rollout-workers", "1"],
        "ppo plays its rollouts itself; allowed for hmappo, mappo, ecc, h2gnn",
    ),
    (
        [
            "--algo",
            "mappo",
            "--env",
            "toy_envs:PlainEnv",
            "--ray",
            "local",
            "--rollout-workers",
            "1",
        ],
        "offers no get_state, with which its teams would travel",
    ),
]


def run_main(capsys: pytest.CaptureFixture[str], *args: str) -> tuple[int, str, str]:
    """``train.py`` in this process: its exit code, and what it prints."""
    try:
        code = main(args, "train")
    except SystemExit as end:
        code = end.code
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.mark.parametrize(("args", "expected"), WRONG)
def test_wrong_arguments(tmp_path, capsys, args, expected):
    where = [] if {"--resume", "-f"} & set(args) else ["-f", str(tmp_path)]
    code, out, err = run_main(capsys, *args, *where)
    assert (code, out) == (2, ""), err
    assert err.count("\n") == 1, err
    assert err.startswith("train.py: error: ")
    assert expected in err
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
    # The first option has its value attached.
    options = ["--seed", 5, "--n-seeds", 2, "--save-freq", 160, "-f", folder]
    result = train("-n320", "--algo", "mappo", *TINY, *SMALL, *FAST, *options)
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
    assert command.startswith("train.py -n320 --algo mappo")
    assert "torch" in command
    assert len((run / "progress.csv").read_text().splitlines()) == 11
    names = [path.name for path in (run / "checkpoints").iterdir()]
    assert sorted(names) == ["step_000000000160.ckpt", "step_000000000320.ckpt"]
    for text in ("OMP_WAIT_POLICY=PASSIVE", "1 threads", "explo_paper", "explo_true", "cover"):
        assert text in output
    second = yaml.safe_load((folder / "mappo" / "area-search-v0_2" / "config.yml").read_text())
    assert second["seed"] == 6


def test_a_run_for_each_algorithm_and_change(tmp_path, capsys):
    tiny = ["n_envs:2", "n_steps:4", "batch_size:8", "rollout_groups:1", "n_shards:1"]
    several = ["--algo", "mappo,hmappo", "--vary", "gamma:0.9", "gamma:0.8"]
    once = ["-n", "8", "--eval-freq", "0", "--eval-episodes", "1", "--verbose", "0"]
    code, _, err = run_main(capsys, *several, "-params", *tiny, *once, "-f", str(tmp_path))
    assert code == 0, err
    found = []
    for algo in ("mappo", "hmappo"):
        for run in sorted((tmp_path / algo).iterdir()):
            config = yaml.safe_load((run / "config.yml").read_text())
            found.append((config["algo"], config["gamma"], config["n_envs"]))
    assert found == [(algo, gamma, 2) for algo in ("mappo", "hmappo") for gamma in (0.9, 0.8)]


def test_config_of_a_run_repeats_it(logs, tmp_path):
    folder, _ = logs
    run = folder / "mappo" / "area-search-v0_1"
    # Algorithm, environment and seed are the run's; the backend is given.
    result = train("-conf", run / "config.yml", "-f", tmp_path,
                   "--tensorboard-log", tmp_path / "tb", "--vec-env", "supersuit",
                   *FAST)  # fmt: skip
    assert result.returncode == 0, result.stderr
    again = tmp_path / "mappo" / "area-search-v0_1"
    first, second = (CheckpointFolder(r / "checkpoints").newest()[1] for r in (run, again))
    for name, tensor in first.policy.items():
        assert tensor.equal(second.policy[name])
    assert list((tmp_path / "tb").rglob("events*"))
    config = yaml.safe_load((again / "config.yml").read_text())
    assert (config["seed"], config["vec_env"]) == (5, "supersuit")
    assert yaml.safe_load((again / "args.yml").read_text())["algo"] == "mappo"


def test_the_command_line_wins_over_the_config_of_a_run(logs, tmp_path, monkeypatch, capsys):
    file = str(logs[0] / "mappo" / "area-search-v0_1" / "config.yml")
    seen = []
    monkeypatch.setattr(job, "run_job", lambda job, stop: seen.append(job["config"]) or 0)
    assert main(["-conf", file, "--seed", "9", "--n-seeds", "2", "-n5"], "train") == 0
    assert main(["-conf", file, "--env", "toy_envs:PlainEnv", "-params",
                 "env_kwargs:null"], "train") == 0  # fmt: skip
    assert [config["seed"] for config in seen] == [9, 10, 5]
    assert [config["n_timesteps"] for config in seen] == [5, 5, 320]
    assert [config["env"] for config in seen] == [*2 * ["area-search-v0"], "toy_envs:PlainEnv"]
    code, _, err = run_main(capsys, "-conf", file, "--algo", "hmappo")
    assert code == 2
    assert "is of a run of mappo: leave --algo hmappo out" in err
    assert len(seen) == 3


def test_a_file_imports_nothing_that_the_user_did_not_name(tmp_path, capsys):
    file = tmp_path / "config.yml"
    config = {"algo": "mappo", "env": "subprocess:Popen", "env_kwargs": {"args": "id"}}
    write_yaml(file, {**config, "n_timesteps": 10})
    write_yaml(tmp_path / "args.yml", {})
    write_yaml(tmp_path / "bad.yml", {"default": {"env": config["env"], "n_timesteps": 10}})
    named = "add --env subprocess:Popen if you trust it"
    other = ["--env", "area-search-v0"]
    for args, expected in [
        (["-conf", str(file)], named),
        (["--resume", str(tmp_path)], named),
        (["--resume", str(tmp_path), *other], "is subprocess:Popen, not area-search-v0"),
        (["-conf", str(tmp_path / "bad.yml")], "env is no hyperparameter: give --env"),
    ]:
        code, _, err = run_main(capsys, *args)
        assert code == 2
        assert expected in err
        assert err.count("\n") == 1


def test_a_resume_that_fails_leaves_the_run_alone(logs, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(logs[0] / "mappo" / "area-search-v0_1", run)
    files = ("config.yml", "command.txt", "progress.csv")
    config = yaml.safe_load((run / "config.yml").read_text())
    wrong = [
        (["-n", "640"], {"policy_kwargs": {"graph_width": 9}}, "do not fit the configuration"),
        (["-n", "100"], {}, "has 320 joint steps already, more than -n 100"),
    ]
    for args, changes, message in wrong:
        write_yaml(run / "config.yml", {**config, **changes})
        before = [(run / name).read_bytes() for name in files]
        code, _, err = run_main(capsys, "--resume", str(run), *args)
        assert code == 2
        assert message in err
        assert err.count("\n") == 1
        assert [(run / name).read_bytes() for name in files] == before
    write_yaml(run / "config.yml", config)
    (run / "progress.csv").write_bytes(b"\xff\xfe")
    code, _, err = run_main(capsys, "--resume", str(run), "-n", "640")
    assert code == 2
    assert "progress.csv: damaged log" in err
    assert yaml.safe_load((run / "config.yml").read_text()) == config
    write_yaml(run / "args.yml", {"tensorboard_log": 3})
    code, _, err = run_main(capsys, "--resume", str(run))
    assert code == 2
    assert "tensorboard_log must be a text, got 3" in err


@pytest.mark.parametrize("window", [3, 100])
def test_the_window_is_that_of_the_configuration(tmp_path, monkeypatch, window):
    made = []
    for name in ("TeamMetricsCallback", "RoleCallback"):
        kind = getattr(job, name)
        monkeypatch.setattr(
            job, name, lambda *args, kind=kind, **options: made.append(kind(*args, **options))
            or made[-1]
        )  # fmt: skip
    args = ["-n", "64", "-f", str(tmp_path), *TINY, *SMALL, f"stats_window_size:{window}", *FAST]
    assert main([*args, "--verbose", "0"], "train") == 0
    assert [callback.window.maxlen for callback in made] == [window, window]
    # 16 steps of four teams, episodes of 6: two each.
    assert len(made[0].window) == min(window, 8)


def test_environments_are_closed_in_the_end(tmp_path, monkeypatch):
    made, closed = [], []

    def make(*args):
        env = make_env(*args)
        close = env.close
        env.close = lambda: (closed.append(env), close())
        made.append(env)
        return env

    monkeypatch.setattr(job, "make_env", make)
    args = ["--env", "toy_envs:PlainEnv", "--algo", "mappo", "-n", "32", "-f", str(tmp_path),
            *SMALL, "--eval-freq", "16", "--eval-episodes", "2", "--verbose", "0"]  # fmt: skip
    assert main(args, "train") == 0
    # That of the training, of the periodic evaluation, and of the last one.
    assert len(made) == 3
    assert set(map(id, closed)) == set(map(id, made))

    def diverge(self):
        raise FloatingPointError("the loss is nan")

    made.clear(), closed.clear()
    monkeypatch.setattr(MAPPO, "train", diverge)
    assert main(args, "train") == 3
    assert len(made) == 2
    assert set(map(id, closed)) == set(map(id, made))


def test_the_commit_is_that_of_the_source(tmp_path):
    def git(*args: str) -> str:
        who = ["-c", "user.name=x", "-c", "user.email=x@x"]
        command = ["git", "-C", str(tmp_path), *who, *args]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    file = tmp_path / "package" / "module.py"
    file.parent.mkdir()
    file.write_text("1")
    assert source_commit(file) is None
    git("init", "-q")
    # In the tree of another project, as what is installed in its virtual environment.
    git("commit", "-q", "--allow-empty", "-m", "x")
    assert source_commit(file) is None
    git("add", "package")
    git("commit", "-q", "-m", "y")
    assert source_commit(file) == git("rev-parse", "HEAD")
    file.write_text("2")
    assert source_commit(file) == git("rev-parse", "HEAD") + " with changes"


def test_scripts_can_be_imported():
    """As processes that are spawned do."""
    code = "import runpy; [runpy.run_path(f + '.py', run_name='__mp_main__') for f in ({})]"
    code = code.format("'train', 'enjoy'")
    result = subprocess.run([sys.executable, "-c", code, "--nonsense"], env=ENVIRONMENT, cwd=ROOT,
                            capture_output=True, text=True)  # fmt: skip
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


def test_a_closed_pipe_ends_quietly(tmp_path):
    process = start("--algo", "mappo", *TINY, *SMALL, *FAST, "-n", 320, "-f", tmp_path)
    process.stdout.close()
    assert process.wait(timeout=100) == 141
    assert process.stderr.read() == ""
    process.stderr.close()


def test_lock(tmp_path):
    lock = RunLock(tmp_path)
    with pytest.raises(UsageError, match=f"process {os.getpid()} is training this run"):
        RunLock(tmp_path)
    lock.release()
    RunLock(tmp_path).release()


def test_a_link_in_the_place_of_the_lock_is_not_followed(tmp_path, monkeypatch):
    precious = tmp_path / "precious"
    precious.write_text("data\n")
    (tmp_path / "lock").symlink_to(precious)
    with pytest.raises(UsageError, match="lock: is a symbolic link"):
        RunLock(tmp_path)
    # Nor one that appears between the look and the opening.
    monkeypatch.setattr("pathlib.Path.is_symlink", lambda path: False)
    with pytest.raises(UsageError, match="lock: Too many levels of symbolic links"):
        RunLock(tmp_path)
    assert precious.read_text() == "data\n"


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


def test_too_little_memory_is_one_line(tmp_path, capsys):
    """Torch raises a RuntimeError, after the rollout buffer is asked for 10^14 bytes."""
    huge = ["-params", "n_envs:4", "n_steps:1000000", "batch_size:16"]
    scene = ["--env-kwargs", "height:999", "width:999", "n_agents:2"]
    code, _, err = run_main(capsys, "-f", str(tmp_path), *scene, *huge, *FAST, "--verbose", "0")
    assert code == 2
    assert err.startswith("train.py: error: out of memory: ")
    assert err.count("\n") == 1


@pytest.mark.parametrize("error", [FloatingPointError, ValueError])
def test_numbers_that_are_not_finite(tmp_path, monkeypatch, capsys, error):
    def diverge(self):
        raise error("the loss is nan:\nno step was taken")

    monkeypatch.setattr(MAPPO, "train", diverge)
    args = ["--algo", "mappo", "-n", "32", "-f", str(tmp_path), *TINY, *SMALL, *FAST]
    code = main(args, "train")
    assert code == 3
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert message.endswith("the loss is nan: no step was taken\n")


@pytest.mark.parametrize("error", [SystemExit(0), OSError("bad memory"), KeyError("x")])
@pytest.mark.parametrize("when", ["training", "evaluation"])
def test_an_error_of_an_environment_is_one_line_and_one_exit_code(
    tmp_path, monkeypatch, capsys, error, when
):
    def step(env, actions):
        raise error

    if when == "training":
        monkeypatch.setattr(toy_envs.PlainEnv, "step", step)
    else:
        own = job._evaluate

        def evaluate(*args):
            monkeypatch.setattr(toy_envs.PlainEnv, "step", step)
            own(*args)

        monkeypatch.setattr(job, "_evaluate", evaluate)
    env = ["--env", "toy_envs:PlainEnv", "--algo", "mappo", "-f", str(tmp_path), "-n", "32"]
    assert main([*env, *SMALL, *FAST], "train") == 3
    message = capsys.readouterr().err
    run = tmp_path / "mappo" / "toy_envs-PlainEnv_1"
    name = type(error).__name__
    begin = f"train.py: error: {run}: environment toy_envs:PlainEnv: {name} in step 1: {error} ("
    assert message.startswith(begin)
    assert message.count("\n") == 1


def test_an_environment_that_can_not_be_closed_is_a_warning(tmp_path, monkeypatch, capsys):
    def fail(env):
        raise RuntimeError("simulator is gone")

    def step(env, actions):
        raise KeyError("x")

    monkeypatch.setattr(toy_envs.PlainEnv, "close", fail)
    env = ["--env", "toy_envs:PlainEnv", "--algo", "mappo", "-f", str(tmp_path), "-n", "32"]
    begin = "warning: environment toy_envs:PlainEnv: RuntimeError in close: simulator is gone ("
    assert main([*env, *SMALL, *FAST], "train") == 0
    assert all(line.startswith(begin) for line in capsys.readouterr().err.splitlines())
    monkeypatch.setattr(toy_envs.PlainEnv, "step", step)
    assert main([*env, *SMALL, *FAST], "train") == 3
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith(begin)
    assert "KeyError in step 1: 'x'" in second


def test_the_command_that_goes_on_names_the_environment(tmp_path, monkeypatch, capsys):
    def interrupted(*args):
        raise KeyboardInterrupt

    env = ["--env", "toy_envs:PlainEnv"]
    words = [*env, "--algo", "mappo", "-f", str(tmp_path / "my logs"), "-n", "32"]
    with monkeypatch.context() as patch:
        patch.setattr(job, "_evaluate", interrupted)
        assert main([*words, *SMALL, *FAST], "train") == 130
    last = capsys.readouterr().out.splitlines()[-1]
    command = shlex.split(last.removeprefix("stopped; to go on: "))
    assert main(command[1:], command[0].removesuffix(".py")) == 0


def test_a_foreign_environment(tmp_path):
    env = ["--env", "toy_envs:PlainEnv", "--algo", "hmappo", "-f", tmp_path, "-n", 64]
    result = train(*env, *SMALL, *FAST)
    assert result.returncode == 0, result.stderr
    assert "return" in result.stdout
    run = tmp_path / "hmappo" / "toy_envs-PlainEnv_1"
    assert (run / "evaluation.yml").exists()
    result = train("--resume", run, "-n", 96)
    assert result.returncode == 2
    assert "add --env toy_envs:PlainEnv if you trust it" in result.stderr
    result = train("--resume", run, "-n", 96, "--env", "toy_envs:PlainEnv")
    assert result.returncode == 0, result.stderr
    assert "not bit-exact: environment of this run offers no get_state" in result.stdout
    assert yaml.safe_load((run / "config.yml").read_text())["n_timesteps"] == 96


def test_what_is_no_run_folder_names_the_runs_there(tmp_path, capsys):
    for name in ("mappo/small_1", "mappo/small_2", "ppo/small_1"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "config.yml").write_text("x")
    folder = tmp_path / "mappo"
    code, _, err = run_main(capsys, "--resume", str(folder))
    what = f"{folder}: no run folder, without config.yml; runs in {folder}: small_1, small_2\n"
    assert (code, err) == (2, f"train.py: error: {what}")
    _, _, err = run_main(capsys, "--resume", str(tmp_path / "nope"))
    assert err.endswith(f"runs in {tmp_path}: mappo/small_1, mappo/small_2, ppo/small_1\n")
    _, _, err = run_main(capsys, "--resume", str(folder / "smal_2"))
    assert err.endswith(f"did you mean {str(folder / 'small_2')!r}?\n")


@pytest.mark.parametrize("name", ["checkpoints", "best"])
def test_a_run_that_can_not_be_written_is_refused_before_anything_changes(logs, tmp_path, name):
    run = tmp_path / "run"
    shutil.copytree(logs[0] / "mappo" / "area-search-v0_1", run)
    if name == "best":
        (run / name).write_text("")
    else:
        (run / name).rename(tmp_path / "aside")
        (run / name).write_text("")
    before = {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()}
    with pytest.raises(SystemExit):
        main(["--resume", str(run), "-n", "640"], "train")
    assert {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()} == before


def test_what_keeps_a_checkpoint_from_fitting_is_named(logs, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(logs[0] / "mappo" / "area-search-v0_1", run)
    config = yaml.safe_load((run / "config.yml").read_text())
    write_yaml(run / "config.yml", {**config, "n_envs": 2})
    code, _, err = run_main(capsys, "--resume", str(run), "-n", "640")
    assert code == 2
    assert err.count("\n") == 1
    assert "n_envs was 4, is 2" in err
