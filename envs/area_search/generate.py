"""Numba kernels that make a new episode: map, targets and start cells."""

from __future__ import annotations

import numpy as np
from numba import njit

from area_search.cells import (
    BORDER,
    COVERED,
    EXPLORED,
    KNOWN_OBSTACLE,
    KNOWN_TARGET,
    MOVE_COLUMNS,
    MOVE_ROWS,
    OBSTACLE,
    ROBOT,
    TARGET,
)
from area_search.random_streams import draw, episode_key, normal_pair, to_unit

# The seed cell is free, so a start cell is found sooner or later; the bound keeps an extreme sigma
# from drawing for ever.
MAX_SPAWN_DRAWS = 1000

_ONE = np.uint64(1)
_TWO = np.uint64(2)
_THREE = np.uint64(3)


@njit(cache=True)
def generate_episode(
    key: np.ndarray,
    episode: int,
    n_free: int,
    n_targets: int,
    sigma: float,
    sigma_growth: float,
    border: int,
    disc: np.ndarray,
    cells: np.ndarray,
    position: np.ndarray,
    free_cells: np.ndarray,
) -> None:
    """Write one team's new map, targets, start cells and initial view.

    A 4-neighbor random walk from a random cell carves free cells (a step off the map is redrawn)
    until ``n_free`` are free, so the map is connected. Targets are drawn from the free cells
    without repeats. Each robot starts at round-toward-zero(Normal(seed cell, sigma)), clipped to
    the map, redrawn with a larger sigma while on an obstacle. The start discs are explored and
    the start cells covered; neither is scored.

    :param key: uint64 (2,), the key of the team's stream
    :param episode: number of the episode in that stream
    :param disc: int64 (n, 2), offsets of the sensed cells
    :param cells: uint8 (height + 2 border, width + 2 border), overwritten
    :param position: int32 (n_agents, 2), overwritten
    :param free_cells: int64 scratch of at least ``n_free`` entries
    """
    height = cells.shape[0] - 2 * border
    width = cells.shape[1] - 2 * border
    first, second = key[0], episode_key(key, episode)
    counter = np.uint64(0)

    cells[:] = BORDER
    cells[border : border + height, border : border + width] = OBSTACLE

    seed_row = int(to_unit(draw(first, second, counter)) * height)
    seed_column = int(to_unit(draw(first, second, counter + _ONE)) * width)
    counter += _TWO
    flat = cells.reshape(-1)
    stride = cells.shape[1]
    here = (seed_row + border) * stride + seed_column + border
    flat[here] = 0
    carved = 1
    bits, left = np.uint64(0), 0
    while carved < n_free:
        if left == 0:
            bits = draw(first, second, counter)
            counter += _ONE
            left = 32
        action = 1 + (bits & _THREE)
        bits >>= _TWO
        left -= 1
        there = here + MOVE_ROWS[action] * stride + MOVE_COLUMNS[action]
        if flat[there] & EXPLORED:  # the border
            continue
        here = there
        # No branch on whether the cell was carved before: half of the guesses would be wrong.
        carved += flat[here] // OBSTACLE
        flat[here] = 0

    found = 0
    for y in range(border, border + height):
        for x in range(border, border + width):
            if cells[y, x] == 0:
                free_cells[found] = y * stride + x
                found += 1
    for i in range(n_targets):
        j = i + int(to_unit(draw(first, second, counter)) * (found - i))
        counter += _ONE
        cell = free_cells[j]
        free_cells[j] = free_cells[i]
        flat[cell] = TARGET

    for agent in range(position.shape[0]):
        spread = sigma
        position[agent, 0], position[agent, 1] = seed_row, seed_column
        for _ in range(MAX_SPAWN_DRAWS):
            a, b, counter = normal_pair(first, second, counter)
            row = min(max(int(seed_row + spread * a), 0), height - 1)
            column = min(max(int(seed_column + spread * b), 0), width - 1)
            if not cells[row + border, column + border] & OBSTACLE:
                position[agent, 0], position[agent, 1] = row, column
                break
            spread += sigma_growth

    for agent in range(position.shape[0]):
        y, x = position[agent, 0] + border, position[agent, 1] + border
        if cells[y, x] & TARGET:
            cells[y, x] = COVERED
        cells[y, x] |= ROBOT
        for k in range(disc.shape[0]):
            cells[y + disc[k, 0], x + disc[k, 1]] |= EXPLORED
    for y in range(border, border + height):
        for x in range(border, border + width):
            cell = cells[y, x]
            if cell & EXPLORED:
                if cell & OBSTACLE:
                    cells[y, x] |= KNOWN_OBSTACLE
                elif cell & TARGET:
                    cells[y, x] |= KNOWN_TARGET
