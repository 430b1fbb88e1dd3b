"""The figures of a plan, drawn from what was played and from the logs of the trainings."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from sb3_roles.common.files import write_atomically
from sb3_roles.evaluation.figures.data import (
    SMOOTHING,
    Bar,
    Curve,
    Drawn,
    Logs,
    Warn,
    collect,
    csv_of,
)
from sb3_roles.evaluation.figures.files import SUFFIXES, drawing_style, render
from sb3_roles.evaluation.figures.panels import draw
from sb3_roles.evaluation.grid.entrants import Results
from sb3_roles.evaluation.grid.plan import Figure, Plan
from sb3_roles.evaluation.metrics import MEANINGS

_MEANINGS = {
    "explore_reward": "explore reward: newly seen cells of the team over B_e",
    "cover_reward": "cover reward: newly covered targets of the team",
    **{name: f"{meaning.text} ({name})" for name, meaning in MEANINGS.items()},
}


def draw_figures(
    plan: Plan,
    results: Results,
    logs: Logs,
    folder: Path,
    quick: bool = False,
    warn: Warn | None = None,
) -> list[Path]:
    """Draw all figures of a plan for which there is something to draw.

    Each becomes ``<name>.svg``, ``.pdf`` and ``.png``, and ``<name>.csv`` with the numbers.
    The same arguments give the same bytes.

    :param plan: its figures are drawn
    :param results: what was played; cells may be missing
    :param logs: row -> run folders, for training curves; rows may be missing
    :param folder: of the files; it is made if it does not exist
    :param quick: they are of the quick form, and say so
    :param warn: told of each row, run and figure that is left out though it should be there, one
        line each; by default they become Python warnings
    :return: the files, figure by figure
    :raises ImportError: if matplotlib is not there
    :raises OSError: if a file can not be written; files are whole or not there
    """
    tell = warn or _warn
    paths = []
    for name, figure in plan.figures.items():
        drawn = collect(figure, results, logs, tell)
        if not drawn:
            tell(f"figure {name}: there is nothing to draw")
            continue
        with drawing_style(name):
            canvas = draw(plan, figure, drawn, _quick_form(drawn) if quick else "")
            files = render(canvas, name, f"{figure.caption}.")
        files["csv"] = csv_of(drawn)
        for suffix in (*SUFFIXES, "csv"):
            paths.append(folder / f"{name}.{suffix}")
            write_atomically(paths[-1], files[suffix])
    return paths


def _warn(line: str) -> None:
    warnings.warn(line, stacklevel=3)


def caption(figure: Figure, quick: bool, plan: Plan, results: Results, logs: Logs) -> str:
    """Return what stands below a figure.

    :param figure: of the plan
    :param quick: see :func:`draw_figures`, and so the rest
    :param plan: the plan
    :param results: what was played
    :param logs: row -> run folders
    :return: sentences in plain text: what is shown, in which units, over how many episodes and
        seeds, what the bands are, and which rows are missing
    """
    drawn = collect(figure, results, logs, lambda line: None)
    sentences = [figure.caption, *(_MEANINGS[metric] for metric in _meant(figure))]
    if drawn:
        sentences += [*_drawn_how(figure, drawn), *_sources(plan, drawn)]
    there = {one.row for one in drawn}
    missing = [plan.rows[row].label for row in figure.rows if row not in there]
    if missing:
        sentences.append(f"Not there: {', '.join(missing)}")
    if quick and drawn:
        form = _quick_form(drawn)
        sentences.append(form[0].upper() + form[1:])
    return " ".join(f"{each[0].upper()}{each[1:]}." for each in sentences if each)


def _meant(figure: Figure) -> Sequence[str]:
    return () if figure.kind in ("roles", "switching") else figure.metrics


def _quick_form(drawn: Drawn) -> str:
    numbers = {one.origin.episodes for one in drawn if one.origin.episodes is not None}
    if not numbers:
        return "quick form; training curves are as in the full form"
    few, many = min(numbers), max(numbers)
    return f"quick form: {_count(many) if few == many else f'{few} to {_count(many)}'}"


def _count(number: int, what: str = "episode") -> str:
    return f"{number:,} {what}{'s' * (number != 1)}"


def _drawn_how(figure: Figure, drawn: Drawn) -> list[str]:
    several = any(one.origin.seeds > 1 for one in drawn)
    if figure.kind == "training":
        band = ["bands: lowest to highest seed"] if several else []
        smooth = f"sums over an episode and the team, rolling mean over {SMOOTHING} rollouts"
        return [smooth, "lines: mean of the seeds, up to the end of the shortest run", *band]
    whiskers = "whiskers" if figure.kind == "time_e" else "bands"
    seeds = ", for rows with several seeds over the seeds" if several else ""
    how = [f"{whiskers}: 95 % intervals over the episodes{seeds}"]
    if figure.kind == "roles":
        styles = {"cover": "solid", "explore": "dashed"}
        lines = ", ".join(f"{role} {styles[role]}" for role in figure.metrics)
        how.insert(0, f"share of the robots in the role, in %: {lines}")
    elif figure.kind == "switching":
        how.insert(0, "share of the robots whose role is another one than in the step before, in %")
    elif figure.kind == "episode":
        how.insert(0, "beside each panel: at the end of the episodes")
        if "explo_paper" in figure.metrics or "explo_true" in figure.metrics:
            how.insert(0, "dotted: 90 %")
    else:
        bars = [one for one in drawn if isinstance(one, Bar)]
        if any(bar.score.mean is None for bar in bars):
            how.append("a dash: never")
        if any(bar.open_ended for bar in bars):
            how.append("an arrow: no known end")
    if figure.paper:
        how.append("stars: what the paper's figure shows")
    return how


def _sources(plan: Plan, drawn: Drawn) -> list[str]:
    """Say how many episodes, seeds and joint steps of training there are."""
    sources = []
    by_row: dict[str, list[Curve | Bar]] = {}
    for one in drawn:
        by_row.setdefault(one.row, []).append(one)
    episodes = {row: _least(ones) for row, ones in by_row.items()}
    numbers = [number for number in episodes.values() if number is not None]
    if numbers:
        usual = max(numbers, key=numbers.count)
        others = [
            f"{plan.rows[row].label}: {number:,}"
            for row, number in episodes.items()
            if number not in (None, usual)
        ]
        more = f" ({', '.join(others)})" if others else ""
        where = "row and seed" if any(one.origin.seeds > 1 for one in drawn) else "row"
        sources.append(f"{_count(usual)} of each {where}{more}")
    trained = []
    for row, ones in by_row.items():
        seeds = min(one.origin.seeds for one in ones)
        steps = [one.origin.env_steps for one in ones if one.origin.env_steps is not None]
        if seeds:
            budget = f" of {min(steps):,} joint steps" if steps else ""
            trained.append(f"{plan.rows[row].label}, {_count(seeds, 'seed')}{budget}")
    if trained:
        sources.append(f"trained: {'; '.join(trained)}")
    return sources


def _least(ones: Sequence[Curve | Bar]) -> int | None:
    numbers = [one.origin.episodes for one in ones if one.origin.episodes is not None]
    return min(numbers, default=None)
