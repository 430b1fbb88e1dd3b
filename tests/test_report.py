"""The report without a browser: its episodes, sentences, list of differences, and the file."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from argparse import Namespace
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from report_pages import (
    EASY,
    HARD,
    HOSTILE,
    SVG,
    entrants,
    make,
    number,
    row_of,
    small_plan,
    small_tables,
    table_of,
    tables_with_a_time,
)

from area_search.scenes import SCENES, Scene, get_scene
from sb3_roles.evaluation.episodes import held_out_seed, run_episodes
from sb3_roles.evaluation.grid.crews import Parcel
from sb3_roles.evaluation.grid.entrants import Entrant
from sb3_roles.evaluation.grid.plan import SCORES, Column
from sb3_roles.evaluation.report import PAGE, page
from sb3_roles.evaluation.report.printed import is_reached, printed_cells
from sb3_roles.evaluation.report.summary import summarize_tables
from sb3_roles.evaluation.report.traces import (
    NEVER,
    Trace,
    encode_traces,
    play_traces,
    record_traces,
)
from sb3_roles.zoo import table_outputs

CONFIGS = Path(__file__).resolve().parent.parent / "zoo_configs"
# What our side of a difference from the paper can rest on.
SOURCES = {"paper", "released code", "measured", "inferred", "ours"}


# Episodes


@pytest.mark.parametrize("row", ["greedy_assigned", "hmappo"])
def test_traces_are_the_episodes_of_the_records(row: str) -> None:
    plan = small_plan()
    traces = record_traces(plan, {row: entrants()[row]}, make, (0, 2))
    assert [(one.column, one.episode) for one in traces] == [
        (EASY, 0),
        (EASY, 2),
        (HARD, 0),
        (HARD, 2),
    ]
    for trace in traces:
        records = run_episodes(
            make(trace.entrant),
            trace.column.scene,
            1,
            held_out_seed(plan.seed),
            trace.episode,
            n_agents=2,
        )
        assert len(trace.position) == records.length[0] + 1
        steps = np.arange(1, len(trace.position))
        free = trace.seen[~trace.obstacle]
        for name, when, first in (
            ("seen", trace.seen, 1),
            ("seen_free", free, 0),
            ("covered", trace.covered, 1),
        ):
            counted = [np.sum((when >= first) & (when <= t)) for t in steps]
            assert counted == records.counts[name][0].tolist(), name
        moved = (np.diff(trace.position.astype(int), axis=0) != 0).any(axis=2)
        assert np.array_equal(moved.cumsum(axis=0), records.distance[0])
        if row == "hmappo":
            assert np.array_equal(trace.roles, records.roles[0])
        else:
            assert trace.roles is None and trace.role_names == ()
        assert np.sum(~trace.obstacle) == records.n_free[0]
        assert len(trace.covered) == np.sum(trace.target) == records.n_targets[0]


def test_a_trace_ends_with_its_episode() -> None:
    scene = get_scene("hard", n_agents=2, early_stop_patience=6)
    entrant = Entrant("hmappo", "run", True)
    traces = play_traces(make(entrant), scene, entrant, HARD, 5, [0, 1, 2, 3])
    records = run_episodes(make(entrant), scene, 4, 5)
    lengths = [len(one.position) - 1 for one in traces]
    assert lengths == records.length.tolist() and len(set(lengths)) > 1
    for trace, length in zip(traces, lengths, strict=True):
        assert trace.roles is not None and len(trace.roles) == length
        assert max(trace.seen[trace.seen != NEVER]) <= length


def test_who_and_where_is_recorded() -> None:
    plan, made = small_plan(), []

    def counting(entrant: Entrant) -> Any:
        made.append(entrant.source)
        return make(entrant)

    players = {**entrants(), "greedy": []}
    traces = record_traces(plan, players, counting, (1,), columns={HARD})
    # The first of several runs, nobody for a row without an entrant, and each made once.
    assert made == ["greedy_assigned", "run0", "random"]
    assert [one.entrant.row for one in traces] == ["greedy_assigned", "hmappo", "oracle"]
    assert {one.column for one in traces} == {HARD}


def test_a_row_that_fails_is_left_out_of_the_player() -> None:
    def failing(entrant: Entrant) -> Any:
        if entrant.row == "greedy":
            raise OSError("its folder is gone")
        return make(entrant)

    lines: list[str] = []
    players = {name: ones for name, ones in entrants().items() if name != "oracle"}
    traces = record_traces(small_plan(), players, failing, (0, 1), {EASY}, lines.append)
    assert [one.entrant.row for one in traces] == ["greedy_assigned"] * 2 + ["hmappo"] * 2
    assert lines == [
        "playing 6 episodes for the player",
        "greedy is left out of the player: its folder is gone",
    ]


def test_the_page_plays_what_the_tables_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The player's episodes come from the parcels, and not from a folder that may be gone."""
    seen = []

    def opened(entrant: Entrant) -> Any:
        if entrant.learned:
            seen.append(Path(entrant.source, "weights").read_bytes())
        return make(entrant)

    monkeypatch.setattr(table_outputs, "make_controller", opened)
    plan = small_plan()
    players = {name: ones for name, ones in entrants().items() if name != "oracle"}
    parcels = {name: Parcel(ones[0]) for name, ones in players.items()}
    parcels["hmappo"] = Parcel(players["hmappo"][0], {"weights": b"those of the tables"})
    # A row without a parcel: the page is written all the same.
    del parcels["greedy"]
    made = table_outputs.Made(plan, players, {}, small_tables(plan), {}, {}, parcels)
    lines: list[str] = []
    table_outputs.write_page(Namespace(out=tmp_path, quick=False), made, lines.append)
    assert seen == [b"those of the tables"]
    elements = Elements()
    elements.feed((tmp_path / PAGE).read_text(encoding="utf-8"))
    rows = {one["row"] for one in data_of(elements)["traces"]["episodes"]}
    assert rows == {"greedy_assigned", "hmappo"}
    assert len(lines) == 2 and lines[1].startswith("greedy is left out of the player")


