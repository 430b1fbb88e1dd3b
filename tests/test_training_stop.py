"""Signals during a run: it ends at once, and goes on as if it had never been stopped."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sb3_roles.common import files, interrupts
from sb3_roles.common.checkpoint import CheckpointFolder
from sb3_roles.evaluation.callback import EvaluationCallback
from sb3_roles.gnn import recording
from sb3_roles.gnn.gnn import GNN
from sb3_roles.prove import processes
from sb3_roles.prove.kills import run_difference
from sb3_roles.prove.small_runs import ITERATION, small_settings
from sb3_roles.zoo import job, training
from sb3_roles.zoo.algorithms import ALGORITHMS
from sb3_roles.zoo.cli import main
from sb3_roles.zoo.config import write_yaml
from sb3_roles.zoo.models import load_model
from sb3_roles.zoo.run_folder import CHECKPOINTS
from sb3_roles.zoo.stop_signals import StopSignals

ENV = "area-search-v0"
GRAPH = {"local_channels": [2, 2, 2], "state_channels": [2, 2, 2], "n_hops": 2, "hop_width": 8,
         "value_arch": [8]}  # fmt: skip
CLONING = {
    "env_kwargs": {"height": 9, "width": 9, "n_targets": 8, "n_agents": 3, "horizon": 11,
                   "known_map": True},
    "policy_kwargs": GRAPH,
    "learning_rate": 1e-3,
    "controller": "greedy_assigned",
    "n_demonstrations": 4,
}  # fmt: skip


def settings(algo):
    if ALGORITHMS[algo].clones:
        keys = {"n_timesteps": 3 * ITERATION, "n_envs": 4, "n_steps": 8, **CLONING}
        return {**keys, "batch_size": 8}
    return small_settings(algo, 3)


def arguments(tmp_path, algo, *more):
    config = tmp_path / "given.yml"
    write_yaml(config, {ENV: settings(algo)})
    begin = ["--algo", algo, "-conf", str(config), "--seed", "3", "--num-threads", "1"]
    often = ["--eval-freq", str(ITERATION + 8), "--eval-episodes", "2", "--save-freq", "0"]
    return [*begin, *often, "--device", "cpu", "--verbose", "0", *more]


def stop_once(monkeypatch, owner, name, calls=1, number=signal.SIGTERM, after=False, only=None):
    """Send a signal when a function is called for the nth time, before or behind what it does.

    Only calls count whose last argument is a path with the name ``only``.
    """
    own, seen = getattr(owner, name), []

    def signalled(*args, **kwargs):
        if only is not None and Path(args[-1]).name != only:
            return own(*args, **kwargs)
        seen.append(None)
        now = len(seen) == calls
        if now and not after:
            os.kill(os.getpid(), number)
        result = own(*args, **kwargs)
        if now and after:
            os.kill(os.getpid(), number)
        return result

    monkeypatch.setattr(owner, name, signalled)
    return seen


def run_of(logs):
    (config,) = logs.glob("*/*/config.yml")
    return config.parent


def steps_in(run):
    return [
        int(path.stem.removeprefix("step_")) for path in CheckpointFolder(run / CHECKPOINTS).paths()
    ]


@pytest.mark.parametrize("algo", ["hmappo", "ppo", "trpo", "recurrent_ppo", "gnn"])
@pytest.mark.parametrize("place", ["first rollout", "rollout", "update", "log"])
def test_a_stopped_run_goes_on_as_if_it_had_not_been(tmp_path, monkeypatch, capfd, algo, place):
    begin = arguments(tmp_path, algo)
    assert main([*begin, "-f", str(tmp_path / "straight")], "train") == 0
    model = ALGORITHMS[algo].load()
    with monkeypatch.context() as patch:
        if place == "update":
            # Behind the second update: all its changes must be forgotten.
            stop_once(patch, model, "train", 2, after=True)
        elif place == "log":
            # In the second one, while a file is replaced, which is finished.
            stop_once(patch, os, "replace", 2, only="progress.csv")
        else:
            stop_once(patch, training._Check, "_on_step", 3 if place == "first rollout" else 12)
        assert main([*begin, "-f", str(tmp_path / "cut")], "train") == 143
    out, err = capfd.readouterr()
    run = run_of(tmp_path / "cut")
    begun = 0 if place == "first rollout" else ITERATION
    assert steps_in(run) == [begun]
    assert (
        f"{run}: {begun} joint steps; checkpoints: 1\nstopped; to go on: train.py --resume" in out
    )
    assert err == "stopping, this iteration will be repeated by --resume; again to stop at once\n"
    load_model(run)
    assert main(["--resume", str(run), "--verbose", "0"], "train") == 0
    assert "not bit-exact" not in capfd.readouterr().out
    assert run_difference(run_of(tmp_path / "straight"), run) is None


def test_a_signal_while_a_checkpoint_is_written_waits_for_it(tmp_path, monkeypatch, capfd):
    begin = arguments(tmp_path, "mappo", "-f", str(tmp_path / "logs"), "--save-freq", "1")
    stop_once(monkeypatch, CheckpointFolder, "save", 1)
    assert main(begin, "train") == 143
    run = run_of(tmp_path / "logs")
    assert steps_in(run) == [ITERATION]
    assert not list(run.rglob("*.partial"))


def test_a_signal_while_a_file_is_replaced_waits_for_it(tmp_path, monkeypatch):
    stop, path = StopSignals(), tmp_path / "file"
    with stop.caught(), monkeypatch.context() as patch:
        stop_once(patch, os, "fsync")
        files.write_atomically(path, b"whole")
        assert path.read_bytes() == b"whole"
        with pytest.raises(KeyboardInterrupt):
            stop.check()
    assert stop.exit_code == 143
    assert [one.name for one in tmp_path.iterdir()] == ["file"]


def test_the_second_signal_ends_at_once(monkeypatch):
    stop = StopSignals()
    monkeypatch.setattr(interrupts, "SAME_STOP", 0.0)
    with pytest.raises(SystemExit) as end, stop.caught(), stop.held():
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)
        pytest.fail("it goes on")
    assert end.value.code == 130


def test_a_signal_that_comes_twice_at_once_is_one():
    stop = StopSignals()
    seen = []
    with pytest.raises(KeyboardInterrupt), stop.caught(), stop.held():
        for _ in range(3):
            os.kill(os.getpid(), signal.SIGTERM)
            seen.append(stop.received)
    assert seen == [signal.SIGTERM] * 3
    assert stop.exit_code == 143


def test_signals_are_handled_as_before_afterwards():
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    stop = StopSignals()
    with stop.caught(), stop.caught():
        assert signal.getsignal(signal.SIGTERM) == stop._note
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_before_a_run_is_begun_nothing_is_left(tmp_path, monkeypatch, capfd, number, code):
    stop_once(monkeypatch, job, "make_env", number=number)
    begin = arguments(tmp_path, "mappo", "-f", str(tmp_path / "logs"))
    assert main(begin, "train") == code
    out, err = capfd.readouterr()
    assert (out, err) == ("", "train.py: stopped before a run was begun\n")
    assert not (tmp_path / "logs").exists()


def test_while_the_run_folder_is_made_it_is_finished_first(tmp_path, monkeypatch, capfd):
    begin = arguments(tmp_path, "mappo")
    assert main([*begin, "-f", str(tmp_path / "straight")], "train") == 0
    capfd.readouterr()
    with monkeypatch.context() as patch:
        stop_once(patch, job, "new_run", after=True)
        assert main([*begin, "-f", str(tmp_path / "logs")], "train") == 143
    run = run_of(tmp_path / "logs")
    out, err = capfd.readouterr()
    assert (out, err) == (f"stopped; to go on: train.py --resume {run}\n", "")
    assert {path.name for path in run.iterdir()} == {
        "args.yml",
        "command.txt",
        "config.yml",
        "lock",
    }
    # Without a checkpoint it begins anew, in the same folder.
    assert main(["--resume", str(run), "--verbose", "0"], "train") == 0
    assert f"{run} has no checkpoint yet: it begins anew\n" in capfd.readouterr().out
    assert run_difference(run_of(tmp_path / "straight"), run) is None


def test_during_the_last_evaluation_the_last_checkpoint_is_whole(tmp_path, monkeypatch, capfd):
    with monkeypatch.context() as patch:
        stop_once(patch, job, "_evaluate", number=signal.SIGINT)
        code = main(arguments(tmp_path, "mappo", "-f", str(tmp_path / "logs")), "train")
    run = run_of(tmp_path / "logs")
    out, err = capfd.readouterr()
    assert (code, err) == (130, "")
    assert out.endswith(f"stopped; to go on: train.py --resume {run}\n")
    assert steps_in(run) == [3 * ITERATION]
    assert not (run / "evaluation.yml").exists()
    assert main(["--resume", str(run), "--verbose", "0"], "train") == 0
    assert (run / "evaluation.yml").exists()


def test_a_signal_while_the_scores_are_written_is_not_lost(tmp_path, monkeypatch):
    words = arguments(tmp_path, "mappo", "-f", str(tmp_path / "logs"), "--n-seeds", "2")
    stop_once(monkeypatch, os, "replace", only="evaluation.yml")
    assert main(words, "train") == 143
    # The other run is not begun.
    assert (run_of(tmp_path / "logs") / "evaluation.yml").exists()


def test_a_finished_run_without_its_checkpoints_does_not_begin_anew(tmp_path, capfd):
    assert main(arguments(tmp_path, "mappo", "-f", str(tmp_path / "logs")), "train") == 0
    run = run_of(tmp_path / "logs")
    for path in CheckpointFolder(run / CHECKPOINTS).paths():
        path.unlink()
    with pytest.raises(SystemExit) as end:
        main(["--resume", str(run)], "train")
    assert end.value.code == 2
    assert "no checkpoint" in capfd.readouterr().err


def stopped_in_the_update(tmp_path, monkeypatch):
    """A run that was killed in its second iteration, before its first checkpoint."""
    with monkeypatch.context() as patch:

        def killed(*args, **kwargs):
            raise SystemExit(9)

        own, seen = ALGORITHMS["mappo"].load().train, []

        def update(model):
            seen.append(None)
            return own(model) if len(seen) == 1 else killed()

        patch.setattr(ALGORITHMS["mappo"].load(), "train", update)
        with pytest.raises(SystemExit):
            main(arguments(tmp_path, "mappo", "-f", str(tmp_path / "logs")), "train")
    run = run_of(tmp_path / "logs")
    assert (run / "progress.csv").exists() and steps_in(run) == []
    return run


def test_a_run_killed_before_its_first_checkpoint_begins_anew_and_says_what_is_dropped(
    tmp_path, monkeypatch, capfd
):
    begin = arguments(tmp_path, "mappo")
    assert main([*begin, "-f", str(tmp_path / "straight")], "train") == 0
    run = stopped_in_the_update(tmp_path, monkeypatch)
    before = (run / "progress.csv").read_bytes()
    with pytest.raises(SystemExit) as end:
        main(["--resume", str(run), "--strict-resume"], "train")
    assert end.value.code == 2
    said = f"train.py: error: --strict-resume: {run} has no checkpoint to go on from\n"
    assert capfd.readouterr().err == said
    assert (run / "progress.csv").read_bytes() == before
    assert main(["--resume", str(run), "--verbose", "0"], "train") == 0
    said = f"{run} has no checkpoint yet: it begins anew; the rows of progress.csv are dropped\n"
    assert said in capfd.readouterr().out
    assert run_difference(run_of(tmp_path / "straight"), run) is None


def test_a_run_whose_folder_of_checkpoints_is_gone_does_not_begin_anew(
    tmp_path, monkeypatch, capfd
):
    run = stopped_in_the_update(tmp_path, monkeypatch)
    (run / CHECKPOINTS).rmdir()
    before = {path.name: path.read_bytes() for path in run.glob("*.*")}
    with pytest.raises(SystemExit) as end:
        main(["--resume", str(run)], "train")
    assert end.value.code == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert f"{run}: no checkpoint is left of what was trained" in line
    assert {path.name: path.read_bytes() for path in run.glob("*.*")} == before


def test_an_evaluation_that_is_broken_off_is_repeated(tmp_path, monkeypatch):
    begin = arguments(tmp_path, "hmappo", "-P")
    assert main([*begin, "-f", str(tmp_path / "straight")], "train") == 0
    with monkeypatch.context() as patch:
        # The bar of -P is closed, too. The weights of the best policy are those of what is dropped.
        stop_once(patch, EvaluationCallback, "run", after=True)
        assert main([*begin, "-f", str(tmp_path / "cut")], "train") == 143
    run = run_of(tmp_path / "cut")
    assert (run / "best" / "model.ckpt").exists()
    assert main(["--resume", str(run), "--verbose", "0"], "train") == 0
    assert run_difference(run_of(tmp_path / "straight"), run) is None


def test_a_signal_stops_a_recording_which_goes_on(tmp_path, monkeypatch, capfd):
    with monkeypatch.context() as patch:
        stop_once(patch, recording, "_play", 1)
        assert main(arguments(tmp_path, "gnn", "-f", str(tmp_path / "logs")), "train") == 143
    run = run_of(tmp_path / "logs")
    out, err = capfd.readouterr()
    assert "recording stopped" in out
    assert out.endswith(f"stopped; to go on: train.py --resume {run}\n")
    assert err == ""
    assert main(["--resume", str(run), "--verbose", "0"], "train") == 0
    assert (run / "demonstrations.yml").exists()
    assert GNN.__name__ in repr(load_model(run))


def test_while_torch_is_imported_a_signal_ends_the_process_on_the_spot(tmp_path):
    # What is imported swallows whatever is raised in it, as some packages do.
    code = """
import os, signal, sys
from sb3_roles.zoo import cli, train

class Finder:
    def find_spec(self, name, path, target=None):
        if name == "torch":
            try:
                os.kill(os.getpid(), signal.SIGTERM)
                for _ in range(10):
                    pass
            except BaseException:
                pass

sys.meta_path.insert(0, Finder())
sys.exit(cli.main(sys.argv[1:], "train"))
"""
    done = subprocess.run(
        [sys.executable, "-c", code, "--algo", "mappo", "-f", str(tmp_path / "logs")],
        env=processes.environment(),
        capture_output=True,
        text=True,
    )
    said = (done.returncode, done.stdout, done.stderr)
    assert said == (143, "", "train.py: stopped before a run was begun\n")
    assert not (tmp_path / "logs").exists()
