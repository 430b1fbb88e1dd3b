"""A Ray cluster plays what one process plays, also when it loses a machine meanwhile."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from grids import assert_same_results, make, small_plan

pytest.importorskip("ray", reason="the extra ray is not installed")

import ray
from ray.cluster_utils import Cluster

from sb3_roles.evaluation.grid.crews import Parcel
from sb3_roles.evaluation.grid.entrants import Entrant
from sb3_roles.evaluation.grid.play import play
from sb3_roles.evaluation.grid.ray_crew import RayCrew, RayError
from sb3_roles.evaluation.grid.store import RecordStore

ROOT = Path(__file__).resolve().parents[1]
NODE = {"num_cpus": 1, "object_store_memory": 100_000_000, "include_dashboard": False}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """Two machines of one CPU each; the workers find this folder."""
    paths = [str(ROOT / "envs"), str(ROOT), str(ROOT / "tests")]
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(paths)
    found = Cluster(initialize_head=True, head_node_args=NODE)
    try:
        yield found
    finally:
        found.shutdown()
        if before is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = before


def read(entrant: Entrant) -> Any:
    """Make the controller that a file of the run names; a scripted one has no file."""
    if not entrant.learned:
        return make(entrant)
    return make(Entrant(entrant.row, Path(entrant.source, "name").read_text()))


class Losing(RayCrew):
    """Loses a machine after some blocks."""

    def __init__(self, cluster: Cluster, node: Any, after: int, *args: Any) -> None:
        super().__init__(cluster.address, *args)
        self._cluster, self._node, self._left = cluster, node, after

    def wait(self) -> Any:
        self._left -= 1
        if self._left == 0:
            # Both machines have something to do.
            assert len(self._running) >= 2
            self._cluster.remove_node(self._node, allow_graceful=False)
        return super().wait()


def test_a_cluster_that_loses_a_machine_plays_the_same(cluster, tmp_path):
    node = cluster.add_node(num_cpus=1, object_store_memory=NODE["object_store_memory"])
    cluster.wait_for_nodes()
    plan = small_plan(("random", "greedy", "broken", "learned"), episodes=12)
    entrants = {
        "random": [Entrant("random", "random")],
        "greedy": [Entrant("greedy", "greedy")],
        "broken": [Entrant("broken", "failing")],
        # Its folder is nowhere: what is in it travels to the workers.
        "learned": [Entrant("learned", "/nowhere", learned=True, training_seed=1)],
    }

    def pack(entrant: Entrant) -> Parcel:
        return Parcel(entrant, {"name": b"greedy"} if entrant.learned else {})

    lines: list[str] = []
    store = RecordStore(tmp_path / "ray", lines.append)
    crew = Losing(cluster, node, 6, read, store)
    try:
        assert crew.size == 2
        outcome = play(plan, entrants, store, read, report=lines.append, crew=crew, pack=pack)
        assert cluster.list_all_nodes() == [cluster.head_node]
    finally:
        crew.close()
    assert outcome.failures == {"broken": "ZeroDivisionError: three steps are enough"}
    own = RecordStore(tmp_path / "own")
    expected = play(plan, entrants, own, read, report=lambda _: None, pack=pack)
    assert_same_results(outcome.results, expected.results)
    learned = [ones[0] for (row, _), ones in outcome.results.items() if row == "learned"]
    assert {one.records.metadata["controller"] for one in learned} == {"GreedyController"}
    assert {one.entrant.source for one in learned} == {"/nowhere"}
    files = [
        {str(path.relative_to(one.folder)) for path in one.folder.rglob("*.parquet")}
        for one in (store, own)
    ]
    assert files[0] == files[1]


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("127.0.0.1:1", "127.0.0.1:1: no Ray cluster: "),
        ("ray://127.0.0.1:1", "ray://127.0.0.1:1: no Ray cluster: "),
        ("lokal", "must be local, auto or HOST:PORT, got 'lokal'"),
        ("here:", "must be local, auto or HOST:PORT, got 'here:'"),
    ],
)
def test_a_cluster_that_is_not_there_is_one_line(address, said, tmp_path):
    with pytest.raises(RayError) as caught:
        RayCrew(address, make, RecordStore(tmp_path))
    assert str(caught.value).startswith(said)
    assert "\n" not in str(caught.value)
    assert not ray.is_initialized()
