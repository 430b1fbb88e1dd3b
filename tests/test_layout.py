"""The direction of dependencies, and what importing a package costs."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
# Each package, and what its modules must not import, at the top of a module or inside a function.
FORBIDDEN = {
    "envs/area_search": ("sb3_roles", "torch", "stable_baselines3"),
    "sb3_roles/common": (
        "area_search",
        "sb3_roles.mappo",
        "sb3_roles.hmappo",
        "sb3_roles.gnn",
        "sb3_roles.baselines",
        "sb3_roles.evaluation",
        "sb3_roles.zoo",
    ),
    "sb3_roles/mappo": (
        "area_search",
        "sb3_roles.hmappo",
        "sb3_roles.gnn",
        "sb3_roles.evaluation",
        "sb3_roles.zoo",
    ),
    "sb3_roles/hmappo": ("area_search", "sb3_roles.gnn", "sb3_roles.evaluation", "sb3_roles.zoo"),
    "sb3_roles/gnn": ("sb3_roles.hmappo", "sb3_roles.evaluation", "sb3_roles.zoo"),
    "sb3_roles/testing": (
        "area_search",
        "sb3_roles.mappo",
        "sb3_roles.hmappo",
        "sb3_roles.gnn",
        "sb3_roles.baselines",
        "sb3_roles.evaluation",
        "sb3_roles.prove",
        "sb3_roles.zoo",
    ),
    "sb3_roles/baselines": ("sb3_roles.gnn", "sb3_roles.zoo"),
    "sb3_roles/evaluation": ("sb3_roles.gnn", "sb3_roles.zoo"),
}


def imported(path: Path) -> set[str]:
    """Names of all modules that a file imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module or "")
    return names


@pytest.mark.parametrize("package", FORBIDDEN)
def test_dependencies_go_one_way(package: str) -> None:
    files = sorted((ROOT / package).rglob("*.py"))
    assert files
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in files
        for name in imported(path)
        for other in FORBIDDEN[package]
        if name == other or name.startswith(f"{other}.")
    ]
    assert not wrong


@pytest.mark.parametrize(
    ("statement", "absent"),
    [
        ("import area_search", ("numba", "pettingzoo", "pygame", "torch")),
        ("import area_search.scenes", ("numpy",)),
        ("from area_search import AreaSearchEnv", ("pygame", "torch", "stable_baselines3")),
        ("import sb3_roles", ("torch", "numba", "stable_baselines3")),
        ("import sb3_roles.testing", ("torch", "numpy", "pettingzoo")),
        (
            "from sb3_roles.testing import check_determinism",
            ("torch", "numba", "stable_baselines3", "pettingzoo"),
        ),
    ],
)
def test_importing_brings_nothing_heavy(statement: str, absent: tuple[str, ...]) -> None:
    code = f"{statement}; import sys; print(sorted(set({absent!r}) & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout.strip() == "[]", result.stdout + result.stderr
