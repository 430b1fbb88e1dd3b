"""R2, R13, R14 and R16 report the faults that they look for; ``--strict-resume``."""

from __future__ import annotations

import json
import tempfile

import numpy as np
import pytest
import torch as th
import yaml

from sb3_roles.common import facts, snapshot
from sb3_roles.common.checkpoint import CheckpointFolder
from sb3_roles.common.group_play import TaskPlayer
from sb3_roles.common.metrics_callback import TeamMetricsCallback
from sb3_roles.gnn import GNN
from sb3_roles.prove import determinism, memory, resumption
from sb3_roles.prove.promises import Setting
from sb3_roles.prove.remains import digest, first_odd
from sb3_roles.prove.resumption import CUTS, Case, all_cases, try_case
from sb3_roles.prove.small_runs import small_settings
from sb3_roles.prove.training_runs import difference
from sb3_roles.zoo.algorithms import ALGORITHMS
from sb3_roles.zoo.cli import main
from sb3_roles.zoo.config import write_yaml
from sb3_roles.zoo.training import CsvLog


def broken_cut(case, folder):
    """Cut a run of two iterations after its first; return what differs."""
    return try_case(case, folder / "case", 2, (1,), 0).get(1)


# R2


def test_every_algorithm_is_cut_with_both_thread_counts_and_all_its_precisions():
    cases = all_cases()
    assert len({case.name for case in cases}) == len(cases)
    found = {(case.algo, case.threads, case.precision) for case in cases}
    for algo in ALGORITHMS:
        for threads in (1, 2):
            for precision in resumption.precisions(algo):
                assert (algo, threads, precision) in found
    assert resumption.precisions("hmappo") == ("fp32", "bf16")
    assert resumption.precisions("recurrent_ppo") == ("",)
    assert CUTS == (1, 2, 3, 4, 5, 6, 7)
    for case in cases:
        config = case.config(8, 3)
        # Longer than what is trained: at its end the learning rate is 0.
        assert config["n_timesteps"] == 9 * 32
        assert config["policy_kwargs"].get("precision") in (case.precision or None, "auto")
    assert {case.algo for case in cases if case.backend == "supersuit"} == set(ALGORITHMS) - {"gnn"}


def test_a_cut_run_that_forgets_the_optimizer_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(snapshot, "_load_optimizer", lambda model, checkpoint: None)
    found = broken_cut(Case("mappo"), tmp_path)
    assert found is not None
    assert found.startswith("policy/")


def test_a_model_whose_state_forgets_something_is_reported(tmp_path, monkeypatch):
    whole = GNN.get_state
    monkeypatch.setattr(
        GNN, "get_state", lambda self: {**whole(self), "epochs": 0, "best_epoch": 0}
    )
    found = broken_cut(Case("gnn"), tmp_path)
    assert found is not None


def test_random_numbers_that_are_not_put_back_are_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(snapshot, "set_rng_state", lambda state: None)
    assert broken_cut(Case("a2c"), tmp_path) is not None


def test_a_log_that_is_not_taken_up_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(CsvLog, "set_state", lambda self, state: None)
    assert broken_cut(Case("mappo"), tmp_path) is not None


def test_a_callback_that_forgets_its_episodes_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(TeamMetricsCallback, "set_state", lambda self, state: None)
    found = broken_cut(Case("mappo"), tmp_path)
    assert found is not None
    assert found.startswith("state/")


def test_stock_saving_is_compared_with_straight_stock_training(monkeypatch, tmp_path):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    said = resumption.stock_cuts(0, tmp_path / "stock", 2, (1,))
    assert not list((tmp_path / "temporary").glob("SB3-*"))
    assert said.startswith("SB3's PPO after save, load, learn: other weights at 1 of 1 cuts, by up")
    assert "straight" not in said


def test_differences_have_a_place():
    one = {"a": [1, {"b": np.array([1.0, np.nan])}], "c": th.ones(2)}
    same = {"a": [1, {"b": np.array([1.0, np.nan])}], "c": th.ones(2)}
    assert difference(one, same, "it") is None
    nan, zero = {"x": th.tensor([np.nan]).bfloat16()}, {"x": th.tensor(0.0)}
    assert difference(nan, {"x": nan["x"].clone()}, "it") is None
    assert difference(zero, {"x": -zero["x"]}, "it") == "it/x"
    assert difference({"x": 0.0}, {"x": -0.0}, "it") == "it/x (0.0, -0.0)"
    for other, where in (
        ({**one, "c": th.ones(2).double()}, "it/c"),
        ({**one, "a": [1, {"b": np.array([1.0, 2.0])}]}, "it/a/1/b"),
        ({**one, "a": [2, one["a"][1]]}, "it/a/0 (1, 2)"),
        ({**one, "d": 1}, "it/d (in one only)"),
        ({**one, "a": [1]}, "it/a (2 and 1 entries)"),
        ({**one, "a": 1}, "it/a (list, int)"),
    ):
        assert difference(one, other, "it") == where


