"""A grid plays what is missing, and nothing but times depends on who played it, and when."""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import signal
import threading
from dataclasses import replace
from pathlib import Path

import pytest
import torch as th
from grids import assert_same, assert_same_results, make, plan_data, scripted, small_plan

from area_search import get_scene
from sb3_roles.baselines import controller_class
from sb3_roles.common.durations import long_duration
from sb3_roles.evaluation.episodes import held_out_seed, run_episodes
from sb3_roles.evaluation.grid import crews, processes
from sb3_roles.evaluation.grid.crews import Controllers, Here, Parcel, Task, play_block
from sb3_roles.evaluation.grid.entrants import Entrant
from sb3_roles.evaluation.grid.plan import Column, PlanError, Row
from sb3_roles.evaluation.grid.plan_file import parse_plan
from sb3_roles.evaluation.grid.play import play
from sb3_roles.evaluation.grid.progress import Estimates, Left, Progress
from sb3_roles.evaluation.grid.store import RecordStore
from sb3_roles.evaluation.grid.survey import Survey
from sb3_roles.evaluation.records import read_records, write_records

PLAN = small_plan()
CELLS = [(row, Column(scene, 2)) for scene in ("easy", "hard") for row in ("random", "greedy")]


@pytest.fixture
def lines() -> list[str]:
    return []


@pytest.fixture
def store(tmp_path, lines) -> RecordStore:
    return RecordStore(tmp_path / "records", lines.append)


@pytest.fixture
def blocks(monkeypatch) -> list[str]:
    """Which blocks this process plays."""
    played = []

    def note(task: Task, controllers: Controllers) -> crews.Finished:
        (first, last), column = task.span, task.series.column
        played.append(f"{task.series.row} {column.scene} {first}-{last}")
        return play_block(task, controllers)

    monkeypatch.setattr(crews, "play_block", note)
    return played


def test_a_cell_is_what_run_episodes_plays(store, lines):
    outcome = play(PLAN, scripted(PLAN), store, make, report=lines.append)
    assert list(outcome.results) == CELLS
    assert outcome.failures == {}
    for (row, column), ones in outcome.results.items():
        (one,) = ones
        assert one.entrant == Entrant(row, row)
        scene = get_scene(column.scene, n_agents=2)
        expected = run_episodes(controller_class(row)(), scene, 8, held_out_seed(1000), name=row)
        assert_same(one.records, expected)
    assert sorted(line.split(";")[0] for line in lines) == sorted(
        f"{row}, {column.scene}, 2 robots: 8 episodes" for row, column in CELLS
    )
    assert lines[-1].endswith("; 4 of 4 cells")


def test_only_missing_blocks_are_played(store, blocks, lines):
    first = play(PLAN, scripted(PLAN), store, make, report=lines.append)
    assert sorted(blocks) == sorted(
        f"{row} {column.scene} {span}" for row, column in CELLS for span in ("0-3", "3-6", "6-8")
    )
    blocks.clear()
    lines.clear()
    assert_same_results(first.results, play(PLAN, scripted(PLAN), store, make).results)
    assert blocks == []
    (lost,) = store.folder.glob("greedy/hard-2/*/3-6.parquet")
    lost.unlink()
    (cut,) = store.folder.glob("random/easy-2/*/0-3.parquet")
    cut.write_bytes(cut.read_bytes()[:-7])
    again = play(PLAN, scripted(PLAN), store, make, report=lines.append)
    assert sorted(blocks) == ["greedy hard 3-6", "random easy 0-3"]
    assert_same_results(first.results, again.results)
    assert lines[0].startswith(f"{cut}: ")


def test_blocks_do_not_depend_on_what_was_asked_for_before(store, blocks):
    play(PLAN, scripted(PLAN), store, make, quick=True, report=lambda _: None)
    assert {text.split()[-1] for text in blocks} == {"0-2"}
    blocks.clear()
    play(PLAN, scripted(PLAN), store, make, episodes=5, report=lambda _: None)
    assert {text.split()[-1] for text in blocks} == {"0-3", "3-5"}
    blocks.clear()
    # The first block is there, the last one was a shorter one.
    outcome = play(PLAN, scripted(PLAN), store, make, report=lambda _: None)
    assert {text.split()[-1] for text in blocks} == {"3-6", "6-8"}
    assert all(len(one.records.episode) == 8 for ones in outcome.results.values() for one in ones)


