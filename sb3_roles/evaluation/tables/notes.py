"""What a reader needs under a table, as sentences made from what was played."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from sb3_roles.common.names import span_text
from sb3_roles.evaluation.episodes import stream_of
from sb3_roles.evaluation.grid.plan import Plan, Table
from sb3_roles.evaluation.metrics import MEANINGS
from sb3_roles.evaluation.tables.aggregate import MIN_EPISODES, N_RESAMPLES

if TYPE_CHECKING:
    from sb3_roles.evaluation.tables.model import TableRow

# Beside what a metric is, see ``MEANINGS``.
_MORE = {
    "time_e_paper": "An interval that ends with the horizon has no known end.",
    "t90_true": "With a small share these are the easy episodes, so it can not be compared by "
    "itself, and is never marked as best.",
}
_SMALL = 4


def notes_of(
    plan: Plan, spec: Table, rows: Sequence[TableRow], seed: int | None, quick: bool
) -> Iterator[str]:
    """Say what a table shows and what it does not.

    :param plan: the table's
    :param spec: the table
    :param rows: with their numbers
    :param seed: of the stream of episodes; None if nothing was played
    :param quick: whether it is the quick form
    """
    played = [row for row in rows if row.values]
    if not played or seed is None:
        yield "Nothing was played."
        return
    yield from _episodes(plan, spec, played, seed, quick)
    for metric in spec.metrics:
        more = f" {_MORE[metric]}" if metric in _MORE else ""
        yield f"{metric} is {MEANINGS[metric].text}.{more}"
    if spec.paper:
        yield from _paper(rows)
    yield from _intervals(spec, played)
    yield from _marks(rows, played)
    yield from _who(rows)


def _episodes(
    plan: Plan, spec: Table, played: Sequence[TableRow], seed: int, quick: bool
) -> Iterator[str]:
    counts = {row.name: sorted({v.n_episodes for v in row.values.values()}) for row in played}
    most = most_episodes(played)
    if quick:
        yield f"Quick form: {most} episodes, for a look only."
    kind, number = stream_of(seed)
    training = "" if kind == "raw" else ", which no training plays"
    yield (
        f"{most} episodes per row, scene and team, and training seed: those of the "
        f"{kind.replace('_', '-')} stream of seed {number}{training}; all rows play the same ones."
    )
    if most < plan.episodes and not quick:
        yield f"These are fewer than the {plan.episodes} of the plan."
    fewer = [(row, counts[row.name]) for row in played if counts[row.name][0] < most]
    if fewer:
        each = ", ".join(f"{row.label} {span_text(sizes[0], sizes[-1])}" for row, sizes in fewer)
        yield f"Fewer episodes (\N{DOUBLE DAGGER}): {each}."
    columns = len(spec.columns)
    gaps = _labels(played, lambda row: len({column for column, _ in row.values}) < columns)
    if gaps:
        yield f"Not played everywhere, and then empty: {gaps}."


def most_episodes(rows: Sequence[TableRow]) -> int:
    """Return how many episodes the rows of a table played that played most.

    :param rows: with their numbers; 0 without any
    """
    return max((v.n_episodes for row in rows for v in row.values.values()), default=0)


def _labels(rows: Sequence[TableRow], which: Callable[[TableRow], bool]) -> str:
    return ", ".join(row.label for row in rows if which(row))


def _paper(rows: Sequence[TableRow]) -> Iterator[str]:
    yield (
        "In parentheses: the paper's number, and ours minus it. A printed 100 stands for 100 or "
        "more, written 100+: with 100 or more of ours there is no difference, and with less it is "
        "at least as large as it says."
    )
    dashes = {
        (row.label, column.n_agents)
        for row in rows
        for (column, metric), value in row.values.items()
        if metric == "explo_paper" and value.printed and value.paper is None
    }
    for label, n_agents in sorted(dashes):
        yield f"The paper prints dashes for {label} with {n_agents} robots; here it has played."


def seeds_of(row: TableRow) -> int:
    """Return how many training runs play for a row.

    :param row: with its numbers; 0 without any
    """
    return max((value.n_seeds for value in row.values.values()), default=0)


def _intervals(spec: Table, played: Sequence[TableRow]) -> Iterator[str]:
    text = (
        "Behind ±: half the width of the 95 % interval, whose ends are in the CSV file. One "
        "policy: Student's t over the episodes"
    )
    times = "; bootstrap percentiles for time_e_paper" if "time_e_paper" in spec.metrics else ""
    yield f"{text}{times}."
    single = _labels(played, lambda row: row.learned and seeds_of(row) == 1)
    if single:
        yield (
            f"One training seed, so the interval is over episodes only (\N{DAGGER}): {single}. "
            "Another training may give other numbers."
        )
    if any(seeds_of(row) > 1 for row in played):
        yield (
            "Several training seeds: interquartile mean over the seeds' means (of three or fewer, "
            "the mean) and bootstrap percentiles over the seeds, "
            f"{N_RESAMPLES:,} resamples. It says how much trainings differ; the episodes are taken "
            "as they are."
        )
    by_seeds: dict[int, list[str]] = {}
    for row in played:
        by_seeds.setdefault(seeds_of(row), []).append(row.label)
    for n in sorted(by_seeds):
        if 1 < n <= _SMALL:
            yield (
                f"With {n} seeds this interval is coarse: it goes from about the lowest to the "
                "highest seed, and includes the expected value in about "
                f"{100 * (1 - 2.0 ** (1 - n)):.0f} of 100 cases, not in 95 "
                f"({', '.join(by_seeds[n])})."
            )


def _marks(rows: Sequence[TableRow], played: Sequence[TableRow]) -> Iterator[str]:
    rivals = [row for row in played if not row.bound]
    if len(rivals) > 1:
        text = (
            "Bold: better than every other row that played there, by the 95 % interval of the "
            "difference on the same episodes (paired bootstrap)"
        )
        if any(seeds_of(row) > 1 for row in rivals):
            text += ", in which training seeds are drawn, too"
        few = any(v.n_episodes < MIN_EPISODES for row in rivals for v in row.values.values())
        yield f"{text}{f'; not where one has fewer than {MIN_EPISODES} episodes' if few else ''}."
        if any(0 < seeds_of(row) <= _SMALL for row in rivals):
            yield (
                "With this few training seeds, a bold number speaks for these trained policies "
                "more than for the method. Where trainings differ much, one of two equal methods "
                "is found better in up to 33 % of all cases with 2 seeds against 2, and in about "
                "18 % with 3 against 3; against a row without training, in up to 50 % with 2, and "
                "in 25 % with 3. 5 % is meant."
            )
    bounds = _labels(rows, lambda row: row.bound)
    if bounds:
        yield f"{bounds}: a bound and no rival, it knows what a team can not know."


def _who(rows: Sequence[TableRow]) -> Iterator[str]:
    trained = [row for row in rows if row.learned and row.values]
    if trained:
        each = "; ".join(f"{row.label} {row.budget}" for row in trained)
        yield f"Trained for: {each}. The paper trained for 5,000,000 joint steps."
    shipped = _labels(trained, lambda row: row.shipped)
    if shipped:
        yield f"Played by the trained weights that come with this package: {shipped}."
    missing = _labels(rows, lambda row: row.learned and row.budget == "not trained")
    if missing:
        yield f"Not trained yet, and therefore empty: {missing}."
    absent = _labels(rows, lambda row: not row.values and row.budget != "not trained")
    if absent:
        yield f"Not played yet, and therefore empty: {absent}."
    drawn = _labels(rows, lambda row: row.drawn and bool(row.values))
    if drawn:
        yield (
            f"Actions are drawn, as in training, for: {drawn}; all other trained rows take the "
            "likeliest one."
        )
    yield from _decision([row for row in rows if row.batch])


def _decision(played: Sequence[TableRow]) -> Iterator[str]:
    by_batch: dict[int, list[str]] = {}
    for row in played:
        by_batch.setdefault(row.batch, []).append(row.label)
    each = "; ".join(
        f"{batch} team{'s' * (batch != 1)} for {', '.join(by_batch[batch])}"
        for batch in sorted(by_batch, reverse=True)
    )
    yield (
        "Decision: median time of a decision on a joint step, observations excluded, on the "
        "machine that played; of several scenes, the median. It is a team's share of the time for "
        f"all teams that are decided for at once, at most {each}. A network that decides for a "
        "single team takes many times its share of a large batch, so rows compare only where this "
        "number is the same."
    )
