"""The proofs on files report what they look for, where it is planted."""

from __future__ import annotations

import io
import os
import pickle
import tempfile
import zipfile

import numpy as np
import pytest
import torch as th

from sb3_roles.common import checkpoint_reading, stored_zip
from sb3_roles.common.checkpoint import CheckpointError, read_checkpoint, write_checkpoint
from sb3_roles.common.files import open_regular
from sb3_roles.common.yaml_text import load_yaml
from sb3_roles.evaluation import records
from sb3_roles.evaluation.records import RecordsError, read_records
from sb3_roles.gnn.demonstrations import load_demonstrations
from sb3_roles.hmappo import HMAPPO
from sb3_roles.mappo import MAPPO
from sb3_roles.mappo.policies import TeamActorCriticPolicy
from sb3_roles.prove import corruption, hostile, source_gate
from sb3_roles.prove.damage import CHECKPOINTS, damaged_bytes, members_of
from sb3_roles.prove.hostile_child import Watch
from sb3_roles.prove.hostile_files import Payload
from sb3_roles.prove.promises import Setting

# The container


def zipfile_bytes(members):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data)
    return packed.getvalue()


MEMBERS = {"a.json": b"{}", "b": b"", "longer.name": bytes(range(256)) * 20}


def test_a_stored_zip_is_what_python_writes():
    assert b"".join(stored_zip.pack(MEMBERS)) == zipfile_bytes(MEMBERS)
    assert members_of(b"".join(stored_zip.pack(MEMBERS))) == MEMBERS


def test_every_byte_of_a_stored_zip_means_something():
    sound = b"".join(stored_zip.pack(MEMBERS))

    def read(data):
        file = io.BytesIO(data)
        found = stored_zip.find_members(file, list(MEMBERS), len(data))
        return {name: stored_zip.read_member(file, one) for name, one in found.items()}

    assert read(sound) == MEMBERS
    for at in range(len(sound)):
        with pytest.raises(stored_zip.StoredZipError):
            read(sound[:at] + bytes([sound[at] ^ 1]) + sound[at + 1 :])
    for wrong in (sound[:-1], sound + b"x", b"x" + sound, b"", sound + sound):
        with pytest.raises(stored_zip.StoredZipError):
            read(wrong)


@pytest.fixture
def written(tmp_path):
    paths = []
    for seed in (1, 2):
        th.manual_seed(seed)
        paths.append(tmp_path / f"{seed}.ckpt")
        weights = {"w": th.randn(40, 30), "b": th.randn(3)}
        state = {"x": np.arange(seed, seed + 5.0), "seed": seed}
        write_checkpoint(paths[-1], {"config": {"seed": seed}}, weights, {"0.m": th.ones(2)}, state)
    return paths


@pytest.mark.parametrize("name", CHECKPOINTS)
def test_each_damage_is_one_and_is_refused(name, written, tmp_path):
    one, other = (path.read_bytes() for path in written)
    rng = np.random.default_rng(0)
    for _ in range(10):
        data = damaged_bytes(CHECKPOINTS[name], rng, one, other)
        assert data != one
        (tmp_path / "damaged.ckpt").write_bytes(data)
        with pytest.raises(CheckpointError):
            read_checkpoint(tmp_path / "damaged.ckpt")


def test_weights_alone_are_read_after_all_is_verified(written):
    whole, weights = read_checkpoint(written[0]), read_checkpoint(written[0], weights_only=True)
    assert th.equal(whole.policy["w"], weights.policy["w"])
    assert (weights.optimizer, weights.state) == ({}, {})
    data = written[0].read_bytes()
    at = data.index(b'"seed": 1}', data.index(b"state.json"))
    written[0].write_bytes(data[:at] + b'"seed": 7}' + data[at + 10 :])
    with pytest.raises(CheckpointError, match=r"state\.json"):
        read_checkpoint(written[0], weights_only=True)


def test_what_a_file_declares_is_seen_before_it_is_read(written, monkeypatch):
    def refuse(outline):
        assert outline.policy["w"].shape == (40, 30)
        assert outline.policy["w"].is_meta
        assert outline.optimizer["0.m"].dtype == th.float32
        raise CheckpointError("not this one")

    monkeypatch.setattr(checkpoint_reading.safetensors.torch, "load", None)
    with pytest.raises(CheckpointError, match="not this one"):
        read_checkpoint(written[0], refuse)