def test_cheap_blocks_come_first(store, blocks):
    def row(name: str, block: int) -> dict[str, object]:
        return {"label": name, "controller": name, "block": block}

    # Small blocks are those of slow rows, as long as nothing is known of them.
    rows = {"random": row("random", 1), "greedy": row("greedy", 3)}
    plan = parse_plan({**plan_data(), "rows": rows})
    play(plan, scripted(plan), store, make, quick=True, report=lambda _: None)
    assert blocks[:2] == ["greedy easy 0-2", "greedy hard 0-2"]
    # What was measured counts more: of an hour each, theirs come last.
    for path in store.folder.glob("greedy/*/*/*.parquet"):
        found = read_records(path)
        write_records(replace(found, timing={**found.timing, "seconds": 3600.0}), path)
    blocks.clear()
    play(plan, scripted(plan), store, make, report=lambda _: None)
    assert [text.split()[0] for text in blocks] == ["random"] * 12 + ["greedy"] * 6


def test_a_survey_counts_blocks_and_estimates_their_time(store):
    play(PLAN, scripted(PLAN), store, make, episodes=3, report=lambda _: None)
    survey = Survey(PLAN, scripted(PLAN), store, make)
    counts = survey.counts()
    assert {name: count[:2] for name, count in counts.items()} == {
        "random": (2, 4),
        "greedy": (2, 4),
    }
    for name, count in counts.items():
        taken = [one.blocks[one.spans[0]].seconds for one in survey.parts() if one.cell[0] == name]
        assert count.left.seconds == pytest.approx(sum(taken) / 6 * 10)
        assert count.left.known
    unknown = Survey(PLAN, scripted(PLAN), RecordStore(store.folder / "none"), make).counts()
    assert unknown == {"random": (0, 6, (0.0, False)), "greedy": (0, 6, (0.0, False))}


def test_estimates_follow_what_was_measured():
    slow, fast = (
        Row("slow", "", controller="random", block=10),
        Row("fast", "", controller="random"),
    )
    estimates = Estimates()
    # Before anything is known, small blocks are those of slow rows.
    assert estimates.seconds(slow, 4, 10) == pytest.approx(10 * estimates.seconds(fast, 4, 10))
    assert not estimates.knows(slow)
    estimates.add(slow, 4, 10, 20.0)
    assert estimates.knows(slow)
    assert not estimates.knows(fast)
    assert estimates.seconds(slow, 4, 5) == pytest.approx(10.0)
    # Other teams are estimated by their size, until they are measured.
    assert estimates.seconds(slow, 16, 5) == pytest.approx(20.0)
    estimates.add(slow, 16, 10, 80.0)
    assert estimates.seconds(slow, 16, 5) == pytest.approx(40.0)
    assert estimates.seconds(slow, 4, 5) == pytest.approx(10.0)
    assert estimates.seconds(slow, 9, 5) == pytest.approx(3 * 5 * 100.0 / (20 + 40))


def test_times_are_for_readers(capsys):
    texts = [long_duration(s) for s in (0.0, 1.4, 89, 91, 600, 5360, 5400, 36000)]
    assert texts == ["1 s", "1 s", "89 s", "2 min", "10 min", "89 min", "1 h 30 min", "10 h 0 min"]
    lines: list[str] = []
    progress = Progress(2, 1, lines.append, bar=True)
    progress.block_done(Left(300.0, True))
    progress.cell_done(("random", Column("easy", 2)), 8, Left(300.0, True))
    progress.close()
    assert lines == []
    shown = capsys.readouterr().err
    assert "1 of 2 blocks" in shown
    assert "about 5 min left" in shown
    progress = Progress(4, 4, lines.append)
    for left in (Left(300.0, True), Left(300.0, False), Left(0.0, False), Left(0.0, True)):
        progress.cell_done(("random", Column("easy", 2)), 8, left)
    assert [line.partition("cells")[2] for line in lines] == [
        ", about 5 min left",
        ", more than 5 min left",
        ", time not known yet",
        "",
    ]


