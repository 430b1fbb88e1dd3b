"""A trained policy from a run folder, ready to act."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_roles.zoo.options import UsageError

if TYPE_CHECKING:
    from sb3_roles.evaluation.policies import PolicyController


@dataclass(frozen=True)
class LoadedRun:
    """A trained policy and how it was trained.

    :param folder: of the run
    :param config: what its ``config.yml`` says
    :param model: an SB3 model or policy
    """

    folder: Path
    config: Mapping[str, Any]
    model: Any

    def controller(
        self, deterministic: bool, communicate: bool, role_control: str | None = None
    ) -> PolicyController:
        """Return the policy as a controller of episodes.

        :param deterministic: see ``PolicyController``
        :param communicate: see ``PolicyController``
        :param role_control: instead of what the run was trained with, see ``RoleWrapper``
        :raises UsageError: if the policy can not be played so
        """
        from sb3_roles.evaluation.policies import PolicyController

        roles = self.config.get("wrapper_kwargs") or {}
        if role_control is not None:
            roles = {**roles, "role_control": role_control}
        try:
            return PolicyController(self.model, roles, deterministic, communicate)
        except ValueError as error:
            raise UsageError(f"{self.folder}: {error}") from error


def load_run(
    folder: Path,
    best: bool = False,
    device: str = "auto",
    env: str | None = None,
    algo: str | None = None,
) -> LoadedRun:
    """Load the policy of a run folder; no code of the folder runs.

    :param folder: the run
    :param best: the best policy of its evaluations instead of the last one
    :param device: where the policy computes
    :param env: the run's environment, which must be given for ``module:factory``
    :param algo: the run's algorithm; may be left out
    :raises UsageError: if it is no run folder, damaged, or of another algorithm or environment
    """
    from sb3_roles.zoo.config import read_run_config
    from sb3_roles.zoo.environments import check_named

    config = read_run_config(folder)
    check_named(folder, config["env"], env)
    if algo is not None and config["algo"] != algo:
        raise UsageError(f"{folder}: its algorithm is {config['algo']}, not {algo}")

    # Torch takes its time to import: not before the folder is known to be a run.
    from sb3_roles.zoo.models import load_model

    return LoadedRun(folder, config, load_model(folder, best, device, env))
