"""Checkpoints: exact resumption, atomic writing, damaged files."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import zipfile

import numpy as np
import pytest
import torch as th
from toy_envs import PlainEnv, WitnessEnv

from sb3_roles.common import checkpoint, stored_zip
from sb3_roles.common import checkpoint_reading as ckpt
from sb3_roles.common.checkpoint import (
    CheckpointError,
    CheckpointFolder,
    read_checkpoint,
    write_checkpoint,
)
from sb3_roles.common.env_state import env_gap
from sb3_roles.common.snapshot import load_weights
from sb3_roles.evaluation.callback import EvaluationCallback
from sb3_roles.prove.small_runs import SMALL_POLICIES, small_run
from sb3_roles.prove.training_runs import (
    EVALUATED,
    NOT_EVALUATED,
    checkpoint_difference,
    difference,
    log_difference,
    train_here,
)
from sb3_roles.zoo.config import write_yaml
from sb3_roles.zoo.models import complete, load_model, make_env, make_model
from sb3_roles.zoo.options import UsageError

# 4 teams x 8 steps = 32 joint steps an iteration.
N, CUT = 96, 32


@pytest.fixture(autouse=True)
def few_threads():
    before = th.get_num_threads()
    th.set_num_threads(1)
    yield
    th.set_num_threads(before)


def run(folder, config, resume=False, stop_at=None, evaluate=True):
    """Train in this process; return the model and the newest checkpoint."""
    options = EVALUATED if evaluate else NOT_EVALUATED
    return train_here(folder, config, resume, stop_at, options=options)


def assert_same(a, b, where="state"):
    assert difference(a, b, where) is None


EXACT = [
    ("hmappo", "native", {}),
    ("hmappo", "supersuit", {}),
    (
        "hmappo",
        "native",
        {
            "wrapper_kwargs": {"role_every": 3, "role_control": "random"},
            "kl_coef": 0.5,
            "policy_kwargs": {**SMALL_POLICIES["RolePolicy"], "norm_layer": "frozen_batch"},
        },
    ),
    (
        "hmappo",
        "native",
        {"policy_kwargs": {**SMALL_POLICIES["RolePolicy"], "optimizer_kwargs": {"fused": True}}},
    ),
    ("mappo", "native", {}),
    ("mappo", "supersuit", {}),
    ("ppo", "native", {}),
    ("ppo", "supersuit", {}),
    ("a2c", "native", {}),
    ("trpo", "native", {}),
    ("maskable_ppo", "native", {}),
    ("recurrent_ppo", "native", {}),
]


@pytest.mark.parametrize(("algo", "backend", "changes"), EXACT)
def test_resumed_training_equals_straight_training(tmp_path, algo, backend, changes):
    config = small_run(algo, backend, **changes)
    _, straight = run(tmp_path / "straight", config)
    run(tmp_path / "cut", config, stop_at=CUT)
    # What was logged after the checkpoint, before the process died, must not stay.
    with open(tmp_path / "cut" / "progress.csv", "a") as file:
        file.write("1,2,3\n")
    _, resumed = run(tmp_path / "cut", config, resume=True)
    assert straight.manifest["env_steps"] == resumed.manifest["env_steps"] == N
    assert straight.optimizer
    assert checkpoint_difference(straight, resumed) is None
    assert log_difference(tmp_path / "straight", tmp_path / "cut") is None


def test_two_runs_differ_only_by_seed(tmp_path):
    _, first = run(tmp_path, small_run("mappo"), stop_at=32)
    _, other = run(tmp_path / "other", {**small_run("mappo"), "seed": 4}, stop_at=32)
    assert any(not th.equal(first.policy[k], other.policy[k]) for k in first.policy)


def test_environment_without_state_resumes_inexactly(tmp_path):
    config = small_run("mappo", "supersuit", env="toy_envs:PlainEnv", policy_kwargs={})
    env = make_env(config)
    assert "offers no get_state" in env_gap(env)
    assert PlainEnv().possible_agents == env.unwrapped.agents
    run(tmp_path, config, stop_at=CUT, evaluate=False)
    model, checkpoint = run(tmp_path, config, resume=True, evaluate=False)
    assert checkpoint.manifest["env_steps"] == N
    assert model.num_timesteps == 2 * N


def first_observations(folder, config, **options):
    """Train on ``WitnessEnv``; return what the episodes of its four teams began with."""
    WitnessEnv.seen.clear()
    run(folder, config, evaluate=False, **options)
    return list(WitnessEnv.seen)


def test_without_its_state_an_environment_does_not_repeat_its_first_episodes(tmp_path):
    config = small_run("mappo", "supersuit", env="toy_envs:WitnessEnv", policy_kwargs={})
    start = first_observations(tmp_path / "a", config, stop_at=CUT)
    for other in ("b", "c"):
        shutil.copytree(tmp_path / "a", tmp_path / other)
    resumed = first_observations(tmp_path / "a", config, resume=True)
    # The first four are those of SB3's reset, before the checkpoint is put back.
    assert resumed[:4] == start[:4]
    assert len(resumed) > 8
    assert not set(resumed[4:]) & set(start)
    # They are a function of the seed and of where the run was.
    assert first_observations(tmp_path / "b", config, resume=True) == resumed
    other = first_observations(tmp_path / "c", {**config, "seed": 9}, resume=True)
    assert not set(other) & set(resumed)


@pytest.mark.parametrize("algo", ["mappo", "hmappo", "recurrent_ppo"])
def test_records_of_an_episode_that_was_cut_off_are_dropped(tmp_path, algo):
    # Episodes of 5 steps, a checkpoint after 8: each team is in the middle of one.
    changes = {} if algo == "recurrent_ppo" else {"policy_kwargs": {}}
    config = small_run(algo, "supersuit", env="toy_envs:PlainEnv", **changes)
    _, cut = run(tmp_path, config, stop_at=CUT, evaluate=False)
    metrics = dict(cut.state["stateful"])["TeamMetricsCallback"]
    assert metrics["steps"].tolist() == [3] * 4
    _, resumed = run(tmp_path, config, resume=True, evaluate=False)
    states = dict(resumed.state["stateful"])
    metrics = states["TeamMetricsCallback"]
    lengths = metrics["window_metrics"][:, metrics["metric_names"].index("length")]
    assert len(lengths) == 10
    assert set(lengths) == {5.0}
    assert metrics["steps"].tolist() == [16 % 5] * 4
    if "RoleCallback" in states:
        roles = states["RoleCallback"]
        assert roles["steps"].tolist() == [16 % 5] * 4
        # Two robots have a role in each of the 5 steps.
        assert (roles["window_counts"].sum(axis=2) == 2).all()
        assert roles["window_counts"].shape[1] == 5


@pytest.fixture
def content():
    return {
        "manifest": {"env_steps": 5},
        "policy": {"w": th.arange(6.0).reshape(2, 3).t()},
        "optimizer": {"0.step": th.tensor(3.0)},
        "state": {
            "keys": np.array([2**63 + 1], np.uint64),
            "list": [1, (2.5, None)],
            "big": 2**100,
        },
    }


def test_round_trip(tmp_path, content):
    write_checkpoint(tmp_path / "a.ckpt", **content)
    read = read_checkpoint(tmp_path / "a.ckpt")
    assert read.manifest["env_steps"] == 5
    assert th.equal(read.policy["w"], content["policy"]["w"])
    assert read.optimizer["0.step"].shape == ()
    assert read.state["keys"].dtype == np.uint64
    assert read.state["keys"][0] == 2**63 + 1
    assert read.state["list"] == [1, [2.5, None]]
    assert read.state["big"] == 2**100
    write_checkpoint(tmp_path / "b.ckpt", **content)
    assert (tmp_path / "a.ckpt").read_bytes() == (tmp_path / "b.ckpt").read_bytes()


@pytest.mark.parametrize("value", [object(), {1: 2}, np.array(["a"]), {"x": {"__array__": "y"}}])
def test_what_can_not_be_stored_is_named(tmp_path, content, value):
    with pytest.raises(CheckpointError, match="state/odd"):
        write_checkpoint(tmp_path / "a.ckpt", **{**content, "state": {"odd": value}})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("broken", ["fsync", "replace", "write"])
def test_a_failed_write_leaves_the_earlier_file(tmp_path, content, monkeypatch, broken):
    folder = CheckpointFolder(tmp_path)
    folder.save(1, **content)
    before = (tmp_path / "step_000000000001.ckpt").read_bytes()

    def fail(*args, **kwargs):
        raise OSError(28, "No space left on device")

    if broken == "write":

        def pack(members):
            yield b"PK"
            fail()

        monkeypatch.setattr(checkpoint, "pack", pack)
    else:
        monkeypatch.setattr(os, broken, fail)
    for step in (1, 2):
        with pytest.raises(OSError, match="No space"):
            folder.save(step, **content)
    monkeypatch.undo()
    assert [path.name for path in tmp_path.iterdir()] == ["step_000000000001.ckpt"]
    assert (tmp_path / "step_000000000001.ckpt").read_bytes() == before


def test_the_last_ones_are_kept_and_remains_removed(tmp_path, content):
    folder = CheckpointFolder(tmp_path, keep=2)
    (tmp_path / "step_000000000001.ckpt.77-ab.partial").write_bytes(b"half")
    folder.prepare()
    for step in (10, 20, 30):
        folder.save(step, **content)
    assert [path.name for path in folder.paths()] == [
        "step_000000000020.ckpt",
        "step_000000000030.ckpt",
    ]
    assert len(list(tmp_path.iterdir())) == 2
    with pytest.raises(ValueError, match="at least 2"):
        CheckpointFolder(tmp_path, keep=1)


def test_what_is_saved_after_going_back_is_kept(tmp_path, content):
    folder = CheckpointFolder(tmp_path, keep=2)
    # A kill before the oldest was removed, and two files that are damaged.
    folder.save(10, **content)
    for step in (30, 40):
        (tmp_path / f"step_{step:012d}.ckpt").write_bytes(b"damaged")
    saved = folder.save(20, **content)
    with pytest.warns(UserWarning, match=f"going back to {saved.name}"):
        assert folder.newest()[0] == saved
    folder.save(30, **content)
    folder.save(40, **content)
    assert [path.name[-7:] for path in folder.paths()] == ["30.ckpt", "40.ckpt"]


def test_damaged_files_are_refused(tmp_path, content):
    folder = CheckpointFolder(tmp_path)
    folder.save(1, **content)
    newest = folder.save(2, **content)
    sound = newest.read_bytes()
    rng = np.random.default_rng(0)
    damaged = [sound[: int(n)] for n in rng.integers(0, len(sound), 40)]
    for position in rng.integers(0, len(sound), 160):
        flipped = bytearray(sound)
        flipped[position] ^= 1 << int(rng.integers(8))
        damaged.append(bytes(flipped))
    for data in damaged:
        newest.write_bytes(data)
        with pytest.raises(CheckpointError) as caught:
            read_checkpoint(newest)
        assert "\n" not in str(caught.value)
    newest.write_bytes(sound[:100])
    with pytest.warns(UserWarning, match=r"going back to step_000000000001\.ckpt") as caught:
        path, _ = folder.newest()
    assert len(caught) == 1
    assert path.name == "step_000000000001.ckpt"
    path.write_bytes(sound[:50])
    with pytest.raises(CheckpointError) as refused:
        folder.newest()
    text = str(refused.value)
    assert text.startswith(f"{newest}: ") and text.count(str(tmp_path)) == 1
    assert text.endswith("; none of the 2 checkpoints can be taken")


def rewrite(path, change):
    """Pack the members again after a change, with a manifest that fits."""
    # It need not vouch for itself: those of earlier releases do not.
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    manifest = json.loads(members.pop("manifest.json"))
    del manifest["sha256"]
    compression = change(manifest, members) or zipfile.ZIP_STORED
    manifest["members"] = {
        name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        for name, data in members.items()
    }
    members = {"manifest.json": json.dumps(manifest).encode(), **members}
    if compression == zipfile.ZIP_STORED:
        path.write_bytes(b"".join(stored_zip.pack(members)))
        return
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(name, data)


HOSTILE = {
    "extra": lambda manifest, members: members.update({"../evil.py": b"1"}),
    "bomb": lambda manifest, members: zipfile.ZIP_DEFLATED,
    "missing": lambda manifest, members: members.pop("state.json") and None,
    "pickle": lambda manifest, members: members.update({"policy.safetensors": b"\x80\x04."}),
    "length": lambda manifest, members: members.update(
        {"arrays.safetensors": (2**60).to_bytes(8, "little") + b"{}"}
    ),
    "deep": lambda manifest, members: members.update({"state.json": b"[" * 100_000}),
    "version": lambda manifest, members: manifest.update(format_version=99),
    "format": lambda manifest, members: manifest.update(format="other"),
    "array": lambda manifest, members: members.update({"state.json": b'{"__array__": "no"}'}),
    "array key": lambda manifest, members: members.update({"state.json": b'{"__array__": []}'}),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused(tmp_path, content, name):
    path = tmp_path / "step_000000000001.ckpt"
    write_checkpoint(path, **content)
    rewrite(path, HOSTILE[name])
    with pytest.raises(CheckpointError) as caught:
        read_checkpoint(path)
    assert "\n" not in str(caught.value)


def test_a_huge_file_is_not_read(tmp_path, content, monkeypatch):
    path = tmp_path / "a.ckpt"
    write_checkpoint(path, **content)
    monkeypatch.setattr(ckpt, "MAX_BYTES", 100)
    with pytest.raises(CheckpointError, match="more than the 100"):
        read_checkpoint(path)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    config = small_run("hmappo")
    model, _ = run(folder, config, stop_at=32)
    write_yaml(folder / "config.yml", complete(config))
    return folder, model


def test_load_model(trained):
    folder, model = trained
    state = th.get_rng_state()
    loaded = load_model(folder, device="cpu")
    assert th.equal(th.get_rng_state(), state)
    assert loaded.num_timesteps == model.num_timesteps
    for name, tensor in model.policy.state_dict().items():
        assert th.equal(tensor, loaded.policy.state_dict()[name])
    rows = model.env.reset()
    actions, _ = model.predict(rows, deterministic=True)
    assert np.array_equal(actions, loaded.predict(rows, deterministic=True)[0])


def test_load_model_takes_the_best_weights_that_the_callback_wrote(tmp_path):
    config = small_run("hmappo")
    env = make_env(config)
    model = make_model(config, env, "cpu")
    seen = []

    def evaluate(model):
        seen.append({name: value.clone() for name, value in model.policy.state_dict().items()})
        return {"cover": [0.1, 0.5, 0.2][len(seen) - 1]}

    callback = EvaluationCallback(32, evaluate=evaluate, folder=tmp_path)
    model.learn(3 * 32 * 3, callback=callback)
    env.close()
    write_yaml(tmp_path / "config.yml", complete(config))
    loaded = load_model(tmp_path, best=True, device="cpu")
    assert loaded.num_timesteps == 2 * 32 * 3
    assert len(seen) == 3
    for name, value in loaded.policy.state_dict().items():
        assert th.equal(value, seen[1][name])
        if "value" in name and "weight" in name:
            assert not th.equal(value, seen[2][name])


def test_load_model_refuses(trained, tmp_path):
    folder, _ = trained
    with pytest.raises(UsageError, match="no such run folder"):
        load_model(tmp_path / "none")
    with pytest.raises(UsageError, match=r"model\.ckpt"):
        load_model(folder, best=True)
    write_yaml(tmp_path / "config.yml", small_run("hmappo"))
    with pytest.raises(UsageError, match="no checkpoint"):
        load_model(tmp_path)


def test_weights_of_another_configuration_are_refused(trained):
    folder, _ = trained
    _, checkpoint = CheckpointFolder(folder / "checkpoints").newest()
    for changes in ({"graph_width": 9}, {"share_encoders": True}):
        config = small_run("hmappo", policy_kwargs={**SMALL_POLICIES["RolePolicy"], **changes})
        model = make_model(config, make_env(config, 1), "cpu")
        before = {name: t.clone() for name, t in model.policy.state_dict().items()}
        with pytest.raises(CheckpointError, match="do not fit the configuration"):
            load_weights(model, checkpoint)
        for name, tensor in model.policy.state_dict().items():
            assert th.equal(tensor, before[name])