# R5


def test_r5_reports_a_reader_that_verifies_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(corruption, "_QUICK_TRIALS", 36)
    monkeypatch.setattr(corruption, "_QUICK_STOCK_TRIALS", 0)
    first = []

    def careless(path):
        # The first three are the sound files.
        first.append(read_checkpoint(path)) if len(first) < 3 else None
        return first[0] if len(first) == 3 else first[-1]

    monkeypatch.setattr(corruption, "read_checkpoint", careless)
    (tmp_path / "run").mkdir()
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    outcome = corruption.damaged(Setting(True, tmp_path / "run", 0))
    assert not list((tmp_path / "temporary").glob("SB3-*"))
    assert not outcome.kept
    assert any("other content was read" in line for line in outcome.failures)


def test_r5_reports_messages_and_errors_that_are_not_one_line(written, monkeypatch):
    sound = read_checkpoint(written[0])
    assert corruption._problem(written[0], sound) == ""
    assert "other content" in corruption._problem(written[1], sound)
    for error, part in ((CheckpointError("a\nb"), "several lines"), (OSError(), "OSError")):

        def fails(path, error=error):
            raise error

        monkeypatch.setattr(corruption, "read_checkpoint", fails)
        assert part in corruption._problem(written[0], sound)


# R6


def test_the_watch_sees_code_that_runs_and_files_that_are_written(tmp_path):
    inside, outside = tmp_path / "run", tmp_path / "other"
    inside.mkdir()
    watch = Watch(inside)
    with watch.on() as seen:
        (inside / "file").write_text("x")
        assert seen == []
        outside.write_text("x")
        os.symlink(outside, inside / "link")
        (inside / "link").write_text("y")
        os.system("true")
        pickle.loads(pickle.dumps(Payload(tmp_path / "marker")))
        exec(compile("1", "of a file", "exec"))
    text = "\n".join(seen)
    assert text.count("to write") == 3
    for part in ("os.system", "pickle.find_class", "exec of of a file"):
        assert part in text
    assert (tmp_path / "marker").exists()
    before = len(watch.seen)
    os.system("true")
    assert len(watch.seen) == before


def test_r6_reports_what_is_not_refused(tmp_path):
    def harmless(run):
        (run / "note.txt").write_text("x")

    outcome = hostile.try_kinds(Setting(True, tmp_path, 0), {"harmless": harmless}, {})
    assert (outcome.held, outcome.tried) == (0, 1)
    assert "exit code 0" in outcome.failures[0]
    assert "runs the payload" in outcome.stock


@pytest.mark.parametrize(
    ("told", "part"),
    [
        ({"code": 1}, "exit code 1"),
        ({"errors": "a\nb\n"}, "2 lines"),
        ({"errors": ""}, "0 lines"),
        ({"errors": "out of memory: x"}, "memory"),
        ({"seen": ["os.system true"]}, "os.system"),
    ],
)
def test_r6_judges_a_load(told, part):
    assert hostile._problems({"code": 2, "errors": "one line\n", "seen": []}) == []
    found = hostile._problems({"code": 2, "errors": "one line\n", "seen": [], **told})
    assert len(found) == 1
    assert part in found[0]


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: os.symlink("/dev/zero", path)])
def test_only_files_are_opened(make, tmp_path):
    make(tmp_path / "x")
    with pytest.raises(OSError, match=r"not a regular file|Is a directory"):
        open_regular(tmp_path / "x")


@pytest.mark.parametrize("load", [read_records, load_demonstrations])
def test_other_loaders_do_not_wait_for_a_pipe(load, tmp_path):
    os.mkfifo(tmp_path / "x")
    with pytest.raises(ValueError, match="not a regular file") as caught:
        load(tmp_path / "x")
    assert "\n" not in str(caught.value)


def test_records_of_too_many_rows_are_not_read(tmp_path, monkeypatch):
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    pq.write_table(pa.table({"a": np.zeros(1000, np.int8)}), tmp_path / "x")
    monkeypatch.setattr(records, "_MAX_VALUES", 999)
    with pytest.raises(RecordsError, match="1000 rows"):
        read_records(tmp_path / "x")


