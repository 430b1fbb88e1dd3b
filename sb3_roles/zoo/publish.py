"""``sb3-roles publish``: trained weights, small enough to come with the package."""

from __future__ import annotations

from argparse import Namespace
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_roles.zoo.config import read_run_config
from sb3_roles.zoo.model_card import CardError, check_files, read_card
from sb3_roles.zoo.options import UsageError, one_of, whole_number
from sb3_roles.zoo.plans import learned_rows, read_plan_file
from sb3_roles.zoo.published import FOLDER, published
from sb3_roles.zoo.row_configs import PLAN
from sb3_roles.zoo.row_runs import Run, fits, named_runs

if TYPE_CHECKING:
    from sb3_roles.evaluation.grid.plan import Plan, Row
    from sb3_roles.zoo.options import Subparsers


def add_parser(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "publish",
        help="make trained weights small, with a card",
        description="Write <out>/<row>/seed_<k>/ for runs of learned rows of the tables: the "
        "weights that it takes to act, the configuration, the learning curve, and a card with "
        "scores, as far as the records of sb3-roles tables hold what these weights played.",
    )
    parser.add_argument(
        "--runs",
        action="append",
        default=[],
        metavar="ROW=RUN",
        help="runs to publish for a learned row, whose configuration they must have: a run folder "
        "or a pattern; may be repeated",
    )
    parser.add_argument(
        "--scores",
        action="store_true",
        help="fill in the scores of all weights that are in --out, from --records",
    )
    parser.add_argument("-o", "--out", type=Path, metavar="DIR", help="default: the package's own")
    parser.add_argument(
        "--records",
        type=Path,
        default=Path("results", "records"),
        metavar="DIR",
        help="of sb3-roles tables",
    )
    parser.add_argument(
        "--episodes",
        type=whole_number(1, 10**6),
        metavar="N",
        help="of each score, instead of the plan's",
    )
    parser.add_argument(
        "--dtype",
        type=one_of("type", ("auto", "float16", "float32")),
        default="auto",
        metavar="NAME",
        help="float16, half the size, or float32, the weights of the run to the last bit; auto: "
        "float16 where the file is large",
    )
    parser.add_argument(
        "--load-best",
        action="store_true",
        help="the best evaluated weights instead of the latest ones",
    )
    parser.add_argument(
        "--replace", action="store_true", help="write over other weights of the same row and seed"
    )
    parser.add_argument(
        "--plan", type=Path, metavar="FILE", help=f"instead of zoo_configs/{PLAN}.yml"
    )
    parser.set_defaults(run=run)


def run(args: Namespace) -> int:
    """Publish runs, and fill in scores.

    :param args: parsed arguments
    :return: exit code
    :raises UsageError: if a run can not be published, or would replace other weights; nothing is
        changed then
    :raises OSError: if something can not be written; what was there is whole then
    """
    if not (args.runs or args.scores):
        raise UsageError("give --runs ROW=RUN to publish runs, or --scores to fill in scores")
    plan = read_plan_file(args.plan)
    out = FOLDER if args.out is None else args.out
    named = named_runs(args.runs, plan)
    wanted = [(run, plan.rows[name]) for name, runs in named.items() for run in runs]
    for one, row in wanted:
        if not fits(one, row):
            raise UsageError(
                f"{one.folder}: its configuration is not that of the row {row.name}, so tables "
                "would not take it"
            )
    from sb3_roles.zoo.staging import put, staged

    with ExitStack() as stack:
        folders = [
            (row, *stack.enter_context(staged(one, row, out, args.dtype, args.load_best)))
            for one, row in wanted
        ]
        for row, partial, target in folders:
            old = _card_there(args, partial, target)
            _score(args, partial, row, plan, old)
        for _, partial, target in folders:
            put(partial, target)
            print(_told(target))
    if args.scores:
        _fill_in(args, plan, out, [target for *_, target in folders])
    files = (
        path for ones in published(out).values() for one in ones for path in _files(one.folder)
    )
    print(f"{out}: {sum(path.stat().st_size for path in files):,} bytes in all")
    return 0


def _files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def _told(folder: Path) -> str:
    card = read_card(folder)
    size = sum(path.stat().st_size for path in _files(folder))
    n_cells = len((card["scores"] or {"cells": ()})["cells"])
    scores = f"scores of {n_cells} cells" if n_cells else "no scores yet"
    return f"{folder}: {card['env_steps']:,} joint steps, {size:,} bytes, {scores}"


def _card_there(args: Namespace, partial: Path, target: Path) -> dict[str, Any] | None:
    """Return the card of the same weights in the place of a folder, if it is there.

    :raises UsageError: if something else is there that must not be replaced
    """
    from sb3_roles.zoo.staging import same_weights

    if not target.exists():
        return None
    new, there = read_card(partial), None
    try:
        there = read_card(target)
        if same_weights(there, new):
            return there
    except CardError:
        pass
    if not args.replace:
        old = "something else" if there is None else _about(there)
        raise UsageError(
            f"{target}: there is {old}, and not {_about(new)}: --replace writes over it"
        )
    return None


def _about(card: dict[str, Any]) -> str:
    points = card["curve"]["points"]
    cover = points[-1][-1] if points else None
    last = "" if cover is None else f", cover {100 * cover:.1f} % in the last evaluation"
    return f"{card['weights']['dtype']} weights of {card['env_steps']:,} joint steps{last}"


def _score(args: Namespace, folder: Path, row: Row, plan: Plan, old: dict[str, Any] | None) -> None:
    """Write the scores of some weights into their card, beside those that it had."""
    from sb3_roles.zoo.card_scores import merged, scores_of
    from sb3_roles.zoo.staging import write_card

    card = read_card(folder)
    new = scores_of(Run(folder, read_run_config(folder)), row, plan, args.records, args.episodes)
    scores = merged(None if old is None else old["scores"], new)
    if scores != card["scores"]:
        write_card(folder, {**card, "scores": scores})


def _fill_in(args: Namespace, plan: Plan, out: Path, done: list[Path]) -> None:
    """Fill in the scores of all weights that are there."""
    rows = learned_rows(plan)
    there = published(out)
    if not there:
        raise UsageError(f"argument --scores: no published weights in {str(out)!r}")
    for name, ones in there.items():
        for one in ones:
            if name not in rows:
                print(f"{one.folder}: not scored: the plan has no learned row of this name")
            elif one.folder not in done:
                check_files(one.folder, one.card)
                _score(args, one.folder, rows[name], plan, one.card)
                print(_told(one.folder))
