"""Numba kernels that advance a batch of teams by one step and keep its maps up to date.

Serial on purpose: parallel njit kills forked workers (``team_slices`` has threads of Python).
Nothing here allocates. Every map that an observation shows is kept current in place, so a step
costs what changed and not the map's area.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from area_search.cells import (
    COVERED,
    EXPLORED,
    FRONTIER,
    KNOWN_OBSTACLE,
    KNOWN_TARGET,
    MOVE_COLUMNS,
    MOVE_ROWS,
    OBSTACLE,
    ROBOT,
    TARGET,
)
from area_search.generate import generate_episode
from area_search.rewards import reward_components, weighted_reward

# Columns of `totals`: counts of one episode so far.
SEEN = 0  # cells first seen in steps 1..t, obstacles included
SEEN_FREE = 1  # free cells explored, start discs included
COVERED_SCORED = 2  # targets covered in steps 1..t
T90_PAPER = 3  # first step (0-based) with explo_paper > 0.9, or NEVER
T90_TRUE = 4  # first step (0-based) with explo_true >= 0.9, or NEVER
N_TOTALS = 5
NEVER = -1

# Columns of `metrics`.
METRICS = ("explo_paper", "explo_true", "cover")


@njit(cache=True, nogil=True)
def rebuild(
    cells: np.ndarray,
    unseen: np.ndarray,
    joint: np.ndarray,
    state: np.ndarray,
    goals: np.ndarray,
    border: int,
) -> None:
    """Derive everything that follows from one team's cells.

    :param cells: uint8 (height + 2 border, width + 2 border); the frontier bits are rewritten
    :param unseen: uint8, like ``cells``: unexplored cells in each cell's 3 x 3 neighborhood
    :param joint: uint8 (height, width, 2), the merged frontier and target maps
    :param state: uint8 (height, width, 5), see ``STATE_CHANNELS``
    :param goals: int64 (2,), number of frontier cells and of known uncovered targets
    """
    height, width = joint.shape[0], joint.shape[1]
    unseen[:] = 0
    for y in range(border, border + height):
        for x in range(border, border + width):
            if not cells[y, x] & EXPLORED:
                for dy in range(-1, 2):
                    for dx in range(-1, 2):
                        unseen[y + dy, x + dx] += 1
    goals[0], goals[1] = 0, 0
    for y in range(border, border + height):
        for x in range(border, border + width):
            cell = cells[y, x] & ~FRONTIER
            if cell & EXPLORED and not cell & OBSTACLE and unseen[y, x] > 0:
                cell |= FRONTIER
                goals[0] += 1
            if cell & KNOWN_TARGET:
                goals[1] += 1
            cells[y, x] = cell
            row, column = y - border, x - border
            joint[row, column, 0] = state[row, column, 1] = (cell & FRONTIER) > 0
            joint[row, column, 1] = (cell & KNOWN_TARGET) > 0
            state[row, column, 0] = (cell & OBSTACLE) > 0
            state[row, column, 2] = (cell & TARGET) > 0
            state[row, column, 3] = (cell & ROBOT) > 0
            state[row, column, 4] = (cell & EXPLORED) > 0


@njit(cache=True, nogil=True)
def reset_teams(
    which: np.ndarray,
    keys: np.ndarray,
    episodes: np.ndarray,
    n_free: int,
    n_targets: int,
    sigma: float,
    sigma_growth: float,
    border: int,
    disc: np.ndarray,
    cells: np.ndarray,
    unseen: np.ndarray,
    joint: np.ndarray,
    state: np.ndarray,
    goals: np.ndarray,
    position: np.ndarray,
    idle: np.ndarray,
    steps: np.ndarray,
    totals: np.ndarray,
    free_cells: np.ndarray,
) -> None:
    """Start episode ``episodes[m]`` of stream ``keys[m]`` for every team with ``which[m]``.

    Rewards, metrics and end flags of the last step are left alone: they belong to the episode that
    ended.
    """
    for m in range(which.shape[0]):
        if not which[m]:
            continue
        generate_episode(
            keys[m],
            episodes[m],
            n_free,
            n_targets,
            sigma,
            sigma_growth,
            border,
            disc,
            cells[m],
            position[m],
            free_cells,
        )
        rebuild(cells[m], unseen[m], joint[m], state[m], goals[m], border)
        idle[m, :] = 0
        steps[m] = 0
        totals[m, :] = 0
        totals[m, T90_PAPER] = NEVER
        totals[m, T90_TRUE] = NEVER
        for row in range(state.shape[1]):
            for column in range(state.shape[2]):
                if state[m, row, column, 4] and not state[m, row, column, 0]:
                    totals[m, SEEN_FREE] += 1


@njit(cache=True)
def _sense(
    cells: np.ndarray,
    unseen: np.ndarray,
    joint: np.ndarray,
    state: np.ndarray,
    goals: np.ndarray,
    totals: np.ndarray,
    border: int,
    edge: np.ndarray,
    n_edge: int,
    y: int,
    x: int,
    fresh: np.ndarray,
) -> int:
    """Explore what came into view of a robot that moved to (y, x); return how many cells."""
    n_fresh = 0
    for k in range(n_edge):
        yy, xx = y + edge[k, 0], x + edge[k, 1]
        cell = cells[yy, xx]
        if cell & EXPLORED:
            continue
        cell |= EXPLORED
        row, column = yy - border, xx - border
        if cell & OBSTACLE:
            cell |= KNOWN_OBSTACLE
        else:
            totals[SEEN_FREE] += 1
            if cell & TARGET:
                cell |= KNOWN_TARGET
                goals[1] += 1
                joint[row, column, 1] = 1
        cells[yy, xx] = cell
        state[row, column, 4] = 1
        fresh[n_fresh, 0] = yy
        fresh[n_fresh, 1] = xx
        n_fresh += 1
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                unseen[yy + dy, xx + dx] -= 1
    # Only a cell next to a newly seen one can have joined or left the frontier. The border is
    # explored obstacle, so it never does.
    for k in range(n_fresh):
        for yy in range(fresh[k, 0] - 1, fresh[k, 0] + 2):
            for xx in range(fresh[k, 1] - 1, fresh[k, 1] + 2):
                cell = cells[yy, xx]
                if cell & (EXPLORED | OBSTACLE) == EXPLORED:
                    is_frontier = unseen[yy, xx] > 0
                    if is_frontier != ((cell & FRONTIER) > 0):
                        cells[yy, xx] = cell ^ FRONTIER
                        goals[0] += 1 if is_frontier else -1
                        joint[yy - border, xx - border, 0] = is_frontier
                        state[yy - border, xx - border, 1] = is_frontier
    totals[SEEN] += n_fresh
    return n_fresh


@njit(cache=True)
def measure(totals: np.ndarray, n_free: int, n_targets: int, out: np.ndarray) -> None:
    """Write the metrics of one team's episode so far, in the order of ``METRICS``."""
    out[0] = totals[SEEN] / n_free
    out[1] = totals[SEEN_FREE] / n_free
    out[2] = totals[COVERED_SCORED] / n_targets