def test_maps_beyond_bytes_are_refused() -> None:
    scene = Scene(name="wide", width=256, n_targets=10)
    with pytest.raises(ValueError, match=r"255 x 255 cells .* wide has 25 x 256"):
        play_traces(make(Entrant("greedy", "greedy")), scene, Entrant("a", "a"), HARD, 0, [0])


def hand_made_trace(**fields: Any) -> Trace:
    obstacle = np.zeros((2, 5), bool)
    obstacle[0, 1] = True
    target = np.zeros((2, 5), bool)
    target[1, 3:] = True
    trace = Trace(
        entrant=Entrant("hmappo", "run", True, training_seed=4),
        column=HARD,
        episode=3,
        role_names=("explore", "cover"),
        communication_radius=10.0,
        obstacle=obstacle,
        target=target,
        position=np.array([[[0, 0]], [[1, 0]], [[1, 1]]], np.uint8),
        roles=np.array([[0], [-1]], np.int8),
        seen=np.arange(10, dtype=np.uint8).reshape(2, 5),
        covered=np.array([2, NEVER], np.uint8),
    )
    return replace(trace, **fields)


def test_encoding_by_hand() -> None:
    other = hand_made_trace(roles=None, role_names=(), episode=4)
    encoded = encode_traces([hand_made_trace(), other])
    assert len(encoded["maps"]) == 1
    game = encoded["maps"][0]
    assert (game["height"], game["width"]) == (2, 5)
    # Bits in the order of rows, the first one the highest: cell 1, and cells 8 and 9.
    assert base64.b64decode(game["obstacle"]) == bytes([0b01000000, 0])
    assert base64.b64decode(game["target"]) == bytes([0, 0b11000000])
    first, second = encoded["episodes"]
    assert base64.b64decode(first["position"]) == bytes([0, 0, 1, 0, 1, 1])
    assert base64.b64decode(first["roles"]) == bytes([0, 255]) and "roles" not in second
    assert base64.b64decode(first["covered"]) == bytes([2, 255])
    assert base64.b64decode(first["seen"]) == bytes(range(10))
    assert (first["row"], first["scene"], first["n_agents"], first["episode"]) == (
        "hmappo",
        "hard",
        2,
        3,
    )
    assert (first["training_seed"], first["map"], second["map"]) == (4, 0, 0)


def test_an_episode_takes_few_bytes() -> None:
    traces = record_traces(small_plan(), entrants(), make, (0,))
    assert len(json.dumps(encode_traces(traces))) / len(traces) < 3500


# Sentences


def test_what_counts_as_reached() -> None:
    assert is_reached(number(60.0, paper=60.5))  # within the interval
    assert is_reached(number(70.0, paper=60.0))
    assert not is_reached(number(58.0, paper=60.0))
    assert is_reached(number(130.0, paper=100.0)) and not is_reached(number(98.0, paper=100.0))
    assert not is_reached(number(None, paper=60.0)) and not is_reached(number(60.0))
    # Fewer steps are better.
    assert is_reached(number(30.0, paper=29.5, unit="steps"))
    assert not is_reached(number(33.0, paper=30.0, unit="steps"))


