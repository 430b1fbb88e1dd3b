"""Every command where nothing can be written, the disk is full, a run is another's or of another
version, and Ctrl-C: one line, the exit code that says it, and what was there before is whole."""

from __future__ import annotations

import errno
import os
import shutil
from importlib import import_module

import pytest
import yaml

from sb3_roles.common import checkpoint, checkpoint_reading
from sb3_roles.common.checkpoint import CheckpointFolder
from sb3_roles.evaluation import records
from sb3_roles.gnn import demonstrations
from sb3_roles.prove.small_runs import ITERATION, small_settings
from sb3_roles.zoo.cli import COMMANDS, main
from sb3_roles.zoo.run_folder import RunLock

TINY = ["--scene-options", "height:9", "width:9", "n_targets:8", "horizon:6", "--n-agents", "2"]
SHORT = ["--episodes", "2", *TINY]
EVALUATIONS = "env_steps,explo_paper,cover\n1,0.1,0.2\n9,0.3,0.4\n"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of seconds, with an evaluation."""
    folder = tmp_path_factory.mktemp("trained")
    settings = small_settings("mappo", 2)
    (folder / "config.yml").write_text(yaml.safe_dump({"default": settings}))
    words = ["--algo", "mappo", "-conf", folder / "config.yml", "-f", folder / "logs"]
    words += ["--eval-episodes", 1, "--eval-freq", ITERATION, "--verbose", 0]
    assert main(list(map(str, words)), "train") == 0
    return folder / "logs" / "mappo" / "area-search-v0_1"


@pytest.fixture
def run(trained, tmp_path, monkeypatch):
    """A copy of it, in the folder that the command is started in."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(trained, tmp_path / "run")
    return tmp_path / "run"


def ended(words, capsys):
    """Run a command; return its exit code and what it said on stderr."""
    first, *rest = map(str, words)
    capsys.readouterr()
    try:
        code = main(rest, first[:-3]) if first.endswith(".py") else main([first, *rest])
    except SystemExit as end:
        code = end.code
    return code, capsys.readouterr().err


def one_error(words, capsys, *named):
    code, err = ended(words, capsys)
    assert code == 2, err
    *before, last = err.splitlines()
    # Progress may come first.
    assert " error: " in last
    assert not [line for line in before if "error" in line or "Traceback" in line]
    assert all(name in last for name in named), last


# A file where the folder should be

UNWRITABLE = [
    ["train.py", "-f", "file/logs"],
    ["train.py", "-tb", "file"],
    ["simulate", *SHORT, "--out", "file/x.parquet"],
    ["simulate", *SHORT, "--render", "file/x.png"],
    ["evaluate", "--controller", "run", *SHORT, "--out", "file/x.parquet"],
    ["demonstrate", *SHORT, "--out", "file/x.npz"],
    ["enjoy.py", "-f", "run", "--video", "file/x.gif"],
    ["curves", "run", "--plot", "file/x.png"],
    ["tables", "--quick", "-o", "file/results"],
    ["report", "--quick", "-o", "file/results"],
    ["publish", "--runs", "mappo=run", "-o", "file/published"],
    ["ablations", "-o", "file/results"],
    ["bench", "growth", "--plot", "file/x.png"],
    ["prove", "R7", "-o", "file/table.md"],
]


@pytest.mark.parametrize("words", UNWRITABLE, ids=lambda words: " ".join(words[:2]))
def test_a_place_that_can_not_be_written(run, words, capsys):
    file = run.parent / "file"
    file.write_text("mine")
    before = sorted(run.parent.rglob("*"))
    named = () if words[0] == "publish" else ("file",)
    one_error(words, capsys, *named)
    assert file.read_text() == "mine"
    assert sorted(run.parent.rglob("*")) == before


# A disk that is full

FULL = [
    (["simulate", *SHORT, "--out", "x.parquet"], "x.parquet"),
    (["simulate", *SHORT, "--render", "x.png"], "x.png"),
    (["demonstrate", "--controller", "greedy", *SHORT, "--out", "y.npz"], "y.npz"),
    (["enjoy.py", "-f", "run", "--algo", "mappo", "--video", "x.gif"], "x.gif"),
    (["curves", "run", "--plot", "x.png"], "x.png"),
    (["train.py", "--resume", "run", "-n", str(3 * ITERATION)], "run/progress.csv"),
]


@pytest.mark.parametrize(("words", "target"), FULL, ids=lambda value: str(value)[:40])
def test_a_full_disk_leaves_what_was_there(run, words, target, capsys, monkeypatch):
    kept = run.parent / target
    if not kept.exists() and target != "y.npz":
        kept.write_text("earlier")
    before = kept.read_bytes() if kept.exists() else None

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", full)
    one_error(words, capsys, "No space left on device")
    assert (kept.read_bytes() if kept.exists() else None) == before
    assert not [path for path in run.parent.rglob("*.partial*")]
    assert len(CheckpointFolder(run / "checkpoints").paths()) >= 1
    CheckpointFolder(run / "checkpoints").newest()


# Runs and files of a later version


@pytest.fixture
def later(run, monkeypatch):
    """Checkpoints that say they are of the next format version."""
    for path in CheckpointFolder(run / "checkpoints").paths():
        found = checkpoint.read_checkpoint(path)
        with pytest.MonkeyPatch.context() as patch:
            # Those that write check what they have written.
            later = checkpoint.FORMAT_VERSION + 1
            for module in (checkpoint, checkpoint_reading):
                patch.setattr(module, "FORMAT_VERSION", later)
            checkpoint.write_checkpoint(path, {}, found.policy, found.optimizer, found.state)
    return run


