"""What the commands share: the parser, types of options, and the options of a scene."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from area_search.scenes import Scene, SceneError, get_scene, unknown
from sb3_roles.common.names import printable, shown

if TYPE_CHECKING:
    Subparsers = argparse._SubParsersAction["Parser"]

MAX_SEED = 2**63 - 1
# What torch, numpy and SB3 take as a seed of a whole run.
MAX_TRAINING_SEED = 2**32 - 1
DEVICES = ("auto", "cpu", "cuda")
_INTEGER = re.compile(r"[+-]?[0-9]{1,100}")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]{1,5})?")
# Not "none": that is the name of a sub-goal.
_CONSTANTS = {"true": True, "false": False, "null": None, "None": None, "~": None}


class UsageError(ValueError):
    """A wrong command line that only the command itself can notice; the message is one line."""


class _Help(argparse.ArgumentDefaultsHelpFormatter):
    """Adds the default to the help of an option, unless there is none or the text names it."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.default is None or action.default is False or "default" in (action.help or ""):
            return action.help
        return super()._get_help_string(action)


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line with the closest match, and exit code 2."""

    def __init__(self, **options: Any) -> None:
        options.setdefault("formatter_class", _Help)
        # An abbreviation that works today is ambiguous once another option is added.
        super().__init__(**options, allow_abbrev=False)
        self.set_defaults(parser=self)

    def error(self, message: str) -> NoReturn:
        """Print one line and exit."""
        self.exit(2, f"{self.prog}: error: {printable(message)}\n")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse, and refuse what is not known here: later it would be the top parser's error."""
        args = list(sys.argv[1:] if args is None else args)
        if args and args[0].startswith("-"):
            # argparse would skip it, and take its value for the command.
            self._check_option(args[0])
        result, extra = super().parse_known_args(args, namespace)
        if extra:
            self._check_option(extra[0])
            self.error(f"unexpected argument {extra[0]!r}")
        return result, extra

    def _check_option(self, given: str) -> None:
        name = given.split("=")[0]
        if not name.startswith("--") and name[:2] in self._option_string_actions:
            return  # A short option with its value attached, -n5000.
        if name.startswith("-") and name not in self._option_string_actions:
            options = [name for name in self._option_string_actions if name.startswith("--")]
            self.error(unknown("option", name, options))

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            what = action.metavar if isinstance(action.metavar, str) else "value"
            raise argparse.ArgumentError(None, unknown(what, value, action.choices))


def one_of(what: str, allowed: Iterable[str]) -> Callable[[str], str]:
    """Make the type of an option that takes one of some names.

    :param what: the kind of thing that is named
    :param allowed: the names that exist
    """
    names = tuple(allowed)

    def name(text: str) -> str:
        if text not in names:
            raise argparse.ArgumentTypeError(unknown(what, text, names))
        return text

    return name


def names_of(text: str) -> list[str]:
    """Read names with commas between."""
    return [name.strip() for name in text.split(",")]


def several_of(what: str, allowed: Iterable[str]) -> Callable[[str], tuple[str, ...]]:
    """Make the type of an option that takes some names with commas between, each of them once.

    :param what: the kind of thing that is named
    :param allowed: the names that exist
    """
    one = one_of(what, allowed)

    def several(text: str) -> tuple[str, ...]:
        return tuple(dict.fromkeys(one(name) for name in names_of(text)))

    return several


def whole_number(low: int, high: int) -> Callable[[str], int]:
    """Make the type of an option that takes a whole number from ``low`` to ``high``."""

    def number(text: str) -> int:
        value = int(text) if _INTEGER.fullmatch(text) else None
        if value is None or not low <= value <= high:
            raise argparse.ArgumentTypeError(
                f"must be a whole number from {low} to {high}, got {shown(text)}"
            )
        return value

    return number


def positive_number(high: float) -> Callable[[str], float]:
    """Make the type of an option that takes a number above 0, up to ``high``."""

    def number(text: str) -> float:
        value = float(text) if _NUMBER.fullmatch(text) else 0.0
        if not 0.0 < value <= high:
            raise argparse.ArgumentTypeError(
                f"must be a number above 0, up to {high:g}, got {shown(text)}"
            )
        return value

    return number


