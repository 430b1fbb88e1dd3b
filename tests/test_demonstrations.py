"""Recording of demonstrations: what is stored is what the teams saw and did."""

import dataclasses
import io
import json
import zipfile

import numpy as np
import pytest
import torch as th
from helpers import hand_made, one_line
from torch.utils.data import DataLoader

from area_search import BatchedAreaSearch, get_scene
from area_search.kernels import METRICS
from sb3_roles.baselines import controller_class
from sb3_roles.gnn import recording
from sb3_roles.gnn.demonstrations import (
    DemonstrationError,
    load_demonstrations,
    pack_maps,
)
from sb3_roles.gnn.joint_steps import JointSteps
from sb3_roles.gnn.recording import record
from sb3_roles.zoo import demonstrate
from sb3_roles.zoo.options import Parser, UsageError

SCENE = get_scene("hard", height=11, width=9, n_targets=12, horizon=12, n_agents=3)
ARRAYS = ("episodes", "maps", "positions", "actions", "metrics")


def same(first, second):
    return first.facts == second.facts and all(
        np.array_equal(getattr(first, name), getattr(second, name)) for name in ARRAYS
    )


@pytest.mark.parametrize("name", ["greedy_assigned", "look_ahead"])
def test_a_recording_is_what_the_teams_observe_and_do(name):
    found = record(name, SCENE, 3, seed=5)
    assert len(found) == 3
    assert found.n_steps == 12
    assert found.n_agents == 3
    batch = BatchedAreaSearch(SCENE, 3, known_map=True)
    batch.reset([recording._STREAM + 5] * 3, np.arange(3))
    controller = controller_class(name)()
    controller.begin(batch)
    for t in range(12):
        seen = found.observe(np.arange(3), np.full(3, t))
        for key in ("known", "joint"):
            assert np.array_equal(seen[key], batch.observations[key])
        assert np.array_equal(seen["position"], batch.observations["position"].reshape(-1, 2))
        assert seen["agent"].tolist() == [[0, 3], [1, 3], [2, 3]] * 3
        # A replay of the recorded moves ends up where the controller did.
        controller.predict({})
        batch.step(found.actions[:, t].astype(np.int64))
    assert np.array_equal(found.metrics, np.stack([batch.metrics[k] for k in METRICS], axis=1))


def test_blocked_moves_are_recorded_as_stops():
    class Stubborn:
        def begin(self, batch):
            self.batch = batch

        def predict(self, *arguments):
            return np.ones(self.batch.n_teams * self.batch.n_agents, np.int64), None

    found = record(Stubborn(), SCENE, 2, seed=0)
    moved = found.positions[:, 1:] != found.positions[:, :-1]
    assert np.array_equal(moved.any(axis=-1), found.actions[:, :-1] == 1)
    assert set(np.unique(found.actions)) == {0, 1}
    assert found.facts["controller"] == "Stubborn"


def test_a_file_holds_the_recording(tmp_path):
    path = tmp_path / "d.npz"
    found = record("greedy_assigned", SCENE, 4, seed=1, path=path)
    assert same(load_demonstrations(path), found)
    assert not list(tmp_path.glob("*.partial"))


def test_a_stopped_recording_goes_on(tmp_path, monkeypatch):
    whole = record("greedy_assigned", SCENE, 7, seed=1, batch_size=7)
    path, counts = tmp_path / "d.npz", []

    def stop(count):
        counts.append(count)
        if count == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record("greedy_assigned", SCENE, 7, seed=1, path=path, batch_size=2, report=stop)
    assert len(load_demonstrations(path)) == 4
    again = record("greedy_assigned", SCENE, 7, 1, path, batch_size=2, report=counts.append)
    assert counts == [2, 4, 6, 7]
    assert same(again, whole)
    # All of it is there: nothing is played any more.
    monkeypatch.setattr(recording, "_play", None)
    assert same(record("greedy_assigned", SCENE, 7, 1, path), whole)
    assert len(record("greedy_assigned", SCENE, 5, 1, path)) == 5


def test_a_file_of_another_recording_is_refused(tmp_path):
    path = tmp_path / "d.npz"
    record("random", SCENE, 1, seed=1, path=path)
    before = path.read_bytes()
    for change, hint in (
        ({"seed": 2}, "seed is 1 there, 2 here"),
        ({"controller": "greedy_assigned"}, "controller is 'random' there"),
        ({"scene": SCENE.with_options(n_targets=9)}, "the scene's n_targets is 12 there, 9 here"),
    ):
        arguments = {"controller": "random", "scene": SCENE, "seed": 1, **change}
        with pytest.raises(DemonstrationError) as caught:
            record(**arguments, n_episodes=2, path=path)
        assert hint in one_line(caught.value)
    assert path.read_bytes() == before


