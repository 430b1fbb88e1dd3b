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
    out: np.ndarray,
) -> None:
    """R_e and R_c of each robot of one team in one step (Eq. 6).

    :param new_cells: int32 (n_agents,), cells first seen by the robot in this step
    :param new_targets: int32 (n_agents,), targets it covered in this step
    :param roles: int8 (n_agents,), only read with ``same_role``
    :param explore_normalizer: B_e, cells worth a reward of 1
    :param same_role: give each robot the sum over the robots that act in its role
    :param out: float32 (n_agents, 2), overwritten with (explore, cover)
    """
    n_agents = new_cells.shape[0]
    if not same_role:
        for i in range(n_agents):
            out[i, 0] = new_cells[i] / explore_normalizer
            out[i, 1] = new_targets[i]
        return
    # Counts are summed before they are divided: the result does not depend on the robots' order.
    for role in range(roles.max() + 1):
        cells, targets = 0, 0
        for i in range(n_agents):
            if roles[i] == role:
                cells += new_cells[i]
                targets += new_targets[i]
        for i in range(n_agents):
            if roles[i] == role:
                out[i, 0] = cells / explore_normalizer
                out[i, 1] = targets


@njit(cache=True)
def weighted_reward(components: np.ndarray, alpha: float, beta: float, out: np.ndarray) -> None:
    """R = alpha R_e + beta R_c for each robot of one team (Eq. 2).

    :param components: float32 (n_agents, 2)
    :param out: float32 (n_agents,), overwritten
    """
    for i in range(components.shape[0]):
        out[i] = alpha * components[i, 0] + beta * components[i, 1]