@pytest.mark.parametrize(
    "words",
    [
        ["train.py", "--resume", "run"],
        ["enjoy.py", "-f", "run", "--algo", "mappo", "--no-render"],
        ["evaluate", "--controller", "run", *SHORT],
        ["tables", "--rows", "mappo", "--runs", "mappo=run"],
        ["publish", "--runs", "mappo=run", "-o", "published"],
    ],
    ids=lambda words: words[0],
)
def test_a_run_of_a_later_version(later, words, capsys):
    before = {path: path.read_bytes() for path in later.rglob("*.*") if path.is_file()}
    # That of publish is about its configuration, which comes first.
    one_error(words, capsys, *([] if words[0] == "publish" else ["format version 2"]))
    assert {path: path.read_bytes() for path in before} == before


def test_files_of_a_later_version(run, capsys, monkeypatch):
    made = {"x.parquet": ["simulate", *SHORT, "--out", "x.parquet"]}
    made["x.npz"] = ["demonstrate", "--controller", "greedy", *SHORT, "--out", "x.npz"]
    with pytest.MonkeyPatch.context() as patch:
        for module in (records, demonstrations):
            patch.setattr(module, "FORMAT_VERSION", module.FORMAT_VERSION + 1)
        for words in made.values():
            assert main(words) == 0
    before = {name: (run.parent / name).read_bytes() for name in made}
    one_error(["records", "x.parquet"], capsys, "x.parquet", "format version 2")
    one_error(made["x.npz"], capsys, "x.npz", "format version 2")
    clone = ["train.py", "--algo", "gnn", "-params", "demonstrations:x.npz", "--n-agents", "2"]
    one_error([*clone, "-f", "logs"], capsys, "x.npz", "format version 2")
    assert not (run.parent / "logs").exists()
    assert {name: (run.parent / name).read_bytes() for name in made} == before


@pytest.mark.parametrize(
    "words",
    [
        ["train.py", "--resume", "run"],
        ["enjoy.py", "-f", "run", "--algo", "mappo"],
        ["evaluate", "--controller", "run", *SHORT],
        ["publish", "--runs", "mappo=run"],
        ["tables", "--runs", "mappo=run"],
    ],
    ids=lambda words: words[0],
)
def test_a_configuration_of_a_later_version(run, words, capsys):
    with open(run / "config.yml", "a") as file:
        file.write("later_key: 1\n")
    one_error(words, capsys, "config.yml", "unknown key 'later_key'")


# Two processes


def test_a_run_that_another_process_trains(run, capsys):
    lock = RunLock(run)
    try:
        one_error(["train.py", "--resume", "run"], capsys, f"process {os.getpid()} is training")
    finally:
        lock.release()


# Ctrl-C

STOPPED = [
    (["simulate", *SHORT], "sb3_roles.evaluation.episodes.run_episodes"),
    (["evaluate", "--controller", "run", *SHORT], "sb3_roles.evaluation.episodes.run_episodes"),
    (["evaluate", "--controller", "run", *SHORT], "sb3_roles.zoo.models.load_model"),
    (["enjoy.py", "-f", "run", "--no-render"], "sb3_roles.zoo.playback.play_scene"),
    (["demonstrate", *SHORT, "--out", "x.npz"], "sb3_roles.gnn.recording.record"),
    (["curves", "run"], "sb3_roles.zoo.curves.read_curves"),
    (["records", "run"], "sb3_roles.zoo.records._look_at"),
    (["tables", "--rows", "random"], "sb3_roles.evaluation.grid.play.play"),
    (["report", "--rows", "random"], "sb3_roles.evaluation.grid.play.play"),
    (["publish", "--runs", "mappo=run"], "sb3_roles.zoo.publish.named_runs"),
    (["ablations", "--dry-run"], "sb3_roles.zoo.ablation_runs.find_runs"),
    (["bench", "env"], "sb3_roles.zoo.bench_env.measure_startup"),
    (["prove", "R7"], "sb3_roles.prove.promises.Promise.prove"),
    (["train.py", "-n", "9"], "sb3_roles.zoo.train.new_jobs"),
    (["train.py", "--resume", "run"], "sb3_roles.zoo.job.make_env"),
    (["train.py", "--resume", "run"], "sb3_roles.zoo.job._evaluate"),
]


@pytest.mark.parametrize(
    ("words", "place"), STOPPED, ids=lambda value: value if isinstance(value, str) else value[0]
)
def test_ctrl_c(run, words, place, capsys, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    before = {path: path.read_bytes() for path in (run / "checkpoints").iterdir()}
    monkeypatch.setattr(place, stop)
    code, err = ended(words, capsys)
    assert code == 130
    assert "Traceback" not in err
    assert {path: path.read_bytes() for path in (run / "checkpoints").iterdir()} == before


def test_ctrl_c_before_the_options_are_read(capsys, monkeypatch):
    def stop(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(import_module(COMMANDS[-1]), "add_parser", stop)
    assert ended(["prove", "R7"], capsys) == (130, "")


def test_ctrl_c_keeps_what_was_recorded(run, capsys, monkeypatch):
    from sb3_roles.gnn import recording

    play, counted = recording._play, []

    def stop(*arguments):
        counted.append(1)
        if len(counted) == 2:
            raise KeyboardInterrupt
        return play(*arguments)

    monkeypatch.setattr(recording, "_play", stop)
    words = ["demonstrate", "--controller", "greedy", *SHORT, "--batch-size", "1", "--out", "x.npz"]
    code, err = ended(words, capsys)
    assert (code, err) == (130, "1 of 2 episodes\n")
    assert len(demonstrations.load_demonstrations(run.parent / "x.npz")) == 1