def output_file(*endings: str) -> Callable[[str], Path]:
    """Make the type of an option that names a file to write; it is checked before the work.

    :param endings: suffixes that are allowed, with the dot
    """

    def path(text: str) -> Path:
        file = Path(text)
        if file.suffix.lower() not in endings:
            raise argparse.ArgumentTypeError(
                f"the file must end in {' or '.join(endings)}, got {shown(text)}"
            )
        if file.is_dir():
            raise argparse.ArgumentTypeError(f"{shown(text)} is a folder, name a file")
        if not file.parent.is_dir():
            said = "is no folder" if file.parent.exists() else "does not exist"
            raise argparse.ArgumentTypeError(f"folder {str(file.parent)!r} {said}")
        # The file takes the place of an earlier one, which needs the rights of the folder.
        if not os.access(file.parent, os.W_OK):
            raise argparse.ArgumentTypeError(f"folder {str(file.parent)!r} can not be written")
        return file

    return path


def folder_name(text: str) -> str:
    """Read the name of a folder: no name is not the current one."""
    if not text:
        raise argparse.ArgumentTypeError("must name a folder, got ''")
    return text


def check_folder(option: str, folder: Path) -> None:
    """Find out, before work that takes long, whether a folder can be made, or written to.

    :param option: that names it
    :param folder: it is not made
    :raises UsageError: if it can not
    """
    try:
        there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    except OSError as error:
        raise UsageError(f"argument {option}: {folder}: {error.strerror}") from None
    if not there.is_dir():
        raise UsageError(f"argument {option}: {there} is no folder")
    if not os.access(there, os.W_OK):
        raise UsageError(f"argument {option}: {str(there)!r} can not be written")


def parse_value(text: str) -> Any:
    """Read the value of a ``key:value`` argument.

    Numbers (``5e-4`` too, which YAML 1.1 takes for text), ``true``, ``false`` and ``null`` or
    ``None`` are what they look like; ``[...]``, ``{...}`` and quoted text are YAML; anything else
    is text. So ``no`` and ``12:30`` stay text, which YAML would turn into False and 750.

    :param text: the part after the colon
    :return: the value
    :raises ValueError: if it begins like YAML and is none
    """
    if _INTEGER.fullmatch(text):
        return int(text)
    if _NUMBER.fullmatch(text):
        return float(text)
    for name in (text, text.lower()):
        if name in _CONSTANTS:
            return _CONSTANTS[name]
    if not text.startswith(("[", "{", '"', "'")):
        return text
    # Few command lines need it at all.
    from sb3_roles.common.yaml_text import YamlError, load_yaml

    try:
        return load_yaml(text)
    except YamlError as error:
        why = str(error).removeprefix("line 1: ")
        raise ValueError(f"not valid YAML: {shown(text)}: {why}") from None


def key_value(text: str) -> tuple[str, Any]:
    """Read one ``key:value`` argument, as rl-zoo's ``--env-kwargs`` takes them.

    :param text: ``key:value``
    :return: key and value
    :raises argparse.ArgumentTypeError: if it has another form
    """
    key, colon, value = text.partition(":")
    if not (colon and value and key.isidentifier()):
        raise argparse.ArgumentTypeError(f"must be key:value, got {shown(text)}")
    try:
        return key, parse_value(value)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{key}: {error}") from None


class KeyValues(argparse.Action):
    """Collect ``key:value`` arguments in a dict; use with ``type=key_value``, ``nargs="+"``."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Add the given pairs."""
        collected = dict(getattr(namespace, self.dest) or {})
        for key, value in values:
            if key in collected:
                raise argparse.ArgumentError(self, f"{key} is given twice")
            collected[key] = value
        setattr(namespace, self.dest, collected)


def add_scene_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--scene``, ``--n-agents`` and ``--scene-options``; read them with :func:`scene_of`."""
    parser.add_argument("--scene", default="hard", help="name of a scene", metavar="NAME")
    parser.add_argument(
        "--n-agents",
        type=int_text,
        default=argparse.SUPPRESS,
        metavar="N",
        help="robots in the team (default: the scene's)",
    )
    parser.add_argument(
        "--scene-options",
        type=key_value,
        nargs="+",
        action=KeyValues,
        default={},
        metavar="KEY:VALUE",
        help="fields of the scene to change, such as horizon:100 free_fraction:0.5",
    )


def int_text(text: str) -> int | str:
    """Read a whole number, and leave anything else to the scene, which knows the range."""
    return int(text) if _INTEGER.fullmatch(text) else text


def scene_of(args: argparse.Namespace) -> Scene:
    """Make the scene that the options of :func:`add_scene_options` describe.

    :param args: parsed arguments
    :return: the scene
    :raises UsageError: if the name or a field is unknown, or a value is out of range
    """
    options = dict(args.scene_options)
    if hasattr(args, "n_agents"):
        if "n_agents" in options:
            raise UsageError("give --n-agents or --scene-options n_agents:..., not both")
        options["n_agents"] = args.n_agents
    try:
        return get_scene(args.scene, **options)
    except SceneError as error:
        raise UsageError(str(error)) from None