def test_what_is_hardly_known_reaches_nothing_by_its_interval() -> None:
    # Eight episodes, whose interval is wide: the means decide.
    vague = number(40.0, paper=60.0, low=10.0, high=70.0)
    assert is_reached(vague) and not is_reached(replace(vague, n_episodes=8))
    assert is_reached(replace(vague, n_episodes=8, mean=61.0))
    late = number(40.0, paper=30.0, low=28.0, high=50.0, unit="steps")
    assert is_reached(late) and not is_reached(replace(late, n_episodes=19))
    assert is_reached(replace(late, n_episodes=19, mean=29.0))


def test_printed_numbers_come_by_the_size_of_their_difference() -> None:
    plan = small_plan()
    tables = small_tables(plan)
    rows = [row for row in tables["I"].rows if row.name != "hmappo"]
    rows.append(row_of(plan, "hmappo", {(EASY, "explo_paper"): 89.5}))
    tables = table_of(plan, rows)
    # Another table with the same cells adds nothing.
    cells = printed_cells({**tables, "II": tables["I"]})
    told = [(one.row, one.scene, one.metric, one.difference, one.reached) for one in cells]
    assert told == [
        ("greedy", "Hard", "cover", 25.0, True),
        ("greedy", "Easy", "explo_paper", -10.0, False),
        ("greedy", "Easy", "cover", 1.0, True),
        ("hmappo", "Easy", "explo_paper", -0.5, True),
        ("greedy", "Hard", "explo_paper", None, True),  # both 100 % or more
        ("hmappo", "Hard", "explo_paper", None, False),  # not played
        ("hmappo", "Hard", "cover", None, False),
    ]
    assert {one.table for one in cells} == {"I"} and cells[-1].ours is None


def test_sentences() -> None:
    plan = small_plan()
    points = {one.head: one for one in summarize_tables(plan, small_tables(plan))}
    heads = list(points)
    # Reached: 89.5 of 90 within the interval; missed: 97 of 100, and 48 of 60.
    assert heads[0].startswith("Roles reaches 1 of 3 numbers")
    own = points[heads[0]]
    assert own.mark == "differs" and "exploration 1 of 2, coverage 0 of 1" in own.text
    assert "2 runs of 1,000 joint steps" in own.text
    greedy = points["Our greedy covers 13.0 points more than the printed one"]
    # 31 against 30 and 65 against 40 printed; and 65 against 60 printed for the paper's method.
    assert greedy.mark == "differs" and "reaches 3 of 4 printed numbers" in greedy.text
    assert "Hard, 2 robots: 65.0 % covered, 40.0 % printed" in greedy.text
    assert "In 1 of 1 places it covers as much" in greedy.text
    short = points["3 of 7 printed percentages are not reached"]
    assert "Roles 2, Greedy 1" in short.text
    assert "Roles, Hard, 2 robots: cover 48.0 %, printed 60.0 %" in short.text
    # 45 against 44, and 48 against 72.
    learned = points["Learning covers more than assigned greedy in 1 of 2 places"]
    assert "\N{MINUS SIGN}11.5 points" in learned.text
    share = points["The printed exploration is not the share of the map that was seen"]
    assert "89.5 % in the paper's metric are 80.0 % of the free cells" in share.text
    assert "Knowing the map is worth +53.0 points of coverage" in points
    assert len(points) == 6


def test_a_time_that_is_never_reached_counts() -> None:
    """It was played, it is not reached, and nothing is further away."""
    plan = small_plan()
    tables = tables_with_a_time(plan)
    first = printed_cells(tables)[0]
    assert (first.row, first.metric, first.played, first.ours) == (
        "hmappo",
        "time_e_paper",
        True,
        None,
    )
    assert not first.reached and first.difference is None
    own = summarize_tables(plan, tables)[0]
    assert own.head.startswith("Roles reaches 1 of 4 numbers")
    assert "Time_E 0 of 1" in own.text
    table = tables["I"]
    rows = [replace(row, values={}) if row.name == "hmappo" else row for row in table.rows]
    absent = {"I": replace(table, rows=tuple(rows))}
    assert not printed_cells(absent)[-1].played
    assert not any(one.head.startswith("Roles reaches") for one in summarize_tables(plan, absent))


def test_the_bound_is_compared_on_the_same_episodes() -> None:
    plan = small_plan()
    *others, bound = small_tables(plan)["I"].rows
    fewer = {key: replace(value, n_episodes=10) for key, value in bound.values.items()}

    def heads(values: Any) -> list[str]:
        tables = table_of(plan, [*others, replace(bound, values=values)])
        return [one.head for one in summarize_tables(plan, tables)]

    assert any(head.startswith("Knowing the map") for head in heads(bound.values))
    assert not any(head.startswith("Knowing the map") for head in heads(fewer))