@njit(cache=True)
def first_invalid(actions: np.ndarray, n_actions: int) -> int:
    """Return the flat index of the first action outside 0..n_actions - 1, or -1."""
    flat = actions.reshape(-1)
    for k in range(flat.shape[0]):
        if flat[k] < 0 or flat[k] >= n_actions:
            return k
    return -1


@njit(cache=True, nogil=True)
def step_teams(
    actions: np.ndarray,
    border: int,
    edges: np.ndarray,
    edge_counts: np.ndarray,
    horizon: int,
    patience: int,
    n_free: int,
    n_targets: int,
    explore_normalizer: float,
    same_role: bool,
    team_share: float,
    alpha: float,
    beta: float,
    roles: np.ndarray,
    cells: np.ndarray,
    unseen: np.ndarray,
    joint: np.ndarray,
    state: np.ndarray,
    goals: np.ndarray,
    position: np.ndarray,
    idle: np.ndarray,
    steps: np.ndarray,
    totals: np.ndarray,
    new_cells: np.ndarray,
    new_targets: np.ndarray,
    components: np.ndarray,
    rewards: np.ndarray,
    metrics: np.ndarray,
    terminated: np.ndarray,
    truncated: np.ndarray,
    fresh: np.ndarray,
) -> None:
    """Move every robot of every team once; sense, cover, reward, measure, and tell who is done.

    Robots move one after the other in index order, may share cells, and stay where a move is
    blocked. A cell or target counts for the first robot that reaches it.

    :param actions: integer (n_teams, n_agents), indices into ``ACTIONS``
    :param edges: int64, see ``cells.edge_offsets``; ``edge_counts`` with it
    :param patience: steps without a new target that end an episode, 0 for never
    :param fresh: int64 scratch (cells of a disc, 2)
    """
    n_teams, n_agents = position.shape[0], position.shape[1]
    for m in range(n_teams):
        board, shown = cells[m], state[m]
        for i in range(n_agents):
            y, x = position[m, i, 0] + border, position[m, i, 1] + border
            if board[y, x] & ROBOT:
                board[y, x] &= ~ROBOT
                shown[y - border, x - border, 3] = 0
        stuck = False
        for i in range(n_agents):
            new_cells[m, i] = 0
            new_targets[m, i] = 0
            action = actions[m, i]
            y = position[m, i, 0] + border + MOVE_ROWS[action]
            x = position[m, i, 1] + border + MOVE_COLUMNS[action]
            # The disc around a robot that has not moved is explored and its cell covered already.
            if action != 0 and not board[y, x] & OBSTACLE:
                position[m, i, 0] = y - border
                position[m, i, 1] = x - border
                new_cells[m, i] = _sense(
                    board,
                    unseen[m],
                    joint[m],
                    shown,
                    goals[m],
                    totals[m],
                    border,
                    edges[action],
                    edge_counts[action],
                    y,
                    x,
                    fresh,
                )
                if board[y, x] & TARGET:
                    board[y, x] = (board[y, x] & ~(TARGET | KNOWN_TARGET)) | COVERED
                    goals[m, 1] -= 1
                    joint[m, y - border, x - border, 1] = 0
                    shown[y - border, x - border, 2] = 0
                    new_targets[m, i] = 1
                    totals[m, COVERED_SCORED] += 1
            idle[m, i] = 0 if new_targets[m, i] else idle[m, i] + 1
            if patience > 0 and idle[m, i] >= patience:
                stuck = True
        for i in range(n_agents):
            row, column = position[m, i, 0], position[m, i, 1]
            board[row + border, column + border] |= ROBOT
            shown[row, column, 3] = 1

        steps[m] += 1
        terminated[m] = stuck
        truncated[m] = steps[m] >= horizon
        measure(totals[m], n_free, n_targets, metrics[m])
        if totals[m, T90_PAPER] == NEVER and metrics[m, 0] > 0.9:
            totals[m, T90_PAPER] = steps[m] - 1
        if totals[m, T90_TRUE] == NEVER and metrics[m, 1] >= 0.9:
            totals[m, T90_TRUE] = steps[m] - 1
        reward_components(
            new_cells[m],
            new_targets[m],
            roles[m],
            explore_normalizer,
            same_role,
            team_share,
            components[m],
        )
        weighted_reward(components[m], alpha, beta, rewards[m])


