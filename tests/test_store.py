"""Blocks of records are kept, and none is trusted that is not what its place says."""

from __future__ import annotations

import os
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as parquet
import pytest
from grids import assert_same

from area_search import get_scene
from sb3_roles.baselines.random import RandomController
from sb3_roles.evaluation import records as records_module
from sb3_roles.evaluation.episodes import describe, held_out_seed, run_episodes
from sb3_roles.evaluation.grid.plan import Column
from sb3_roles.evaluation.grid.store import RecordStore, Series, Span, concatenate, spans
from sb3_roles.evaluation.records import EpisodeRecords, read_records, write_records

SEED = held_out_seed(7)
COLUMN = Column("easy", 2)
SCENE = get_scene("easy", n_agents=2)


def series_of(row: str = "random", seed: int = SEED) -> Series:
    return Series(row, COLUMN, describe(RandomController(), SCENE, row), seed)


def played(first: int, last: int, seed: int = SEED, name: str = "random") -> EpisodeRecords:
    n = last - first
    return run_episodes(RandomController(), SCENE, n, seed, first, batch_size=n, name=name)


@pytest.fixture(scope="module")
def block() -> EpisodeRecords:
    return played(2, 4)


@pytest.fixture
def lines() -> list[str]:
    return []


@pytest.fixture
def store(tmp_path, lines) -> RecordStore:
    return RecordStore(tmp_path / "records", lines.append)


def files(store: RecordStore) -> list[str]:
    return sorted(path.name for path in store.folder.rglob("*") if path.is_file())


def test_blocks_lie_on_a_fixed_grid():
    assert spans(8, 3) == [(0, 3), (3, 6), (6, 8)]
    assert spans(6, 3) == [(0, 3), (3, 6)]
    assert spans(2, 3) == [(0, 2)]


def test_a_block_comes_back_from_its_own_place_only(store, block, lines):
    series, span = series_of(), Span(2, 4)
    assert store.read(series, span) is None
    store.write(series, span, block)
    assert_same(store.read(series, span), block)
    digest = series.description["config_hash"][:16]
    assert store.path(series, span).relative_to(store.folder) == Path(
        "random", "easy-2", f"{digest}-{SEED}", "2-4.parquet"
    )
    assert store.read(series, Span(0, 2)) is None
    assert store.read(series_of(seed=SEED + 1), span) is None
    assert store.read(series_of(row="other"), span) is None
    assert files(store) == ["2-4.parquet"]
    assert lines == []


def damage_byte(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0xFF
    path.write_bytes(content)


def of_next_format(path: Path) -> None:
    version = records_module.FORMAT_VERSION
    records_module.FORMAT_VERSION = version + 1
    try:
        write_records(played(2, 4), path)
    finally:
        records_module.FORMAT_VERSION = version


def of_another_version(path: Path) -> None:
    found = read_records(path)
    write_records(replace(found, metadata={**found.metadata, "version": "0.0.1"}), path)


def of_another_scene(path: Path) -> None:
    found = read_records(path)
    scene = {**found.metadata["scene"], "sensor_radius": 3.0}
    write_records(replace(found, metadata={**found.metadata, "scene": scene}), path)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (damage_byte, "damaged"),
        (lambda path: path.write_bytes(path.read_bytes()[:-100]), "damaged"),
        (lambda path: path.write_bytes(b""), "damaged"),
        (of_next_format, "format version 2, this program reads 1"),
        (of_another_version, "its version is not"),
        (of_another_scene, "its scene is not"),
        (lambda path: write_records(played(2, 4, SEED + 1), path), "its seed is not"),
        (lambda path: write_records(played(2, 4, name="x"), path), "its name is not"),
        (lambda path: write_records(played(3, 5), path), "holds other episodes"),
        (lambda path: write_records(played(2, 5), path), "holds other episodes"),
    ],
)
def test_a_file_that_is_not_what_it_should_be_is_put_aside(spoil, said, store, block, lines):
    series, span = series_of(), Span(2, 4)
    store.write(series, span, block)
    path = store.path(series, span)
    spoil(path)
    content = path.read_bytes()
    assert store.read(series, span) is None
    (line,) = lines
    assert line.startswith(f"{path}: ")
    assert said in line
    assert line.endswith("renamed to 2-4.parquet.damaged, it is played again")
    assert "\n" not in line
    # Nothing is lost, and the place is free.
    assert path.with_name("2-4.parquet.damaged").read_bytes() == content
    assert store.read(series, span) is None
    assert len(lines) == 1
    store.write(series, span, block)
    assert_same(store.read(series, span), block)
    # The next one does not replace the first.
    spoil(path)
    assert store.read(series, span) is None
    assert files(store) == ["2-4.parquet.damaged", "2-4.parquet.damaged-2"]


