"""``sb3-roles``: finds the command, and turns every way to fail into an exit code.

A command is a module with ``add_parser(subparsers)``, which sets ``run`` as a default of its
parser, and ``run(args) -> int``. Its heavy imports belong inside ``run``: help and usage errors
must not wait for torch or numba.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Sequence
from importlib import import_module

from sb3_roles._version import __version__
from sb3_roles.common.env_failures import EnvironmentFailed
from sb3_roles.common.interrupts import interrupt_once, leave_at_interrupt
from sb3_roles.zoo.options import Parser, UsageError

COMMANDS = (
    "sb3_roles.zoo.train",
    "sb3_roles.zoo.demonstrate",
    "sb3_roles.zoo.simulate",
    "sb3_roles.zoo.evaluate",
    "sb3_roles.zoo.enjoy",
    "sb3_roles.zoo.curves",
    "sb3_roles.zoo.records",
    "sb3_roles.zoo.tables",
    "sb3_roles.zoo.publish",
    "sb3_roles.zoo.ablations",
    "sb3_roles.zoo.bench",
    "sb3_roles.prove.command",
)
EXIT_FAILED, EXIT_INTERRUPTED, EXIT_CLOSED_PIPE = 3, 130, 141


def make_parser(script: str | None = None) -> Parser:
    """Build the parser of all commands.

    :param script: the command that calls itself ``<script>.py`` in its messages
    """
    parser = Parser(
        prog="sb3-roles",
        description="Multi-agent, role-hierarchical PPO and the area-search environment.",
    )
    parser.add_argument("--version", action="version", version=f"sb3-roles {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="command", required=True)
    for command in COMMANDS:
        import_module(command).add_parser(subparsers)
    if script is not None:
        subparsers.choices[script].prog = f"{script}.py"
    return parser


def main(argv: Sequence[str] | None = None, script: str | None = None) -> int:
    """Run one command.

    :param argv: arguments without the name of the program, ``sys.argv[1:]`` by default
    :param script: the command, where it is not the first argument: ``"train"`` for ``train.py``
    :return: the exit code: 0, 2 after a usage error, 3 after an error of an environment, 130 after
        Ctrl-C, 141 after a closed pipe, or the command's own
    :raises SystemExit: after help, ``--version`` and a wrong command line
    """
    if argv is not None:
        return _main(argv, script)
    interrupt_once()
    try:
        return _main(sys.argv[1:], script)
    finally:
        leave_at_interrupt()


def _main(arguments: Sequence[str], script: str | None) -> int:
    if hasattr(sys.stdout, "reconfigure"):
        # A terminal that can not show "±" gets "?", not a traceback.
        sys.stdout.reconfigure(errors="replace")
    try:
        parser = make_parser(script)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    arguments = [*arguments] if script is None else [script, *arguments]
    try:
        try:
            args = parser.parse_args(arguments)
            args.arguments, parser = arguments, args.parser
            code = args.run(args)
        finally:
            # Here and not at exit, where a closed pipe can no longer be handled.
            if sys.stdout is not None:
                sys.stdout.flush()
        return code
    except BrokenPipeError:
        _drop_output()
        return EXIT_CLOSED_PIPE
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except EnvironmentFailed as error:
        print(f"{parser.prog}: error: {error}", file=sys.stderr)
        return EXIT_FAILED
    except UsageError as error:
        parser.error(str(error))
    except MemoryError as error:
        parser.error(f"out of memory: {error or 'ask for less at once'}")
    except OSError as error:
        _drop_output()
        where = f"{error.filename}: " if error.filename else ""
        parser.error(f"{where}{error.strerror or error}")


def _drop_output() -> None:
    # The interpreter flushes once more at exit; what is left has nowhere to go.
    with contextlib.suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)