def test_a_row_that_fails_does_not_stop_the_others(store, lines):
    names = ("random", "broken", "missing", "greedy", "empty")
    plan = small_plan(names)
    entrants = {name: [Entrant(name, name)] for name in ("random", "greedy", "missing")}
    entrants["broken"] = [Entrant("broken", "random"), Entrant("broken", "failing", learned=True)]
    entrants["empty"] = []
    outcome = play(plan, entrants, store, make, report=lines.append)
    assert outcome.failures == {
        "missing": "install something",
        "broken": "failing: ZeroDivisionError: three steps are enough",
    }
    assert list(outcome.results) == CELLS
    assert "missing is left out: install something" in lines
    assert len([line for line in lines if "left out" in line]) == 2


def test_torch_has_its_threads_again(store):
    before = th.get_num_threads()
    th.set_num_threads(2)
    try:
        play(PLAN, scripted(PLAN), store, make, quick=True, report=lambda _: None)
        assert th.get_num_threads() == 2
    finally:
        th.set_num_threads(before)


def test_a_disk_that_refuses_ends_the_run(store, monkeypatch):
    def refuse(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(store, "write", refuse)
    with pytest.raises(OSError, match="No space left"):
        play(PLAN, scripted(PLAN), store, make, report=lambda _: None)


def test_what_was_packed_plays_and_comes_back(store):
    """The steps are those of the weights, whatever was known of the run before."""
    plan = small_plan(("random", "learned", "broken"))
    learned = [Entrant("learned", f"/{n}", True, training_seed=n, env_steps=10) for n in (1, 2)]
    entrants = {
        "random": [Entrant("random", "random")],
        "learned": learned,
        "broken": [Entrant("broken", "failing")],
    }
    packed = []

    def pack(one: Entrant) -> Parcel:
        packed.append(one)
        if not one.learned:
            return Parcel(one)
        return Parcel(replace(one, env_steps=20 + len(packed)), {"name": b"greedy"})

    def read(one: Entrant):
        if not one.learned:
            return make(one)
        return controller_class(Path(one.source, "name").read_text())()

    outcome = play(plan, entrants, store, read, report=lambda _: None, pack=pack)
    assert packed == [entrants["random"][0], *learned, entrants["broken"][0]]
    expected = [replace(learned[0], env_steps=22), replace(learned[1], env_steps=23)]
    for (row, _), ones in outcome.results.items():
        assert row != "learned" or [one.entrant for one in ones] == expected
    assert set(outcome.parcels) == {"random", "learned"}
    assert outcome.parcels["learned"] == Parcel(expected[0], {"name": b"greedy"})
    assert type(outcome.parcels["learned"].open(read)).__name__ == "GreedyController"


@pytest.mark.parametrize("where", ["packed", "opened here", "opened to play"])
def test_a_full_disk_ends_the_run_wherever_it_is(where, store, monkeypatch):
    """The same for a controller's files as for the store: no row is at fault."""
    plan = small_plan(("random", "learned"))
    entrants = {"random": [Entrant("random", "random")]}
    entrants["learned"] = [Entrant("learned", "/nowhere", learned=True)]
    opened = []

    def write(path: Path, content: bytes) -> None:
        opened.append(path)
        raise OSError(28, "No space left on device")

    def pack(one: Entrant) -> Parcel:
        if where == "packed":
            raise OSError(28, "No space left on device", "/tmp/x")
        return Parcel(one, {"name": b"greedy"} if one.learned else {})

    def read(one: Entrant):
        return controller_class("random")()

    if where == "opened here":
        monkeypatch.setattr(Path, "write_bytes", write)
    if where == "opened to play":
        # A process has its own controllers: the survey's are made.
        original = Here.submit

        def submit(self: Here, task: Task) -> None:
            monkeypatch.setattr(Path, "write_bytes", write)
            original(self, task)

        monkeypatch.setattr(Here, "submit", submit)
        entrants = {"learned": entrants["learned"]}
    with pytest.raises(OSError, match="No space left") as caught:
        play(plan, entrants, store, read, report=lambda _: None, pack=pack)
    assert caught.value.filename == ("/tmp/x" if where == "packed" else str(opened[-1]))


def test_records_of_several_versions_in_a_cell_are_reported(store, lines):
    play(PLAN, scripted(PLAN), store, make, report=lambda _: None)

    def change(pattern: str, **versions: str) -> None:
        for path in store.folder.glob(pattern):
            found = read_records(path)
            versions = {**found.metadata["versions"], **versions}
            write_records(replace(found, metadata={**found.metadata, "versions": versions}), path)

    # One that older records do not state is no difference.
    change("greedy/easy-2/*/0-3.parquet", ortools="9.15")
    play(PLAN, scripted(PLAN), store, make, report=lines.append)
    assert lines == []
    change("greedy/easy-2/*/3-6.parquet", ortools="9.14")
    change("greedy/hard-2/*/3-6.parquet", numpy="1.0")
    play(PLAN, scripted(PLAN), store, make, report=lines.append)
    assert lines == [
        "2 cells mix records of several versions, such as greedy, easy, 2 robots: "
        "ortools 9.14, 9.15"
    ]


def number(**paper: object) -> dict[str, object]:
    table = plan_data()["tables"]["I"]
    return {"tables": {"I": {**table, "paper": paper}}}


def table(**changes: object) -> dict[str, object]:
    return {"tables": {"I": {**plan_data()["tables"]["I"], **changes}}}


def label(text: str) -> dict[str, object]:
    return {"rows": {**plan_data()["rows"], "x": {"label": text, "controller": "random"}}}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (number(random={5: {"cover": [1, 2]}}), "table I, paper, random: unknown key 5: allowed"),
        (number(random={"2": {"cover": [1, 2]}}), "unknown key '2': allowed are 2; did you mean 2"),
        *(
            (number(random={2: {"cover": [1, value]}}), "must be null or numbers from 0 to 1000000")
            for value in (float("nan"), float("inf"), -1, 10**400, True, "1")
        ),
        ({"seed": 2**63}, "seed must be a whole number of at least 0, at most 9223372036854775807"),
        ({"seed": -1}, "seed must be a whole number"),
        (label("two\nlines"), "row x: label must be a text of one line, not empty"),
        (label(" "), "row x: label must be a text of one line, not empty"),
        (label("\x1b[0m"), "row x: label must be a text of one line, not empty"),
        (table(caption=""), "table I: caption must be a text of one line, not empty"),
        (table(scenes={"easy": "a\tb"}), "the label of easy must be a text of one line"),
        (table(scenes={}), "table I: scenes must be at least one scene"),
        (table(n_agents=[2, 2]), "n_agents must be a list of numbers of robots, each once"),
        (table(rows=["random", "random"]), "rows must be a list of names, each once"),
        (table(metrics=["cover", "cover"]), "metrics must be a list of names, each once"),
    ],
)
def test_a_wrong_plan_is_one_line(changes, said):
    with pytest.raises(PlanError) as caught:
        parse_plan(plan_data(**changes))
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(caught.value).isprintable()