@njit(cache=True, nogil=True)
def observe_teams(
    which: np.ndarray,
    cells: np.ndarray,
    position: np.ndarray,
    border: int,
    table: np.ndarray,
    masks: np.ndarray,
    local: np.ndarray,
    coordinates: np.ndarray,
) -> None:
    """Write the egocentric windows and the positions of the robots of some teams.

    :param which: bool (n_teams,)
    :param table: uint32 (16,), see ``cells.window_table``
    :param masks: uint32 (side * side,), see ``cells.window_masks``
    :param local: uint32 (n_teams, n_agents, side, side): four channel bytes per cell, overwritten
    :param coordinates: float32 (n_teams, n_agents, 2): row and column, overwritten
    """
    side = local.shape[2]
    reach = side // 2
    for m in range(position.shape[0]):
        if not which[m]:
            continue
        for i in range(position.shape[1]):
            row, column = position[m, i, 0], position[m, i, 1]
            coordinates[m, i, 0] = row
            coordinates[m, i, 1] = column
            top, left = row + border - reach, column + border - reach
            for dy in range(side):
                for dx in range(side):
                    local[m, i, dy, dx] = (
                        table[cells[m, top + dy, left + dx] & 15] & masks[dy * side + dx]
                    )


@njit(cache=True, nogil=True)
def observe_known(which: np.ndarray, cells: np.ndarray, border: int, known: np.ndarray) -> None:
    """Write the team's map of some teams: where cells are known to be free, and to be obstacles.

    :param which: bool (n_teams,)
    :param known: uint8 (n_teams, height, width, 2), see ``cells.KNOWN_CHANNELS``: overwritten
    """
    for m in range(known.shape[0]):
        if not which[m]:
            continue
        for row in range(known.shape[1]):
            for column in range(known.shape[2]):
                cell = cells[m, row + border, column + border]
                known[m, row, column, 0] = (cell & (EXPLORED | OBSTACLE)) == EXPLORED
                known[m, row, column, 1] = (cell & KNOWN_OBSTACLE) > 0
