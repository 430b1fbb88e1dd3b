"""The experiments on the environment report the faults that they look for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from area_search import SCENES, BatchedAreaSearch, get_scene
from area_search import cells as layout
from area_search.paths import SUB_GOALS
from area_search.reference import ReferenceAreaSearch
from sb3_roles.prove import environments, planted
from sb3_roles.prove.promises import Setting
from sb3_roles.prove.reference_play import SideBySide
from sb3_roles.prove.search_rules import RULES
from sb3_roles.prove.search_watch import Watch

SMALL = {"height": 9, "width": 9, "n_targets": 12, "n_agents": 3, "horizon": 6}


def watched(monkeypatch: pytest.MonkeyPatch, fault: Any, **options: Any) -> list[str]:
    """Return what is said of play in which each step is followed by a fault."""
    right = BatchedAreaSearch.step

    def step(self: BatchedAreaSearch, actions: np.ndarray) -> None:
        right(self, actions)
        fault(self)

    scene = get_scene("hard", **{**SMALL, **options})
    batch = BatchedAreaSearch(scene, 4, "nearest", known_map=True, time=True)
    batch.reset(3)
    watch, rng = Watch(batch), np.random.default_rng(0)
    assert watch.begin() == []
    assert watch.step(rng.integers(0, 5, (4, scene.n_agents))) == []
    monkeypatch.setattr(BatchedAreaSearch, "step", step)
    lines = watch.step(rng.integers(0, 5, (4, scene.n_agents)))
    return lines


def flip(bit: int, where: Any) -> Any:
    """Return a fault that flips a bit of one cell of team 1's map; where takes the batch."""

    def fault(batch: BatchedAreaSearch) -> None:
        batch.cells[(1, *where(batch))] ^= bit

    return fault


def unseen(batch: BatchedAreaSearch) -> Any:
    """Return a free cell of team 1 that is not explored, and without a target."""
    return np.argwhere(batch.cells[1] == 0)[0]


def under_robot(batch: BatchedAreaSearch) -> Any:
    return batch.position[1, 0] + batch._border


def put(name: str, index: Any, value: Any) -> Any:
    """Return a fault that overwrites an entry of an array of the batch."""

    def fault(batch: BatchedAreaSearch) -> None:
        getattr(batch, name)[index] = value

    return fault


def add(name: str, index: Any, value: Any) -> Any:
    def fault(batch: BatchedAreaSearch) -> None:
        getattr(batch, name)[index] += value

    return fault


def show(key: str, index: Any) -> Any:
    """Return a fault that changes a number of an observation."""

    def fault(batch: BatchedAreaSearch) -> None:
        array = batch.observations[key]
        array[index] = 1 - array[index]

    return fault


def outside(batch: BatchedAreaSearch) -> None:
    batch.observations["sub_goal"][1, 0, 0, 0] = np.nan


def all_ways_open(batch: BatchedAreaSearch) -> None:
    batch.observations["sub_goal"][1, 0, 0] = [0, 1, 1, 1, 1, 0]


FAULTS = {
    "on_free_cells": add("position", (1, 0), 100),
    "moves": add("position", (1, 0, 0), 2),
    "map_stays": flip(layout.OBSTACLE, unseen),
    "targets_stay": flip(layout.TARGET, unseen),
    "explored_is_what_was_seen": flip(layout.EXPLORED, unseen),
    "covered_is_what_was_visited": flip(layout.COVERED, unseen),
    "knowledge": flip(layout.FRONTIER, unseen),
    "counts": add("totals", (1, 1), 1),
    "finds": add("new_cells", (1, 2), 1),
    "rewards": add("rewards", (1, 2), 0.01),
    "metrics": add("metric_values", (1, 2), 1.0),
    "ends": put("truncated", 1, True),
    "in_spaces": outside,
    "joint_maps": show("joint", (1, 0, 4, 4)),
    "local_windows": show("local", (1, 0, 1, 0, 0)),
    "communication": show("local", (1, 0, 3, 4, 4)),
    "sub_goals": all_ways_open,
}


