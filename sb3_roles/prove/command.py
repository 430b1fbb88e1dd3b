"""``sb3-roles prove``: run the experiments behind the promises, and write a table of them."""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_roles.common.names import one_line
from sb3_roles.prove.promises import PROMISES, Outcome, Promise, Setting
from sb3_roles.zoo.options import MAX_TRAINING_SEED, one_of, output_file, whole_number
from sb3_roles.zoo.stop_signals import StopSignals

if TYPE_CHECKING:
    from sb3_roles.zoo.options import Subparsers

EXIT_KEPT, EXIT_BROKEN = 0, 1


def add_parser(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "prove",
        help="try what is promised about reliability",
        description="Run the experiments behind the promises on reliability, on this machine, one "
        "line each. The exit code is 1 if one was broken. Promises: "
        + "; ".join(f"{one.name} {one.text}" for one in PROMISES.values())
        + ".",
    )
    parser.add_argument(
        "promises",
        nargs="*",
        type=one_of("promise", PROMISES),
        metavar="PROMISE",
        help="those to try, such as R1 R5 (default: all; with --quick all with a short form)",
    )
    parser.add_argument("--quick", action="store_true", help="short forms, up to a minute each")
    parser.add_argument(
        "--seed",
        type=whole_number(0, MAX_TRAINING_SEED),
        default=0,
        metavar="S",
        help="of every random choice",
    )
    parser.add_argument(
        "-o", "--output", type=output_file(".md"), metavar="FILE", help="Markdown table to write"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Try the promises.

    :param args: parsed arguments
    :return: 0 if all were kept, 1 if one was broken; one that can not be tried here is neither
    :raises UsageError: if the short form of a promise is asked for that has none
    """
    stop = StopSignals()
    try:
        # So that nothing is left behind after SIGTERM either.
        with stop.caught():
            return _run(args)
    except KeyboardInterrupt:
        return stop.exit_code


def _run(args: argparse.Namespace) -> int:
    from sb3_roles.common.files import write_atomically
    from sb3_roles.prove.table import results_page
    from sb3_roles.zoo.launcher import prepare_process
    from sb3_roles.zoo.machine import describe_machine
    from sb3_roles.zoo.options import UsageError

    names = list(dict.fromkeys(args.promises))
    long = [name for name in names if not PROMISES[name].has_quick]
    if args.quick and long:
        raise UsageError(f"{long[0]} has no short form: leave --quick out")
    asked = [PROMISES[name] for name in names] or [
        one for one in PROMISES.values() if one.has_quick or not args.quick
    ]
    packages = {"torch": version("torch"), "stable_baselines3": version("stable_baselines3")}
    machine, results = {**describe_machine(), **packages}, []
    # Experiments train in this process, too.
    prepare_process()
    for promise in asked:
        outcome, seconds = _try(promise, args.quick, args.seed)
        print(line(promise, outcome, seconds), flush=True)
        for failure in outcome.failures:
            print(f"    {failure}", flush=True)
        results.append((promise, outcome, seconds))
        if args.output is not None:
            # After each: an interruption keeps what was tried.
            write_atomically(args.output, results_page(results, machine, args.quick).encode())
    broken = [one for one, outcome, _ in results if not outcome.kept and not outcome.skipped]
    return EXIT_BROKEN if broken else EXIT_KEPT


def line(promise: Promise, outcome: Outcome, seconds: float) -> str:
    """Write an outcome as the line that is printed.

    :param promise: what was tried
    :param outcome: what came out
    :param seconds: how long it took
    """
    if outcome.skipped:
        return f"{promise.name} not tried: {outcome.skipped}"
    verdict = "" if outcome.kept else "BROKEN: "
    text = f"{promise.name} {verdict}{outcome.held}/{outcome.tried} {outcome.said}"
    stock = f"; stock: {outcome.stock}" if outcome.stock else ""
    return f"{text}{stock} ({seconds:.0f} s)"


def _try(promise: Promise, quick: bool, seed: int) -> tuple[Outcome, float]:
    folder = Path(tempfile.mkdtemp(prefix=f"prove_{promise.name.lower()}_"))
    start = time.monotonic()

    def note(text: str) -> None:
        print(f"{promise.name}: {text}", file=sys.stderr, flush=True)

    try:
        outcome = promise.prove(Setting(quick, folder, seed, note))
    except KeyboardInterrupt:
        note("stopped")
        raise
    except Exception as error:
        # The others shall be tried.
        text = f"{type(error).__name__}: {one_line(error)}"
        outcome = Outcome(0, 0, "the experiment failed", (text,))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return outcome, time.monotonic() - start
