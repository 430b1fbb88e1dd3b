"""Where the tables agree with the paper and where not, in a few sentences and as a list."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from statistics import mean
from typing import TYPE_CHECKING, NamedTuple

from sb3_roles.evaluation.grid.plan import SCORES, Column, Plan
from sb3_roles.evaluation.report.printed import Gap, printed_cells
from sb3_roles.evaluation.tables.aggregate import MIN_EPISODES

if TYPE_CHECKING:
    from sb3_roles.evaluation.tables.model import TableResult, TableRow

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
        *_roles(rows, means),
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


class _Mean(NamedTuple):
    """A mean, over how many episodes of how many training runs."""

    value: float
    n_episodes: int
    n_seeds: int


# Metric -> column -> row -> mean, of what exists.
_Means = Mapping[str, Mapping[Column, Mapping[str, _Mean]]]


def _means(tables: Mapping[str, TableResult]) -> _Means:
    means: dict[str, dict[Column, dict[str, _Mean]]] = {metric: {} for metric in SCORES}
    for table in tables.values():
        for row in table.rows:
            for (column, metric), value in row.values.items():
                if value.mean is not None:
                    one = _Mean(value.mean, value.n_episodes, value.n_seeds)
                    means[metric].setdefault(column, {}).setdefault(row.name, one)
    return means


def _gain(of_rows: Mapping[str, _Mean], row: str, other: str) -> float | None:
    """Return what a row has more than another; None unless both played the same episodes."""
    ours, theirs = of_rows.get(row), of_rows.get(other)
    if ours is None or theirs is None or ours.n_episodes != theirs.n_episodes:
        return None
    return ours.value - theirs.value


def _example(columns: Iterable[Column]) -> Column | None:
    """Where everything was trained, if that was played, or else the first one."""
    found = list(columns)
    return _TRAINING if _TRAINING in found else next(iter(found), None)


def _mark(good: int, total: int) -> str:
    return "agrees" if good == total else "partly" if 2 * good >= total else "differs"


def _own_row(rows: Mapping[str, TableRow], gaps: Sequence[Gap]) -> Iterator[Point]:
    own = [one for one in gaps if one.row == OURS and one.played]
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
        f"or our 95 % interval, of at least {MIN_EPISODES} episodes, ends there.",
    )


def _greedy(plan: Plan, means: _Means, gaps: Sequence[Gap]) -> Iterator[Point]:
    greedy = [one for one in gaps if one.row == GREEDY and one.played]
    cover = [one for one in greedy if one.metric == "cover"]
    if not cover:
        return
    above = sum(one.reached for one in greedy)
    average = mean(one.difference or 0.0 for one in cover)
    most = max(cover, key=lambda one: one.difference or 0.0)
    text = (
        f"It reaches {above} of {len(greedy)} printed numbers; the difference is largest in "
        f"{most.scene}, {most.n_agents} robots: {most.ours:.1f} % covered, {most.paper:.1f} % "
        "printed."
    )
    rivals = [
        (of_rows[GREEDY].value, paper)
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
    more = "more" if average >= 0 else "less"
    head = f"Our greedy covers {abs(average):.1f} points {more} than the printed one"
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
    played = sum(one.played and one.metric != "time_e_paper" for one in gaps)
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
        learned = {name: _gain(of_rows, name, ASSIGNED) for name in of_rows if rows[name].learned}
        gains = {name: gain for name, gain in learned.items() if gain is not None}
        if gains:
            best = max(gains, key=lambda name: gains[name])
            differences.append(gains[best])
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


def _roles(rows: Mapping[str, TableRow], means: _Means) -> Iterator[Point]:
    gains, seeds = [], []
    for of_rows in means["cover"].values():
        gain = _gain(of_rows, OURS, WITHOUT_ROLES)
        if gain is not None:
            gains.append(gain)
            seeds.append((of_rows[OURS].n_seeds, of_rows[WITHOUT_ROLES].n_seeds))
    if not gains:
        return
    average = mean(gains)
    more = "more" if average >= 0 else "less"
    ours, theirs = min(one for one, _ in seeds), min(other for _, other in seeds)
    yield Point(
        "note",
        f"{rows[OURS].label} covers {abs(average):.1f} points {more} than "
        f"{rows[WITHOUT_ROLES].label}",
        f"Over {len(gains)} places, from {_signed(min(gains))} to {_signed(max(gains))}, with "
        f"{ours} against {theirs} training seeds. Both have the same observations, but the reward "
        "for moves differs, too: roles alone need not be the reason.",
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
        f"{printed[column][OURS].value:.1f} % in the paper's metric are "
        f"{true[column][OURS].value:.1f} % of the free cells.",
    )


def _bound(
    rows: Mapping[str, TableRow], scenes: Mapping[str, str], means: _Means
) -> Iterator[Point]:
    """Compare with the bound, where the best row played as many episodes, and so the same ones."""
    found = {}
    for column, of_rows in means["cover"].items():
        rivals = [name for name in of_rows if not rows[name].bound]
        if rivals:
            best = max(rivals, key=lambda name: of_rows[name].value)
            gain = _gain(of_rows, BOUND, best)
            if gain is not None:
                found[column] = best, gain
    shown = _example(found)
    if shown is None:
        return
    (best, gain), cover = found[shown], means["cover"][shown]
    yield Point(
        "note",
        f"Knowing the map is worth {_signed(gain)} points of coverage",
        f"{scenes[shown.scene]}, {shown.n_agents} robots: {rows[BOUND].label} covers "
        f"{cover[BOUND].value:.1f} %, the best row that searches, {rows[best].label}, "
        f"{cover[best].value:.1f} %.",
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