@pytest.mark.parametrize("rule", FAULTS)
def test_a_fault_breaks_its_invariant(rule: str, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = watched(monkeypatch, FAULTS[rule])
    (line,) = (line for line in lines if line.startswith(f"{rule}:"))
    assert "1 of 4 teams, first team 1, step 2 of episode 1, hard, 3 robots" in line


def test_every_invariant_has_a_fault() -> None:
    assert set(FAULTS) == set(RULES)


def test_what_is_left_of_an_earlier_episode_is_seen(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    right = BatchedAreaSearch.reset_teams

    def reset_teams(self: BatchedAreaSearch, which: np.ndarray) -> None:
        self.keys[which, 0] += np.uint64(1)  # a stream that goes on with what was played
        right(self, which)

    part = environments._Part(get_scene("hard", **SMALL), "none", 3, 8, 0)
    assert environments.watched(part, 0)[1:] == (0, [])
    monkeypatch.setattr(BatchedAreaSearch, "reset_teams", reset_teams)
    steps, broken, lines = environments.watched(part, 0)
    assert steps == 24
    assert broken > 0
    assert any("reset_forgets" in line for line in lines)


def test_the_experiment_counts_broken_steps(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    part = environments._Part(get_scene("hard", **SMALL), "none", 3, 8, 0)
    monkeypatch.setattr(environments, "_watched_parts", lambda quick: iter([part]))
    setting = Setting(True, tmp_path, 0)
    assert environments.invariants(setting).kept
    right = BatchedAreaSearch.step

    def step(self: BatchedAreaSearch, actions: np.ndarray) -> None:
        right(self, actions)
        self.rewards[2] += 1

    monkeypatch.setattr(BatchedAreaSearch, "step", step)
    outcome = environments.invariants(setting)
    assert (outcome.held, outcome.tried) == (16, 24)
    assert not outcome.kept
    assert all(line.startswith("rewards: 1 of 3 teams, first team 2") for line in outcome.failures)


def test_the_parts_are_what_is_promised() -> None:
    for quick, least in ((False, 1_000_000), (True, 18_000)):
        parts = list(environments._watched_parts(quick))
        assert sum(part.n_teams * part.n_steps for part in parts) >= least
        assert {(part.scene.name, part.scene.n_agents) for part in parts} == {
            (name, n) for name in SCENES for n in environments.ROBOTS
        }
        assert {part.sub_goal for part in parts} == set(SUB_GOALS)
    for quick, least in ((False, 20_000), (True, 300)):
        parts = list(environments._compared_parts(quick))
        assert sum(part.n_teams * part.n_steps for part in parts) >= least
        assert len({(part.scene.name, part.scene.n_agents) for part in parts}) == 28
        assert {part.sub_goal for part in parts} == set(SUB_GOALS)


@pytest.mark.parametrize(
    ("array", "index", "words"),
    [
        ("_local_words", (0, 1, 2, 3), "observation 'local'[1, "),
        ("_joint", (0, 3, 3, 0), "observation 'joint'[0, 3, 3] is"),
        ("rewards", (0, 2), "rewards[2] is"),
        ("truncated", 0, "truncated is True, not False"),
        ("totals", (0, 3), "t90_paper is"),
    ],
)
def test_a_byte_that_differs_from_the_reference_is_named(
    array: str, index: Any, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    played = SideBySide(get_scene("hard", **SMALL), 5, "nearest", 1, time=True)
    assert played.differences() == [[]]
    assert played.step() == [[]]
    right = BatchedAreaSearch.step

    def step(self: BatchedAreaSearch, actions: np.ndarray) -> None:
        right(self, actions)
        values = getattr(self, array)
        values[index] = 1 - values[index]

    monkeypatch.setattr(BatchedAreaSearch, "step", step)
    (found,) = played.step()
    assert any(words in line for line in found), found


def test_the_comparison_counts_steps_that_differ(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    part = environments._Part(get_scene("hard", **SMALL), "none", 1, 9, 0)
    monkeypatch.setattr(environments, "_compared_parts", lambda quick: iter([part]))
    setting = Setting(True, tmp_path, 0)
    assert environments.reference(setting).kept
    right = ReferenceAreaSearch.rewards
    monkeypatch.setattr(
        ReferenceAreaSearch,
        "rewards",
        lambda self: right(self) + np.float32(self.n_steps == 2),
    )
    outcome = environments.reference(setting)
    assert (outcome.held, outcome.tried) == (7, 9)
    assert "hard, 3 robots, sub-goals none, step 2: rewards[0] is" in outcome.failures[0]


def test_a_bug_that_is_not_found_breaks_the_promise(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    loss = planted.Bug("loss", "none at all", planted.RIGHT["loss"])
    monkeypatch.setattr(planted, "BUGS", (loss, planted.BUGS[-1]))
    notes: list[str] = []
    outcome = planted.bugs(Setting(True, tmp_path, 0, notes.append))
    assert (outcome.held, outcome.tried) == (1, 2)
    assert notes[0] == "missed none at all"
    assert notes[1].startswith(f"caught {planted.BUGS[-1].name}: ")
    assert outcome.failures == ("loss: none at all: not found",)
    monkeypatch.setitem(planted.RIGHT, "loss", planted.BUGS[-1].planted)
    assert (
        "loss without a bug: the gradient" in planted.bugs(Setting(True, tmp_path, 0)).failures[0]
    )
