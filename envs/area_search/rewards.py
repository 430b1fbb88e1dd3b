"""Reward components and their weighted sum: pure functions of counts (Eqs. 2 and 6)."""

from __future__ import annotations

import numpy as np
from numba import njit

REWARD_COMPONENTS = ("explore", "cover")
MAX_ROLES = 16


@njit(cache=True)
def reward_components(
    new_cells: np.ndarray,
    new_targets: np.ndarray,
    roles: np.ndarray,
    explore_normalizer: float,
    same_role: bool,
    team_share: float,
    out: np.ndarray,
) -> None:
    """R_e and R_c of each robot of one team in one step (Eq. 6), or shared with its team.

    :param new_cells: int32 (n_agents,), cells first seen by the robot in this step
    :param new_targets: int32 (n_agents,), targets it covered in this step
    :param roles: int8 (n_agents,), only read with ``same_role``
    :param explore_normalizer: B_e, cells worth a reward of 1
    :param same_role: give each robot the sum over the robots that act in its role
    :param team_share: without ``same_role``, the share of the team's mean in each robot's reward
    :param out: float32 (n_agents, 2), overwritten with (explore, cover)
    """
    n_agents = new_cells.shape[0]
    if not same_role:
        mean_cells, mean_targets = new_cells.sum() / n_agents, new_targets.sum() / n_agents
        own = 1.0 - team_share
        for i in range(n_agents):
            cells = own * new_cells[i] + team_share * mean_cells
            out[i, 0] = cells / explore_normalizer
            out[i, 1] = own * new_targets[i] + team_share * mean_targets
        return
    # Counts are summed before they are divided: the result does not depend on the robots' order.
    for role in range(roles.max() + 1):
        role_cells, role_targets = 0, 0
        for i in range(n_agents):
            if roles[i] == role:
                role_cells += new_cells[i]
                role_targets += new_targets[i]
        for i in range(n_agents):
            if roles[i] == role:
                out[i, 0] = role_cells / explore_normalizer
                out[i, 1] = role_targets


@njit(cache=True)
def weighted_reward(components: np.ndarray, alpha: float, beta: float, out: np.ndarray) -> None:
    """R = alpha R_e + beta R_c for each robot of one team (Eq. 2).

    :param components: float32 (n_agents, 2)
    :param out: float32 (n_agents,), overwritten
    """
    for i in range(components.shape[0]):
        out[i] = alpha * components[i, 0] + beta * components[i, 1]
