"""A Ray cluster plays the rollouts of a run, and runs side by side, as one process would."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

pytest.importorskip("ray", reason="the extra ray is not installed")

from ray.cluster_utils import Cluster

from sb3_roles.prove.ray_deaths import die_once
from sb3_roles.prove.remains import first_odd, remains_of_run
from sb3_roles.prove.training_runs import untimed_rows
from sb3_roles.zoo import ray_rollouts
from sb3_roles.zoo.cli import main
from sb3_roles.zoo.ray_runs import RunOf, run_arguments, train_run

ROOT = Path(__file__).resolve().parents[1]
NODE = {"num_cpus": 1, "object_store_memory": 100_000_000, "include_dashboard": False}
TINY = ["--env-kwargs", "height:7", "width:7", "n_targets:5", "n_agents:2", "horizon:6"]
SMALL = ["-params", "n_envs:5", "n_steps:8", "batch_size:16", "n_epochs:1", "rollout_groups:2"]
OPTIONS = [*TINY, *SMALL, "--num-threads", "1", "--eval-freq", "60", "--eval-episodes", "4",
           "--save-freq", "80", "--device", "cpu", "--verbose", "0"]  # fmt: skip
N_STEPS = ["-n", "160"]
LIVES = "SB3_ROLES_TEST_LIVES"


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """Two machines of one CPU each; the workers find this folder."""
    paths = [str(ROOT / "envs"), str(ROOT), str(ROOT / "tests")]
    names = {
        "PYTHONPATH": os.pathsep.join(paths),
        LIVES: str(tmp_path_factory.mktemp("lives")),
    }
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(names)
    found = Cluster(initialize_head=True, head_node_args=NODE)
    found.add_node(num_cpus=1, object_store_memory=NODE["object_store_memory"])
    found.wait_for_nodes()
    try:
        yield found
    finally:
        found.shutdown()
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def train(folder: Path, *args: str) -> Path:
    """Train in this process, and return the run folder."""
    assert main([*OPTIONS, *args, "-f", str(folder)], "train") == 0
    (run,) = (folder / "hmappo").iterdir()
    return run


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run without Ray."""
    return train(tmp_path_factory.mktemp("alone"), *N_STEPS)


def assert_same(run: Path, other: Path) -> None:
    assert first_odd(remains_of_run(run), remains_of_run(other)) == ""
    assert len(untimed_rows(run / "progress.csv")) > 2


def play_or_die(config, folder, task, weights, n_threads):
    """Play, and die with what was played at the third task."""
    record = _PLAY(config, folder, task, weights, n_threads)
    count = len(os.listdir(os.environ[LIVES]))
    Path(os.environ[LIVES], f"played_{count}_{os.getpid()}").touch()
    if count >= 2:
        die_once(Path(os.environ[LIVES], "death"))
    return record


_PLAY = ray_rollouts.play_task


class Losing(ray_rollouts.RayPlayer):
    """Loses a machine in the middle of its second rollout."""

    cluster: Cluster
    left = 4

    def submit(self, *args):
        sent = super().submit(*args)
        self.left -= 1
        if self.left == 0:
            machines = self.cluster.list_all_nodes()
            lost = next(one for one in machines if one != self.cluster.head_node)
            self.cluster.remove_node(lost, allow_graceful=False)
        return sent


def test_two_workers_of_which_one_dies_and_a_machine_that_is_lost(
    cluster, alone, tmp_path, monkeypatch
):
    monkeypatch.setattr(ray_rollouts, "play_task", play_or_die)
    monkeypatch.setattr(ray_rollouts, "RayPlayer", Losing)
    monkeypatch.setattr(Losing, "cluster", cluster, raising=False)
    run = train(tmp_path, *N_STEPS, "--ray", cluster.address, "--rollout-workers", "2")
    assert Path(os.environ[LIVES], "death").exists()
    assert cluster.list_all_nodes() == [cluster.head_node]
    assert_same(run, alone)


def test_one_worker_and_a_run_that_goes_on_with_and_without_ray(cluster, alone, tmp_path):
    half = train(tmp_path / "half", "-n", "80", "--ray", cluster.address, "--rollout-workers", "1")
    there = shutil.copytree(half, tmp_path / "there")
    goes_on = ["-n", "160", "--verbose", "0"]
    assert main(["--resume", str(half), *goes_on], "train") == 0
    ray = ["--ray", cluster.address, "--rollout-workers", "1"]
    assert main(["--resume", str(there), *goes_on, *ray], "train") == 0
    assert_same(half, there)


def test_runs_side_by_side(cluster, tmp_path, capfd):
    common = [*OPTIONS, "-n", "80", "--n-seeds", "2", "--seed", "3"]
    assert main([*common, "-f", str(tmp_path / "one")], "train") == 0
    capfd.readouterr()
    options = [*common, "-f", str(tmp_path / "side"), "--ray", cluster.address]
    assert main(options, "train") == 0
    lines = capfd.readouterr().out.splitlines()
    assert [line for line in lines if not line.startswith(" ")] == [
        "hmappo, seed 3: exit code 0",
        "hmappo, seed 4: exit code 0",
    ]
    assert sum("held-out episodes of seed 1" in line for line in lines) == 2
    found = []
    for name in ("one", "side"):
        runs = {}
        for run in (tmp_path / name / "hmappo").iterdir():
            config = yaml.safe_load((run / "config.yml").read_text())
            runs[config["seed"]] = run
        assert sorted(runs) == [3, 4]
        found.append(runs)
    for seed in (3, 4):
        assert_same(found[0][seed], found[1][seed])
    # Nothing of the others: a reader of the run folder repeats this run.
    command = (found[1][3] / "command.txt").read_text()
    assert "--ray" not in command and "--n-seeds" not in command and "--seed 3" in command


def test_more_threads_than_any_machine_has(cluster, tmp_path, capfd):
    options = ["--n-seeds", "2", "--num-threads", "64", "-f", str(tmp_path)]
    with pytest.raises(SystemExit) as end:
        main([*options, "--ray", cluster.address], "train")
    assert end.value.code == 2
    said = capfd.readouterr().err
    assert said.endswith("no machine of the cluster has so many CPUs, the largest has 1\n")


def test_a_run_elsewhere_says_how_it_ended(tmp_path):
    code, lines = train_run(["train", "--algo", "hmapo"], str(tmp_path))
    assert code == 2 and "did you mean 'hmappo'?" in lines[-1]
    code, lines = train_run(["train"], str(tmp_path / "nowhere"))
    assert code == 1 and lines[0].endswith(f"No such file or directory: {tmp_path / 'nowhere'}")


def test_a_run_elsewhere_has_a_command_of_its_own():
    given = ["train", "--ray=auto", "--algo", "ppo,mappo", "--seed", "3", "--n-seeds=2", "-n5"]
    given += ["--vary", "gamma:0.9", "gamma:0.95", "-params", "n_envs:4", "--num-threads", "4"]
    common = ["train", "-n5", "-params", "n_envs:4"]
    own = ["--algo", "ppo", "--seed", "4", "--num-threads", "1"]
    assert run_arguments(given, RunOf("ppo", None, 4), 1) == common + own
    assert run_arguments(given, RunOf("ppo", "gamma:0.9", 4), 1) == (
        [*common, *own, "--hyperparams", "gamma:0.9"]
    )