def rewrite(path, **changes):
    """Save the arrays of a file again, some of them changed."""
    with np.load(path) as content:
        arrays = {**content, **changes}
    np.savez_compressed(path, **{k: v for k, v in arrays.items() if v is not None})


def facts(path, **changes):
    with np.load(path) as content:
        values = {**json.loads(bytes(content["facts"])), **changes}
    return np.frombuffer(json.dumps(values).encode(), np.uint8)


def of_scene(path, **changes):
    return facts(path, scene={**load_demonstrations(path).facts["scene"], **changes})


def members(path):
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def repack(path, compression, **changes):
    content = {**members(path), **changes}
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in content.items():
            archive.writestr(name, data)


def promise(path, count):
    """Let the head of an array declare more than there is."""
    head = io.BytesIO()
    declared = {"descr": "<i8", "fortran_order": False, "shape": (count,)}
    np.lib.format.write_array_header_1_0(head, declared)
    repack(path, zipfile.ZIP_DEFLATED, **{"episodes.npy": head.getvalue() + bytes(16)})


DAMAGES = {
    "no file": lambda path: path.unlink(),
    "no archive": lambda path: path.write_bytes(b"nothing of the kind"),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-200]),
    "another archive": lambda path: zipfile.ZipFile(path, "w").writestr("a.txt", "hello"),
    "a missing array": lambda path: rewrite(path, actions=None),
    "an object array": lambda path: rewrite(path, actions=np.array([{}], object)),
    "another type": lambda path: rewrite(path, maps=np.zeros((2, 12, 4, 13), np.float32)),
    "another shape": lambda path: rewrite(path, maps=np.zeros((2, 12, 4, 12), np.uint8)),
    "a wrong action": lambda path: rewrite(path, actions=np.full((2, 12, 3), 5, np.int8)),
    "off the map": lambda path: rewrite(path, positions=np.full((2, 12, 3, 2), 9, np.int16)),
    "another format": lambda path: rewrite(path, facts=facts(path, format="x")),
    "a later version": lambda path: rewrite(path, facts=facts(path, format_version=9)),
    "no scene": lambda path: rewrite(path, facts=facts(path, scene=None)),
    "an endless scene": lambda path: rewrite(path, facts=of_scene(path, height=float("inf"))),
    "a scene of no height": lambda path: rewrite(path, facts=of_scene(path, height=0)),
    "a side that is no whole number": lambda path: rewrite(path, facts=of_scene(path, width=9.0)),
    "no controller": lambda path: rewrite(path, facts=facts(path, controller=None)),
    "lines in a name": lambda path: rewrite(path, facts=facts(path, controller="a\nb")),
    "a header that promises too much": lambda path: promise(path, 10**13),
    "another packing": lambda path: repack(path, zipfile.ZIP_LZMA),
    "no text": lambda path: rewrite(path, facts=np.array([255, 254], np.uint8)),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_and_foreign_files_give_one_line(tmp_path, damage):
    path = tmp_path / "d.npz"
    record("random", SCENE, 2, seed=1, path=path)
    DAMAGES[damage](path)
    with pytest.raises(DemonstrationError) as caught:
        load_demonstrations(path)
    assert one_line(caught.value).startswith(str(path))


def test_bytes_that_flip_are_noticed(tmp_path):
    path = tmp_path / "d.npz"
    record("greedy_assigned", SCENE, 2, seed=1, path=path)
    content = path.read_bytes()
    good = load_demonstrations(path)
    rng = np.random.default_rng(0)
    for place in rng.integers(0, len(content), 40):
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            found = load_demonstrations(path)
        except DemonstrationError as error:
            one_line(error)
        else:
            # Only what carries no meaning, such as the date of a member, may differ.
            assert same(found, good)