def test_what_roles_change_is_said_with_its_seeds() -> None:
    parts = small_plan()
    rows = {**parts.rows, "mappo": replace(parts.rows["hmappo"], name="mappo", label="Plain")}
    plan = replace(parts, rows=rows)
    (ours,) = [row for row in small_tables(plan)["I"].rows if row.name == "hmappo"]
    plain = row_of(plan, "mappo", {(EASY, "cover"): 40.0, (HARD, "cover"): 46.0})
    points = {one.head: one for one in summarize_tables(plan, table_of(plan, [ours, plain]))}
    # 45 against 40, and 48 against 46.
    text = points["Roles covers 3.5 points more than Plain"].text
    assert "Over 2 places, from +2.0 to +5.0, with 2 against 2 training seeds" in text
    assert "reward for moves differs, too" in text
    worse = row_of(plan, "mappo", {(EASY, "cover"): 50.0})
    heads = [one.head for one in summarize_tables(plan, table_of(plan, [ours, worse]))]
    assert "Roles covers 5.0 points less than Plain" in heads


def test_sentences_without_results() -> None:
    plan = small_plan()
    empty = [row_of(plan, name, {}) for name in plan.rows]
    (point,) = summarize_tables(plan, table_of(plan, empty))
    assert point.head == "Not played yet" and point.text.startswith("8 of 8 places")
    assert summarize_tables(plan, {})[0].text.startswith("8 of 8 places")


# Differences from the paper


def entries() -> list[dict[str, Any]]:
    found = yaml.safe_load(page._resource("deviations.yml"))
    assert isinstance(found, list)
    return found


def fact(path: str) -> Any:
    """Look up what the code says: a default of scenes, a field of one, or a configuration."""
    source, *keys = path.split(".")
    if source == "scene":
        return getattr(Scene(), keys[0])
    if source == "scenes":
        return getattr(SCENES[keys[0]], keys[1])
    found = yaml.safe_load((CONFIGS / f"{source}.yml").read_text(encoding="utf-8"))
    found = found["area-search-v0"]
    for key in keys[:-1]:
        found = found[key]
    # What a configuration does not name is the default of the scene.
    if keys[0] == "env_kwargs" and keys[-1] not in found:
        return getattr(Scene(), keys[-1])
    return found[keys[-1]]


def test_differences_are_true_of_the_code() -> None:
    facts = {path: value for entry in entries() for path, value in entry.get("holds", {}).items()}
    assert len(facts) > 40
    assert {path: fact(path) for path in facts} == facts


def test_differences_are_well_formed() -> None:
    known = {"area", "what", "paper", "ours", "source", "switch", "holds"}
    for entry in entries():
        assert set(entry) <= known, entry
        assert entry["source"] in SOURCES, entry
        assert all(entry[key].strip() for key in ("area", "what", "paper", "ours")), entry
    names = [(entry["area"], entry["what"]) for entry in entries()]
    assert len(set(names)) == len(names)
    assert page.deviations()[0].keys() == known - {"holds"}
    assert {entry["source"] for entry in entries()} == SOURCES


# The file


