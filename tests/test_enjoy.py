"""Trained policies are watched, filmed and evaluated from the command line."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = {
    **{name: value for name, value in os.environ.items() if "DISPLAY" not in name},
    "PYTHONPATH": os.pathsep.join([str(ROOT / "envs"), str(ROOT), str(ROOT / "tests")]),
    "OMP_NUM_THREADS": "1",
}
TINY = ["height:7", "width:7", "n_targets:8", "horizon:6"]


def command(*args: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *args], env=ENVIRONMENT, capture_output=True, text=True, cwd=cwd
    )


@pytest.fixture(scope="module")
def logs(tmp_path_factory) -> Path:
    """Two runs on area search and one on another environment, as ``train.py`` leaves them."""
    from sb3_roles.common.checkpoint import CheckpointFolder
    from sb3_roles.zoo.config import resolve, write_yaml
    from sb3_roles.zoo.models import make_env, make_model
    from sb3_roles.zoo.run_folder import BEST, CHECKPOINTS, new_run

    root = tmp_path_factory.mktemp("logs")
    scene = {"height": 7, "width": 7, "n_targets": 8, "horizon": 6, "sub_goal": "assigned"}
    scene["early_stop_patience"] = 2
    for seed, (algo, env, env_kwargs) in enumerate(
        [
            ("hmappo", "area-search-v0", scene),
            ("hmappo", "area-search-v0", scene),
            ("mappo", "toy_envs:PlainEnv", {}),
        ]
    ):
        settings = {"n_timesteps": 8, "n_envs": 2, "n_steps": 2, "batch_size": 2}
        config = resolve(algo, env, {**settings, "env_kwargs": env_kwargs}, seed)
        model = make_model(config, make_env(config), "cpu")
        run = new_run(root, algo, env)
        write_yaml(run / "config.yml", config)
        weights = model.policy.state_dict()
        CheckpointFolder(run / CHECKPOINTS).prepare()
        CheckpointFolder(run / CHECKPOINTS).save(0, manifest={}, policy=weights)
        if seed == 0:
            from sb3_roles.evaluation.callback import save_policy

            save_policy(model, run / BEST, {})
    return root


@pytest.fixture
def play(monkeypatch, capsys):
    """Run a command in this process; what it prints."""
    from sb3_roles.zoo.cli import main

    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)

    def run(*args: str) -> str:
        assert main(args) == 0
        captured = capsys.readouterr()
        assert captured.err == ""
        return captured.out

    return run


def n_frames(video: Path) -> int:
    if video.suffix == ".gif":
        from PIL import Image

        with Image.open(video) as image:
            return image.n_frames
    reader = pytest.importorskip("imageio_ffmpeg").read_frames(str(video))
    next(reader)
    return sum(1 for _ in reader)


def test_the_launcher_films_an_episode(logs, tmp_path):
    pytest.importorskip("PIL")
    result = command(
        *("enjoy.py", "--algo", "hmappo", "--env", "area-search-v0", "-f", str(logs)),
        *("--video", str(tmp_path / "episode.gif")),
    )
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    assert n_frames(tmp_path / "episode.gif") == 7
    result = command("enjoy.py", "--sed", "1")
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith("enjoy.py: error: ")
    assert "did you mean '--seed'?" in result.stderr


@pytest.mark.parametrize("ending", [".gif", ".mp4"])
def test_a_video_shows_the_start_and_every_step(ending, logs, tmp_path, play):
    pytest.importorskip("PIL" if ending == ".gif" else "imageio_ffmpeg")
    video = tmp_path / f"episode{ending}"
    printed = play("enjoy", "-f", str(logs), "--video", str(video), "--n-agents", "5")
    assert "area-search-v0_2" in printed
    # The early stop of the training is off.
    assert "length 6" in printed
    assert "explore " in printed
    assert n_frames(video) == 7
    assert os.listdir(tmp_path) == [video.name]


def test_runs_are_chosen_as_in_rl_zoo(logs, play):
    first = play(
        *("enjoy", "--algo", "hmappo", "-f", str(logs), "--exp-id", "1", "--load-best"),
        *("--stochastic", "--episodes", "2", "--env-kwargs", "horizon:4", "--no-communication"),
    )
    assert "area-search-v0_1" in first
    assert "no display" in first
    assert "length 4" in first
    assert "mean of 2" in first
    folder = logs / "hmappo" / "area-search-v0_1"
    assert "no display" not in play("enjoy", "-f", str(folder), "--no-render")


def test_another_environment_is_played(logs, play):
    printed = play(
        *("enjoy", "--algo", "mappo", "--env", "toy_envs:PlainEnv", "-f", str(logs)),
        *("--no-render", "--episodes", "2"),
    )
    assert "return" in printed
    assert "length 5" in printed


def test_code_runs_only_if_the_user_names_it(logs, tmp_path, play, monkeypatch, capsys):
    """A run folder from anybody must not choose what is imported and called."""
    from sb3_roles.zoo import environments
    from sb3_roles.zoo.cli import main
    from sb3_roles.zoo.models import load_model
    from sb3_roles.zoo.options import UsageError

    run = tmp_path / "run"
    shutil.copytree(logs / "mappo" / "toy_envs-PlainEnv_1", run)
    config = yaml.safe_load((run / "config.yml").read_text())
    evil = "subprocess:Popen"
    (run / "config.yml").write_text(
        yaml.safe_dump({**config, "env": evil, "env_kwargs": {"args": ["touch", "x"]}})
    )
    imported = []
    monkeypatch.setattr(environments, "import_module", imported.append)
    wrong = [
        (["-f", str(run)], f"add --env {evil} if you trust it"),
        (["-f", str(run), "--env", "toy_envs:PlainEnv"], f"is {evil}, not toy_envs:PlainEnv"),
        (["-f", str(run), "--env", "area-search-v0"], f"is {evil}, not area-search-v0"),
    ]
    for args, message in wrong:
        with pytest.raises(SystemExit) as end:
            main(["enjoy", "--no-render", *args])
        error = capsys.readouterr().err
        assert end.value.code == 2
        assert message in error
        assert error.count("\n") == 1
    with pytest.raises(UsageError, match="its environment is code"):
        load_model(run)
    with pytest.raises(UsageError, match="not area-search-v0"):
        load_model(run, env="area-search-v0")
    assert imported == []
    monkeypatch.undo()
    model = load_model(logs / "mappo" / "toy_envs-PlainEnv_1", env="toy_envs:PlainEnv")
    assert model.num_timesteps == 0


def test_a_window_shows_the_episode(logs, play, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    assert "length 6" in play("enjoy", "-f", str(logs), "--fps", "200")


def test_frames_of_another_environment():
    from toy_envs import ToyEnv

    from sb3_roles import MAPPO, TeamWrapper, make_team_vec_env
    from sb3_roles.evaluation.policies import PolicyController
    from sb3_roles.zoo.playback import play_env

    model = MAPPO(
        "TeamPolicy",
        TeamWrapper(make_team_vec_env(ToyEnv, 1, 0)),
        policy_kwargs={"actor_keys": ["vector"], "critic_keys": ["vector"]},
        device="cpu",
    )
    frames = []
    metrics, roles = play_env(PolicyController(model), ToyEnv(), 3, frames.append)
    assert len(frames) == metrics["length"] + 1 == len(roles) + 1
    assert frames[0].shape == (4, 6, 3)
    assert metrics["total"] >= 0


@pytest.mark.parametrize("name", ["RUN", "random"])
def test_evaluate(name, logs, play):
    controller = str(logs / "hmappo" / "area-search-v0_2") if name == "RUN" else name
    printed = play(
        *("evaluate", "--controller", controller, "--episodes", "10"),
        *("--json", "--n-agents", "3", "--scene-options", *TINY),
    )
    report = json.loads(printed)
    assert report["config"]["controller"] == controller
    assert report["metrics"]["length"]["mean"] == 6


@pytest.mark.parametrize("algo", ["maskable_ppo", "recurrent_ppo", "ppo"])
def test_policies_of_single_robots_are_controllers(algo):
    from area_search import get_scene
    from sb3_roles.evaluation.episodes import run_episodes
    from sb3_roles.evaluation.policies import PolicyController
    from sb3_roles.zoo.config import resolve
    from sb3_roles.zoo.models import make_env, make_model

    settings = {"n_timesteps": 8, "n_envs": 1, "n_steps": 4, "batch_size": 4}
    scene = {"height": 7, "width": 7, "n_targets": 8, "horizon": 6}
    config = resolve(algo, "area-search-v0", {**settings, "env_kwargs": scene})
    env = make_env(config)
    controller = PolicyController(make_model(config, env, "cpu"))
    records = run_episodes(controller, get_scene("hard", **scene), 4, seed=0)
    assert records.roles.min() >= 0


WRONG = [
    (["enjoy", "--algo", "hmapo"], "did you mean 'hmappo'"),
    (["enjoy", "-f", "/nowhere"], "no run of hmappo"),
    (["enjoy", "-f", "LOGS", "--exp-id", "7"], "no run 7"),
    (["enjoy", "-f", "LOGS", "--exp-id", "-1"], "--exp-id"),
    (["enjoy", "-f", "LOGS", "--video", "x.avi"], ".mp4 or .gif"),
    (["enjoy", "-f", "LOGS", "--video", "nowhere/x.gif"], "'nowhere'"),
    (["enjoy", "-f", "LOGS", "--scene", "hrad"], "did you mean 'hard'"),
    (["enjoy", "-f", "LOGS", "--n-agents", "0"], "got 0"),
    (["enjoy", "-f", "LOGS", "--env-kwargs", "horizn:4"], "horizon"),
    (["enjoy", "-f", "LOGS", "--load-best"], "area-search-v0_2"),
    (["enjoy", "-f", "LOGS", "--deterministic", "--stochastic"], "not allowed"),
    (["enjoy", "-f", "LOGS/hmappo/area-search-v0_1", "--algo", "mappo"], "hmappo, not mappo"),
    (["enjoy", "-f", "LOGS/mappo/toy_envs-PlainEnv_1"], "add --env toy_envs:PlainEnv"),
    (["enjoy", "-f", "LOGS", "--device", "gpu"], "allowed are auto, cpu, cuda"),
    (["enjoy", "-f", "LOGS", "--fps", "0"], "--fps"),
    (["evaluate", "--controller", "randm"], "did you mean 'random'"),
    (["evaluate", "--controller", "LOGS"], "config.yml"),
    (["evaluate"], "--controller"),
]


@pytest.mark.parametrize(("args", "part"), WRONG)
def test_wrong_command_line(args, part, logs, capsys):
    from sb3_roles.zoo.cli import main

    with pytest.raises(SystemExit) as end:
        main([arg.replace("LOGS", str(logs)) for arg in args])
    assert end.value.code == 2
    message = capsys.readouterr().err
    assert message.startswith(f"sb3-roles {args[0]}: error: ")
    assert part in message
    assert message.count("\n") == 1


def test_a_missing_package_names_the_extra(monkeypatch, tmp_path):
    from sb3_roles.zoo import video
    from sb3_roles.zoo.options import UsageError

    monkeypatch.setattr(video, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"needs imageio-ffmpeg: .*sb3_roles\[video\]"):
        video.check_video(tmp_path / "x.mp4")


def test_an_interrupted_video_leaves_nothing(tmp_path):
    from sb3_roles.zoo.video import VideoWriter

    pytest.importorskip("PIL")
    with pytest.raises(KeyboardInterrupt), VideoWriter(tmp_path / "x.gif", 5) as video:
        video.add(np.zeros((4, 4, 3), np.uint8))
        raise KeyboardInterrupt
    assert os.listdir(tmp_path) == []