def test_the_digest_is_that_of_the_content(tmp_path):
    path = tmp_path / "d.npz"
    found = record("random", SCENE, 3, seed=1, path=path)
    digest = found.digest()
    assert len(digest) == 64
    assert load_demonstrations(path).digest() == digest
    # Neither the packing nor the version that recorded matters.
    repack(path, zipfile.ZIP_STORED)
    rewrite(path, facts=facts(path, version="0.0"))
    assert load_demonstrations(path).digest() == digest
    assert record("random", SCENE, 5, seed=1).first(3).digest() == digest
    others = [
        found.first(2),
        record("random", SCENE, 3, seed=2),
        record("greedy", SCENE, 3, seed=1),
        dataclasses.replace(found, actions=np.zeros_like(found.actions)),
        dataclasses.replace(found, facts={**found.facts, "controller": "greedy"}),
    ]
    assert len({digest, *(other.digest() for other in others)}) == 6


def test_more_episodes_than_there_are_can_not_be_had():
    found = record("random", SCENE, 2, seed=1)
    assert same(found.first(2), found)
    with pytest.raises(DemonstrationError, match="there are 2 demonstrated episodes, 3 are asked"):
        found.first(3)


def test_maps_are_packed_cell_by_cell():
    batch = hand_made(["0.T#", "??.%", "...."])
    batch.show_known_map()
    batch.show_known_map()  # Once is enough.
    known, joint = batch.observations["known"], batch.observations["joint"]
    assert known[0, 0].tolist()[:3] == [[1, 1, 1, 0, 0], [0, 0, 1, 0, 0], [1, 1, 1, 1, 0]]
    assert known[0, 1].tolist()[:3] == [[0, 0, 0, 1, 1], [0, 0, 0, 0, 1], [0, 0, 0, 0, 1]]
    packed = pack_maps(known, joint)
    assert packed.shape == (1, 4, 4)
    maps = np.unpackbits(packed, axis=-1, count=25).reshape(4, 5, 5)
    assert np.array_equal(maps, np.concatenate([known[0], joint[0]]))


def test_the_data_set_serves_a_loader():
    found = record("greedy_assigned", SCENE, 5, seed=3)
    steps = JointSteps(found, [4, 1])
    assert len(steps) == 24
    observations, actions = steps[13]
    assert actions.tolist() == found.actions[1, 1].tolist()
    assert observations["position"].tolist() == found.positions[1, 1].tolist()
    loader = DataLoader(
        steps, 7, shuffle=True, generator=th.Generator().manual_seed(0), collate_fn=lambda b: b
    )
    batches = list(loader)
    assert [len(actions) for _, actions in batches] == [21, 21, 21, 9]
    assert all(len(seen["joint"]) * 3 == len(actions) for seen, actions in batches)
    counted = np.bincount(th.cat([actions for _, actions in batches]).numpy(), minlength=5)
    assert counted.tolist() == np.bincount(found.actions[[4, 1]].reshape(-1), minlength=5).tolist()


@pytest.fixture
def without_ortools(monkeypatch):
    """As if OR-Tools were not installed."""

    def missing(name):
        raise ImportError(f"no module {name}")

    monkeypatch.setattr("sb3_roles.baselines.ortools_routing.import_module", missing)


def command(*arguments):
    """Run ``sb3-roles demonstrate``."""
    parser = Parser()
    demonstrate.add_parser(parser.add_subparsers())
    args = parser.parse_args(["demonstrate", *arguments])
    return args.run(args)


@pytest.mark.parametrize("name", ["random", "look_ahead"])
def test_the_command_records_and_goes_on(tmp_path, capsys, name):
    path = tmp_path / "d.npz"
    options = ["--controller", name, "--n-agents", "2", "--seed", "4", "--out", str(path)]
    options += ["--scene-options", "horizon:5", "--batch-size", "2"]
    assert command(*options, "--episodes", "2") == 0
    assert command(*options, "--episodes", "5") == 0
    assert capsys.readouterr().err.splitlines() == [
        "2 of 2 episodes",
        "4 of 5 episodes",
        "5 of 5 episodes",
    ]
    scene = get_scene("hard", n_agents=2, horizon=5)
    assert same(load_demonstrations(path), record(name, scene, 5, seed=4))
    with pytest.raises(UsageError) as caught:
        command(*options, "--episodes", "2", "--seed", "5")
    assert "argument --out" in one_line(caught.value)
    assert "seed is 4 there, 5 here" in str(caught.value)


def test_a_controller_that_is_not_installed_gives_one_line(tmp_path, without_ortools):
    path = tmp_path / "d.npz"
    with pytest.raises(UsageError) as caught:
        command("--controller", "vrpc", "--episodes", "2", "--out", str(path))
    assert one_line(caught.value).startswith("argument --controller: ")
    assert "sb3_roles[vrp]" in str(caught.value)
    assert not path.exists()