# Logs


def test_rows_of_a_log_are_in_its_file_alone(tmp_path):
    log = CsvLog(tmp_path / "log.csv")
    for i in range(3):
        log.write({"a": i}, {})
    log.write({"a": 3, "b": "x,y"}, {})
    text = 'a,b\n0,\n1,\n2,\n3,"x,y"\n'
    assert log.path.read_text() == text
    state = log.get_state()
    log.write({"a": 4, "c": 1}, {})
    assert log.path.read_text().startswith("a,b,c\n0,,\n")
    resumed = CsvLog(log.path)
    resumed.set_state(state)
    assert log.path.read_text() == text
    resumed.write({"a": 4}, {})
    assert log.path.read_text() == f"{text}4,\n"
    assert not any(isinstance(value, list) and len(value) > 2 for value in vars(resumed).values())


def test_rows_of_a_log_that_are_gone_are_named(tmp_path, capsys):
    log = CsvLog(tmp_path / "log.csv")
    for i in range(3):
        log.write({"a": i}, {})
    state = log.get_state()
    log.path.write_text("a\n0\n")
    log.set_state(state)
    assert capsys.readouterr().out == f"warning: {log.path}: 2 rows of 3 are gone\n"
    log.write({"a": 3}, {})
    assert log.path.read_text() == "a\n0\n3\n"


