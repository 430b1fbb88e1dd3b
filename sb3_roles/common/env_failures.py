"""Errors of an environment, told as such: which one failed, when, and where in its code."""

from __future__ import annotations

import sys
import sysconfig
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sb3_roles.common.names import one_line

RESET_PARTS = ("observation", "info")
STEP_PARTS = ("observation", "reward", "termination", "truncation", "info")
_LIBRARIES = tuple(sorted({sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")}))


# A ValueError, as all that says what is wrong with an environment.
class EnvironmentFailed(ValueError):
    """An environment raised an error, or broke its interface; the message is one line."""


def env_class(env: object) -> str:
    """Return what messages call an environment: module and class of the innermost one."""
    kind = type(getattr(env, "unwrapped", env))
    return f"{kind.__module__}:{kind.__qualname__}"


def _failure(env: object, where: str, error: BaseException) -> EnvironmentFailed:
    """Make the error that tells another one as the environment's.

    :param env: the environment
    :param where: what it was doing, such as ``step 6``
    :param error: what was raised
    """
    said = one_line(error)
    text = f"environment {env_class(env)}: {type(error).__name__} in {where}"
    return EnvironmentFailed(f"{text}{': ' if said else ''}{said}{place_of(error, env)}")


def called(env: object, where: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Call a function of an environment.

    Signals pass, and with them the end of the program after a second one; so does a lack of memory,
    which is not the environment's alone.

    :param env: the environment, for the message
    :param where: what it is to do, such as ``step 6``
    :param function: to call, with the arguments that follow
    :raises EnvironmentFailed: if it raises, ``SystemExit`` included
    """
    try:
        return function(*args, **kwargs)
    except (EnvironmentFailed, MemoryError):
        raise
    except Exception as error:
        raise _failure(env, where, error) from error
    except SystemExit as error:
        if type(error) is not SystemExit:
            raise  # The program's own, see ``zoo.stop_signals``.
        raise _failure(env, where, error) from error


def close_or_warn(env: Any) -> None:
    """Close environments; if that fails, say so on stderr: how the work ended matters more.

    :param env: a vectorized environment whose ``close`` raises :class:`EnvironmentFailed`
    """
    try:
        env.close()
    except EnvironmentFailed as error:
        print(f"warning: {error}", file=sys.stderr, flush=True)


def place_of(error: BaseException, env: object = None) -> str:
    """Return where in an environment's code an error came up: `` (file.py:65)``, with the space.

    What a library raises is told by the line that called it.

    :param error: was caught by who called the environment
    :param env: it may be part of an installed package
    :return: empty where the call itself failed
    """
    begin = None if error.__traceback__ is None else error.__traceback__.tb_next
    frames = [(frame.f_code.co_filename, n, frame) for frame, n in traceback.walk_tb(begin)]
    package = type(getattr(env, "unwrapped", env)).__module__.partition(".")[0]
    own = [
        (name, number)
        for name, number, frame in frames
        if not name.startswith((*_LIBRARIES, "<"))
        or str(frame.f_globals.get("__name__")).partition(".")[0] == package
    ] or [(name, number) for name, number, _ in frames]
    return f" ({Path(own[-1][0]).name}:{own[-1][1]})" if own else ""


def parts_problem(result: object, names: tuple[str, ...]) -> str | None:
    """Return what is wrong with what a reset or step returned; None if it is dicts, one by name.

    :param result: what it returned
    :param names: :data:`RESET_PARTS` or :data:`STEP_PARTS`
    """
    got = None
    if not isinstance(result, tuple) or len(result) != len(names):
        got = f"{len(result)} values" if isinstance(result, tuple) else type(result).__name__
    else:
        for name, part in zip(names, result, strict=True):
            if not isinstance(part, dict):
                got = f"{type(part).__name__} as {name}"
                break
    return got and f"expected {len(names)} dicts by agent ({', '.join(names)}), got {got}"