@pytest.mark.parametrize(("number", "stops"), [(24, True), (5, True), (12, True), (13, False)])
def test_what_can_not_be_read_now_is_not_called_damaged(
    number, stops, store, block, lines, monkeypatch
):
    series, span = series_of(), Span(2, 4)
    store.write(series, span, block)
    path = store.path(series, span)

    def refuse(*_, **__):
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr(parquet, "ParquetFile", refuse)
        if stops:
            with pytest.raises(OSError, match=os.strerror(number)) as caught:
                store.read(series, span)
            assert (caught.value.errno, caught.value.filename) == (number, str(path))
        else:
            assert store.read(series, span) is None
            assert lines == [f"{path}: {os.strerror(number)}; it is played again"]
    assert files(store) == ["2-4.parquet"]
    assert_same(store.read(series, span), block)


def test_a_survey_leaves_damaged_files_where_they_are(store, block, lines):
    series, span = series_of(), Span(2, 4)
    store.write(series, span, block)
    damage_byte(store.path(series, span))
    only_looking = RecordStore(store.folder, lines.append, set_aside=False)
    assert only_looking.read(series, span) is None
    assert files(store) == ["2-4.parquet"]
    assert len(lines) == 1


@pytest.mark.skipif(os.geteuid() == 0, reason="the administrator can write into any folder")
def test_in_a_read_only_folder_a_damaged_file_stays(store, block, lines):
    series, span = series_of(), Span(2, 4)
    store.write(series, span, block)
    path = store.path(series, span)
    damage_byte(path)
    path.parent.chmod(0o500)
    try:
        assert store.read(series, span) is None
    finally:
        path.parent.chmod(0o700)
    assert lines[0].endswith("; it is played again")
    assert files(store) == ["2-4.parquet"]


def test_what_a_killed_writer_left_is_removed_and_nothing_else(store, block):
    series, span = series_of(), Span(2, 4)
    store.write(series, span, block)
    folder = store.path(series, span).parent
    stale, fresh = folder / "0-2.parquet.7-ab.partial", folder / "0-2.parquet.8-cd.partial"
    for path in (stale, fresh):
        path.write_bytes(b"half")
    os.utime(stale, (1e9, 1e9))
    os.utime(store.path(series, span), (1e9, 1e9))
    store.clean()
    assert files(store) == ["0-2.parquet.8-cd.partial", "2-4.parquet"]


def test_a_disk_that_refuses_leaves_nothing_behind(store, block, monkeypatch):
    def refuse(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OSError, match="No space left") as caught:
        store.write(series_of(), Span(2, 4), block)
    assert caught.value.filename == str(store.path(series_of(), Span(2, 4)))
    assert files(store) == []


def test_writers_of_the_same_block_do_each_other_no_harm(store, block, lines):
    series, span = series_of(), Span(2, 4)
    errors = []

    def write() -> None:
        try:
            for _ in range(10):
                store.write(series, span, block)
        except OSError as error:
            errors.append(error)

    threads = [threading.Thread(target=write) for _ in range(4)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        found = store.read(series, span)
        if found is not None:
            assert_same(found, block)
    assert errors == []
    assert lines == []
    assert files(store) == ["2-4.parquet"]


def test_records_of_other_weights_versions_and_seeds_are_found(store, block):
    series, span = series_of(), Span(2, 4)
    store.write(series, span, block)
    path = store.path(series, span)
    other = path.parent.with_name("0123456789abcdef-4294967303")
    shutil.copytree(path.parent, other)
    # Another place, which is not asked for.
    shutil.copytree(path.parent, store.folder / "random" / "hard-4" / other.name)
    assert store.unused(["random"], [series]) == [other.relative_to(store.folder)]
    assert store.unused(["greedy"], [series]) == []


def test_joined_blocks_are_what_one_call_would_have_played():
    parts = [played(0, 3), played(3, 6), played(6, 8)]
    whole = concatenate(parts)
    assert_same(whole, played(0, 8))
    assert whole.timing == {"seconds": sum(part.seconds for part in parts), "batch_size": 3}
    assert np.isfinite(whole.decision_seconds).all()
    assert concatenate(parts[:1]) is parts[0]


def test_versions_that_differ_are_listed():
    first, second = played(0, 2), played(2, 4)
    newer = {**second.metadata["versions"], "numpy": "99.0", "extra": "1"}
    second = replace(second, metadata={**second.metadata, "versions": newer})
    versions = concatenate([first, second]).metadata["versions"]
    assert versions["numpy"] == ", ".join(sorted([np.__version__, "99.0"]))
    assert versions["extra"] == "1, none"
    assert versions["python"] == first.metadata["versions"]["python"]


@pytest.mark.parametrize(
    ("others", "said"),
    [
        ([(3, 5)], "not consecutive"),
        ([(0, 2)], "not consecutive"),
        ([(2, 4, SEED + 1)], "not of one controller"),
        ([(2, 4, SEED, "other")], "not of one controller"),
    ],
)
def test_blocks_that_do_not_belong_together_are_not_joined(others, said):
    with pytest.raises(ValueError, match=said):
        concatenate([played(0, 2), *(played(*other) for other in others)])
