"""From records to the numbers, marks and notes of tables, and to Markdown, LaTeX and CSV."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import replace

import numpy as np
import pytest

from sb3_roles.common.durations import short_duration
from sb3_roles.evaluation.episodes import held_out_seed
from sb3_roles.evaluation.grid.entrants import Entrant, Played
from sb3_roles.evaluation.grid.plan import Column
from sb3_roles.evaluation.grid.plan_file import parse_plan
from sb3_roles.evaluation.metrics import summarize
from sb3_roles.evaluation.records import EpisodeRecords
from sb3_roles.evaluation.tables.aggregate import interval_over_runs
from sb3_roles.evaluation.tables.model import Value, make_tables
from sb3_roles.evaluation.tables.text import DASH, text_of
from sb3_roles.evaluation.tables.writers import (
    CSV_COLUMNS,
    latex_text,
    to_csv,
    to_latex,
    to_markdown,
)

HORIZON, CELLS = 10, 1000
HARD, EASY = Column("hard", 4), Column("easy", 4)
PLAN = {
    "episodes": 30,
    "quick_episodes": 10,
    "seed": 7,
    "rows": {
        "oracle": {"label": "Oracle", "controller": "oracle", "bound": True},
        "random": {"label": "Random & co_1", "controller": "random", "about": "10 % luck"},
        "greedy": {"label": "Greedy", "controller": "greedy"},
        "vrpc": {"label": "VRPC", "controller": "vrpc"},
        "mappo": {"label": "MAPPO", "algo": "mappo"},
        "ecc": {"label": "ECC", "algo": "ecc", "drawn": True},
        "gnn": {"label": "GNN", "algo": "gnn"},
    },
    "tables": {
        "I": {
            "caption": "Four robots",
            "n_agents": [4],
            "scenes": {"hard": "Hard", "easy": "Easy"},
            "metrics": ["explo_paper", "explo_true", "cover"],
            "rows": ["oracle", "random", "greedy", "vrpc", "mappo", "ecc", "gnn"],
            "paper": {
                "random": {4: {"explo_paper": [22.2, 22.1], "cover": [11.2, 11.4]}},
                "greedy": {4: {"explo_paper": [100.0, 100.0]}},
                "vrpc": {4: {"explo_paper": [None, 60.8]}},
                "gnn": {4: {"cover": [36.4, 35.1]}},
            },
        },
        "V": {
            "caption": "Times",
            "n_agents": [4, 8],
            "scenes": {"hard": "Hard"},
            "metrics": ["explo_paper", "time_e_paper", "t90_true"],
            "rows": ["random", "greedy", "mappo"],
            "paper": {"greedy": {4: {"time_e_paper": [None]}, 8: {"time_e_paper": [38]}}},
        },
    },
    "figures": {},
}


def recorded(column, explo_paper, explo_true=None, cover=None, seconds=1e-3, curve=None):
    """Records whose episodes end at these fractions, which they approach on a straight line."""
    n = len(explo_paper)
    ramp = np.linspace(1 / HORIZON, 1, HORIZON) if curve is None else np.asarray(curve)
    ends = {
        "seen": explo_paper,
        "seen_free": explo_paper if explo_true is None else explo_true,
        "covered": np.array(explo_paper) / 2 if cover is None else cover,
    }
    counts = {k: np.rint(CELLS * np.outer(end, ramp)).astype(np.int32) for k, end in ends.items()}
    return EpisodeRecords(
        metadata={
            "name": "x",
            "seed": held_out_seed(7),
            "scene": {"name": column.scene, "n_agents": column.n_agents},
        },
        episode=np.arange(n),
        length=np.full(n, HORIZON),
        counts=counts,
        n_free=np.full(n, CELLS, np.int32),
        n_targets=np.full(n, CELLS, np.int32),
        distance=np.zeros((n, HORIZON, column.n_agents), np.int16),
        roles=np.full((n, HORIZON, column.n_agents), -1, np.int8),
        decision_seconds=np.full((n, HORIZON), seconds, np.float32),
        timing={"seconds": 1.0, "batch_size": n},
        bounds=np.full(n, np.nan),
    )


def scripted(name, records):
    return [Played(Entrant(name, name), records)]


def trained(name, all_records, steps=500_000):
    return [
        Played(Entrant(name, f"runs/{name}_{k}", True, False, k, steps), records)
        for k, records in enumerate(all_records, 1)
    ]


EPISODES = np.random.default_rng(0).normal(0, 0.1, 30)


def ends(mean, noise=0.01, n=30, seed=1):
    rng = np.random.default_rng([seed, int(1000 * mean)])
    return mean + EPISODES[:n] + rng.normal(0, noise, n)


@pytest.fixture(scope="module")
def plan():
    return parse_plan(PLAN)


@pytest.fixture(scope="module")
def results():
    found = {}
    for column, shift in ((HARD, 0.0), (EASY, 0.05)):
        found["random", column] = scripted("random", recorded(column, ends(0.2 + shift)))
        found["greedy", column] = scripted("greedy", recorded(column, ends(1.1 + shift)))
        found["vrpc", column] = scripted("vrpc", recorded(column, ends(0.5 + shift, n=20)))
        found["oracle", column] = scripted("oracle", recorded(column, ends(1.3), seconds=2.6e-3))
        runs = [recorded(column, ends(mean + shift)) for mean in (0.70, 0.72, 0.80)]
        found["mappo", column] = trained("mappo", runs)
    found["ecc", HARD] = trained("ecc", [recorded(HARD, ends(0.6))], steps=300_000)
    return found


@pytest.fixture(scope="module")
def tables(plan, results):
    return make_tables(plan, results)


def rows_of(table):
    return {row.name: row for row in table.rows}


def noted(table, *words):
    """The one note in which all of the words stand."""
    notes = [note for note in table.notes if all(word in note for word in words)]
    assert len(notes) == 1, (words, table.notes)
    return notes[0]


def test_scripted_rows_have_what_the_summary_says(results, tables):
    summary = summarize(results["greedy", EASY][0].records)
    value = rows_of(tables["I"])["greedy"].values[EASY, "cover"]
    assert value.mean == summary["cover"]["mean"]
    assert [value.low, value.high] == summary["cover"]["ci95"]
    assert (value.n_episodes, value.n_seeds, value.unit) == (30, 0, "%")
    assert rows_of(tables["I"])["greedy"].budget == ""


def test_learned_rows_are_aggregated_over_seeds_first(results, tables):
    row = rows_of(tables["I"])["mappo"]
    value = row.values[HARD, "explo_paper"]
    means = [
        100 * one.records.curves["explo_paper"][:, -1].mean() for one in results["mappo", HARD]
    ]
    assert value.mean == pytest.approx(np.mean(means))
    assert (value.low, value.high) == pytest.approx((min(means), max(means)))
    assert (value.n_episodes, value.n_seeds) == (30, 3)
    assert row.budget == "3 runs of 500,000 joint steps"
    single = rows_of(tables["I"])["ecc"].values[HARD, "explo_paper"]
    own = summarize(results["ecc", HARD][0].records)["explo_paper"]
    assert [single.low, single.high] == own["ci95"]
    assert single.n_seeds == 1


def test_four_seeds_lose_the_extremes(plan):
    column = HARD
    runs = [recorded(column, np.full(6, end)) for end in (0.1, 0.5, 0.6, 0.9)]
    table = make_tables(plan, {("mappo", column): trained("mappo", runs)})["I"]
    assert rows_of(table)["mappo"].values[column, "explo_paper"].mean == pytest.approx(55)


def test_over_all_scenes(results, tables):
    rows = rows_of(tables["I"])
    for name in ("random", "mappo", "oracle"):
        for metric in ("explo_paper", "explo_true", "cover"):
            scenes = [rows[name].values[column, metric].mean for column in (HARD, EASY)]
            assert rows[name].overall[4, metric].mean == pytest.approx(np.mean(scenes))
    # The same episodes in both scenes: their noise does not cancel out.
    one, both = rows["greedy"].values[HARD, "cover"], rows["greedy"].overall[4, "cover"]
    assert both.high - both.low == pytest.approx(one.high - one.low, rel=0.05)
    assert rows["ecc"].overall == {}
    assert not both.printed
    scores = [
        [100 * one.records.curves["cover"][:, -1].mean() for one in results["mappo", column]]
        for column in (HARD, EASY)
    ]
    both = rows["mappo"].overall[4, "cover"]
    assert (both.low, both.high) == pytest.approx(interval_over_runs(np.array(scores).T))
    assert all(row.overall == {} for row in tables["V"].rows)


def test_the_planted_winner_is_marked_and_the_bound_is_not(tables):
    rows = rows_of(tables["I"])
    for column in (HARD, EASY):
        marked = [name for name, row in rows.items() if _value(row, column).best]
        assert marked == ["greedy"]
    assert rows["greedy"].overall[4, "explo_paper"].best
    assert tables["I"].rows[-1].name == "oracle"
    assert tables["I"].rows[-1].bound


def _value(row, column, metric="explo_paper"):
    nothing = Value(None, None, None, "%", False, None, False, 0, 0, None)
    return row.values.get((column, metric), nothing)


def test_a_tie_is_not_marked(plan, results):
    tied = {**results, ("random", HARD): scripted("random", results["greedy", HARD][0].records)}
    table = make_tables(plan, tied)["I"]
    assert not any(_value(row, HARD).best for row in table.rows)
    assert _value(rows_of(table)["greedy"], EASY).best


def test_the_order_of_rows_changes_nothing(plan, results, tables):
    spec = plan.tables["I"]
    turned = replace(plan, tables={"I": replace(spec, rows=spec.rows[::-1])})
    shuffled = make_tables(turned, dict(reversed(results.items())))
    assert rows_of(shuffled["I"]) == rows_of(tables["I"])


def test_times(plan):
    steep = np.clip(np.arange(1, HORIZON + 1) / 4, 0, 1)
    flat = recorded(HARD, np.full(20, 0.5))
    early = recorded(HARD, np.full(20, 1.2), np.array([1.0] * 10 + [0.5] * 10), curve=steep)
    late = recorded(HARD, np.full(20, 1.2))
    results = {
        ("random", HARD): scripted("random", flat),
        ("greedy", HARD): scripted("greedy", early),
        ("mappo", HARD): trained("mappo", [early, late, late]),
    }
    rows = rows_of(make_tables(plan, results)["V"])
    assert _value(rows["random"], HARD, "time_e_paper").mean is None
    assert _value(rows["random"], HARD, "t90_true").share == 0
    # 1.2 of a curve of 0.25, 0.5, 0.75, 1: above 0.9 at the fourth step, the straight line (0.12 a
    # step) at the eighth.
    greedy = _value(rows["greedy"], HARD, "time_e_paper")
    assert (greedy.mean, greedy.unit, greedy.printed, greedy.paper) == (3, "steps", True, None)
    assert _value(rows["mappo"], HARD, "time_e_paper").mean == pytest.approx((3 + 7 + 7) / 3)
    t90 = _value(rows["greedy"], HARD, "t90_true")
    assert (t90.mean, t90.share, t90.best) == (3, 0.5, False)
    assert _value(rows["mappo"], HARD, "t90_true").share == pytest.approx((0.5 + 1 + 1) / 3)
    # A run that never gets there leaves no time for the row.
    results["mappo", HARD] = trained("mappo", [late, flat])
    table = make_tables(plan, results)["V"]
    assert _value(rows_of(table)["mappo"], HARD, "time_e_paper").mean is None
    assert _value(rows_of(table)["greedy"], HARD, "time_e_paper").best
    t90 = _value(rows_of(table)["mappo"], HARD, "t90_true")
    assert (t90.mean, t90.share, t90.low) == (7, 0.5, None)
    noted(table, "time_e_paper is the first step")


def test_nobody_who_never_gets_there_is_first(plan):
    results = {
        ("random", HARD): scripted("random", recorded(HARD, np.full(20, 0.5))),
        ("greedy", HARD): scripted("greedy", recorded(HARD, np.full(20, 0.6))),
    }
    table = make_tables(plan, results)["V"]
    assert not any(_value(row, HARD, "time_e_paper").best for row in table.rows)


@pytest.mark.parametrize(
    ("mean", "paper", "difference", "text"),
    [
        (96.34, 77.0, 19.34, "96.3 ± 1.0 (77.0, +19.3)"),
        (70.0, 77.0, -7.0, "70.0 ± 1.0 (77.0, -7.0)"),
        (112.0, 100.0, None, "112.0 ± 1.0 (100+)"),
        (100.0, 100.0, None, "100.0 ± 1.0 (100+)"),
        (93.0, 100.0, -7.0, "93.0 ± 1.0 (100+, -7.0)"),
        (93.0, None, None, "93.0 ± 1.0 (\N{EN DASH})"),
        (None, 77.0, None, "\N{EN DASH} (77.0)"),
    ],
)
def test_difference_to_the_paper(mean, paper, difference, text):
    low, high = (None, None) if mean is None else (mean - 1, mean + 1)
    value = Value(mean, low, high, "%", True, paper, False, 30, 0, None)
    assert value.difference == (None if difference is None else pytest.approx(difference))
    cell = text_of(value, "explo_paper")
    half = f" ± {cell.half}" if cell.half else ""
    assert f"{cell.mean}{half} ({', '.join(cell.beside)})" == text


def test_times_are_whole_steps_and_shares_stand_beside_them():
    time = Value(41.0, 40.0, 43.0, "steps", True, 38, True, 30, 0, None)
    assert text_of(time, "time_e_paper") == ("41", "1.5", ("38", "+3"), True)
    share = Value(31.24, 31.0, 31.6, "steps", False, None, False, 30, 0, 0.836)
    assert text_of(share, "t90_true") == ("31.2", "0.3", ("84 %",), False)


@pytest.mark.parametrize(
    ("seconds", "text"), [(2.6e-3, "2.6 ms"), (1.5, "1.5 s"), (4.321e-6, "4.32 µs")]
)
def test_durations(seconds, text):
    assert short_duration(seconds) == text


def test_notes_are_made_of_the_data(tables):
    table = tables["I"]
    assert noted(table, "held-out stream of seed 7").startswith("30 episodes")
    assert "VRPC 20" in noted(table, "Fewer episodes")
    assert "ECC" in noted(table, "One training seed", "over episodes only")
    assert "75 of 100" in noted(table, "With 3 seeds", "MAPPO")
    assert "GNN" in noted(table, "Not trained yet")
    assert "ECC" in noted(table, "as in training")
    assert "Oracle" in noted(table, "a bound and no rival")
    assert "VRPC with 4 robots" in noted(table, "prints dashes")
    assert "MAPPO 3 runs of 500,000 joint steps" in noted(table, "ECC 1 run of 300,000")
    assert "100 or more" in noted(table, "In parentheses")
    noted(table, "explo_paper", "can exceed 100 %")
    noted(table, "Not played everywhere", "ECC")
    assert not any("Quick" in note or "plan" in note for note in table.notes)
    assert not any("One training seed" in note for note in tables["V"].notes)


def test_the_decision_time_says_of_how_many_teams_it_is_a_share(plan, results, tables):
    rows = rows_of(tables["I"])
    assert (rows["greedy"].batch, rows["vrpc"].batch, rows["gnn"].batch) == (30, 20, 0)
    note = noted(tables["I"], "Decision: median time")
    assert "30 teams for Random & co_1, Greedy, MAPPO, ECC, Oracle; 20 teams for VRPC" in note
    assert "single team takes many times its share" in note
    slow = scripted("greedy", recorded(EASY, ends(1.1), seconds=3e-3))
    row = rows_of(make_tables(plan, {**results, ("greedy", EASY): slow})["I"])["greedy"]
    # The median of the scenes, in all forms of the table.
    assert row.decision_over([HARD, EASY]) == pytest.approx(2e-3)
    assert row.decision_over([Column("hard", 8)]) is None


def test_marks_need_enough_episodes_and_seeds_to_speak_for_a_method(plan, results, tables):
    note = noted(tables["I"], "With this few training seeds")
    assert "18 % with 3 against 3" in note
    assert not any("fewer than 20 episodes" in note for note in tables["I"].notes)
    few = [recorded(HARD, ends(0.5, n=19))]
    table = make_tables(plan, {**results, ("vrpc", HARD): scripted("vrpc", few[0])})["I"]
    noted(table, "Bold:", "not where one has fewer than 20 episodes")
    assert not any(_value(row, HARD).best for row in table.rows)


def test_fewer_episodes_than_the_plan_has(results, plan):
    few = {("random", HARD): scripted("random", recorded(HARD, ends(0.2, n=8)))}
    noted(make_tables(plan, few)["I"], "fewer than the 30 of the plan")


def test_nothing_was_played(plan):
    table = make_tables(plan, {})["I"]
    assert table.notes == ("Nothing was played.",)
    assert [row.name for row in table.rows][-1] == "oracle"
    assert "| GNN (not trained)" in to_markdown({"I": table})
    assert rows_of(table)["gnn"].budget == "not trained"


def test_the_quick_form_says_so_in_every_caption(plan, results, tables):
    quick = make_tables(plan, results, quick=True)
    loud = "QUICK FORM: 30 episodes, for a look only."
    assert all(table.caption.endswith(loud) for table in quick.values())
    headings = [line for line in to_markdown(quick).splitlines() if line.startswith("## Table")]
    captions = [line for line in to_latex(quick).splitlines() if r"\caption" in line]
    assert len(headings) == 2
    assert len(captions) == 3
    assert all(loud in line for line in headings + captions)
    assert {line["quick"] for line in parsed(quick)} == {"true"}
    for table in quick.values():
        noted(table, "Quick form: 30 episodes")
    for write in (to_markdown, to_latex):
        assert "QUICK" not in write(tables)
    assert {line["quick"] for line in parsed(tables)} == {"false"}


def parsed(tables):
    return list(csv.DictReader(io.StringIO(to_csv(tables).decode())))


def test_numbers_come_back_from_csv(tables):
    lines = parsed(tables)
    assert list(lines[0]) == list(CSV_COLUMNS)
    # Every row in every column and metric, played or not, and those over all scenes.
    overall = sum(len(row.overall) for table in tables.values() for row in table.rows)
    assert len(lines) == 7 * 2 * 3 + 3 * 2 * 3 + overall
    keys = [
        tuple(line[k] for k in ("table", "row", "n_agents", "scene", "metric")) for line in lines
    ]
    assert len(set(keys)) == len(keys)
    names = ("mean", "low", "high", "paper", "difference", "share", "n_episodes", "n_seeds")
    for line, key in zip(lines, keys, strict=True):
        row = rows_of(tables[key[0]])[key[1]]
        if line["scene"] == "all":
            value = row.overall[int(key[2]), key[4]]
        else:
            value = row.values.get((Column(key[3], int(key[2])), key[4]))
        if value is None:
            assert line["mean"] == line["n_episodes"] == ""
            continue
        for name in names:
            number = getattr(value, name)
            assert line[name] == ("" if number is None else str(number))
        assert (line["best"], line["printed"]) == (
            str(value.best).lower(),
            str(value.printed).lower(),
        )
        assert line["budget"] == row.budget
    found = dict(zip(keys, lines, strict=True))
    oracle = found["I", "oracle", "4", "hard", "cover"]
    assert float(oracle["decision_us"]) == pytest.approx(2600)
    assert oracle["batch"] == "30"
    dash = found["I", "vrpc", "4", "hard", "explo_paper"]
    assert (dash["printed"], dash["paper"]) == ("true", "")
    absent = found["I", "gnn", "4", "hard", "cover"]
    assert (absent["printed"], absent["paper"], absent["mean"]) == ("true", "36.4", "")


def markdown_lines(text):
    """Cells of all lines of tables."""
    lines = text.replace("\N{NO-BREAK SPACE}", " ").splitlines()
    lines = [line for line in lines if line.startswith("|")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


def test_markdown_holds_the_numbers(tables):
    text = to_markdown({"I": tables["I"]})
    lines = markdown_lines(text)
    start = lines.index(["Method", "Hard", "Easy", "Mean of 2", "Decision"])
    found = {}
    for line in lines[start + 2 :]:
        if line[0].startswith("**"):
            group = re.search(r"\((\w+)\)", line[0])[1]
        else:
            found[line[0], group] = line[1:]
    for row in tables["I"].rows:
        for metric in tables["I"].spec.metrics:
            cells = next(v for (name, m), v in found.items() if row.label in name and m == metric)
            for column, cell in zip((HARD, EASY), cells, strict=False):
                value = row.values.get((column, metric))
                if value is None:
                    assert cell.startswith(DASH)
                    continue
                mean, half = re.match(r"\**(-?[\d.]+)\** ± ([\d.]+)", cell).groups()
                assert float(mean) == pytest.approx(value.mean, abs=0.0501)
                assert float(half) == pytest.approx((value.high - value.low) / 2, abs=0.0501)
                assert cell.startswith("**") == value.best
                if value.difference is not None:
                    assert f"({value.paper:.1f}, {value.difference:+.1f})" in cell
    assert found["*Oracle (bound)*", "cover"][-1] == "2.6 ms"
    assert found["GNN (not trained)", "cover"] == [f"{DASH} (36.4)", f"{DASH} (35.1)", "", ""]
    assert {"ECC †", "VRPC ‡"} <= {name for name, _ in found}
    widths = {line.count("|") for line in text.splitlines() if line.startswith("| Greedy")}
    assert widths == {4, 6}
    for note in tables["I"].notes:
        assert f"* {note}" in text


def test_markdown_says_common_notes_once(tables):
    text = to_markdown(tables)
    assert text.count("In parentheses:") == 1
    assert text.index("In parentheses:") < text.index("## Table I.")
    assert text.index("cover is the share") > text.index("## Table I.")
    assert "### 8 robots" in text


def test_markdown_escapes(plan, results):
    rows = {**plan.rows, "random": replace(plan.rows["random"], label="a|b*c<d[e](f)")}
    text = to_markdown(make_tables(replace(plan, rows=rows), results))
    assert r"a\|b\*c\<d\[e](f)" in text
    assert {len(line) for line in markdown_lines(text)} == {3, 5}


def test_latex_escapes_and_is_balanced(tables):
    assert latex_text(r"50 % of a_b & c# $x{y}\ ~ ^ < >") == (
        r"50 \% of a\_b \& c\# \$x\{y\}\textbackslash{} \textasciitilde{} \textasciicircum{} "
        r"\textless{} \textgreater{}"
    )
    text = to_latex(tables)
    assert r"Random \& co\_1" in text
    assert text.isascii()
    begun, ended = (re.findall(rf"\\{what}{{([a-z*]+)}}", text) for what in ("begin", "end"))
    assert sorted(begun) == sorted(ended)
    assert begun.count("table*") == 3
    opened = re.sub(r"\\[{}]", "", text)
    assert opened.count("{") == opened.count("}")
    # Only alignment has a bare &, and only comments, or the line of resizebox, a bare %.
    inside = False
    for line in text.splitlines():
        bare = re.sub(r"\\[&%_#$]", "", line)
        if line.startswith(r"\begin{tabular}"):
            inside, columns = True, re.search(r"{(l[r]+)}", line)[1]
        elif line.startswith(r"\end{tabular}"):
            inside = False
        elif inside and line.endswith(r"\\") and r"\multicolumn" not in line:
            assert bare.count("&") == len(columns) - 1, line
        else:
            assert "&" not in bare, line
        if not line.startswith("%"):
            assert "%" not in bare.removesuffix("{!}{%"), line
            assert "_" not in bare, line
            assert bare.count("$") % 2 == 0, line
    assert r"\textbf{" in text
    assert r"$-$" in text


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({("greedy", HARD): scripted("greedy", recorded(EASY, ends(0.5)))}, "records are of easy"),
        (
            {("greedy", HARD): scripted("greedy", recorded(Column("hard", 8), ends(0.5)))},
            "records are of hard, 8 robots",
        ),
    ],
)
def test_records_of_another_place_are_refused(plan, results, wrong, message):
    with pytest.raises(ValueError, match=message):
        make_tables(plan, {**results, **wrong})


def test_records_of_other_episodes_are_refused(plan, results):
    records = recorded(HARD, ends(0.5))
    other = replace(records, metadata={**records.metadata, "seed": held_out_seed(8)})
    with pytest.raises(ValueError, match="only the same episodes"):
        make_tables(plan, {**results, ("greedy", HARD): scripted("greedy", other)})
    later = replace(records, episode=records.episode + 1)
    with pytest.raises(ValueError, match="do not count up from 0"):
        make_tables(plan, {**results, ("greedy", HARD): scripted("greedy", later)})
