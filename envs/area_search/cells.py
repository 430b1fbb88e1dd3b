"""The layout of a map: one byte per cell, with a border of explored obstacles around it.

The border is as wide as the largest thing that reaches over the map's edge, so that windows,
sensors, moves and path searches need no bounds checks; it reads as "explored obstacle", which is
what the paper's observation shows off the map.
"""

from __future__ import annotations

import numpy as np

# The four low bits are the four channels of the `local` observation, in order.
KNOWN_OBSTACLE = 1
FRONTIER = 2
KNOWN_TARGET = 4
ROBOT = 8
EXPLORED = 16
OBSTACLE = 32
TARGET = 64
COVERED = 128

BORDER = EXPLORED | OBSTACLE | KNOWN_OBSTACLE

LOCAL_CHANNELS = ("obstacle", "frontier", "target", "robot")
JOINT_CHANNELS = ("frontier", "target")
STATE_CHANNELS = ("obstacle", "frontier", "target", "robot", "explored")
KNOWN_CHANNELS = ("free", "obstacle")

# Stop, then the paper's Move-forward, Turn-right, Move-backward, Turn-left as absolute moves.
ACTIONS = ("stop", "up", "right", "down", "left")
MOVE_ROWS = np.array([0, -1, 0, 1, 0], np.int64)
MOVE_COLUMNS = np.array([0, 0, 1, 0, -1], np.int64)
N_ACTIONS = len(ACTIONS)


def border_width(view_radius: int, sensor_radius: float) -> int:
    """Cells of border that make every look over the edge safe."""
    return max(1, view_radius, int(sensor_radius))


def disc_offsets(radius: float) -> np.ndarray:
    """Offsets of the cells whose centers lie within a Euclidean radius, row by row.

    :param radius: radius in cells
    :return: int64 array (n, 2) of (row, column) offsets; 13 of them for radius 2
    """
    reach = int(radius)
    offsets = [
        (dy, dx)
        for dy in range(-reach, reach + 1)
        for dx in range(-reach, reach + 1)
        if dy * dy + dx * dx <= radius * radius
    ]
    return np.array(offsets, np.int64).reshape(-1, 2)


def edge_offsets(disc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Offsets of the cells that come into view with each move: 5 of 13 for radius 2.

    :param disc: int64 (n, 2), see :func:`disc_offsets`
    :return: int64 (5, n, 2), for each action offsets from the new position, and their number,
        int64 (5,)
    """
    within = {(int(dy), int(dx)) for dy, dx in disc}
    edges = np.zeros((N_ACTIONS, *disc.shape), np.int64)
    counts = np.zeros(N_ACTIONS, np.int64)
    for action in range(N_ACTIONS):
        up, left = int(MOVE_ROWS[action]), int(MOVE_COLUMNS[action])
        for dy, dx in sorted(within):
            if (dy + up, dx + left) not in within:
                edges[action, counts[action]] = dy, dx
                counts[action] += 1
    return edges, counts


def window_masks(view_radius: int, communication_radius: float) -> np.ndarray:
    """Per window cell, which channels of ``local`` may be shown there.

    A robot shows its own position and that of team mates it can communicate with (strictly nearer
    than the radius); the other channels come from the team's map and are always shown.

    :return: uint32 array (side * side,), each the four channel bytes, 255 where shown
    """
    side = 2 * view_radius + 1
    masks = np.full((side, side, 4), 255, np.uint8)
    for row in range(side):
        for column in range(side):
            dy, dx = row - view_radius, column - view_radius
            within = dy * dy + dx * dx < communication_radius * communication_radius
            masks[row, column, 3] = 255 if within or (dy == 0 and dx == 0) else 0
    return masks.view(np.uint32).reshape(-1)


def window_table() -> np.ndarray:
    """Four channel bytes, as one uint32, for each value of the four low bits of a cell."""
    table = np.array([[value >> bit & 1 for bit in range(4)] for value in range(16)], np.uint8)
    return table.view(np.uint32).reshape(-1)
