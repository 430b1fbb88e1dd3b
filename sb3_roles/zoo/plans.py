"""The file of a plan, read and checked."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from sb3_roles.zoo.config import ConfigError, config_file, read_yaml
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.row_configs import PLAN, config_of_row

if TYPE_CHECKING:
    from sb3_roles.evaluation.grid.plan import Plan, Row


def read_plan_file(file: Path | None = None) -> Plan:
    """Read a plan, and check the configurations of its learned rows.

    :param file: by default that of the paper's tables
    :raises UsageError: if it is wrong
    """
    from sb3_roles.evaluation.grid.plan import PlanError
    from sb3_roles.evaluation.grid.plan_file import parse_plan

    path = config_file(PLAN) if file is None else file
    content = read_yaml(path)
    try:
        plan = parse_plan(content)
        for row in plan.rows.values():
            if row.learned:
                config_of_row(row)
    except (PlanError, ConfigError) as error:
        raise UsageError(f"{path}: {error}") from None
    return plan


def learned_rows(plan: Plan) -> dict[str, Row]:
    """Return the learned rows of a plan, by name."""
    return {name: row for name, row in plan.rows.items() if row.learned}