class Elements(HTMLParser):
    """Collects elements with their attributes, and the text within scripts and styles."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[tuple[str, str]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.found and self.found[-1][0] in ("script", "style") and data.strip():
            self.texts.append((self.found[-1][0], data))


def written(folder: Path, **changes: Any) -> tuple[str, Elements]:
    plan = small_plan()
    given: dict[str, Any] = {
        "plan": plan,
        "tables": small_tables(plan),
        "figures": {"episode": SVG},
        "captions": {"episode": HOSTILE},
        "traces": [hand_made_trace()],
        "facts": {"Version": "1.2", "Training": {"Roles": 1000}, "Machine": ["two", "cores"]},
        "quick": False,
        **changes,
    }
    path = folder / "new" / "report.html"
    page.write_report(path, **given)
    text = path.read_text(encoding="utf-8")
    elements = Elements()
    elements.feed(text)
    return text, elements


def data_of(elements: Elements) -> Any:
    (text,) = [text for tag, text in elements.texts if tag == "script" and text[0] == "{"]
    return json.loads(text)


def test_texts_can_not_become_markup(tmp_path: Path) -> None:
    text, elements = written(tmp_path, facts={HOSTILE: HOSTILE})
    assert [tag for tag, _ in elements.found if tag in ("script", "img")] == ["script", "script"]
    data = data_of(elements)
    assert data["rows"]["greedy_assigned"]["label"] == HOSTILE
    assert data["figures"][0]["caption"] == HOSTILE
    assert data["facts"] == [{"name": HOSTILE, "value": HOSTILE}]
    assert text.count("</script>") == 2
    assert "innerHTML" not in text and "{{" not in text.replace(HOSTILE, "")


def test_one_file_that_needs_nothing_else(tmp_path: Path) -> None:
    text, elements = written(tmp_path)
    for tag, attributes in elements.found:
        for name in ("src", "href"):
            target = attributes.get(name) or "#"
            assert target.startswith(("#", "data:")), (tag, target)
    assert not re.search(r"@import|url\((?!data:)", text)
    (policy,) = [
        attributes["content"]
        for tag, attributes in elements.found
        if tag == "meta" and attributes.get("http-equiv") == "Content-Security-Policy"
    ]
    assert policy is not None and policy.startswith("default-src 'none'; ")
    assert "unsafe" not in policy and "http" not in policy
    for tag, content in elements.texts:
        if content[0] != "{":
            digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
            assert f"{tag}-src 'sha256-{digest}'" in policy
    assert not any("style" in attributes for _, attributes in elements.found)


def test_what_the_page_is_told(tmp_path: Path) -> None:
    plan = small_plan()
    tables = small_tables(plan)
    greedy, *others = tables["I"].rows
    partial = {key: value for key, value in greedy.values.items() if key[0] == EASY}
    partial[EASY, "explo_true"] = number(float("nan"), low=None, high=None)
    greedy = replace(greedy, values=partial, overall={(2, "cover"): number(48.0)})
    _, elements = written(tmp_path, tables=table_of(plan, [greedy, *others]), quick=True)
    data = data_of(elements)
    assert data["quick"] is True
    table = data["tables"][0]
    assert table["caption"] == "Table I. Two robots." and table["teams"] == [2]
    easy, hard = table["rows"][0]["values"][0]
    assert (easy[0]["mean"], easy[0]["paper"], easy[0]["difference"]) == (60.0, 70.0, -10.0)
    assert easy[1]["mean"] is None
    # Not played: nothing but what the paper prints.
    assert hard == [{"printed": True, "paper": 100.0}, None, {"printed": True, "paper": 40.0}]
    assert [one and one["mean"] for one in table["rows"][0]["overall"][0]] == [None, None, 48.0]
    assert table["rows"][0]["seconds"] == [[2e-6, 4e-6]]
    # One number for the row, the same as in the other forms of the table.
    assert table["rows"][0]["decision"] == [3e-6] and table["rows"][0]["batch"] == 20
    assert data["metrics"]["cover"]["short"] == "Covered"
    assert set(data["metrics"]) == set(SCORES)
    source = data["figures"][0]["source"]
    assert base64.b64decode(source.removeprefix("data:image/svg+xml;base64,")).decode() == SVG
    assert data["facts"][1:] == [
        {"name": "Training", "value": ["Roles: 1000"]},
        {"name": "Machine", "value": ["two", "cores"]},
    ]


def test_a_page_without_anything(tmp_path: Path) -> None:
    text, elements = written(tmp_path, tables={}, figures={}, captions={}, traces=[], facts={})
    data = data_of(elements)
    assert data["tables"] == data["figures"] == data["traces"]["episodes"] == []
    assert text.startswith("<!DOCTYPE html>")


def test_the_same_input_gives_the_same_page(tmp_path: Path) -> None:
    assert written(tmp_path / "a")[0] == written(tmp_path / "b")[0]


def test_the_plan_of_the_project_has_a_page(tmp_path: Path) -> None:
    from sb3_roles.evaluation.grid.plan_file import parse_plan
    from sb3_roles.evaluation.tables.model import make_tables

    plan = parse_plan(yaml.safe_load((CONFIGS / "tables.yml").read_text(encoding="utf-8")))
    _, elements = written(tmp_path, plan=plan, tables=make_tables(plan, {}), traces=[])
    data = data_of(elements)
    assert [table["name"] for table in data["tables"]] == ["I", "II", "III", "IV", "V"]
    assert data["tables"][4]["teams"] == [4, 8, 15]
    # What two tables print is listed once.
    papers = [table.paper for table in plan.tables.values()]
    printed = {key for paper in papers for key, value in paper.items() if value is not None}
    assert not any(one["played"] for one in data["printed"])
    assert len(data["printed"]) == len(printed)
    assert data["summary"][-1]["head"] == "Not played yet"
    assert Column("hard", 4) in plan.tables["I"].columns and data["scenes"]["hard"] == "Hard"