# --strict-resume


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run that was stopped half way."""
    folder = tmp_path_factory.mktemp("strict")
    settings = small_settings("mappo", 2)
    write_yaml(folder / "mappo.yml", {"area-search-v0": settings})
    options = ["--conf-file", str(folder / "mappo.yml"), "--algo", "mappo", "-f", str(folder)]
    options += ["--eval-freq", "0", "--eval-episodes", "2", "--verbose", "0", "--num-threads", "1"]
    assert main([*options, "--device", "cpu"], "train") == 0
    return folder / "mappo" / "area-search-v0_1"


def contents(folder):
    return {
        str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes())
        for path in folder.rglob("*")
        if path.is_file()
    }


def strict(capsys, run, *options):
    before = th.get_num_threads()
    try:
        code = main(["--resume", str(run), "--strict-resume", "--verbose", "0", *options], "train")
    except SystemExit as end:
        code = end.code
    finally:
        th.set_num_threads(before)
    return code, capsys.readouterr()


def test_strict_resume_refuses_what_is_not_bit_exact(run, capsys, monkeypatch):
    # What a killed writer left would be removed.
    (run / "checkpoints" / ".step_1.ckpt.7.tmp").write_bytes(b"half")
    (run / "lock").unlink()
    before = contents(run)
    monkeypatch.setattr(facts, "resolve_precision", lambda *args: "bf16")
    monkeypatch.setenv("MKL_CBWR", "COMPATIBLE")
    code, said = strict(capsys, run, "--num-threads", "2", "-n", "96")
    assert code == 2
    (line,) = said.err.splitlines()
    assert line.startswith(f"train.py: error: --strict-resume: {run}: not bit-exact: ")
    for part in (
        "threads was 1, is 2",
        "precision was fp32, is bf16",
        "MKL_CBWR was None, is COMPATIBLE",
        "n_timesteps was 64, is 96",
    ):
        assert part in line
    assert said.out == ""
    assert contents(run) == before
    assert not (run / "lock").exists()


def test_a_changed_configuration_is_no_bit_exact_resumption(run, capsys):
    text = (run / "config.yml").read_text()
    config = yaml.safe_load(text)
    config["gamma"] = 0.5
    try:
        write_yaml(run / "config.yml", config)
        before = contents(run)
        code, said = strict(capsys, run)
        assert code == 2
        assert said.err.endswith("not bit-exact: gamma was 0.95, is 0.5\n")
        assert contents(run) == before
    finally:
        (run / "config.yml").write_text(text)


def test_strict_resume_goes_on_where_nothing_differs(run, capsys):
    steps = CheckpointFolder(run / "checkpoints").newest()[1].manifest["env_steps"]
    code, said = strict(capsys, run)
    assert code == 0
    assert "not bit-exact" not in said.out
    assert CheckpointFolder(run / "checkpoints").newest()[1].manifest["env_steps"] == steps


def test_that_the_newest_checkpoint_is_damaged_is_said_once(run, capsys):
    folder = CheckpointFolder(run / "checkpoints")
    newest, sound = folder.paths()[-1], folder.paths()[-1].read_bytes()
    try:
        newest.write_bytes(sound[:100])
        newest.with_name("step_000000000001.ckpt").write_bytes(sound)
        code, said = strict(capsys, run)
    finally:
        newest.write_bytes(sound)
        newest.with_name("step_000000000001.ckpt").unlink(missing_ok=True)
    assert code == 0
    assert said.out.count("going back to step_000000000001.ckpt") == 1


def test_without_it_the_differences_are_printed(run, capsys):
    code = main(["--resume", str(run), "-n", "96", "--verbose", "0"], "train")
    assert code == 0
    assert "not bit-exact: n_timesteps was 64, is 96\n" in capsys.readouterr().out


def test_strict_resume_needs_a_run(capsys):
    with pytest.raises(SystemExit) as end:
        main(["--strict-resume"], "train")
    assert end.value.code == 2
    assert capsys.readouterr().err.endswith("--strict-resume needs --resume RUN\n")


# R13


def test_a_process_that_depends_on_hashes_is_reported(tmp_path):
    before = (
        "from sb3_roles.prove import determinism\n"
        "determinism.evaluated = lambda here: {}\n"
        "from sb3_roles.common.metrics_callback import TeamMetricsCallback as T\n"
        "own = T.summary\n"
        "T.summary = lambda self: {**own(self), 'odd': hash('odd') % 997}"
    )
    outcome = determinism.processes(Setting(True, tmp_path, 0), before)
    assert not outcome.kept
    (failure,) = outcome.failures
    assert "hmappo: progress.csv" in failure
    assert "hmappo: weights" not in failure


def test_digests():
    tree = {"a": np.arange(3), "b": [1, th.ones(2)]}
    assert digest(tree) == digest({"b": [1, th.ones(2)], "a": np.arange(3)})
    assert digest(tree) != digest({**tree, "a": np.arange(3).astype(np.int32)})
    assert digest(tree) != digest({**tree, "b": [1, th.ones(3)]})
    assert first_odd({"a": "1", "b": "2"}, {"a": "1", "b": "3", "c": "4"}) == "b, c"
    assert first_odd({"a": "1"}, {"a": "1"}) == ""


# R14


def test_ray_is_not_tried_without_it(tmp_path, monkeypatch):
    from sb3_roles.zoo.options import UsageError

    def missing():
        raise UsageError("argument --ray: install sb3_roles[ray] to use it")

    monkeypatch.setattr(determinism, "import_ray", missing)
    outcome = determinism.ray(Setting(True, tmp_path, 0))
    assert "sb3_roles[ray]" in outcome.skipped
    assert not outcome.kept


def test_a_player_that_loses_what_a_dead_worker_played_is_reported(tmp_path, monkeypatch):
    """What is played again has other random numbers; without a cluster."""
    pytest.importorskip("ray", reason="the extra ray is not installed")
    from sb3_roles.prove import ray_deaths
    from sb3_roles.zoo.ray_rollouts import play_task

    class Wrong(TaskPlayer):
        def __init__(self, learner, config, n_workers, markers):
            super().__init__(learner)
            self.config, self.markers = json.dumps(config, sort_keys=True), markers

        def run(self, tasks, weights):
            (self.markers / f"round_{len(list(self.markers.iterdir()))}").touch()
            lost = tasks[1]._replace(seed=tasks[1].seed + 1)
            return [play_task(self.config, ".", one, weights, 1) for one in (tasks[0], lost)]

    monkeypatch.setattr(ray_deaths, "DeadlyPlayer", Wrong)
    monkeypatch.setattr(ray_deaths, "connect", lambda *args: None)
    monkeypatch.setattr(ray_deaths, "disconnect", lambda: None)
    (trial,) = ray_deaths.training_trials(Setting(True, tmp_path, 0))
    assert trial.deaths == 2
    assert "weights" in trial.odd


# R16


def test_growth_is_measured_after_warm_up():
    flat = [1000] * 100
    assert memory.relative_growth(flat) == (0.0, 1000.0)
    # What is taken in the first tenth is the warm-up.
    assert memory.relative_growth([*range(100, 1000, 90), *[1000] * 90])[0] == 0.0
    growing = [1000 + i for i in range(100)]
    share, first = memory.relative_growth(growing)
    assert first == 1012.0
    assert share == pytest.approx((1097 - 1012) / 1012)


def test_a_leak_is_reported(tmp_path):
    before = (
        "from sb3_roles.prove import memory\n"
        "memory.SCENE.update(n_agents=3)\n"
        "memory.CHANGES.update(n_envs=4, n_steps=8, batch_size=32)\n"
        "memory.CHANGES['env_kwargs'].update(memory.SCENE)\n"
        "from sb3_roles.zoo.training import CsvLog\n"
        "own, kept = CsvLog.write, []\n"
        "CsvLog.write = lambda *a: (kept.append(b'x' * 4_000_000), own(*a))"
    )
    outcome = memory.growth(Setting(False, tmp_path, 0), 20 * 4 * 8 * 3, before)
    assert not outcome.kept
    (failure,) = outcome.failures
    assert failure.startswith("resident memory grew by +")
    assert "20 iterations" in outcome.said
