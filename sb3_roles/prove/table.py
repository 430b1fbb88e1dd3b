"""The results of proofs as a Markdown page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sb3_roles.prove.promises import Outcome, Promise
from sb3_roles.zoo.bench_report import Table, machine_lines, page

_COLUMNS = ("", "promise", "target", "seen here", "stock stack, same run", "s")


def results_page(
    results: Sequence[tuple[Promise, Outcome, float]], machine: dict[str, Any], quick: bool
) -> str:
    """Write outcomes as Markdown.

    :param results: promise, outcome and seconds
    :param machine: of ``describe_machine``
    :param quick: whether these are the short forms
    """
    form = "short forms: fewer trials than the targets name" if quick else "full forms"
    table = Table(_COLUMNS, n_texts=len(_COLUMNS) - 1)
    failures = []
    for promise, outcome, seconds in results:
        seen = f"{outcome.held}/{outcome.tried} {outcome.said}"
        if outcome.skipped:
            seen = f"not tried: {outcome.skipped}"
        elif not outcome.kept:
            seen = f"**broken**: {seen}"
            failures += [f"* {promise.name}: {one}" for one in outcome.failures]
        table.add(promise.name, promise.text, promise.target, seen, outcome.stock, f"{seconds:.0f}")
    text = page([f"`sb3-roles prove`, {form}", *machine_lines(machine)], [table], markdown=True)
    broken = "\n\nWhat was broken:\n\n" + "\n".join(failures) if failures else ""
    return f"{text}{broken}\n"