def test_yaml_may_have_aliases_but_not_bombs():
    text = "a: &a {x: 1}\nb: *a\nc: {<<: *a, y: 2}\n"
    assert load_yaml(text) == {"a": {"x": 1}, "b": {"x": 1}, "c": {"x": 1, "y": 2}}
    assert load_yaml("") is None
    laughs = "\n".join(
        ["a0: &a0 [x]", *(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]" for i in range(1, 40))]
    )
    for bad, part in (
        (laughs, "values"),
        ("&a [*a]", "contains itself"),
        (f"x: {'1' * 200}", "200 char"),
    ):
        with pytest.raises(ValueError, match=part):
            load_yaml(bad)


@pytest.mark.parametrize("cls", [MAPPO, HMAPPO, TeamActorCriticPolicy])
def test_pickles_of_sb3_are_not_loaded_without_trust(cls, tmp_path):
    marker = tmp_path / "marker"
    (tmp_path / "model.zip").write_bytes(pickle.dumps(Payload(marker)))
    with pytest.raises(ValueError, match="trust=True") as caught:
        cls.load(str(tmp_path / "model.zip"))
    assert "\n" not in str(caught.value)
    assert "load_model" in str(caught.value)
    assert not marker.exists()


# R7

PLANTED = {
    "import pickle": "pickle",
    "from cloudpickle import loads": "cloudpickle",
    "import dill": "dill",
    "import marshal": "marshal",
    "import shelve": "shelve",
    "import joblib": "joblib",
    "eval(x)": "eval",
    "exec(x)": "exec",
    "builtins.eval(x)": "eval",
    "compile(x, '', 'exec')": "compile",
    "__import__('os')": "__import__",
    "importlib.import_module(x)": "import_module",
    "from importlib import import_module as get": "import_module as get",
    "runpy.run_path(x)": "run_path",
    "yaml.load(x)": "yaml.load",
    "yaml.load(x, Loader=yaml.Loader)": "yaml.Loader",
    "yaml.unsafe_load(x)": "yaml.unsafe_load",
    "from yaml import full_load": "yaml.full_load",
    "th.load(x)": "torch.load",
    "torch.load(x, weights_only=False)": "weights_only=False",
    "np.load(x)": "numpy.load",
    "np.load(x, allow_pickle=True)": "allow_pickle=True",
    "from numpy import load": "numpy.load",
    "import numpy as n": "numpy as n",
    "pd.read_pickle(x)": "read_pickle",
}


@pytest.mark.parametrize("line", PLANTED)
def test_r7_finds_what_is_planted(line, monkeypatch, tmp_path):
    assert PLANTED[line] in [what for _, what, _ in source_gate.hits_in(f"x = 1\n{line}\n")]
    modules = [("clean.py", "x = 1"), ("planted.py", line)]
    monkeypatch.setattr(source_gate, "package_modules", lambda: modules)
    monkeypatch.setattr(source_gate, "ALLOWED", {})
    outcome = source_gate.hits(Setting(True, tmp_path, 0))
    assert outcome.tried - outcome.held == 1
    assert outcome.failures[0].startswith("planted.py:1: ")


def test_r7_lets_what_is_safe_pass():
    text = (
        "import numpy as np\nimport torch as th\nyaml.safe_load(x)\nimport_module('os')\n"
        "np.load(x, allow_pickle=False)\nth.load(x, weights_only=True)\nmodel.eval()\n"
        "re.compile(x)\njson.load(x)\n"
    )
    assert source_gate.hits_in(text) == []


def test_r7_refuses_an_exception_that_is_not_needed(monkeypatch, tmp_path):
    entry = ("sb3_roles/zoo/cli.py", "eval")
    monkeypatch.setattr(source_gate, "ALLOWED", {**source_gate.ALLOWED, entry: "why not"})
    outcome = source_gate.hits(Setting(True, tmp_path, 0))
    assert outcome.held == outcome.tried
    assert outcome.failures == ("sb3_roles/zoo/cli.py: eval is allowed, but no longer there",)
    assert all(reason for reason in source_gate.ALLOWED.values())
