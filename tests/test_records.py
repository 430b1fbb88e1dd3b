"""Records come back from their files as they were, and pandas reads them by itself."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from area_search import get_scene
from sb3_roles.baselines.random import RandomController
from sb3_roles.evaluation import records as module
from sb3_roles.evaluation.episodes import held_out_seed, run_episodes
from sb3_roles.evaluation.metrics import summarize
from sb3_roles.evaluation.records import EpisodeRecords, RecordsError, read_records, write_records

STOPPING = get_scene("hard", horizon=40, early_stop_patience=6, n_agents=3)


class Bounded(RandomController):
    """Random, and knows a bound in most episodes."""

    def begin(self, batch):
        super().begin(batch)
        self.bounds = np.where(batch.episodes % 10 == 3, np.nan, 20.0 + batch.episodes)


class WithRoles(RandomController):
    """Random, in roles that follow the clock."""

    role_names = ("explore", "cover")
    deterministic = False
    communicate = True

    def __init__(self):
        self.description = {"limit": 0.5}

    def act(self, batch):
        self.roles = np.full((batch.n_teams, batch.n_agents), batch.steps[0] % 2, np.int8)
        return super().act(batch)


@pytest.fixture(scope="module")
def recorded() -> EpisodeRecords:
    return run_episodes(WithRoles(), STOPPING, 40, held_out_seed(3), first_episode=10)


def test_versions_are_of_what_a_controller_uses(monkeypatch):
    """Whoever else has loaded OR-Tools in this process."""

    class Routes(RandomController):
        solutions = 20

    monkeypatch.setitem(sys.modules, "ortools", SimpleNamespace(__version__="9.0"))
    versions = [
        run_episodes(one(), STOPPING, 1, held_out_seed(3)).metadata["versions"]
        for one in (Routes, RandomController)
    ]
    assert versions[0].pop("ortools") == "9.0"
    assert versions[0] == versions[1]
    assert "numba" in versions[1]


def assert_identical(first: EpisodeRecords, second: EpisodeRecords) -> None:
    for field in fields(EpisodeRecords):
        one, other = getattr(first, field.name), getattr(second, field.name)
        if field.name == "counts":
            assert list(one) == list(other)
        elif not isinstance(one, np.ndarray):
            assert one == other, field.name
            continue
        arrays = one.items() if field.name == "counts" else [("", one)]
        for name, array in arrays:
            twin = other[name] if name else other
            assert array.dtype == twin.dtype, (field.name, name)
            assert array.shape == twin.shape, (field.name, name)
            assert array.tobytes() == twin.tobytes(), (field.name, name)


@pytest.mark.parametrize("controller", [WithRoles(), RandomController(), Bounded()])
@pytest.mark.parametrize("scene", [STOPPING, get_scene("easy", horizon=5, n_agents=1)])
def test_records_come_back_as_they_were(controller, scene, tmp_path):
    records = run_episodes(controller, scene, 12, 2**64 - 1, first_episode=3, batch_size=5)
    write_records(records, tmp_path / "new" / "x.parquet")
    back = read_records(tmp_path / "new" / "x.parquet")
    assert_identical(records, back)
    assert summarize(back) == summarize(records)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["x.parquet"]
    has_roles = isinstance(controller, WithRoles)
    assert (back.roles.max() >= 0) == has_roles
    known = isinstance(controller, Bounded)
    expected = np.arange(23.0, 35.0) if known else np.full(12, np.nan)
    expected[[0, 10]] = np.nan
    np.testing.assert_array_equal(back.bounds, expected)
    assert ("cover_bound" in summarize(back)) == known


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="threads are counted in /proc")
def test_arrow_starts_no_threads(recorded, tmp_path):
    # One that is left when the process ends may abort it, when all of its work is done.
    path = tmp_path / "records.parquet"
    write_records(recorded, path)
    code = (
        "import os, sys\n"
        "from sb3_roles.evaluation.records import read_records, write_records\n"
        "import pyarrow.parquet\n"
        "before = len(os.listdir('/proc/self/task'))\n"
        "write_records(read_records(sys.argv[1]), sys.argv[1])\n"
        "print(before, len(os.listdir('/proc/self/task')))\n"
    )
    output = subprocess.run(
        [sys.executable, "-c", code, str(path)], check=True, capture_output=True, text=True
    ).stdout
    before, after = output.split()
    assert before == after


def test_long_horizons_have_wider_distances(tmp_path):
    records = run_episodes(RandomController(), get_scene("hard", horizon=2**15, n_agents=1), 1, 0)
    assert records.distance.dtype == np.int32
    write_records(records, tmp_path / "x.parquet")
    assert_identical(records, read_records(tmp_path / "x.parquet"))


def test_pandas_reads_a_tidy_table(recorded, tmp_path):
    pandas = pytest.importorskip("pandas")
    write_records(recorded, tmp_path / "x.parquet")
    table = pandas.read_parquet(tmp_path / "x.parquet")
    assert len(table) == recorded.length.sum() < 40 * STOPPING.horizon
    robots = [f"{name}_{i}" for name in ("distance", "role") for i in range(3)]
    assert table.columns.tolist() == [
        *("controller", "seed", "episode", "step", "seen", "seen_free", "covered"),
        *("n_free", "n_targets", *robots, "decision_seconds"),
    ]
    assert table["controller"].dtype == "category"
    assert {str(table[name].dtype) for name in robots} == {"int16", "int8"}
    assert not table.isna().any().any()
    assert set(table["controller"]) == {"WithRoles"}
    assert set(table["seed"]) == {held_out_seed(3)}
    last = table.groupby("episode").last()
    assert last.index.tolist() == list(range(10, 50))
    assert np.array_equal(last["step"] + 1, recorded.length)
    for name, counts, total in (
        ("explo_paper", "seen", "n_free"),
        ("explo_true", "seen_free", "n_free"),
        ("cover", "covered", "n_targets"),
    ):
        assert np.array_equal(last[counts] / last[total], recorded.curves[name][:, -1])
    assert np.array_equal(last["distance_2"], recorded.distance[:, -1, 2])
    assert np.array_equal(table["role_0"], (table["step"] % 2))


def test_what_was_played_is_in_the_schema(recorded, tmp_path):
    import pyarrow.parquet as pq

    write_records(recorded, tmp_path / "x.parquet")
    header = json.loads(pq.read_schema(tmp_path / "x.parquet").metadata[b"sb3_roles"])
    assert header["format_version"] == module.FORMAT_VERSION
    about = header["metadata"]
    assert about["controller_options"] == {"limit": 0.5}
    assert (about["deterministic"], about["communication"]) == (False, True)
    assert about["role_names"] == ["explore", "cover"]
    assert get_scene("hard").with_options(**about["scene"]) == STOPPING
    assert header["timing"].keys() == {"seconds", "batch_size"}


def test_a_failed_write_leaves_the_old_file(recorded, tmp_path, monkeypatch):
    path = tmp_path / "x.parquet"
    write_records(recorded, path)
    before = path.read_bytes()
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError(28, "full")))
    other = run_episodes(RandomController(), STOPPING, 5, 0)
    with pytest.raises(OSError, match="full"):
        write_records(other, path)
    assert path.read_bytes() == before
    assert_identical(recorded, read_records(path))


def test_a_seed_beyond_64_bits_has_no_column(recorded, tmp_path):
    huge = replace(recorded, metadata={**recorded.metadata, "seed": 2**64})
    with pytest.raises(RecordsError, match=r"below 2 \*\* 64, got 18446744073709551616"):
        write_records(huge, tmp_path / "x.parquet")
    assert list(tmp_path.iterdir()) == []


def refusal(path) -> str:
    with pytest.raises(RecordsError) as caught:
        read_records(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


def test_damaged_and_foreign_files_are_refused(recorded, tmp_path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = tmp_path / "x.parquet"
    assert refusal(path) == "No such file or directory"
    assert refusal(tmp_path) == "Is a directory"
    write_records(recorded, path)
    sound = path.read_bytes()
    for length in (0, 3, 100, len(sound) // 2, len(sound) - 1):
        path.write_bytes(sound[:length])
        assert "no Parquet file" in refusal(path)
    # Wherever one bit is wrong, the records are those that were written, or none.
    for k in range(11, len(sound), 97):
        path.write_bytes(sound[:k] + bytes([sound[k] ^ 1]) + sound[k + 1 :])
        try:
            back = read_records(path)
        except RecordsError:
            continue
        assert_identical(recorded, back)
    path.write_bytes(b"step,seen\n0,3\n")
    assert "no Parquet file" in refusal(path)
    pq.write_table(pa.table({"step": [0]}), path)
    assert refusal(path) == "a Parquet file, but not one of episode records"
    pq.write_table(pa.table({"step": [0]}, metadata={b"sb3_roles": b"{"}), path)
    assert "damaged records" in refusal(path)


def test_tables_that_are_no_episodes_are_refused(recorded, tmp_path):
    import pyarrow.parquet as pq

    path = tmp_path / "x.parquet"
    write_records(recorded, path)
    table = pq.read_table(path)

    def rewritten(change, **header) -> str:
        header = {**json.loads(table.schema.metadata[b"sb3_roles"]), **header}
        text = json.dumps(header)
        pq.write_table(change(table).replace_schema_metadata({b"sb3_roles": text}), path)
        return refusal(path)

    def same(whole):
        return whole

    newer = rewritten(same, format_version=2)
    assert newer == "records of format version 2, this program reads 1"
    assert "not one of episode records" in rewritten(same, format="something else")
    assert "damaged records" in rewritten(same, metadata={})
    early = rewritten(lambda whole: whole.slice(0, 2))
    assert early == "damaged records: an episode of 2 steps ended before its scene can end it"
    assert "count up from 0" in rewritten(lambda whole: whole.take([0, 2, 3]))
    assert "begin at 0" in rewritten(lambda whole: whole.slice(1))
    assert "damaged records" in rewritten(lambda whole: whole.slice(0, 0))
    assert "damaged records" in rewritten(lambda whole: whole.drop_columns(["role_1"]))

    def wide(whole):
        k = whole.column_names.index("seen")
        return whole.set_column(k, "seen", whole["seen"].cast("int64"))

    assert "column seen is int64, not int32" in rewritten(wide)


def without(entries, key):
    return {name: value for name, value in entries.items() if name != key}


METADATA_KEYS = (
    *("name", "controller", "controller_options", "scene", "deterministic", "communication"),
    *("version", "config_hash", "seed", "role_names", "versions"),
)


def test_metadata_that_nobody_could_have_written_are_refused(recorded, tmp_path):
    import pyarrow.parquet as pq

    path = tmp_path / "x.parquet"
    write_records(recorded, path)
    table = pq.read_table(path)
    header = json.loads(table.schema.metadata[b"sb3_roles"])
    about, timing, scene = header["metadata"], header["timing"], header["metadata"]["scene"]
    assert sorted(about) == sorted(METADATA_KEYS)

    def rewritten(metadata=about, timing=timing) -> str:
        # With the hash that belongs to them.
        digest = module._digest(metadata, timing)
        text = json.dumps({**header, "metadata": metadata, "timing": timing, "sha256": digest})
        pq.write_table(table.replace_schema_metadata({b"sb3_roles": text}), path)
        return refusal(path).removeprefix("damaged records: ")

    for key in about:
        assert rewritten(without(about, key)) == f"the entry '{key}' of the metadata is missing"
        assert rewritten({**about, key: 0.5}) == f"the entry '{key}' of the metadata is 0.5"
    for key in timing:
        wrong = rewritten(timing=without(timing, key))
        assert wrong == f"the entry '{key}' of the metadata is missing"
        for value in (None, 0, True, -1.0):
            assert f"the entry '{key}'" in rewritten(timing={**timing, key: value})
    for key, value in (
        ("seed", -1),
        ("seed", 2**64),
        ("seed", True),
        ("role_names", [1]),
        ("versions", {"python": 3}),
    ):
        assert f"the entry '{key}'" in rewritten({**about, key: value})
    assert "NaN" in rewritten({**about, "controller_options": {"x": float("nan")}})
    assert "'horizon'" in rewritten({**about, "scene": without(scene, "horizon")})
    assert "'depth'" in rewritten({**about, "scene": {**scene, "depth": 1}})
    # No memory is asked for that the rows do not account for.
    for change, message in (
        ({"horizon": 10**15}, "horizon must be a whole number from 1 to 1000000"),
        ({"horizon": 10**6, "early_stop_patience": None}, "before its scene can end it"),
        ({"n_agents": 10**9}, "n_agents must be"),
        ({"n_agents": 4}, "distance_3"),
        ({"n_targets": 3}, "column n_targets is not the scene's 3"),
    ):
        assert message in rewritten({**about, "scene": {**scene, **change}})
