"""Runs of GNN from the command line: what is refused, what is noted, and how they are stopped."""

import os
import signal

import pytest
import yaml
from gnn_teams import SCENE

from sb3_roles.gnn import recording
from sb3_roles.gnn.demonstrations import load_demonstrations
from sb3_roles.gnn.recording import record
from sb3_roles.zoo.cli import main
from sb3_roles.zoo.config import load_settings
from sb3_roles.zoo.run_folder import CHECKPOINTS
from sb3_roles.zoo.train_jobs import DEFAULTS

NETWORK = "policy_kwargs:{n_hops: 1, hop_width: 4, encoder: patches, value_arch: [4]}"
SIZES = ["height:11", "width:11", "n_targets:12", "horizon:10", "n_agents:3"]


def call(capsys, folder, *parameters, options=()):
    """Call ``train.py --algo gnn`` with some hyperparameters."""
    arguments = ["--algo", "gnn", "-f", str(folder), "--env-kwargs", *SIZES, "--device", "cpu"]
    arguments += [*options, "-params", NETWORK, "n_envs:2", "n_steps:5"]
    if not any(one.startswith("n_demonstrations") for one in parameters):
        arguments.append("n_demonstrations:6")
    try:
        code = main([*arguments, *parameters], "train")
    except SystemExit as error:
        code = error.code
    out, err = capsys.readouterr()
    return code, out, err


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory):
    path = tmp_path_factory.mktemp("demonstrations") / "greedy.npz"
    record("greedy_assigned", SCENE, 6, seed=0, path=path)
    return path


@pytest.mark.parametrize(
    ("parameters", "hint"),
    [
        (["demonstrations:{folder}/nope.npz"], "nope.npz: No such file"),
        (["demonstrations:{file}", "n_demonstrations:7"], "there are 6 demonstrated episodes"),
        (["demonstrations:{file}", "validation_share:1.0"], "leaves none to validate on, or none"),
        (["validation_share:0.01"], "leaves none to validate on, or none"),
        (["validation_share:0"], "validation_share must be a number in (0, 1]"),
        (["controller:vrpc"], "sb3_roles[vrp]"),
    ],
)
def test_what_can_not_be_learned_from_leaves_nothing_behind(
    capsys, tmp_path, monkeypatch, demonstrations, parameters, hint
):
    def missing(name):
        raise ImportError(f"no module {name}")

    monkeypatch.setattr("sb3_roles.baselines.ortools_routing.import_module", missing)
    given = [one.format(folder=tmp_path, file=demonstrations) for one in parameters]
    code, out, err = call(capsys, tmp_path / "logs", *given)
    assert code == 2
    assert hint in err
    assert err.count("\n") == 1
    assert out == ""
    assert not (tmp_path / "logs").exists()


def test_a_batch_may_be_larger_than_what_is_played(capsys, tmp_path, demonstrations):
    options = ["-n", "20", "--eval-episodes", "2", "--eval-freq", "10"]
    given = [f"demonstrations:{demonstrations}", "batch_size:1000"]
    code, out, _ = call(capsys, tmp_path, *given, options=options)
    assert code == 0
    assert "6 episodes of greedy_assigned" in out
    folder = tmp_path / "gnn" / "area-search-v0_1"
    facts = yaml.safe_load((folder / "demonstrations.yml").read_text())
    assert facts["sha256"] == load_demonstrations(demonstrations).digest()
    assert facts["scene"]["n_targets"] == 12
    assert (folder / "best" / "model.ckpt").exists()
    # Resumed with other demonstrations in the place of these.
    content = demonstrations.read_bytes()
    demonstrations.unlink()
    try:
        record("random", SCENE, 6, seed=0, path=demonstrations)
        with pytest.raises(SystemExit) as caught:
            main(["--resume", str(folder), "-n", "30"], "train")
        assert caught.value.code == 2
        assert "controller was 'greedy_assigned', is 'random'" in capsys.readouterr().err
    finally:
        demonstrations.write_bytes(content)
    assert main(["--resume", str(folder), "-n", "30"], "train") == 0


def test_a_run_of_the_defaults_is_evaluated_and_saved_often(capsys, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr("sb3_roles.zoo.job.run_job", lambda job, stop: seen.append(job) or 0)
    for options in ([], ["--eval-freq", "70"]):
        assert call(capsys, tmp_path, options=options)[0] == 0
    assert main(["--algo", "mappo", "-f", str(tmp_path)], "train") == 0
    assert [job["options"]["eval_freq"] for job in seen] == [1000, 70, DEFAULTS["eval_freq"]]
    assert [job["options"]["save_freq"] for job in seen] == [1000, 1000, DEFAULTS["save_freq"]]
    settings = load_settings("gnn", "area-search-v0", None)
    epochs = settings["n_timesteps"] / (settings["n_steps"] * settings["n_envs"])
    assert epochs == 100
    assert settings["n_timesteps"] / 1000 == 20


def test_ctrl_c_stops_a_recording_at_once(capsys, tmp_path, monkeypatch):
    play, calls = recording._play, []
    before = signal.getsignal(signal.SIGINT)

    def interrupted(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return play(*arguments)

    monkeypatch.setattr(recording, "_play", interrupted)
    code, out, _ = call(capsys, tmp_path, "controller:random", "n_demonstrations:1000")
    assert code == 130
    assert len(calls) == 2
    assert signal.getsignal(signal.SIGINT) is before
    assert "recording stopped" in out
    assert "recorded 25 of 1000 episodes of random" in out
    folder = tmp_path / "gnn" / "area-search-v0_1"
    kept = load_demonstrations(folder / "demonstrations.npz")
    assert len(kept) == 25
    assert not list((folder / CHECKPOINTS).glob("*.ckpt"))
