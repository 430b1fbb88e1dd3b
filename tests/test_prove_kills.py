"""Experiments with kills and full disks find what is planted."""

from __future__ import annotations

import shutil
import signal
import subprocess
import time
from types import SimpleNamespace

import pytest
import torch as th

from sb3_roles.common.checkpoint import CheckpointFolder
from sb3_roles.prove import full_disk, kills, processes, watched
from sb3_roles.prove.promises import Setting
from sb3_roles.prove.small_runs import ITERATION, small_settings
from sb3_roles.zoo.cli import main
from sb3_roles.zoo.config import write_yaml
from sb3_roles.zoo.environments import AREA_SEARCH
from sb3_roles.zoo.run_folder import CHECKPOINTS


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a run of two iterations."""
    folder = tmp_path_factory.mktemp("runs")
    write_yaml(folder / "given.yml", {AREA_SEARCH: small_settings(kills.ALGO, 2)})
    words = ["--algo", kills.ALGO, "-conf", str(folder / "given.yml"), "-f", str(folder / "logs")]
    words += ["--eval-freq", str(ITERATION), "--eval-episodes", "2", "--save-freq", str(ITERATION)]
    assert main([*words, "--num-threads", "1", "--device", "cpu", "--verbose", "0"], "train") == 0
    return folder / "logs" / kills.ALGO / f"{AREA_SEARCH}_1"


def change_weights(run):
    folder = CheckpointFolder(run / CHECKPOINTS)
    _, found = folder.newest()
    name = next(iter(found.policy))
    policy = {**found.policy, name: found.policy[name] + 1e-6}
    manifest = {key: found.manifest[key] for key in ("env_steps", "agent_steps")}
    folder.save(
        manifest["env_steps"],
        manifest=manifest,
        policy=policy,
        optimizer=found.optimizer,
        state=found.state,
    )


def change_line(name):
    def change(run):
        lines = (run / name).read_text().splitlines()
        (run / name).write_text("\n".join(lines[:-1]) + "\n")

    return change


PLANTED = {
    "policy": change_weights,
    "progress.csv": change_line("progress.csv"),
    "roles.csv": change_line("roles.csv"),
    "evaluations.csv": change_line("evaluations.csv"),
    "evaluation.yml": change_line("evaluation.yml"),
    "best/model.ckpt": lambda run: (run / "best/model.ckpt").write_bytes(b"other"),
}


@pytest.mark.parametrize("name", PLANTED)
def test_runs_that_differ_are_told_apart(finished, tmp_path, name):
    other = tmp_path / "other"
    shutil.copytree(finished, other)
    assert kills.run_difference(finished, other) is None
    PLANTED[name](other)
    assert kills.run_difference(finished, other).startswith(name)
    assert kills.run_difference(finished, None) == "their being there"


def stopped(finished, tmp_path, code=143, error="one line\n", prepare=lambda run: None):
    """Return what is said of a process that was stopped by SIGTERM."""
    trainee = kills.Trainee(tmp_path / "trial", small_settings(kills.ALGO, 2))
    shutil.copytree(finished.parents[1], trainee.folder / "logs")
    prepare(trainee.run)
    trainee.board.write(watched.UPDATE)
    process = SimpleNamespace(returncode=code)
    return kills._stopped_badly(trainee, process, signal.SIGTERM, error)


def damage(run):
    for path in (run / CHECKPOINTS).iterdir():
        path.write_bytes(path.read_bytes()[:-1])


BAD = {
    "exit code 0": {"code": 0},
    "died of the signal": {"code": -15},
    "2 lines: b": {"error": "a\nb"},
    "left x.1-a.partial": {"prepare": lambda run: (run / "x.1-a.partial").touch()},
    "does not load": {"prepare": damage},
    "left half a run folder": {"prepare": lambda run: (run / "config.yml").unlink()},
}


@pytest.mark.parametrize("problem", BAD)
def test_a_stop_that_leaves_something_bad_is_told(finished, tmp_path, problem):
    (found,) = stopped(finished, tmp_path, **BAD[problem])
    assert found.startswith(problem)


def test_a_good_stop_has_no_problems(finished, tmp_path):
    assert stopped(finished, tmp_path) == []


def test_processes_that_stay_are_found_and_killed(tmp_path):
    process = subprocess.Popen(
        ["sh", "-c", "sleep 60 & echo $!"],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    left = int(process.stdout.readline())
    process.wait()
    assert processes.left_behind(process) == [left]
    processes.kill_session(process)
    deadline = time.monotonic() + 60
    while processes.left_behind(process):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_board_tells_the_phase(tmp_path):
    board = watched.Board(tmp_path / "board")
    assert board.read() == (watched.IMPORT, 0)
    board.write(watched.START)
    inside = SimpleNamespace(work=lambda: other.read())
    other = watched.Board(tmp_path / "board")
    board.watch(inside, "work", watched.SAVE)
    assert inside.work() == (watched.SAVE, 2)
    assert other.read().phase == watched.BETWEEN


def test_writing_in_place_is_found_by_kills_and_by_a_full_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(kills, "SAVE_LOOPS", "planted_writes")
    monkeypatch.setattr(full_disk, "DISK_TRIALS", "planted_writes")
    for name, prove in (("saves", kills.saves), ("disk", full_disk.offsets)):
        folder = tmp_path / name
        folder.mkdir()
        outcome = prove(Setting(True, folder, 0))
        assert not outcome.kept
        assert outcome.failures, outcome
        assert outcome.held < outcome.tried
    assert any("checkpoint" in line for line in outcome.failures)


def test_weights_of_another_save_are_found(tmp_path, monkeypatch):
    from sb3_roles.prove import save_loops

    monkeypatch.setattr(save_loops, "killed_loop", lambda save, delay: save(1) and 1)
    assert save_loops.own_trial(tmp_path, 0.0, False) == (False, "")
    monkeypatch.setattr(save_loops, "killed_loop", lambda save, delay: 2)
    assert "save 2 was done, 1 is the newest" in save_loops.own_trial(tmp_path, 0.0, False)[1]
    changed = {"policy": {"w": th.zeros(3)}}
    CheckpointFolder(tmp_path).save(2, **{**save_loops.content(2), **changed})
    assert "weights of another one" in save_loops.own_trial(tmp_path, 0.0, False)[1]
