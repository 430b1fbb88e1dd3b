"""R7: the source has nothing that runs what a file says."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import area_search
import sb3_roles
from sb3_roles.prove.promises import Outcome, Setting

_PICKLES = ("pickle", "_pickle", "cPickle", "cloudpickle", "dill", "marshal", "shelve", "joblib")
_BUILTINS = ("eval", "exec", "compile", "__import__")
_IMPORTERS = ("import_module", "__import__", "run_path", "run_module", "exec_module")
_YAML = ("load", "load_all", "unsafe_load", "unsafe_load_all", "full_load", "full_load_all")
_LOADERS = ("Loader", "UnsafeLoader", "FullLoader")
_NUMPY, _TORCH = ("np", "numpy"), ("th", "torch")

OF_CONSTANTS = "what it imports is written in the source"
ALLOWED: Mapping[tuple[str, str], str] = MappingProxyType(
    {
        ("sb3_roles/__init__.py", "import_module"): OF_CONSTANTS,
        ("sb3_roles/baselines/__init__.py", "import_module"): OF_CONSTANTS,
        ("sb3_roles/prove/promises.py", "import_module"): OF_CONSTANTS,
        ("sb3_roles/testing/__init__.py", "import_module"): OF_CONSTANTS,
        (
            "sb3_roles/testing/seeds.py",
            "import_module",
        ): "the environment that a caller of check_fresh_process gives, by name, to its child",
        ("sb3_roles/zoo/algorithms.py", "import_module"): OF_CONSTANTS,
        ("sb3_roles/zoo/bench.py", "import_module"): OF_CONSTANTS,
        ("sb3_roles/zoo/cli.py", "import_module"): OF_CONSTANTS,
        ("area_search/__init__.py", "import_module"): OF_CONSTANTS,
        (
            "sb3_roles/zoo/environments.py",
            "import_module",
        ): "module:factory, which a user has to name on the command line, see check_named",
        (
            "sb3_roles/common/env_declarations.py",
            "cloudpickle",
        ): "pickles an environment to see whether its copies work; loads nothing",
        ("sb3_roles/prove/hostile_files.py", "pickle"): "makes the payloads of R6; loads nothing",
    }
)
"""File and what is found there -> why it may be."""


def hits(setting: Setting) -> Outcome:
    """Look through all modules of both packages.

    A trial is a module; it is kept if nothing is found in it that is not allowed.

    :param setting: how; the short form is the whole
    """
    modules = dict(package_modules())
    failures, found, tainted = [], set(), set()
    for name, text in modules.items():
        for line, what, why in hits_in(text):
            if (name, what) in ALLOWED:
                found.add((name, what))
            else:
                failures.append(f"{name}:{line}: {what}: {why}")
                tainted.add(name)
    failures += [
        f"{name}: {what} is allowed, but no longer there"
        for name, what in ALLOWED
        if (name, what) not in found
    ]
    return Outcome(
        len(modules) - len(tainted),
        len(modules),
        f"modules without a hit ({len(found)} places are allowed, each with its reason)",
        tuple(failures),
    )


def package_modules() -> Iterator[tuple[str, str]]:
    """Return path, from its package on, and text of each module of both packages."""
    for package in (sb3_roles, area_search):
        root = Path(str(package.__file__)).parent
        for path in sorted(root.rglob("*.py")):
            yield path.relative_to(root.parent).as_posix(), path.read_text(encoding="utf-8")


def hits_in(text: str) -> list[tuple[int, str, str]]:
    """Return what a module has that may run what a file says: line, name and reason.

    :param text: source code
    """
    return [
        (getattr(node, "lineno", 0), *hit)
        for node in ast.walk(ast.parse(text))
        for hit in _hits_of(node)
    ]


def _hits_of(node: ast.AST) -> Iterator[tuple[str, str]]:
    if isinstance(node, (ast.Import, ast.ImportFrom)):
        yield from _imports(node)
    elif isinstance(node, ast.Call):
        yield from _calls(node)
    elif isinstance(node, ast.keyword):
        for name, wrong in (("weights_only", False), ("allow_pickle", True)):
            if node.arg == name and not _is(node.value, not wrong):
                yield f"{name}={wrong}", "unpickles"
    elif (
        isinstance(node, ast.Attribute) and node.attr in _LOADERS and _named(node.value, ("yaml",))
    ):
        yield f"yaml.{node.attr}", "makes objects of a file; SafeLoader does not"


def _imports(node: ast.Import | ast.ImportFrom) -> Iterator[tuple[str, str]]:
    for alias in node.names:
        known = alias.name in ("numpy", "torch", "yaml", "builtins", *_IMPORTERS)
        if known and alias.asname not in (None, "np", "th"):
            yield f"{alias.name} as {alias.asname}", "hides what this gate looks for"
    names = [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        module = node.module or ""
        if module.partition(".")[0] == "yaml":
            yield from (
                (f"yaml.{one}", "name it where it is used") for one in names if one in _YAML
            )
        for names_of, owner in ((_NUMPY, "numpy"), (_TORCH, "torch")):
            if module in names_of and "load" in names:
                yield f"{owner}.load", "name it where it is used"
        names = [module]
    for name in names:
        top = name.partition(".")[0]
        if top in _PICKLES:
            yield top, "unpickling runs what a file says"


def _calls(node: ast.Call) -> Iterator[tuple[str, str]]:
    function = node.func
    options = {one.arg: one.value for one in node.keywords}
    if isinstance(function, ast.Name):
        if function.id in _BUILTINS:
            yield function.id, "runs text"
        elif function.id in _IMPORTERS and not _constant(node.args):
            yield function.id, "imports what is not written in the source"
    elif isinstance(function, ast.Attribute):
        name, owner = function.attr, function.value
        if name in _IMPORTERS and not _constant(node.args):
            yield name, "imports what is not written in the source"
        elif name in _BUILTINS[:2] and _named(owner, ("builtins",)):
            yield name, "runs text"
        elif name in _YAML and _named(owner, ("yaml",)):
            yield f"yaml.{name}", "makes objects of a file; safe_load does not"
        elif name == "load" and _named(owner, _TORCH):
            if not _is(options.get("weights_only"), True):
                yield "torch.load", "unpickles without weights_only=True"
        elif name == "load" and _named(owner, _NUMPY):
            if not _is(options.get("allow_pickle"), False):
                yield "numpy.load", "says nothing of allow_pickle=False"
        elif name == "read_pickle":
            yield name, "unpickles"


def _constant(arguments: Sequence[ast.expr]) -> bool:
    return bool(arguments) and isinstance(arguments[0], ast.Constant)


def _named(node: ast.expr, names: Sequence[str]) -> bool:
    return isinstance(node, ast.Name) and node.id in names


def _is(node: ast.expr | None, value: bool) -> bool:
    return isinstance(node, ast.Constant) and node.value is value