def test_the_largest_seed_of_a_plan_can_be_kept():
    assert parse_plan(plan_data(seed=2**63 - 1)).seed == 2**63 - 1
    assert held_out_seed(2**63 - 1) < 2**64


def test_files_of_a_parcel_are_there_while_the_controller_is_made():
    entrant = Entrant("x", "/the/run", learned=True)
    seen = []

    def read(one: Entrant):
        folder = Path(one.source)
        seen.append((replace(one, source=""), folder, (folder / "a" / "b").read_bytes()))
        return controller_class("random")()

    parcel = Parcel(entrant, {"a/b": b"weights"})
    controllers = Controllers(read)
    assert controllers.get(parcel) is controllers.get(Parcel(entrant, {"a/b": b"weights"}))
    assert len(seen) == 1
    ((one, folder, content),) = seen
    assert (one, content) == (replace(entrant, source=""), b"weights")
    assert not folder.exists()
    # Other weights are another controller.
    controllers.get(Parcel(entrant, {"a/b": b"others"}))
    assert [content for *_, content in seen] == [b"weights", b"others"]


def test_a_worker_with_another_controller_is_refused(store):
    survey = Survey(PLAN, scripted(PLAN), store, make)
    part = survey.parts()[0]
    other = replace(part.series, description={**part.series.description, "version": "0.0.1"})
    here = Here(make, store)
    here.submit(Task(0, part.parcel, other, part.spans[0]))
    finished = here.wait()
    assert finished.records is None
    assert "another controller" in finished.error
    assert not store.folder.exists()


