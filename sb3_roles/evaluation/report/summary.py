"""Where the tables agree with the paper and where not, in a few sentences and as a list."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from statistics import mean
from typing import TYPE_CHECKING, NamedTuple

from sb3_roles.evaluation.grid.plan import SCORES, Column, Plan

if TYPE_CHECKING:
    from sb3_roles.evaluation.tables.model import TableResult, TableRow, Value

# Rows of zoo_configs/tables.yml that the sentences are about; those that a plan lacks are skipped.
OURS, WITHOUT_ROLES, ASSIGNED, GREEDY, BOUND = (
    "hmappo",
    "mappo",
    "greedy_assigned",
    "greedy",
    "oracle",
)
_TRAINING = Column("hard", 4)


class Point(NamedTuple):
    """One thing to know.

    :param mark: ``"agrees"``, ``"partly"``, ``"differs"`` or ``"note"``
    :param head: a few words
    :param text: a sentence or two
    """

    mark: str
    head: str
    text: str


class Gap(NamedTuple):
    """One printed number beside ours.

    :param table: its name
    :param row: name of the row
    :param label: what readers call the row
    :param scene: what readers call the scene
    :param n_agents: robots
    :param metric: its name
    :param paper: as printed
    :param ours: None if it does not exist or was not played
    :param difference: ours minus the paper's; None without ours, and where both are 100 % or more
    :param reached: ours is at least as good, or its 95 % interval ends there
    """

    table: str
    row: str
    label: str
    scene: str
    n_agents: int
    metric: str
    paper: float
    ours: float | None
    difference: float | None
    reached: bool


def is_reached(value: Value) -> bool:
    """Whether ours is at least as good as printed, or its 95 % interval ends there.

    :param value: of a cell
    """
    if value.mean is None or value.paper is None:
        return False
    if value.unit == "steps":
        return min(value.mean, value.mean if value.low is None else value.low) <= value.paper
    return max(value.mean, value.mean if value.high is None else value.high) >= value.paper


def printed_cells(tables: Mapping[str, TableResult]) -> list[Gap]:
    """Return every printed number with ours, the largest difference first, those not played last.

    A number that two tables print is listed once, as the first prints it.

    :param tables: by name
    """
    found: dict[tuple[str, Column, str], Gap] = {}
    for name, table in tables.items():
        for row in table.rows:
            for (row_name, column, metric), paper in table.spec.paper.items():
                key = row_name, column, metric
                if row_name != row.name or paper is None or key in found:
                    continue
                value = row.values.get((column, metric))
                found[key] = Gap(
                    name,
                    row.name,
                    row.label,
                    table.spec.scenes[column.scene],
                    column.n_agents,
                    metric,
                    paper,
                    value.mean if value else None,
                    value.difference if value else None,
                    value is not None and is_reached(value),
                )
    return sorted(found.values(), key=_size, reverse=True)


def _size(cell: Gap) -> float:
    if cell.ours is None:
        return -1.0
    return abs(cell.difference or 0.0)


def summarize_tables(plan: Plan, tables: Mapping[str, TableResult]) -> list[Point]:
    """Say in a few sentences what the tables show; what was not played is not talked about.

    :param plan: what they are made of
    :param tables: by name
    """
    means, gaps = _means(tables), printed_cells(tables)
    rows = {row.name: row for table in tables.values() for row in table.rows}
    scenes = {name: label for t in tables.values() for name, label in t.spec.scenes.items()}
    points = [
        *_own_row(rows, gaps),
        *_greedy(plan, means, gaps),
        *_furthest_below(gaps),
        *_best_learned(rows, means),
        *_roles(means),
        *_true_share(rows, scenes, means),
        *_bound(rows, scenes, means),
    ]
    missing = _missing(plan, tables)
    if missing:
        points.append(Point("note", "Not played yet", missing))
    return points


_CLOSE = 3.0  # points of coverage


def _signed(points: float) -> str:
    return f"{points:+.1f}".replace("-", "\N{MINUS SIGN}")


# Metric -> column -> row -> mean, of what exists.
_Means = Mapping[str, Mapping[Column, Mapping[str, float]]]


def _means(tables: Mapping[str, TableResult]) -> _Means:
    means: dict[str, dict[Column, dict[str, float]]] = {metric: {} for metric in SCORES}
    for table in tables.values():
        for row in table.rows:
            for (column, metric), value in row.values.items():
                if value.mean is not None:
                    means[metric].setdefault(column, {}).setdefault(row.name, value.mean)
    return means


def _example(columns: Iterable[Column]) -> Column | None:
    """Where everything was trained, if that was played, or else the first one."""
    found = list(columns)
    return _TRAINING if _TRAINING in found else next(iter(found), None)


def _mark(good: int, total: int) -> str:
    return "agrees" if good == total else "partly" if 2 * good >= total else "differs"


def _own_row(rows: Mapping[str, TableRow], gaps: Sequence[Gap]) -> Iterator[Point]:
    own = [one for one in gaps if one.row == OURS and one.ours is not None]
    if not own:
        return
    parts = []
    for metric, what in (
        ("explo_paper", "exploration"),
        ("cover", "coverage"),
        ("time_e_paper", "Time_E"),
    ):
        of_metric = [one for one in own if one.metric == metric]
        if of_metric:
            parts.append(f"{what} {sum(one.reached for one in of_metric)} of {len(of_metric)}")
    good = sum(one.reached for one in own)
    row = rows[OURS]
    budget = f"; {row.budget}, the paper has one of 5,000,000" if row.budget else ""
    yield Point(
        _mark(good, len(own)),
        f"{row.label} reaches {good} of {len(own)} numbers printed for the paper's method",
        f"By metric: {', '.join(parts)}{budget}. A number is reached if ours is at least as good, "
        "or our 95 % interval ends there.",
    )


def _greedy(plan: Plan, means: _Means, gaps: Sequence[Gap]) -> Iterator[Point]:
    greedy = [one for one in gaps if one.row == GREEDY and one.ours is not None]
    cover = [one for one in greedy if one.metric == "cover"]
    if not cover:
        return
    above = sum(one.reached for one in greedy)
    average = mean(one.difference or 0.0 for one in cover)
    most = max(cover, key=lambda one: one.difference or 0.0)
    text = (
        f"On average {_signed(average)} points of coverage; most in {most.scene}, {most.n_agents} "
        f"robots: {most.ours:.1f} % covered, {most.paper:.1f} % printed."
    )
    rivals = [
        (of_rows[GREEDY], paper)
        for column, of_rows in means["cover"].items()
        if GREEDY in of_rows
        for paper in [_printed(plan, OURS, column, "cover")]
        if paper is not None
    ]
    wins = sum(ours >= paper for ours, paper in rivals)
    if wins:
        text += (
            f" In {wins} of {len(rivals)} places it covers as much as is printed for the paper's "
            "own method: there the printed number is no high bar."
        )
    head = f"A correct greedy reaches {above} of {len(greedy)} numbers printed for greedy"
    yield Point("agrees" if abs(average) < _CLOSE else "differs", head, text)


def _furthest_below(gaps: Sequence[Gap]) -> Iterator[Point]:
    short = [
        one
        for one in gaps
        if one.difference is not None and not one.reached and one.metric != "time_e_paper"
    ]
    if not short:
        return
    worst = min(short, key=lambda one: one.difference or 0.0)
    rows = Counter(one.label for one in short)
    where = ", ".join(f"{label} {count}" for label, count in rows.most_common())
    played = sum(one.ours is not None and one.metric != "time_e_paper" for one in gaps)
    yield Point(
        "differs",
        f"{len(short)} of {played} printed percentages are not reached",
        f"By row: {where}. Furthest below is {worst.label}, {worst.scene}, {worst.n_agents} "
        f"robots: {worst.metric} {worst.ours:.1f} %, printed {worst.paper:.1f} %.",
    )


def _printed(plan: Plan, row: str, column: Column, metric: str) -> float | None:
    values = (table.paper.get((row, column, metric)) for table in plan.tables.values())
    return next((value for value in values if value is not None), None)


def _best_learned(rows: Mapping[str, TableRow], means: _Means) -> Iterator[Point]:
    differences, names = [], []
    for of_rows in means["cover"].values():
        learned = [name for name in of_rows if rows[name].learned]
        if ASSIGNED in of_rows and learned:
            best = max(learned, key=lambda name: of_rows[name])
            differences.append(of_rows[best] - of_rows[ASSIGNED])
            names.append(rows[best].label)
    if not differences:
        return
    wins = sum(difference > 0 for difference in differences)
    yield Point(
        "note",
        f"Learning covers more than assigned greedy in {wins} of {len(differences)} places",
        f"On average {_signed(mean(differences))} points of coverage; the best learned row is "
        f"{' or '.join(sorted(set(names)))}. Greedy with goals shared out one to one needs no "
        "training: this is the bar that matters.",
    )


def _roles(means: _Means) -> Iterator[Point]:
    pairs = [
        of_rows[OURS] - of_rows[WITHOUT_ROLES]
        for of_rows in means["cover"].values()
        if {OURS, WITHOUT_ROLES} <= of_rows.keys()
    ]
    if pairs:
        yield Point(
            "note",
            f"Roles change coverage by {_signed(mean(pairs))} points",
            f"HMAPPO against MAPPO with the same observations, over {len(pairs)} places, from "
            f"{_signed(min(pairs))} to {_signed(max(pairs))}.",
        )


def _true_share(
    rows: Mapping[str, TableRow], scenes: Mapping[str, str], means: _Means
) -> Iterator[Point]:
    printed, true = means["explo_paper"], means["explo_true"]
    column = _example(one for one, of_rows in printed.items() if OURS in of_rows)
    if column is None or OURS not in true.get(column, {}):
        return
    yield Point(
        "note",
        "The printed exploration is not the share of the map that was seen",
        f"{rows[OURS].label}, {scenes[column.scene]}, {column.n_agents} robots: "
        f"{printed[column][OURS]:.1f} % in the paper's metric are {true[column][OURS]:.1f} % of "
        "the free cells.",
    )


def _bound(
    rows: Mapping[str, TableRow], scenes: Mapping[str, str], means: _Means
) -> Iterator[Point]:
    rivals = {
        column: [name for name in of_rows if not rows[name].bound]
        for column, of_rows in means["cover"].items()
        if BOUND in of_rows
    }
    column = _example(one for one, names in rivals.items() if names)
    if column is None:
        return
    cover = means["cover"][column]
    best = max(rivals[column], key=lambda name: cover[name])
    yield Point(
        "note",
        f"Knowing the map is worth {_signed(cover[BOUND] - cover[best])} points of coverage",
        f"{scenes[column.scene]}, {column.n_agents} robots: {rows[BOUND].label} covers "
        f"{cover[BOUND]:.1f} %, the best row that searches, {rows[best].label}, "
        f"{cover[best]:.1f} %.",
    )


def _missing(plan: Plan, tables: Mapping[str, TableResult]) -> str:
    played = {
        (row.name, column)
        for table in tables.values()
        for row in table.rows
        for column, _ in row.values
    }
    wanted = {
        (row, column)
        for table in plan.tables.values()
        for row in table.rows
        for column in table.columns
    }
    absent = wanted - played
    labels = [row.label for row in plan.rows.values() if row.name in {name for name, _ in absent}]
    if not absent:
        return ""
    return f"{len(absent)} of {len(wanted)} places, in the rows {', '.join(labels)}."