def test_processes_play_what_one_process_plays_and_may_be_killed(tmp_path, monkeypatch):
    """One controller kills its process once, and one whenever it plays."""
    # Copies of one that has imported what all of them need; tables are played by fresh ones.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["grids", "sb3_roles.evaluation.grid.processes"])
    monkeypatch.setattr(processes.multiprocessing, "get_context", lambda how: context)
    monkeypatch.setattr(processes, "MAX_TRIES", 2)
    plan = small_plan(("random", "greedy", "once", "always"))
    marker = tmp_path / "killed"
    entrants = {name: [Entrant(name, name)] for name in ("random", "greedy")}
    entrants["once"] = [Entrant("once", f"deadly:{marker}")]
    entrants["always"] = [Entrant("always", "deadly:")]
    lines: list[str] = []
    store = RecordStore(tmp_path / "several", lines.append)
    several = play(plan, entrants, store, make, jobs=2, report=lines.append)
    assert marker.exists()
    assert set(several.failures) == {"always"}
    assert "2 processes died of a block" in several.failures["always"]
    assert "was killed by signal 9" in several.failures["always"]
    assert any(line.startswith("once, ") and "is played again" in line for line in lines)
    # Now that the marker is there, it plays to the end.
    del entrants["always"]
    store = RecordStore(tmp_path / "one", lines.append)
    assert_same_results(
        several.results, play(plan, entrants, store, make, report=lambda _: None).results
    )
    files = [
        sorted(path.relative_to(tmp_path / name) for path in (tmp_path / name).rglob("*.parquet"))
        for name in ("several", "one")
    ]
    assert files[0] == files[1]
    assert len(files[0]) == 3 * 2 * 3


def test_two_grids_may_fill_one_store(store, tmp_path):
    """Each of them plays what it does not find, whatever the other one does meanwhile."""
    outcomes = []

    def run() -> None:
        outcomes.append(play(PLAN, scripted(PLAN), store, make, report=lambda _: None))

    threads = [threading.Thread(target=run) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    alone = RecordStore(tmp_path / "alone")
    expected = play(PLAN, scripted(PLAN), alone, make, report=lambda _: None).results
    for outcome in outcomes:
        assert_same_results(outcome.results, expected)
    assert len(list(store.folder.rglob("*.parquet"))) == len(list(itertools.product(CELLS, "abc")))


def test_records_of_other_versions_are_reported_and_kept(store, lines):
    play(PLAN, scripted(PLAN), store, make, report=lines.append)
    (path,) = store.folder.glob("random/easy-2/*/0-3.parquet")
    old = path.parent.with_name(f"{'0' * 16}-{held_out_seed(1000)}")
    old.mkdir()
    write_records(store.read(*_block(store, path)), old / path.name)
    lines.clear()
    play(PLAN, scripted(PLAN), store, make, report=lines.append)
    (line,) = lines
    assert line == (
        f"{store.folder}: 1 folder of records is of other weights, versions or seeds and not used, "
        f"such as {old.relative_to(store.folder)}"
    )
    assert (old / path.name).is_file()


def _block(store: RecordStore, path: Path):
    survey = Survey(PLAN, scripted(PLAN), store, make)
    for part in survey.parts():
        for span in part.spans:
            if store.path(part.series, span) == path:
                return part.series, span
    raise AssertionError(path)


def test_an_interrupt_that_a_callback_swallows_stops_all_the_same(store):
    """Python prints what is raised in a callback, and goes on."""
    plan, seen = small_plan(), []

    class Deaf(Here):
        def wait(self):
            done = super().wait()
            seen.append(done.task.span)
            with contextlib.suppress(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGINT)
            return done

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        play(plan, scripted(plan), store, make, crew=Deaf(make, store), report=lambda line: None)
    assert len(seen) == 1
    assert signal.getsignal(signal.SIGINT) is before
